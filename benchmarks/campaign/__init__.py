"""Jobs over tasks, algorithms and seeds."""
