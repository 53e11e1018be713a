"""Posteriors of one or two unknowns that are skewed, at a bound, or have a long tail, against quadrature.

What is printed is compared with quadrature over the prior: deviations, and the probability beyond the printed ends of
95 %. Twelve sets of noise each, with what a study takes by default; beside them what the weighted points alone say.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from forward.model import FloatArray
from forward.pointwise import FunctionModel
from inverse.criticism.assessment import Assessment, answer
from inverse.criticism.verdict import verdict_on_few
from inverse.data.noise import Noise
from inverse.low_dimensional.evidence import evidence
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.methods.invert import Invert
from tests.problems import examine_few
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Distribution, LogNormal, Normal, Uniform
from uq.inputs.random_parameters import Inputs

SEEDS = 12
CELLS = {1: 200_001, 2: 1501}  # of the quadrature along each unknown
LEVELS = (0.025, 0.975)
STEP = 1e-6  # of differences, which give derivatives
Map = Callable[[FloatArray], FloatArray]


class Case(NamedTuple):
    """Outputs (m, …) of parameters (d, …), the priors, data (m,), and their error."""

    outputs: Callable[[FloatArray], list[FloatArray]]
    priors: Mapping[str, Distribution]
    data: tuple[float, ...]
    sigma: float


def unit(**names: float) -> dict[str, Distribution]:
    """Uniform priors from zero to these ends."""
    return {name: Uniform(lower=0, upper=end) for name, end in names.items()}


WIDE = LogNormal(mean=3, std=3)
CASES = {
    "at a bound": Case(lambda p: [p[0]], unit(a=1), (0.02,), 0.05),
    "little data, bounds": Case(lambda p: [p[0]], unit(a=1), (0.3,), 0.3),
    "in a corner": Case(lambda p: [p[0] + p[1], p[0] - p[1]], unit(a=1, b=1), (0.1, 0.0), 0.1),
    "compliance, uniform": Case(lambda p: [1 / p[0]], {"a": Uniform(lower=1, upper=200)}, (0.05,), 0.02),
    "compliance, log-normal": Case(lambda p: [1 / p[0]], {"a": LogNormal(mean=20, std=40)}, (0.05,), 0.02),
    "saturating": Case(lambda p: [p[0] / (1 + p[0])], unit(a=50), (0.9,), 0.05),
    "product": Case(lambda p: [p[0] * p[1]], unit(a=10, b=10), (10.0,), 1.0),
    "product and factor": Case(lambda p: [p[0] * p[1], p[0]], {"a": WIDE, "b": WIDE}, (10.0, 3.0), 1.0),
    "contrast": Case(
        lambda p: [p[1] / (1 + 0.3 / p[0]), p[1]],
        {"a": Uniform(lower=1, upper=50), "b": Uniform(lower=0.5, upper=2)},
        (0.94, 1.0),
        0.03,
    ),
    "logarithm": Case(lambda p: [np.log1p(p[0])], {"a": LogNormal(mean=1, std=3)}, (1.0,), 0.6),
    "bent": Case(
        lambda p: [np.exp(p[0]) + 0.3 * p[1]], {"a": Normal(mean=0, std=1), "b": Normal(mean=0, std=1)}, (1.0,), 0.5
    ),
}


def posed(case: Case, seed: int) -> tuple[Posterior, FloatArray, FloatArray]:
    """Return a posterior, and points (n, d) of the prior with their weights (n,) in it."""

    def values(p: FloatArray) -> FloatArray:
        return np.array(case.outputs(p))

    def slopes(p: FloatArray) -> FloatArray:
        steps = STEP * np.maximum(np.abs(p), 1e-3)
        ends = [(values(p + e) - values(p - e)) / (2 * e.sum()) for e in np.diag(steps)]
        return np.array(ends).T

    data = np.array(case.data)
    if seed:
        data = data + case.sigma * np.random.default_rng(seed).normal(size=len(data))
    inputs, d = Inputs(case.priors), len(case.priors)
    model = FunctionModel(values, tuple(case.priors), tuple(f"y{k}" for k in range(len(data))), slopes)
    middles = (np.arange(CELLS[d]) + 0.5) / CELLS[d]
    points = inputs.points(np.stack(np.meshgrid(*[middles] * d, indexing="ij"), axis=-1).reshape(-1, d))
    log = -(((values(points.T).T - data) / case.sigma) ** 2).sum(axis=1) / 2
    weights = np.exp(log - log.max())
    return Posterior(inputs, SerialEvaluate(model), data, Noise(np.full(len(data), case.sigma))), points, weights


def main() -> None:
    """Print a row for each problem."""
    print("| problem | not trusted | printed: width off by | beyond an end | by points alone: width | beyond an end |")
    print("|---|---|---|---|---|---|")
    for name, case in CASES.items():
        refused, found = 0, list[FloatArray]()
        for seed in range(SEEDS):
            posterior, points, weights = posed(case, seed)
            weights /= weights.sum()
            std = np.sqrt(weights @ (points - weights @ points) ** 2)
            gaussian = laplace(posterior)
            one = evidence(posterior, gaussian, Invert().solves(len(std), field=False), seed=seed)
            if verdict_on_few(gaussian, one, examine_few(posterior, gaussian)).trust == "neither":
                refused += 1
                continue
            rows = []
            for way in (one, replace(one, many=None)):
                known = answer(posterior, Assessment(gaussian, way))
                below = np.array([weights @ (points <= end) for end in known.quantiles(LEVELS).T])
                outside = np.concatenate([below[0], 1 - below[1]])
                rows += [np.abs(known.std / std - 1).max(), outside.min(), outside.max()]
            found.append(np.array(rows))
        if not found:
            print(f"| {name} | {refused} of {SEEDS} | | | | |", flush=True)
            continue
        rows = np.array(found)
        told = [
            f"{100 * rows[:, k].max():.0f} % | {100 * rows[:, k + 1].min():.1f}–{100 * rows[:, k + 2].max():.1f} %"
            for k in (0, 3)
        ]
        print(f"| {name} | {refused} of {SEEDS} | {' | '.join(told)} |", flush=True)
