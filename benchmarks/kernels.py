"""Forces of a body: several cells at once in the lanes of a vector unit, against DOLFINx's loop over cells."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from mpi4py import MPI

from forward.hyperelastic import Hyperelastic
from forward.native import FLAGS

ROUNDS, CALLS = 5, 20
MATERIALS = {
    "Mooney–Rivlin": {"kind": "mooney-rivlin", "C1": 1e4, "C2": 2e5, "D1": 2e5},
    "neo-Hookean, coupled": {"kind": "neo-hookean-coupled", "mu": 4e4, "lmbda": 1e5},
    "Demiray": {"kind": "demiray", "a": 4e4, "b": 2.0, "D1": 2e5},
    "Ogden": {
        "kind": "ogden",
        "mu1": 2e4,
        "alpha1": 1.5,
        "mu2": 1e3,
        "alpha2": 5.0,
        "mu3": -1e4,
        "alpha3": -2.0,
        "D1": 2e5,
    },
}
CELLS = {"tetrahedron": (20, 4, 4), "hexahedron": (20, 4, 4)}


def main() -> None:
    """Print the time of the processor for one assembly; the smallest of several rounds, in turns."""
    print(f"compiled with {' '.join(FLAGS)}")
    print(
        "| material | cells | unknowns | one after the other (ms) | several at once (ms) | lanes | ratio | difference |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name, material in MATERIALS.items():
        for cell, cells in CELLS.items():
            print(_row(name, material, cell, cells), flush=True)


def _row(name: str, material: dict[str, object], cell: str, cells: tuple[int, int, int]) -> str:
    body = {"kind": "box", "size": (0.28, 0.0215, 0.087), "cells": cells, "cell": cell, "degree": 2}
    gravity = {"kind": "gravity", "direction": (0.0, -1.0, 0.0), "density": 600.0}
    output = {"kind": "max-displacement", "name": "largest"}
    spec = Hyperelastic.model_validate(
        {"body": body, "material": material, "clamp": ("x-min",), "loads": (gravity,), "outputs": (output,)}
    )
    equations = spec.build(MPI.COMM_SELF, ()).equations  # type: ignore[attr-defined]
    equations.set_state(1e-5 * np.random.default_rng(0).standard_normal(equations.size))
    form = equations._imbalance_form()
    ways = [equations.vector(form), equations.vector(form, often=True)]
    lanes = 1 if ways[1]._lanes is None else ways[1]._lanes.lanes
    times = np.array([[_time(way) for way in ways] for _ in range(ROUNDS)]).min(axis=0)
    slow, fast = (way() for way in ways)
    gap = np.abs(slow - fast).max() / np.abs(slow).max()
    return (
        f"| {name} | {cell} | {equations.size:,} | {1e3 * times[0]:.2f} | {1e3 * times[1]:.2f} "
        f"| {lanes} | {times[0] / times[1]:.1f} | {gap:.0e} |"
    )


def _time(way: Callable[[], object]) -> float:
    begin = time.process_time()
    for _ in range(CALLS):
        way()
    return (time.process_time() - begin) / CALLS
