"""Lane changing on the twin: LC2013, as SUMO's documentation and its outputs show it."""
