"""One realisation: the textbook against prediction and correction with a reference factor, side by side."""

from __future__ import annotations

import time

import numpy as np
from mpi4py import MPI

from benchmarks.beams import beam
from benchmarks.throughput import resident
from uq.evaluation.evaluate import Evaluate, Request, SerialEvaluate
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import random_points, sobol_points
from uq.surrogates.basis import orthonormal
from uq.surrogates.candidates import whole
from uq.surrogates.field_regression import Projections, StateExpansion
from uq.surrogates.least_squares import Data, fit_best
from uq.surrogates.linearisation import Linearisation, linearise

DRAWS = 50
ORDER, SOLVES = 3, 16  # of the chaos prediction, which is fitted to values and gradients
SIZES = ((10, 2, 2), (20, 4, 4), (40, 8, 8))
HEAD = (
    "| unknowns | textbook (s) | this (s) | ratio of medians | median ratio | smallest ratio | factorisations "
    "| corrections, median and most | from chaos (s) | median ratio | smallest ratio | corrections, median and most "
    "| all tangents | one adjoint | memory (MiB) | in lockstep (s) | ratio | from chaos, in lockstep (s) | ratio |"
)


def main() -> None:
    """Print medians over random draws of the published beam (quadratic tetrahedra), both ways on each draw in turn.

    Times are of the processor, with the test for stability that every state passes. In lockstep, all draws are given to
    `solve_many`; the time of one is their mean.

    The textbook is Newton's method from zero with a new factorisation (LDLᵀ by MUMPS) in every iteration, on the same
    compiled forms and to the same tolerance. "This" starts from the tangent prediction, and then from the prediction of
    an expansion of the state. Derivatives are in per cent of the textbook's time.
    """
    print(f"{DRAWS} draws each; chaos of order {ORDER} from {SOLVES} solves\n\n{HEAD}\n|{'---|' * 19}")
    for cells in SIZES:
        print(_row(cells), flush=True)


def _row(cells: tuple[int, int, int]) -> str:
    study = beam(cells, 'model.body.cell="tetrahedron"')
    inputs = study.inputs
    textbook = beam(cells, 'model.body.cell="tetrahedron"', 'model.solver="newton"').model.build(
        MPI.COMM_SELF, inputs.names
    )
    before = resident()
    model = study.model.build(MPI.COMM_SELF, inputs.names)
    evaluate = SerialEvaluate(model)
    centre = linearise(inputs, evaluate)
    assert centre.prediction is not None
    guess = centre.prediction.on(model)
    warm = model.solve(inputs.mean, guess(inputs.mean))  # factorises the reference
    warm.tangent(np.eye(2)), warm.adjoint(np.eye(2)[0])  # compiles
    begin = time.process_time()
    expansion = expanded(inputs, evaluate, centre).on(model)
    setup = time.process_time() - begin
    times, counts, gap = [], [], 0.0
    points = inputs.points(random_points(1, 0, DRAWS, 2))
    states = []
    for point in points:
        marks = [time.process_time()]

        def lap(marks: list[float] = marks) -> None:
            marks.append(time.process_time())

        expected = textbook.solve(point)
        lap()
        solution = model.solve(point, guess(point))
        lap()
        work = solution.work
        counts.append([expected.work.factorisations, work.factorisations, work.back_substitutions])
        solution.tangent(np.eye(2))
        lap()
        solution.adjoint(np.eye(2)[0])
        lap()
        predicted = model.solve(point, expansion(point))
        lap()
        counts[-1].append(predicted.work.back_substitutions)
        times.append(np.diff(marks))
        states.append(expected.state)
        size = np.abs(expected.state).max()
        gap = max(gap, *(np.abs(expected.state - s.state).max() / size for s in (solution, predicted)))
    alongside = []
    for predict in (guess, expansion):
        begin = time.process_time()
        found = list(model.solve_many(points, map(predict, points)))
        alongside.append((time.process_time() - begin) / DRAWS)
        gaps = [np.abs(a - b.state).max() / np.abs(a).max() for a, b in zip(states, found, strict=True)]
        gap = max(gap, *gaps)
    slow, fast, tangents, adjoint, by_chaos = np.array(times).T
    ratio, gain, (a, b, corrections, fewer) = slow / fast, slow / by_chaos, np.array(counts).T
    return (
        f"| {study.model.unknowns:,} | {np.median(slow):.3f} | {np.median(fast):.4f} "
        f"| {np.median(slow) / np.median(fast):.1f} | {np.median(ratio):.1f} | {ratio.min():.1f} "
        f"| {np.median(a):.0f} against {np.mean(b):.2g} | {np.median(corrections):.0f}, {corrections.max()} "
        f"| {np.median(by_chaos):.4f} | {np.median(gain):.1f} | {gain.min():.1f} "
        f"| {np.median(fewer):.0f}, {fewer.max()} "
        f"| {100 * np.median(tangents / slow):.1f} % | {100 * np.median(adjoint / slow):.1f} % "
        f"| {resident() - before:.0f} | {alongside[0]:.4f} | {np.median(slow) / alongside[0]:.1f} "
        f"| {alongside[1]:.4f} | {np.median(slow) / alongside[1]:.1f} |\n"
        f"<!-- largest relative difference of the states {gap:.1e}; set-up of the chaos prediction {setup:.2g} s -->"
    )


def expanded(inputs: Inputs, evaluate: Evaluate, centre: Linearisation) -> StateExpansion:
    """Expand the state, fitted to `SOLVES` solves with their gradients."""
    bases = whole(inputs, ORDER)
    basis = orthonormal(inputs, bases.all)
    points = inputs.points(sobol_points(0, 0, 0, SOLVES, len(inputs.names)))
    sums = Projections(basis, centre.state, True, None, None)
    found = evaluate(Request(points, tangents=True, fields=sums, start=centre.prediction))
    return StateExpansion.fitted(basis, fit_best(bases, basis, Data.of(found, inputs, None)), found.fields, centre)
