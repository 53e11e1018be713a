"""One realisation: the textbook against prediction and correction with a reference factor, side by side."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from mpi4py import MPI

from benchmarks.beams import beam
from benchmarks.throughput import resident
from forward.model import FloatArray, SolveError
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Evaluate, Request
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import random_points, sobol_points
from uq.surrogates.basis import whole
from uq.surrogates.field_regression import Projections, StateExpansion
from uq.surrogates.least_squares import Data, fit_best
from uq.surrogates.linearisation import Linearisation, linearise

DRAWS = 50
EXPANSIONS = ((3, 16), (6, 48))  # orders of the predictions, and solves with gradients to which they are fitted
SIZES = {(10, 2, 2): 1, (20, 4, 4): 1, (40, 8, 8): 5}  # cells; the textbook solves every so many-th of the draws
HEAD = (
    "| unknowns | prediction | set-up (s) | textbook (s) | this (s) | median ratio | smallest | corrections, median "
    "and most | together (s) | ratio | an audit (s) | tangents | adjoint | memory (MiB) |"
)


def main() -> None:
    """Print medians over random draws of the published beam (quadratic tetrahedra), both ways on each draw in turn.

    Times are of the processor, with the test for stability that every state passes. Together: all draws are given to
    `solve_many`, and their mean time is compared with the median of the textbook. One in 200 is audited besides, which
    few draws cannot show: those are left out, and what an audit adds stands apart.

    The textbook is Newton's method from zero with a new factorisation (LDLᵀ by MUMPS) in every iteration, on the same
    compiled forms and to the same tolerance. "This" starts from the tangent prediction, or from expansions of the
    state. Derivatives are in per cent of the textbook's time.
    """
    print(f"{DRAWS} draws each\n\n{HEAD}\n|{'---|' * HEAD.count('| ')}")
    for cells in SIZES:
        rows(cells)


def rows(cells: tuple[int, int, int]) -> None:
    """Print the rows of one mesh."""
    study = beam(cells, 'model.body.cell="tetrahedron"')
    inputs = study.inputs
    textbook = beam(cells, 'model.body.cell="tetrahedron"', 'model.solver="newton"').model.build(
        MPI.COMM_SELF, inputs.names
    )
    before = resident()
    model = study.model.build(MPI.COMM_SELF, inputs.names)
    evaluate = SerialEvaluate(model)
    begin = time.process_time()
    centre = linearise(inputs, evaluate)
    assert centre.prediction is not None
    predictions, setups = [centre.prediction.on(model)], [time.process_time() - begin]
    warm = model.solve(inputs.mean, predictions[0](inputs.mean))  # factorises the reference
    warm.tangent(np.eye(2)), warm.adjoint(np.eye(2)[0])  # compiles
    for order, solves in EXPANSIONS:
        begin = time.process_time()
        predictions.append(expanded(inputs, evaluate, centre, order, solves).on(model))
        setups.append(time.process_time() - begin)
    points = inputs.points(random_points(1, 0, DRAWS, 2))
    slow = np.full(DRAWS, np.nan)
    states: dict[int, FloatArray] = {}
    fast, corrections = np.empty((len(predictions), DRAWS)), np.empty((len(predictions), DRAWS))
    derivatives, audited = np.empty((2, DRAWS)), np.zeros(DRAWS, dtype=bool)
    for i, point in enumerate(points):
        if i % SIZES[cells] == 0:
            with timed(slow, i):
                states[i] = textbook.solve(point).state
        for k, predict in enumerate(predictions):
            with timed(fast[k], i):
                solution = model.solve(point, predict(point))
            work = solution.work
            audited[i] |= work.audits > 0
            corrections[k, i] = work.back_substitutions - work.audit_back_substitutions
            if i % SIZES[cells] == 0:
                require_same(solution.state, states[i])
        with timed(derivatives[0], i):
            solution.tangent(np.eye(2))
        with timed(derivatives[1], i):
            solution.adjoint(np.eye(2)[0])
    expected = np.nanmedian(slow)
    shares = 100 * np.median(derivatives, axis=1) / expected
    names = ["tangent", *(f"order {order} from {solves}" for order, solves in EXPANSIONS)]
    for k, predict in enumerate(predictions):
        plain = points[~audited]
        begin = time.process_time()
        found = list(model.solve_many(plain, map(predict, plain)))
        together = (time.process_time() - begin) / len(plain)
        for i, one in zip(np.flatnonzero(~audited), found, strict=True):
            assert not isinstance(one, SolveError)
            if i in states:
                require_same(one.state, states[i])
        ratio = slow / fast[k]
        audit = f"{fast[k, audited].mean() - np.median(fast[k]):.2f}" if audited.any() else "none"
        print(
            f"| {study.model.unknowns:,} | {names[k]} | {setups[k]:.1f} | {expected:.3f} | {np.median(fast[k]):.4f} "
            f"| {np.nanmedian(ratio):.1f} | {np.nanmin(ratio):.1f} | {np.median(corrections[k]):.0f}, "
            f"{corrections[k].max():.0f} | {together:.4f} | {expected / together:.1f} "
            f"| {audit} | {shares[0]:.1f} % | {shares[1]:.1f} % | {resident() - before:.0f} |",
            flush=True,
        )


@contextmanager
def timed(times: FloatArray, i: int) -> Iterator[None]:
    """Put the processor time (s) of what is inside into times[i]."""
    begin = time.process_time()
    yield
    times[i] = time.process_time() - begin


def require_same(state: FloatArray, expected: FloatArray) -> None:
    """Stop where states differ by more than the tolerance allows."""
    assert np.abs(state - expected).max() <= 1e-8 * np.abs(expected).max()


def expanded(inputs: Inputs, evaluate: Evaluate, centre: Linearisation, order: int, solves: int) -> StateExpansion:
    """Expand the state, fitted to so many solves with their gradients."""
    bases = whole(inputs, order)
    basis = bases.basis
    points = inputs.points(sobol_points(0, 0, 0, solves, len(inputs.names)))
    sums = Projections(basis, centre.state, True, None, None)
    found = evaluate(Request(points, tangents=True, fields=sums, start=centre.prediction))
    return StateExpansion.fitted(basis, fit_best(bases, Data.of(found, inputs, None)), found.fields, centre)
