"""Outputs: what is computed from a deformed body."""
