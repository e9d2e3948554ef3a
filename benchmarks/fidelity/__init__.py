"""How far the twin is from SUMO."""
