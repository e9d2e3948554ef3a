"""How many episodes of the twin run in one process: memory, threads, batches."""
