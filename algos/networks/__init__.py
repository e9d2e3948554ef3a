"""Networks and distributions of policies and critics."""
