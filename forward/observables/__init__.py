"""Outputs: what is computed from a deformed body, one file each."""
