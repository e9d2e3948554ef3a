"""Room: conf."""
