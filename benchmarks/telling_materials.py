"""What tells materials apart that a curve of force over depth does not.

The truth is the Mooney–Rivlin material of `configs/synthesize-indentation.toml`. Each other candidate of
`configs/indentation-material.toml` is fitted to its data without errors, by Gauss and Newton, and half of what is left
of the misfit, Σ ((y − ψ)/σ)²/2, is about the ln Bayes factor for the truth that data with errors give, but for what
priors add. The mesh is coarse, and the same for all.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
from mpi4py import MPI

from forward.hyperelastic import Path
from forward.model import FloatArray

SIDE, RADIUS = 10e-3, 3e-3  # m
OF_FORCE, STEPS, HALVED = 0.03, 8, 6  # errors of the root mean square of a curve; Gauss–Newton steps, how often halved
D1 = 2e4
TRUTH = {"kind": "mooney-rivlin", "C1": 450.0, "C2": 350.0, "D1": D1}
CANDIDATES: dict[str, dict[str, Any]] = {
    "neo-Hookean": {"kind": "neo-hookean", "C1": 800.0, "D1": D1},
    "Ogden, one term": {
        "kind": "ogden", "mu1": 800.0, "alpha1": 4.0, "mu2": 0.0, "alpha2": 1.0, "mu3": 0.0, "alpha3": 1.0, "D1": D1,
    },
    "Demiray": {"kind": "demiray", "a": 1600.0, "b": 0.5, "D1": D1},
}  # fmt: skip
CONSTANTS = {"neo-hookean": ("C1",), "ogden": ("mu1", "alpha1"), "demiray": ("a", "b")}
BALL = {"kind": "indenter", "name": "tool", "shape": "sphere", "radius": RADIUS, "at": (0.0, 0.0, SIDE)}
PLATE = {"kind": "indenter", "name": "tool", "shape": "plane", "at": (0.0, 0.0, SIDE)}
FORCE = {"kind": "force", "name": "force", "tool": "tool", "times": 4.0}
BESIDE = tuple(
    {"kind": "displacement", "name": name, "at": (x, 0.0, SIDE), "component": axis}
    for name, x, axis in (("out", 4e-3, "x"), ("down", 4e-3, "z"), ("farther", 7e-3, "z"))
)
TO = tuple(k * 0.3e-3 for k in range(1, 6))
TESTS: dict[str, tuple[dict[str, Any], tuple[dict[str, Any], ...], tuple[float, ...]]] = {
    "ball": (BALL, (FORCE,), TO),
    "deeper": (BALL, (FORCE,), (*TO, 1.8e-3, 2.1e-3, 2.4e-3)),
    "beside": (BALL, (FORCE, *BESIDE), TO),
    "plate": (PLATE, (FORCE,), (1e-3, 2e-3, 3e-3, 4e-3)),
}
DATA: dict[str, tuple[tuple[str, ...], float]] = {  # tests, and errors of displacements (m)
    "the ball to 1.5 mm": (("ball",), 0.0),
    "the ball to 2.4 mm": (("deeper",), 0.0),
    "the ball to 1.5 mm and displacements beside it to 10 µm": (("beside",), 10e-6),
    "the ball to 1.5 mm and displacements beside it to 2 µm": (("beside",), 2e-6),
    "the ball to 1.5 mm and a plate that presses by 4 mm": (("ball", "plate"), 0.0),
}


def model(material: dict[str, Any], test: str, constants: tuple[str, ...]) -> Any:
    """Return a quarter of a block under a tool."""
    tool, outputs, depth = TESTS[test]
    spec = Path.model_validate(
        {
            "body": {
                "kind": "box",
                "size": (SIDE,) * 3,
                "cells": (3,) * 3,
                "degree": 2,
                "grading": dict.fromkeys(("x-min", "y-min", "z-max"), 3.0),
            },
            "material": material,
            "formulation": "displacement",
            "clamp": ("z-min",),
            "displacements": ({"on": "x-min", "x": 0.0}, {"on": "y-min", "y": 0.0}),
            "loads": ({**tool, "on": "z-max", "direction": (0.0, 0.0, -1.0), "depth": depth[-1]},),
            "steps": {"loads.tool.depth": depth},
            "outputs": outputs,
        }
    )
    return spec.build(MPI.COMM_SELF, tuple(f"material.{name}" for name in constants))


def misfit(tests: tuple[str, ...], of_place: float, material: dict[str, Any]) -> tuple[float, FloatArray]:
    """Fit a candidate to what tests measure of the truth; return half of the misfit that is left, and its constants."""
    constants = CONSTANTS[material["kind"]]
    data = [np.asarray(model(TRUTH, test, ()).solve(np.zeros(0)).outputs) for test in tests]
    sigma = [_sigma(values, TESTS[test][1], of_place) for values, test in zip(data, tests, strict=True)]
    models = [model(material, test, constants) for test in tests]

    def at(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        found = [candidate.solve(x) for candidate in models]
        left = [(y - one.outputs) / s for y, one, s in zip(data, found, sigma, strict=True)]
        slopes = [one.tangent(np.diag(x)).T / s[:, None] for one, s in zip(found, sigma, strict=True)]
        return np.concatenate(left), np.concatenate(slopes)

    x = np.array([material[name] for name in constants])
    left, slopes = at(x)
    for _ in range(STEPS):
        change = np.linalg.lstsq(slopes, left, rcond=None)[0]
        if np.abs(change).max() < 1e-2:
            break
        change *= min(1.0, 0.7 / np.abs(change).max())
        for halved in range(HALVED):
            there = x * np.exp(change / 2**halved)  # constants stay positive
            trial = at(there)
            if trial[0] @ trial[0] < left @ left:
                x, (left, slopes) = there, trial
                break
    return float(left @ left) / 2, x


def _sigma(values: FloatArray, outputs: tuple[dict[str, Any], ...], of_place: float) -> FloatArray:
    """Standard deviations of the errors of outputs, step by step."""
    curves = values.reshape(-1, len(outputs))
    sizes = [
        OF_FORCE * float(np.sqrt((curve**2).mean())) if output["kind"] == "force" else of_place
        for output, curve in zip(outputs, curves.T, strict=True)
    ]
    return np.tile(sizes, len(curves))


def telling() -> None:
    """Print what is left of the misfit of each candidate."""
    begin = time.process_time()
    sys.stdout.write(f"Half of the misfit that is left, forces to {100 * OF_FORCE:g} %: {', '.join(CANDIDATES)}\n")
    for words, (tests, of_place) in DATA.items():
        found = [misfit(tests, of_place, material) for material in CANDIDATES.values()]
        sizes = "  ".join(f"{size:.2g}" for size, _ in found)
        constants = "; ".join(", ".join(f"{value:.4g}" for value in x) for _, x in found)
        sys.stdout.write(f"{words:56s} {sizes}   ({constants})\n")
        sys.stdout.flush()
    sys.stdout.write(f"{time.process_time() - begin:.0f} s of CPU\n")
