"""Modes of blocks against modes of the whole body: errors by modes and snapshots; a block in full under a tool."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from forward.model import FloatArray
from forward.reduced.model import ReducedModel
from forward.reduced.reduction import Reduction, Sizes
from forward.reduced.snapshots import Snapshots
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Request
from uq.inputs.sampling import random_points
from uq.surrogates.linearisation import linearise
from workflows.config.study import load
from workflows.studies.reduction_job import KeptStates

CONFIG = Path(__file__).parent.parent / "configs" / "slab.toml"
CHANGES = [
    'model.fields=[{of="stiffness", length=0.04, std=0.3, modes=50}]',
    'model.outputs=[{name="deepest", kind="max-displacement"}, {name="middle", kind="displacement", '
    'at=[0.06, 0.045, 0.03], component="z"}, {name="stress", kind="max-von-mises"}]',
]
CUTS: tuple[Any, ...] = (None, (2, 1, 1), (2, 2, 1), (4, 3, 1))
MODES = (40, 80, 160, 240)
UNSEEN = 64
LEFT, RIGHT = (0.03, 0.05), (0.09, 0.045, 0.03)  # m: where the tool was, and where it is


def main(words: Sequence[str] = ()) -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks blocks")
    parser.add_argument("--snapshots", type=int, default=100)
    parser.add_argument("--only", choices=["modes", "tool"], default=None)
    given = parser.parse_args(words)
    study: Any = load(CONFIG, CHANGES)
    inputs = study.inputs
    model = study.spec.build(MPI.COMM_SELF, inputs.names)
    evaluate = SerialEvaluate(model)
    start = linearise(inputs, evaluate).prediction
    reduction = Reduction(model, inputs.mean, inputs.std)
    points = inputs.points(random_points((5,), 0, given.snapshots + UNSEEN, len(inputs.names)))
    if given.only in (None, "modes"):
        trained = _solved(evaluate, start, points[UNSEEN:])
        unseen = _solved(evaluate, start, points[:UNSEEN])
        print(f"{given.snapshots} snapshots (states), 57 parameters, errors at {UNSEEN} unseen samples\n")
        _head()
        for modes in MODES:
            for cut in CUTS:
                sizes = Sizes(modes, 2e-3, 3e-3, 0, cut)
                if cut is not None or modes <= 2 * given.snapshots:
                    _row("the whole" if cut is None else " × ".join(map(str, cut)), reduction, trained, sizes, unseen)
    if given.only in (None, "tool"):
        place = inputs.names.index("loads.spot.x")
        left, right = points[UNSEEN:].copy(), points[:16].copy()
        left[:, place] = LEFT[0] + (LEFT[1] - LEFT[0]) * np.linspace(0, 1, len(left))
        right[:, [place, place + 1]] = RIGHT[:2]
        trained, unseen = _solved(evaluate, start, left), _solved(evaluate, start, right)
        print(
            f"\nA tool that no snapshot has seen: trained for x = {LEFT[0]} to {LEFT[1]} m, pressed at {RIGHT[0]} m\n"
        )
        _head()
        for label, cut, full in (
            ("the whole", None, ()),
            ("4 × 3 × 1", CUTS[-1], ()),
            ("4 × 3 × 1, that under the tool in full", CUTS[-1], (RIGHT,)),
        ):
            _row(label, reduction, trained, Sizes(80, 2e-3, 3e-3, 0, cut, full), unseen)


def _solved(evaluate: SerialEvaluate, start: Any, points: FloatArray) -> Snapshots:
    found = evaluate(Request(points, fields=KeptStates(None), start=start))
    assert found.sketches is not None
    states, ok = found.sketches[:, 0], found.ok
    print(f"{len(points)} solves of {found.seconds.mean():.3g} s")
    none = np.zeros((0, states.shape[1]))
    return Snapshots(points[ok], states, none, none, found.outputs[ok])


def _head() -> None:
    print("| blocks | modes | points | state (%) | deepest (% of its spread) | middle | stress | a solve (ms) |")
    print("|---|---|---|---|---|---|---|---|")


def _row(label: str, reduction: Reduction, trained: Snapshots, sizes: Sizes, unseen: Snapshots) -> None:
    data = reduction.reduced(trained, sizes)
    model = ReducedModel(data, data.parameters, tested=False)
    begin = time.process_time()
    solutions: list[Any] = list(model.solve_many(unseen.parameters))
    taken = (time.process_time() - begin) / len(solutions)
    good = [i for i, one in enumerate(solutions) if not isinstance(one, Exception)]
    if not good:
        print(f"| {label} | {model.level.modes} | {data.about['points']} | no equilibrium | | | | |", flush=True)
        return
    outputs, states = (np.array([getattr(solutions[i], what) for i in good]) for what in ("outputs", "state"))
    of_state = np.linalg.norm(states - unseen.states[good]) / np.linalg.norm(unseen.states[good])
    errors = np.sqrt(((outputs - unseen.outputs[good]) ** 2).mean(axis=0)) / trained.outputs.std(axis=0)
    lost = f" ({len(solutions) - len(good)} without an answer)" if len(good) < len(solutions) else ""
    print(
        f"| {label} | {model.level.modes} | {data.about['points']} | {100 * of_state:.2g}{lost} | "
        + " | ".join(f"{100 * error:.2g}" for error in errors)
        + f" | {1e3 * taken:.2g} |",
        flush=True,
    )


if __name__ == "__main__":
    main(sys.argv[1:])
