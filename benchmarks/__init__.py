"""Measurements of speed and accuracy; each prints a table and the command that made it."""
