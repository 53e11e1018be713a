"""Uncertainty quantification of forward models: random inputs, evaluation, estimators. No FEniCSx in here."""
