"""Protocols that compare algorithms, and measurements of speed."""
