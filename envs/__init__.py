"""Room: envs."""
