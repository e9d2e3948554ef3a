"""Scripted drivers: policies without learning."""
