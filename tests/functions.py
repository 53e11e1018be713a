"""Functions that are models, good and bad."""

import numpy as np

from configs.own_model import beam, slopes

__all__ = ["beam", "slopes"]


def product(p):
    return p[0] * p[1] * p[2]


def brittle(p):
    if p[1] > 1:
        message = "the beam broke"
        raise RuntimeError(message)
    return beam(p)


def cube(p):
    return p[0] ** 3


def short(p):
    return p[:1]


def flat(p):
    return np.zeros((2, 2))


NUMBER = 3.0


def higher_moments(marginal):
    """Third and fourth central moments of a distribution, from the recurrence or the rule of its polynomials."""
    if marginal.closed:
        # Of the standardised variable they are α_1 and 1 + α_1² + β_2: entries of powers of the Jacobi matrix.
        alpha, beta = marginal.recurrence(2)
        std = marginal.moments[1]
        return float(alpha[1] * std**3), float((1 + alpha[1] ** 2 + beta[2]) * std**4)
    _, offsets, weights = marginal.rule
    deviations = offsets - weights @ offsets
    return float(weights @ deviations**3), float(weights @ deviations**4)
