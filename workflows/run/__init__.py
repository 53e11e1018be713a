"""A run: its plan, its ranks, its progress, its end."""
