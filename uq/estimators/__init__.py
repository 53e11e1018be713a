"""Estimates and their errors: moments, indices, and reasons to doubt them."""
