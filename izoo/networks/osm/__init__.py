"""Intersections from OpenStreetMap extracts."""
