"""Further unknowns of a posterior: what first order misses of them, by a grid."""

import numpy as np
import pytest

from forward.pointwise import FunctionModel
from inverse.data.noise import Noise
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.low_dimensional.wider import missed, widened
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Normal
from uq.inputs.random_parameters import Inputs

ROWS, BY = np.array([1.0, 0.7, -0.4]), 0.15
INPUTS = Inputs({"a": Normal(mean=1.0, std=0.6)})
NOISE = Noise(np.full(3, 0.2))


def model(names):
    """A model that is linear in a, and bent in b."""

    def values(p):
        return ROWS * p[0] * np.exp(BY * p[1]) + 0.1 * p[1] ** 2

    def slopes(p):
        return np.column_stack([ROWS * np.exp(BY * p[1]), BY * ROWS * p[0] * np.exp(BY * p[1]) + 0.2 * p[1]])

    return SerialEvaluate(FunctionModel(values, tuple(names), ("u", "v", "w"), slopes))


def test_third_derivatives_tell_how_far_the_mean_is_from_the_mode():
    """Of a posterior that only the further unknown bends: against sums over a grid."""
    data = ROWS * 1.3 + [0.1, -0.1, 0.2]
    narrow = SerialEvaluate(FunctionModel(lambda p: ROWS * p[0], ("a",), ("u", "v", "w"), lambda p: ROWS[:, None]))
    wider = widened(Posterior(INPUTS, narrow, data, NOISE), np.zeros(1), ("b",), np.zeros(1), model)
    found = laplace(wider.posterior, starts=1)
    wider = wider._replace(first=found.mode)
    x = np.stack(np.meshgrid(*2 * [np.linspace(-6, 6, 61)], indexing="ij"), axis=-1).reshape(-1, 2)
    logs = wider.posterior.at(x).log_posterior
    weights = np.exp(logs - logs.max())
    mean = weights @ x / weights.sum()
    std = np.sqrt(weights @ (x[:, 0] - mean[0]) ** 2 / weights.sum())
    far = (mean[0] - found.mode[0]) / std
    assert abs(far) > 0.05
    assert missed(wider)[0] == pytest.approx(far, rel=0.25)
    assert (wider.own, wider.new) == ([0], [1])
