"""What the twin reads of a net before an episode: lanes, links, conflicts, routes."""
