"""Surrogates of a model: polynomial expansions, regressions, Taylor polynomials."""
