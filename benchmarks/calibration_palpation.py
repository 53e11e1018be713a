"""Calibration of palpation, with data of another mesh: which intervals hold the truth.

Lumps below the surface of the block of `configs/palpation.toml` are drawn from the prior. Their forces are those of the
mesh of `configs/synthesize-palpation.toml`, with errors of 3 %. A few are inverted as the shipped study is, with its
solves on finer meshes; of many it is computed how often intervals of the posterior that is linear at the truth hold it,
over all noise, with a correction for the mesh that an expansion of a few solves on finer meshes gives. What is made and
found is kept in results/meshes-palpation-*, so that a run that is stopped goes on where it was.
"""

from __future__ import annotations

import pickle
import sys
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI

from benchmarks.beams import CONFIG
from benchmarks.meshes import FOLDER, Case, Known, expect, invert, known
from forward.fem.finer import extrapolated
from forward.model import FloatArray, Guess, SolveError
from inverse.criticism.finer import Finer
from inverse.methods.invert import Invert
from inverse.methods.stand_ins import expanded_finer
from uq.evaluation.block import merge
from uq.evaluation.evaluate import OfEvaluate, SerialEvaluate
from uq.evaluation.request import Evaluate, Evaluations, Request
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import random_points
from workflows.config.study import load
from workflows.studies.inversion import Inversion

OWN, OTHER = (CONFIG.parent / f"{name}.toml" for name in ("palpation", "synthesize-palpation"))
NOISE, SEED, FEW = 0.03, 23, 16
INVERT = Invert(samples=32, starts=1)
MADE = FOLDER / "meshes-palpation.npz"


class Made(NamedTuple):
    """Truths (n, d) of which there are data, and these (n, m) without noise."""

    truths: FloatArray
    data: FloatArray


def main(specimens: int = 100, inverted: int = 3) -> None:
    """Print how often intervals hold the truth: counted in inversions, and expected of linear posteriors."""
    study = load(OWN)
    assert isinstance(study, Inversion)
    inputs = study.inputs
    model: Any = study.specimen.build(MPI.COMM_SELF, inputs.names)
    finer = extrapolated(model, inputs.mean).of(model)
    truths = inputs.points(random_points(SEED, 0, 2 * specimens, len(inputs.names)))
    made = _made(inputs, truths, specimens)

    def own(point: FloatArray) -> tuple[FloatArray, FloatArray]:
        solution = model.solve(point)
        return np.array(solution.outputs), solution.tangent(np.eye(len(point))).T

    points = inputs.points(random_points(SEED, 1, FEW, len(inputs.names)))
    there, missed = expanded_finer(inputs, Kept(finer, inputs), points, own)
    smooth, at, data = Case(inputs, model, there), list[Known](), list[FloatArray]()
    for truth, clean in zip(*made, strict=True):
        with suppress(SolveError):  # beyond the points of the expansion
            at.append(known(smooth, truth))
            data.append(clean)
    expect(smooth, at, np.array(data), (NOISE,))
    off = np.sqrt(np.mean((missed / (NOISE * np.sqrt((made.data**2).mean(axis=0)))) ** 2))
    sys.stdout.write(
        f"\n{len(at)} of {len(made.truths)} truths; the expansion of the error of the mesh misses {off:.2g} of the "
        "noise (root mean square).\n"
    )
    if inverted:
        case = Case(inputs, model, Finer.by(SerialEvaluate(finer)))
        invert(case, made.truths[:inverted], made.data[:inverted], "palpation-inverted", (NOISE,), INVERT)


class Kept(OfEvaluate):
    """Solves on finer meshes, kept one by one, since each takes most of a minute."""

    def __init__(self, model: Any, inputs: Inputs) -> None:
        self._evaluate: Evaluate = SerialEvaluate(model)
        self._inputs = inputs

    def __call__(self, request: Request) -> Evaluations:
        """Evaluate the points that were not evaluated before."""
        found = []
        for k, point in enumerate(request.points):
            file = FOLDER / f"meshes-palpation-finer-{k}.pickle"
            if file.exists():
                found.append(pickle.loads(file.read_bytes()))
            if len(found) == k or not np.array_equal(found[k].points[0], point):
                found[k:] = [self._evaluate(replace(request, points=point[None]))]
                file.write_bytes(pickle.dumps(found[k]))
        return merge(found)

    def on(self, model: str) -> Evaluate:
        """There is one model only."""
        return self._evaluate.on(model)


def _made(inputs: Inputs, truths: FloatArray, count: int) -> Made:
    """Return the first truths that have data, and these; kept as they are made."""
    found = list[FloatArray]()
    if MADE.exists():
        there = np.load(MADE)
        same = len(there["data"])
        if same <= len(truths) and np.allclose(there["truths"], truths[:same]):
            found = list(there["data"])
    model: Any = load(OTHER).specimen.build(MPI.COMM_SELF, inputs.names)  # type: ignore[attr-defined]
    guess: Guess | None = None
    FOLDER.mkdir(parents=True, exist_ok=True)
    while (good := np.isfinite(np.reshape(found, (len(found), len(model.outputs)))).all(axis=1)).sum() < count:
        assert len(found) < len(truths), "too few truths have an answer"
        guess = guess or Guess(model.solve(inputs.mean).state)
        try:
            found.append(np.array(model.solve(truths[len(found)], guess).outputs))
        except SolveError as error:
            sys.stdout.write(f"no data of truth {len(found)}: {error.reason}\n")
            found.append(np.full(len(model.outputs), np.nan))
        np.savez(MADE, truths=truths[: len(found)], data=found)
    return Made(truths[: len(found)][good][:count], np.array(found)[good][:count])
