"""Forward models of soft-tissue bodies: specifications without FEniCSx, and finite elements with it."""

from forward import catalogue as catalogue  # words of findings, wherever one is made
