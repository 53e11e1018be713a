"""Estimates and their errors: moments, indices, and what speaks against them."""
