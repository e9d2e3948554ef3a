"""The ten built-in cities, rebuilt from published statistics."""
