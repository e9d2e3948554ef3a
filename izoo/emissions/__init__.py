"""Room: emissions."""
