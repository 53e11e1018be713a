"""Bayesian inversion and model selection."""

from inverse import catalogue as catalogue  # words of findings, wherever one is made
