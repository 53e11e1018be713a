"""Rigid tools: closed forms on a large block, large strains against another code, random indentations, and their cost.

Options: ``--cells 6 8`` for the meshes of the closed forms (none leaves these tables out), ``--random 1000`` for the
number of random indentations, ``--kept FILE`` for those that are finished: the same command goes on with them.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from benchmarks.axisymmetric import indented
from benchmarks.indentations import random
from forward.hyperelastic import Hyperelastic
from forward.model import Guess, ReferenceSolution

C1, D1 = 1e3, 2e3  # ν = 2/7
CONTACT, DEPTH = 1e-3, 2e-5  # radius in contact and depth (m) of the closed forms
SIDE = 20e-3
PATHS = {
    "material": ("material.C1",),
    "depth": ("loads.indenter.depth",),
    "depth, radius, material": ("loads.indenter.depth", "loads.indenter.radius", "material.C1"),
}


def quarter(
    side: float, cells: tuple[int, int, int], grading: float, tool: dict[str, Any], **more: Any
) -> Hyperelastic:
    """A quarter of a block that is indented in the middle of its top and bonded below."""
    shared = {"kind": "indenter", "on": "z-max", "at": [0.0, 0.0, side], "direction": [0.0, 0.0, -1.0]}
    blocks = {
        "body": {
            "kind": "box",
            "size": [side] * 3,
            "cells": list(cells),
            "degree": 2,
            "grading": dict.fromkeys(("x-min", "y-min", "z-max"), grading),
        },
        "material": {"kind": "neo-hookean", "C1": C1, "D1": D1},
        "formulation": "displacement",
        "displacements": [
            {"on": "x-min", "x": 0.0},
            {"on": "y-min", "y": 0.0},
            {"on": "z-min", "x": 0.0, "y": 0.0, "z": 0.0},
        ],
        "loads": [shared | tool],
        "outputs": [
            {"name": "force", "kind": "force"},
            {"name": "below", "kind": "reaction", "on": "z-min", "component": "z"},
        ],
    }
    return Hyperelastic.model_validate(blocks | more)


def closed_forms(cells: list[int]) -> None:
    """Forces over those of Hertz, Boussinesq's punch and Sneddon's cone on a half-space."""
    angle = math.atan(math.pi / 2 * CONTACT / DEPTH)
    tools: dict[str, tuple[dict[str, Any], float]] = {
        "sphere": ({"radius": CONTACT**2 / DEPTH}, 4 / 3 * CONTACT * DEPTH),
        "flat": ({"radius": CONTACT, "edge": CONTACT / 20}, 2 * CONTACT * DEPTH),
        "cone": ({"angle": math.degrees(angle), "tip": CONTACT / 20}, 2 / math.pi * math.tan(angle) * DEPTH**2),
    }
    sys.stdout.write("Force over the closed form (quarter of a block of 80 contact radii), penetration over depth\n")
    for shape, (numbers, over_modulus) in tools.items():
        for n in cells:
            lattice = (n, n, max(3 * n // 4, 1))
            spec = quarter(80 * CONTACT, lattice, 160.0, {"shape": shape, "depth": DEPTH, **numbers})
            model = spec.build(MPI.COMM_SELF, ())
            start = time.process_time()
            found = model.solve(np.zeros(0))
            seconds = time.process_time() - start
            ratio = 4 * found.outputs[0] / (over_modulus * spec.contact_modulus)
            into = model.equations.penetrations()["indenter"] / DEPTH
            line = (
                f"{shape:6s} {spec.unknowns:7,d} unknowns  {ratio:.4f}  {into:.1e}  {found.work.factorisations} factors"
            )
            sys.stdout.write(f"{line}  {seconds:.1f} s\n")
            sys.stdout.flush()


def large_strains() -> None:
    """A sphere of 3 mm pressed 0.5, 1 and 1.5 mm into a block of 12 mm, and into a cylinder of equal area."""
    side, radius = 12e-3, 3e-3
    spec = quarter(side, (8, 8, 6), 16.0, {"shape": "sphere", "radius": radius, "depth": 1e-3})
    model = spec.build(MPI.COMM_SELF, ("loads.indenter.depth",))
    sys.stdout.write("Sphere of 3 mm, large strains: depth, force (mN), by an axisymmetric code, ratio\n")
    for depth in (0.5e-3, 1e-3, 1.5e-3):
        force = 4 * model.solve(np.array([depth])).outputs[0]
        other = indented(2 * side / math.sqrt(math.pi), side, radius, depth, C1, D1)
        sys.stdout.write(f"{1e3 * depth:.1f} mm  {1e3 * force:.4f}  {1e3 * other:.4f}  {force / other:.4f}\n")
        sys.stdout.flush()


def cost(draws: int = 8) -> None:
    """Predict and correct against Newton's method, from the same predictions and from zero."""
    sys.stdout.write(
        "CPU time (s) of a sample, median of 8 (3,993 unknowns); random by 10 %, radius by 5 %: corrected, Newton"
        " from the prediction, Newton from zero\n"
    )
    tool = {"shape": "sphere", "radius": 5e-3, "depth": 2e-3}
    spec = quarter(SIDE, (5, 5, 5), 8.0, tool)
    rng = np.random.default_rng(0)
    for what, names in PATHS.items():
        model, textbook = spec.build(MPI.COMM_SELF, names), spec.textbook().build(MPI.COMM_SELF, names)
        mean = np.array([spec.scalars[name].value for name in names])
        std = mean * np.array([0.05 if name.endswith("radius") else 0.1 for name in names])
        at_mean = model.solve(mean)
        slopes = at_mean.state_tangent(np.eye(len(names)))
        reference = ReferenceSolution(mean, at_mean.state, std)
        model.solve(mean, Guess(at_mean.state, reference))  # the factor of the reference is made once
        times = []
        for _ in range(draws):
            point = mean + std * rng.standard_normal(len(names))
            near = at_mean.state + (point - mean) @ slopes
            row = []
            for solver, guess in ((model, Guess(near, reference)), (model, Guess(near)), (textbook, None)):
                start = time.process_time()
                solver.solve(point, guess)
                row.append(time.process_time() - start)
            times.append(row)
        medians = "  ".join(f"{value:.3f}" for value in np.median(times, axis=0))
        sys.stdout.write(f"{what:24s} {medians}\n")
        sys.stdout.flush()


def main(arguments: list[str] | None = None) -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks indentation")
    parser.add_argument("--cells", type=int, nargs="*", default=[6, 9, 12])
    parser.add_argument("--random", type=int, default=1000)
    parser.add_argument("--kept", type=Path, default=Path("indentations.jsonl"))
    options = parser.parse_args(arguments or [])
    if options.cells:
        closed_forms(options.cells)
        large_strains()
    cost()
    if options.random:
        random(options.random, options.kept)
