"""What the speed benchmarks time."""
