"""Further unknowns of a posterior: what first order misses of them, by a grid."""

from dataclasses import replace

import numpy as np
import pytest

from forward.pointwise import FunctionModel
from inverse.data.noise import Noise
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior, missed, widened
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Normal
from uq.inputs.random_parameters import Inputs

ROWS = np.array([1.0, 0.7, -0.4])
INPUTS = Inputs({"a": Normal(mean=1.0, std=0.6)})
NOISE = Noise(np.full(3, 0.2))


def model(names, by):
    """A model that is linear in a, and bent in b."""

    def values(p):
        return ROWS * p[0] * np.exp(by * p[1])

    def slopes(p):
        return np.column_stack([ROWS * np.exp(by * p[1]), by * values(p)])[:, : len(names)]

    return SerialEvaluate(
        FunctionModel(
            lambda p: values([*p, 0.0][:2]), tuple(names), ("u", "v", "w"), lambda p: slopes(np.array([*p, 0.0][:2]))
        )
    )


@pytest.mark.parametrize("by", [0.1, 0.3])
@pytest.mark.parametrize("data", [[1.4, 0.8, -0.3], [2.4, 1.6, -0.9], [0.5, 0.4, -0.3]])
def test_three_points_tell_what_first_order_misses(by, data):
    """Of the mean and the deviation, when the further unknown bends the posterior: against sums over a grid."""
    first, mode = Posterior(INPUTS, model(("a",), by), np.array(data), NOISE), np.zeros(1)
    for _ in range(5):
        a = first.physical(mode[None])[0]
        first = replace(first, noise=replace(NOISE, uncertain=by * ROWS[None] * a))
        mode = laplace(first, starts=1).mode
    gaussian, at = laplace(first, starts=1), first.at(mode[None])
    likely = -first.noise.pull @ first.residuals(at.outputs, mode[None])[0]
    plain = replace(first, noise=NOISE)
    wider = widened(plain, mode, ("b",), likely, lambda names: model(names, by))
    assert (wider.own, wider.new) == ([0], [1])
    x = np.stack(np.meshgrid(*2 * [np.linspace(-6, 6, 61)], indexing="ij"), axis=-1).reshape(-1, 2)
    logs = wider.posterior.at(x).log_posterior
    weights = np.exp(logs - logs.max()) / np.exp(logs - logs.max()).sum()
    mean = weights @ x[:, 0]
    std = np.sqrt(weights @ (x[:, 0] - mean) ** 2)
    covariance = np.linalg.inv(gaussian.hessian)
    moved, widths = missed(wider, covariance)
    assert moved[0] == pytest.approx((mean - mode[0]) / std, abs=0.05)
    assert widths[0] == pytest.approx(np.log(std / covariance[0, 0] ** 0.5), abs=0.05)
