"""Measurements: every figure of the README comes from here."""
