"""Intersections as nets: built, imported, given signals, and read as arrays."""
