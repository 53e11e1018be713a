"""What `tissuq check` predicts against what solves take, in processor time."""

from __future__ import annotations

import argparse
import gc
import os
import sys
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from mpi4py import MPI

from benchmarks.beams import CONFIG, beam
from forward.fem.cost import times
from uq.inputs.sampling import random_points
from uq.surrogates.linearisation import Linearisation
from workflows.config.study import load

T = TypeVar("T")
DRAWS = 3
CUBE = "model.body.size=[5,5,5]"  # m: so large that its weight strains it by some per cent
SIZES: tuple[tuple[tuple[int, int, int], str], ...] = (
    ((3, 3, 3), CUBE),
    ((20, 1, 1), ""),
    ((7, 7, 7), CUBE),
    ((33, 3, 3), ""),
    ((10, 10, 10), CUBE),
    ((40, 5, 5), ""),
)
LARGE = ((15, 15, 15), CUBE)
PARTS = ("first solve", "reference", "tangents", "sample", "textbook")
BALL = (  # cells, and depth (mm), of the block of `configs/indentation-forward.toml`
    ((3, 3, 3), 1.5),
    ((4, 4, 4), 1.5),
    ((5, 5, 5), 1.5),
    ((6, 6, 6), 1.5),
    ((8, 8, 8), 1.5),
    ((5, 5, 4), 0.2),
    ((5, 5, 4), 0.5),
    ((5, 5, 4), 3.0),
)


def main(words: Sequence[str] = ()) -> None:
    """Print predicted and measured times of a cube and of the published, slender beam, cells of degree 2.

    Each time is measured once, the sample on a few random draws, with compiled forms and `OMP_NUM_THREADS=1`.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks predictions")
    parser.add_argument("--tools", action="store_true", help="first solves under a ball instead")
    tools = parser.parse_args(words).tools
    if os.environ.get("OMP_NUM_THREADS") != "1":
        sys.stderr.write("set OMP_NUM_THREADS=1: threads that wait spend processor time, too\n")
        return
    if tools:
        _under_a_ball()
        return
    print("| body | cells | form | unknowns | " + " | ".join(f"{part} (s)" for part in PARTS) + " | ratios |")
    print("|---|---|---|---:|" + "---|" * (len(PARTS) + 1))
    found = [
        _row(cells, change, cell, form)
        for cells, change in SIZES
        for form in ("displacement", "mixed")
        for cell in ("hexahedron", "tetrahedron")
    ]
    found.append(_row(*LARGE, "hexahedron", "displacement"))
    for part, ratios in zip(PARTS, np.array(found).T, strict=True):
        print(f"\n{part}: predicted over measured {ratios.min():.2f} to {ratios.max():.2f}", end="")
    print()


def _under_a_ball() -> None:
    """Print predicted and measured times of first solves in contact, and their factorisations."""
    print("| cells | depth (mm) | unknowns | factorisations | predicted, measured (s) | ratio |")
    print("|---|---:|---:|---:|---|---:|")
    for cells, depth in BALL:
        changes = [f"model.body.cells={list(cells)}", f"model.loads.0.depth={depth * 1e-3}"]
        uncertain = 'parameters={ "material.C1" = { kind = "uniform", lower = 500, upper = 700 } }'
        study = load(CONFIG.with_name("indentation-forward.toml"), [*changes, uncertain])
        model = study.spec.build(MPI.COMM_SELF, study.inputs.names)
        seconds, solution = _timed(lambda model=model, at=study.inputs.mean: model.solve(at))
        first = study.spec.cost().first
        print(
            f"| {' × '.join(map(str, cells))} | {depth} | {study.spec.unknowns:,} | {solution.work.factorisations} "
            f"| {first:.2g}, {seconds:.2g} | {first / seconds:.2f} |",
            flush=True,
        )


def _row(cells: Sequence[int], change: str, cell: str, form: str) -> list[float]:
    """Print a row; return predicted over measured times."""
    gc.collect()  # PETSc's objects of the row before
    a, b, c = cells
    changes = [f"model.body.cell={cell!r}", f"model.formulation={form!r}", *([change] if change else [])]
    study = beam((a, b, c), *changes)
    inputs, d = study.inputs, len(study.inputs.names)
    model = study.spec.build(MPI.COMM_SELF, inputs.names)
    textbook = study.spec.textbook()
    forced = textbook.build(MPI.COMM_SELF, inputs.names)
    tiny = beam((1, 1, 1), *changes)
    small = tiny.model.build(MPI.COMM_SELF, inputs.names).solve(inputs.mean)
    small.tangent(np.eye(d)), small.state_tangent(np.eye(d))  # compiles
    first, solution = _timed(lambda: model.solve(inputs.mean))
    tangents, (slopes, outputs) = _timed(lambda: (solution.state_tangent(np.eye(d)), solution.tangent(np.eye(d))))
    gathered, by_parameter = model.space.gather(solution.state[None]), model.space.gather(slopes)
    assert gathered is not None
    assert by_parameter is not None
    centre = Linearisation(
        inputs.mean, solution.outputs, outputs.T, gathered[0], by_parameter, inputs.coordinates, inputs.std
    )
    assert centre.prediction is not None
    guess = centre.prediction.on(model)
    reference = guess(inputs.mean).reference
    once, _ = _timed(lambda: (model.reference.prepare(reference), model.reference.prepare_screen()))
    points = inputs.points(random_points(1, 0, DRAWS, d))
    samples = sum(_timed(lambda at=at: model.solve(at, guess(at)))[0] for at in points) / DRAWS
    slow, _ = _timed(lambda: forced.solve(points[0]))
    model_times = times(study.spec.body, mixed=study.spec.mixed)
    predicted = np.array(
        [
            model_times.first,
            model_times.reference_factor(d),
            model_times.tangents(d),
            model_times.corrected,
            model_times.first,  # with its analysis, as it is the first of this model
        ]
    )
    measured = np.array([first, once, tangents, samples, slow])
    ratios = predicted / measured
    print(
        f"| {'cube' if change else 'beam'} | {a} × {b} × {c}, {cell} | {form} | {study.spec.unknowns:,} | "
        + " | ".join(f"{p:.2g}, {m:.2g}" for p, m in zip(predicted, measured, strict=True))
        + f" | {', '.join(f'{ratio:.2f}' for ratio in ratios)} |",
        flush=True,
    )
    return [float(ratio) for ratio in ratios]


def _timed(what: Callable[[], T]) -> tuple[float, T]:
    begin = time.process_time()
    found = what()
    return time.process_time() - begin, found
