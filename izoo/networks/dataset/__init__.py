"""Import of the published dataset."""
