"""Room: traffic."""
