"""Fixed-time signal plans where none is given: a search for the least delay."""
