"""The twin's tables of a net: lanes, links, conflicts, routes."""
