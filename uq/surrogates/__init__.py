"""Functions that stand for a model: expansions in polynomials, regressions, Taylor's."""
