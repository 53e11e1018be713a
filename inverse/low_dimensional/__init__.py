"""Posteriors and evidences of few parameters."""
