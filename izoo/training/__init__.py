"""Runs: folders, checkpoints, logs, collection and the training loop that every algorithm shares."""
