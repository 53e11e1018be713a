"""Posteriors of fields of thousands of values."""
