"""Room: algos."""
