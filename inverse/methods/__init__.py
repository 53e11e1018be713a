"""Inversion and selection as methods of a study."""
