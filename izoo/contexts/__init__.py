"""Room: contexts."""
