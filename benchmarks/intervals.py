"""Coverage of what inversions predict: 200 synthetic specimens, from data to intervals that were not measured.

Each specimen is of Demiray's material, its constants a draw of the prior, and is stretched to at most 1.3 with errors
of 5 %; predicted are its stresses at stretches of 1.2 and 1.5, and in shear, as a study with `[predict]` does. Beside
them stand the intervals of the same posteriors by summation over a fine grid: what these hold of so few specimens is
chance, and what the study's hold less than they is its error.
"""

from __future__ import annotations

import sys
import tempfile
import time
import tomllib
from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from mpi4py import MPI

from inverse.criticism.assessment import quantiles
from inverse.methods.infer import Problem
from inverse.methods.invert_few import invert_few
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.random_parameters import Inputs
from workflows.config.study import parse
from workflows.studies import predicted

COUNT, SAMPLES = 200, 256
OUTPUTS = [f"p{i}" for i in range(6)]
MODULE = """
import numpy as np

STRETCH = np.array([1.05, 1.1, 1.15, 1.2, 1.25, 1.3])
FARTHER = np.array([1.2, 1.5])


def stretched(p, stretch):
    mu, b = p[:, ..., None]
    return mu * np.exp(b * (stretch**2 + 2 / stretch - 3)) * (stretch - stretch**-2)


def shear(p, amount):
    return p[0] * amount * np.exp(p[1] * amount**2)


def uniaxial(p, stretch):
    stress = stretched(np.asarray(p), stretch)
    return stress, np.column_stack([stress / p[0], stress * (stretch**2 + 2 / stretch - 3)])


def sheared(p, amount):
    stress = shear(p, amount)
    return stress, np.array([stress / p[0], stress * amount**2])


def measured(p):
    return uniaxial(p, STRETCH)[0]


def slopes(p):
    return uniaxial(p, STRETCH)[1]


def predicted(p):
    return np.append(uniaxial(p, FARTHER)[0], sheared(p, 0.4)[0])


def predicted_slopes(p):
    return np.vstack([uniaxial(p, FARTHER)[1], sheared(p, 0.4)[1]])
"""
GRID = 301  # points in each direction
GOALS = ("stretched to 1.2", "stretched to 1.5", "sheared by 0.4")
STUDY = f"""
[model]
kind = "python"
function = "demiray.measured"
jacobian = "demiray.slopes"
parameters = {{ mu = 1000.0, b = 1.0 }}
outputs = {OUTPUTS}

[parameters]
mu = {{ kind = "log-normal", mean = 1000, std = 500 }}
b = {{ kind = "log-normal", mean = 2, std = 1.5 }}

[predict]
model = {{ function = "demiray.predicted", jacobian = "demiray.predicted_slopes", outputs = {list(GOALS)} }}
samples = 12

[method]
kind = "invert"
samples = SAMPLES
starts = 1
"""


def held(folder: Path, count: int, seed: int, samples: int = SAMPLES) -> tuple[np.ndarray, ...]:
    """Return how far inside 95 % intervals truths lie (count, k, 2), over their widths: negative ones lie outside.

    The last axis has the distances from the lower and to the upper end; after the data, before them, and exactly
    after them.
    """
    (folder / "demiray.py").write_text(MODULE)
    sys.path.insert(0, str(folder))
    blocks = tomllib.loads(STUDY.replace("SAMPLES", str(samples)))
    model: dict = {}
    exec(MODULE, model)
    rng = np.random.default_rng(seed)
    study = parse(blocks | {"data": {"outputs": {"p0": 1.0}, "sigma": {"p0": 1.0}}})
    inputs = study.inputs
    measured = study.spec.build(MPI.COMM_SELF, inputs.names)
    solved = SerialEvaluate(study.predicted.build(MPI.COMM_SELF, predicted.parameters(study)))
    before = predicted.prior_band(study, solved)
    points = inputs.random(seed, 0, count)
    found, exact = [], []
    for point in points:
        clean = model["measured"](point)
        sigma = 0.05 * clean
        data = clean + sigma * rng.standard_normal(clean.size)
        exact.append(exactly(inputs, model, data, sigma))
        given = {
            kind: dict(zip(OUTPUTS, map(float, x), strict=True)) for kind, x in (("outputs", data), ("sigma", sigma))
        }
        one = parse(blocks | {"data": given})
        inverted = invert_few(
            inputs, SerialEvaluate(measured), Problem(one.measurements[0], one.method, finer=None)
        ).dataset
        record = predicted.of_few(one, inverted, solved, solved, lambda: before)
        found.append([record["prediction_lower"], record["prediction_upper"]])
    truth = np.array([model["predicted"](point) for point in points])
    ends = [np.array(found), np.broadcast_to([before.lower, before.upper], np.shape(found)), np.array(exact)]
    widths = [float(np.median(one[:, 1] - one[:, 0])) for one in ends]
    print(
        "median width of intervals, all outputs: {:.4g} Pa after, {:.4g} Pa before, {:.4g} Pa exactly".format(*widths)
    )
    return tuple(
        np.stack([truth - low, up - truth], axis=2) / (up - low)[:, :, None]
        for low, up in (np.moveaxis(one, 1, 0) for one in ends)
    )


def exactly(inputs: Inputs, model: dict, data: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Return the ends (2, k) of 95 % intervals by a sum over a grid, first wide and then where the posterior is."""
    lower, upper = np.full(2, -6.0), np.full(2, 6.0)
    for _ in range(3):
        axes = [np.linspace(a, b, GRID) for a, b in zip(lower, upper, strict=True)]
        x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        at = inputs.from_normals(x)[0].T
        gaps = (model["stretched"](at, model["STRETCH"]) - data) / sigma
        logs = -(gaps**2).sum(axis=1) / 2 - (x**2).sum(axis=1) / 2
        some = logs > logs.max() - 18
        steps = (upper - lower) / (GRID - 1)
        lower, upper = x[some].min(axis=0) - 2 * steps, x[some].max(axis=0) + 2 * steps
    weights = np.exp(logs - logs.max())
    goals = np.column_stack([model["stretched"](at, model["FARTHER"]), model["shear"](at, 0.4)])
    return np.array([quantiles(column, weights / weights.sum(), (0.025, 0.975)) for column in goals.T]).T


def main(words: Sequence[str] = ()) -> None:
    """Print the coverage of 95 % intervals."""
    parser = ArgumentParser(prog="intervals")
    parser.add_argument("--count", type=int, default=COUNT, help="specimens")
    parser.add_argument("--samples", type=int, default=SAMPLES, help="points of each posterior")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args(words)
    begin = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        after, before, exact = held(Path(folder), asked.count, asked.seed, asked.samples)
    error = 100 * np.sqrt(0.95 * 0.05 / asked.count)
    print(
        f"| 95 % interval, {asked.samples} points | holds (± {error:.1f} %) | truth below, above | exactly | before |"
    )
    print("|---|---|---|---|---|")
    for k, goal in enumerate(GOALS):
        inside, prior, best = (100 * (one[:, k] > 0).all(axis=1).mean() for one in (after, before, exact))
        low, high = (int((after[:, k, end] < 0).sum()) for end in (0, 1))
        print(f"| {goal} | {inside:.1f} % | {low}, {high} | {best:.1f} % | {prior:.1f} % |", flush=True)
    print(f"{asked.count} specimens, {time.process_time() - begin:.0f} s of CPU")
