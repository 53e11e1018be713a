"""One realisation: the textbook against prediction and correction with a reference factor, side by side."""

from __future__ import annotations

import time

import numpy as np
from mpi4py import MPI

from benchmarks.beams import beam
from benchmarks.throughput import resident
from uq.evaluate import SerialEvaluate
from uq.linearisation import linearise
from uq.sampling import random_points

DRAWS = 50
SIZES = ((10, 2, 2), (20, 4, 4), (40, 8, 8))
HEAD = (
    "| unknowns | textbook (s) | this (s) | ratio of medians | median ratio | smallest ratio | factorisations "
    "| corrections, median and most | all tangents | one adjoint | memory (MiB) |"
)


def main() -> None:
    """Print medians over random draws of the published beam (quadratic tetrahedra), both ways on each draw in turn.

    The textbook is Newton's method from zero with a new factorisation (LDLᵀ by MUMPS) in every iteration, on the same
    compiled forms and to the same tolerance. Derivatives are in per cent of its time.
    """
    print(f"{DRAWS} draws each\n\n{HEAD}\n|{'---|' * 11}")
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
    prediction = linearise(inputs, SerialEvaluate(model)).prediction
    assert prediction is not None
    predict, reference = prediction.on(model)
    warm = model.solve(inputs.mean, predict(inputs.mean), reference)  # factorises the reference
    warm.tangent(np.eye(2)), warm.adjoint(np.eye(2)[0])  # compiles
    times, counts, gap = [], [], 0.0
    for point in inputs.points(random_points(1, 0, DRAWS, 2)):
        marks = [time.perf_counter()]

        def lap(marks: list[float] = marks) -> None:
            marks.append(time.perf_counter())

        expected = textbook.solve(point)
        lap()
        solution = model.solve(point, predict(point), reference)
        lap()
        counts.append((expected.work.factorisations, solution.work.factorisations, solution.work.back_substitutions))
        solution.tangent(np.eye(2))
        lap()
        solution.adjoint(np.eye(2)[0])
        lap()
        times.append(np.diff(marks))
        gap = max(gap, np.abs(expected.state - solution.state).max() / np.abs(expected.state).max())
    slow, fast, tangents, adjoint = np.array(times).T
    ratio, (a, b, corrections) = slow / fast, np.array(counts).T
    return (
        f"| {study.model.unknowns:,} | {np.median(slow):.3f} | {np.median(fast):.4f} "
        f"| {np.median(slow) / np.median(fast):.1f} | {np.median(ratio):.1f} | {ratio.min():.1f} "
        f"| {np.median(a):.0f} against {np.mean(b):.2g} | {np.median(corrections):.0f}, {corrections.max()} "
        f"| {100 * np.median(tangents / slow):.1f} % | {100 * np.median(adjoint / slow):.1f} % "
        f"| {resident() - before:.0f} |\n<!-- largest relative difference of the states {gap:.1e} -->"
    )
