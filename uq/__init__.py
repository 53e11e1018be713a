"""Uncertainty quantification of forward models: random inputs, evaluation, estimators. No FEniCSx in here."""

from uq import catalogue as catalogue  # words of findings, wherever one is made
