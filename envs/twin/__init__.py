"""The twin: a compiled microsimulator that drives vehicles as SUMO does."""
