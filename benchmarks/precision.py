"""A reference's factor in single and in double precision, side by side: back-substitutions, samples, memory."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from mpi4py import MPI

from benchmarks.beams import beam
from benchmarks.size import CELLS
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.sampling import random_points
from uq.surrogates.linearisation import linearise

REPEATS = 3
TOGETHER = (1, 8, 32)  # right-hand sides


def main(words: Sequence[str] = ()) -> None:
    """Print processor times (ms) for one of several right-hand sides and samples, and memory (MB) of the factor."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks precision")
    parser.add_argument("--unknowns", type=float, nargs="+", choices=sorted(CELLS), default=[1e4, 3e4])
    parser.add_argument("--samples", type=int, default=16)
    given = parser.parse_args(words)
    sides = " | ".join(f"one of {count}" for count in TOGETHER)
    print(f"| unknowns | precision | {sides} | factorisation | sample | corrections | tangents | MB | contraction |")
    print("|---:|---|" + "---:|" * (len(TOGETHER) + 6))
    for size in given.unknowns:
        found = {precision: _measured(size, precision, given.samples) for precision in ("double", "single")}
        print(f"\nstates differ by {_apart(*(states for states, _ in found.values())):.1e} of the largest, ", end="")
        print(f"tangents by {_apart(*(tangents for _, tangents in found.values())):.1e}\n", flush=True)


def _measured(size: float, precision: str, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Print a row; return states and tangents."""
    study = beam(CELLS[size], 'model.body.cell="tetrahedron"', f"model.solver.precision={precision}")
    model = study.model.build(MPI.COMM_SELF, study.inputs.names)
    start = linearise(study.inputs, SerialEvaluate(model)).prediction.on(model)
    points = study.inputs.points(random_points(1, 0, samples, len(study.inputs.names)))
    reference = start(points[0]).reference
    assert reference is not None
    factor = model.reference.at(reference)
    solver: Any = factor._solver
    factorisation = _milliseconds(solver.factorise, 1)
    rights = np.random.default_rng(0).standard_normal((max(TOGETHER), model.equations.size))
    rights[:, model.equations.fixed] = 0
    sides = [_milliseconds(lambda k=k: factor.solve(rights[:k]), REPEATS) / k for k in TOGETHER]  # type: ignore[misc]
    list(model.solve_many(points[:2], map(start, points[:2])))  # vectors of the screen
    begin = time.process_time()
    found: list[Any] = list(model.solve_many(points, map(start, points)))
    sample = (time.process_time() - begin) / samples * 1e3
    model.reference.at(reference).slopes()
    begin = time.process_time()
    tangents = np.array([one.tangent(np.eye(len(study.inputs.names))) for one in found[:REPEATS]])
    of_tangents = (time.process_time() - begin) / REPEATS * 1e3
    times = " | ".join(f"{value:.2f}" for value in [*sides, factorisation, sample])
    corrections = np.mean([one.work.back_substitutions for one in found])
    single = precision == "single" and solver.in_single
    contraction = f"{solver.contraction:.4f}" if single else ""
    memory = solver._library.told(solver._factor, 22) if single else _in_double(solver).getMumpsInfog(22)  # MB
    print(
        f"| {model.equations.size:,} | {precision} | {times} | {corrections:.1f} | {of_tangents:.0f} "
        f"| {memory} | {contraction} |",
        flush=True,
    )
    return np.array([one.state for one in found]), tangents


def _milliseconds(call: Callable[[], object], repeats: int) -> float:
    call()
    begin = time.process_time()
    for _ in range(repeats):
        call()
    return (time.process_time() - begin) / repeats * 1e3


def _in_double(solver: Any) -> Any:
    """Return MUMPS's factor in double precision."""
    return getattr(solver, "_double", solver)._ksp.pc.getFactorMatrix()


def _apart(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(one - other).max() / np.abs(one).max())
