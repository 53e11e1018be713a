"""Errors of a linear model that are learnt from pairs of solves: whether intervals hold, and what evidences become."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI

from forward.model import WORK, FloatArray, SolveError
from forward.specimen import Specimen
from inverse.criticism.assessment import answer
from inverse.data.measurements import Measurements
from inverse.data.noise import ModelError, Noise
from inverse.low_dimensional.posterior import Posterior
from inverse.methods.infer import Problem, infer
from inverse.methods.invert import Invert
from inverse.methods.model_error import Truth
from inverse.methods.stand_ins import shared_expansion
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Evaluations, Failure, Request
from uq.inputs.distributions import LogNormal, Uniform
from uq.inputs.random_parameters import Inputs

INPUTS = Inputs(
    {
        "material.C1": LogNormal(mean=300, std=90),
        "material.D1": LogNormal(mean=2000, std=800),
        "inclusions.lump.contrast": LogNormal(mean=3, std=1.5),
        "inclusions.lump.x": Uniform(lower=0.015, upper=0.035),
    }
)
PLACES = [(0.048, y, z) for y in (0.01, 0.03) for z in (0.02, 0.035, 0.047)] + [
    (0.02, 0.045, 0.03),
    (0.04, 0.02, 0.045),
]
PAIRS = (8, 16, 32)
ENDS = (0.025, 0.975)


def specimen(strains: str) -> Specimen:
    """Return a lump in a cube that is sheared and pulled until it is up to half as long again."""
    lump = {"name": "lump", "x": 0.025, "y": 0.025, "z": 0.03, "radius": 0.014, "contrast": 3, "width": 8e-3}

    def case(name: str, direction: list[int], size: float) -> dict[str, Any]:
        pull = {"kind": "traction", "name": name, "on": "z-max", "direction": direction, "size": size}
        return {"name": f"by-{name}", "clamp": ["z-min"], "loads": [pull]}

    return Specimen.model_validate(
        {
            "strains": strains,
            "body": {"kind": "box", "size": [0.05] * 3, "cells": [3] * 3, "cell": "hexahedron", "degree": 2},
            "material": {"kind": "mooney-rivlin", "C1": 300, "C2": 200, "D1": 2000},
            "inclusions": [lump],
            "cases": [case("shear", [1, 0, 0], 150), case("traction", [0, 0, 1], 300)],
        }
    )


@dataclass(frozen=True)
class AtOnce(SerialEvaluate):
    """An expansion in place of a model, at all points at once."""

    def __call__(self, request: Request) -> Evaluations:
        """Evaluate it; beyond its range there is no answer."""
        model: Any = self.model
        one, points = model.function.__self__, request.points
        at, n = one.basis.coordinates.of(points), len(points)
        ok = ((at >= one.lower) & (at <= one.upper)).all(axis=1)
        tangents = None
        if request.tangents:
            along = np.swapaxes(one.basis.derivatives(points) @ one.coefficients, 1, 2)
            tangents = along / one.basis.coordinates.steps(points)[:, None]
        values = np.where(ok[:, None], one.basis.values(points) @ one.coefficients, np.nan)
        lost = tuple(Failure(int(i), tuple(points[i].tolist()), "beyond") for i in np.flatnonzero(~ok))
        work = np.zeros((n, len(WORK)), dtype=np.int64)
        steady = np.full(n, 1e-4), work, np.zeros(n), ok, np.zeros(n, dtype=np.int8)
        return Evaluations(points, values, tangents, lost, *steady, np.zeros((0, 0)))


def expanded(strains: str, solves: int) -> AtOnce:
    """Solve a model over the priors, and take its expansion for it: a data set then takes seconds."""
    begin, rows = time.process_time(), 3 * len(PLACES)
    places, axes = np.array(PLACES * 2).repeat(3, axis=0), np.tile([0, 1, 2], 2 * len(PLACES))
    model = specimen(strains).build(MPI.COMM_SELF, INPUTS.names)
    seen = model.observing(places, axes, np.repeat([0, 1], rows), np.tile(np.eye(3), (2 * len(PLACES), 1)))
    found = shared_expansion(INPUTS, SerialEvaluate(seen), None, solves)
    each = (time.process_time() - begin) / solves
    print(f"{strains} strains: {each:.2g} s a solve with tangents; the expansion is off by {found.error.max():.1e} m")
    return AtOnce(found.model)


def inverted(own: AtOnce, truth: Truth | None, data: FloatArray, sigma: FloatArray, seed: int) -> Any:
    """Invert data for the four unknowns."""
    posterior = Posterior(INPUTS, own, data, Noise(sigma))
    given = Measurements.of(data, sigma, [0] * len(data), range(len(data)))
    method = Invert(samples=256, starts=2, seed=seed)
    return infer(posterior, Problem(given, method, finer=None, start=lambda point: None, truth=truth))


# Of linear models with Gaussian errors: data, unknowns, patterns of the errors, size of the first over the noise, what
# part of it each has of the one before, and pairs.
CLOSED = ((48, 4, 3, 1.0, 1.0, 8), (48, 4, 20, 2.0, 0.6, 8), (48, 4, 48, 0.3, 1.0, 16), (48, 4, 48, 0.3, 1.0, 32))


def closed(trials: int) -> None:
    """Print how often 95 % intervals hold of linear models, whose posteriors are known."""
    print("| data, patterns, size, pairs | without % | learnt % | known % |\n|---|---|---|---|")
    for m, d, patterns, size, part, pairs in CLOSED:
        rng, held = np.random.default_rng(0), np.zeros(3)
        A, root = rng.standard_normal((m, d)), rng.standard_normal((m, patterns)) * size * part ** np.arange(patterns)
        for _ in range(trials):
            truth, *errors = rng.standard_normal((2 + pairs, max(d, patterns)))
            drawn = np.array(errors)[:, :patterns] @ root.T
            data = A @ truth[:d] + drawn[0] + rng.standard_normal(m)
            found = ModelError.of_pairs(drawn[1:], np.ones(m))
            learnt = found.root.T @ found.root + np.diag(found.apart**2)
            ways = ((0.0, np.zeros((m, m))), (found.error, learnt), (0.0, root @ root.T))
            for k, (mean, covariance) in enumerate(ways):
                weighted = np.linalg.solve(np.eye(m) + covariance, A).T
                spread = np.linalg.inv(np.eye(d) + weighted @ A)
                off = np.abs(spread @ (weighted @ (data - mean)) - truth[:d])
                held[k] += (off < 1.96 * np.sqrt(np.diag(spread))).mean() / trials
        shares = " | ".join(f"{100 * share:.1f}" for share in held)
        print(f"| {m}, {patterns}, {size * part ** (patterns - 1):.2g} to {size:g}, {pairs} | {shares} |", flush=True)


def main(words: Sequence[str] = ()) -> None:
    """Print how often 95 % intervals hold, of truths drawn from the prior, and what stands beside them.

    By the truth itself, by the linear model, and by the linear model with errors from pairs of solves, so many over the
    prior and as many over the posterior.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks learnt_errors")
    parser.add_argument("--sets", type=int, default=300, help="data sets")
    parser.add_argument("--solves", type=int, default=150, help="of each expansion")
    parser.add_argument("--noise", type=float, nargs="*", default=[0.2, 0.05], help="over the size of the data")
    parser.add_argument("--trials", type=int, default=1000, help="of linear models in closed form")
    given = parser.parse_args(words)
    closed(given.trials)
    if not given.sets:
        return
    true, linear = expanded("finite", given.solves), expanded("small", given.solves)
    usual = true(Request(INPUTS.drawn(np.random.default_rng(1), 200))).outputs
    size = float(np.sqrt(np.nanmean(usual**2)))
    ways: dict[str, tuple[AtOnce, int]] = {"the truth": (true, 0), "linear": (linear, 0)}
    ways |= {f"linear, {pairs} pairs": (linear, pairs) for pairs in PAIRS}
    names = [name.rsplit(".", 1)[-1] for name in INPUTS.names]
    head = f"| model | {' | '.join(f'{name} %' for name in names)} | widths | effective | ln Z | left out |"
    for share in given.noise:
        print(f"\nnoise of {100 * share:g} % of {1e3 * size:.2g} mm, {given.sets} data sets\n")
        print(f"{head}\n|{'---|' * (head.count('|') - 1)}")
        for label, way in ways.items():
            rows = list(filter(None, (_one(*way, true, share * size, seed) for seed in range(given.sets))))
            held, widths, effective, evidence = map(np.array, zip(*rows, strict=True))
            shares = " | ".join(f"{100 * one:.1f}" for one in held.mean(axis=0))
            narrow = ", ".join(f"{one:.2f}" for one in np.median(widths, axis=0))
            told = f"{narrow} | {np.median(effective):.0f} | {np.mean(evidence):.1f} | {given.sets - len(rows)}"
            print(f"| {label} | {shares} | {told} |", flush=True)


def _one(own: AtOnce, pairs: int, true: AtOnce, sigma: float, seed: int) -> tuple[Any, ...] | None:
    """Return which intervals hold (d,), widths over those of the prior (d,), effective points and ln Z."""
    rng = np.random.default_rng(seed)
    truth = INPUTS.drawn(rng, 1)
    right = true(Request(truth)).outputs[0]
    data = right + sigma * rng.standard_normal(len(right))
    learnt = Truth(true, pairs, seed) if pairs else None
    try:
        one = inverted(own, learnt, data, np.full(len(data), sigma), seed)
    except (SolveError, np.linalg.LinAlgError):
        return None
    low, high = answer(one.posterior, one.assessment).quantiles(ENDS).T
    evidence = one.assessment.evidence
    return (
        (low <= truth[0]) & (truth[0] <= high),
        (high - low) / (3.92 * INPUTS.std),
        evidence.ess,
        evidence.log_evidence,
    )
