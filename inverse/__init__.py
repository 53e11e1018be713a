"""Bayesian inversion and model selection."""
