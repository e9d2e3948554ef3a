"""What ``python -m izoo.X`` does."""
