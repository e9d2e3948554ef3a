"""SUMO nets from intersections: plain XML, ``netconvert``, heights, and their cache."""
