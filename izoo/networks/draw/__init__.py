"""Pictures of intersections and of the features of a set of them."""
