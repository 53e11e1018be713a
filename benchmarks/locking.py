"""Locking: outputs of the displacement form over those of the mixed form, by κ/μ, degree and cell, on three bodies."""

from __future__ import annotations

from typing import Any

import numpy as np
from mpi4py import MPI

from forward.hyperelastic import Hyperelastic
from forward.model import Guess, SolveError

RATIOS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 1e2, 1e3, 1e4)
SHEAR = 1e4  # μ (Pa)
CELLS = (("tetrahedron", 1), ("hexahedron", 1), ("tetrahedron", 2), ("hexahedron", 2))

# Each with the cells of the mesh, and of a finer one (mixed, quadratic hexahedra) for the truth.
BODIES: dict[str, tuple[dict[str, Any], tuple[int, int, int], tuple[int, int, int]]] = {
    "cantilever": (
        {
            "body": {"size": [1.0, 0.2, 0.2]},
            "clamp": ["x-min"],
            "loads": [{"kind": "traction", "on": "x-max", "direction": [0, 0, -1], "size": 5.0}],
            "outputs": [{"kind": "mean-displacement", "name": "w", "on": "x-max", "component": "z"}],
        },
        (10, 2, 2),
        (20, 4, 4),
    ),
    "Cook": (
        {
            "body": {
                "kind": "block",
                "corners": [
                    [x, y, z] for z in (0.0, 0.01) for x, y in ((0.0, 0.0), (0.048, 0.044), (0.0, 0.044), (0.048, 0.06))
                ],
            },
            "clamp": ["x-min"],
            "displacements": [{"on": "z-min", "z": 0.0}, {"on": "z-max", "z": 0.0}],
            "loads": [{"kind": "traction", "on": "x-max", "direction": [0, 1, 0], "size": 100.0}],
            "outputs": [{"kind": "mean-displacement", "name": "w", "on": "x-max", "component": "y"}],
        },
        (6, 6, 1),
        (16, 16, 1),
    ),
    "block": (
        {
            "body": {"size": [0.1, 0.1, 0.05]},
            "clamp": ["z-min"],
            "displacements": [{"on": "z-max", "x": 0.0, "y": 0.0, "z": -0.005}],
            "outputs": [{"kind": "reaction", "name": "w", "on": "z-max", "component": "z"}],
        },
        (4, 4, 2),
        (8, 8, 4),
    ),
}


def curve(name: str, cells: tuple[int, int, int], cell: str, degree: int, formulation: str) -> list[float]:
    """Return the output of a body for every κ/μ; NaN where there is no answer."""
    blocks, _, _ = BODIES[name]
    spec = Hyperelastic.model_validate(
        blocks
        | {
            "formulation": formulation,
            "body": blocks["body"] | {"cells": list(cells), "cell": cell, "degree": degree},
            "material": {"kind": "neo-hookean", "C1": SHEAR / 2, "D1": SHEAR / 2},
        }
    )
    model = spec.build(MPI.COMM_WORLD, ("material.D1",))
    found, start = [], None
    for ratio in RATIOS:
        try:
            solution = model.solve(np.array([ratio * SHEAR / 2]), Guess(start))
        except SolveError:
            found.append(np.nan)
            continue
        found.append(float(solution.outputs[0]))
        start = solution.state
    return found


def main() -> None:
    """Print the table: too stiff is below 1 for the deflections, above 1 for the reaction of the block."""
    print("Output over that of the mixed form on a finer mesh (quadratic hexahedra)\n")
    print("| body | element | " + " | ".join(f"κ/μ = {ratio:g}" for ratio in RATIOS) + " |")
    print("|---" * (2 + len(RATIOS)) + "|")
    for name, (_, cells, finer) in BODIES.items():
        truth = np.array(curve(name, finer, "hexahedron", 2, "mixed"))
        for cell, degree in CELLS:
            for formulation in ("displacement", "mixed")[:degree]:
                shares = np.array(curve(name, cells, cell, degree, formulation)) / truth
                words = f"{cell}, degree {degree}, {formulation}"
                print(f"| {name} | {words} | " + " | ".join(f"{share:.3f}" for share in shares) + " |", flush=True)
