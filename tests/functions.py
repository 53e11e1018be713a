"""Functions that are models, good and bad."""

from dataclasses import dataclass

import numpy as np

from configs.own_model import beam, slopes
from forward.model import WORK
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Evaluations

__all__ = ["beam", "slopes"]


@dataclass(frozen=True)
class AtOnce(SerialEvaluate):
    """Values at all points by one call of a function of (d, n), as one at a time takes longer than what is done next.

    Where derivatives are asked for they are taken point by point.
    """

    def __call__(self, request):
        if request.tangents or request.mesh_errors or self.kept is not None:
            return super().__call__(request)
        n = len(request.points)
        values = np.array(self.model.function(request.points.T), dtype=float).reshape(-1, n).T
        ok = np.isfinite(values).all(axis=1)
        steady = np.full(n, 1e-4), np.zeros((n, len(WORK)), dtype=np.int64), np.zeros(n), ok
        return Evaluations(request.points, values, None, (), *steady, np.zeros(n, dtype=np.int8), np.zeros((0, 0)))


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
