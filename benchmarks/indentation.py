"""Rigid tools: closed forms, large strains, random indentations, their cost, and what tells materials apart.

Options: ``--tables closed-forms cost …`` for some of the tables (none leaves all out), ``--shapes sphere …`` and
``--meshes 40,0.2,1.6 …`` for the closed forms (size and first edge over the radius in contact, growth),
``--random 1000`` for the number of random indentations, ``--kept FILE`` for those that are finished: the same command
goes on with them.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from benchmarks.axisymmetric import indented, thin
from benchmarks.half_spaces import C1, CONTACT, D1, DEPTH, MESHES, TOOLS, Mesh, closed_forms
from benchmarks.indentations import random
from benchmarks.organ_indentation import phases
from benchmarks.telling_materials import telling
from forward.fem.finer import extrapolated
from forward.hyperelastic import Hyperelastic
from forward.model import Guess, ReferenceSolution
from inverse.criticism.finer import Look
from inverse.data.measurements import Measurements
from inverse.data.noise import Noise
from inverse.methods.mesh_correction import error_of

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


def rough(cells: int = 5) -> None:
    """A punch that does not slip, over one without friction: (1 − ν) ln(3 − 4ν)/(1 − 2ν) on a half-space."""
    sys.stdout.write("Rough over smooth flat punch: Poisson's ratio, computed, V. I. Mossakovski 1954, CPU time (s)\n")
    for nu in (0.0, 0.2, 2 / 7):
        material = {"kind": "neo-hookean", "C1": C1, "D1": 2 * C1 * (1 + nu) / (3 * (1 - 2 * nu))}
        tool = {"shape": "flat", "radius": CONTACT, "edge": CONTACT / 20, "depth": 5 * DEPTH}
        start, forces = time.process_time(), []
        for friction in ({"friction": 10.0, "increments": 2}, {}):
            spec = quarter(40 * CONTACT, (cells,) * 3, 80.0, tool | friction, material=material)
            forces.append(spec.build(MPI.COMM_SELF, ()).solve(np.zeros(0)).outputs[0])
        known = (1 - nu) * math.log(3 - 4 * nu) / (1 - 2 * nu)
        seconds = time.process_time() - start
        sys.stdout.write(f"{nu:.3f}  {forces[0] / forces[1]:.4f}  {known:.4f}  {seconds:.1f} s\n")
        sys.stdout.flush()


def large_strains() -> None:
    """A sphere of 3 mm pressed 0.5, 1 and 1.5 mm into a block of 12 mm, and into a cylinder of equal area."""
    side, radius, across = 12e-3, 3e-3, 2 / math.sqrt(math.pi)
    outputs = [{"name": "force", "kind": "force", "times": 4}, {"name": "area", "kind": "contact-area"}]
    meshes = (((8, 8, 6), 16.0), *(((n,) * 3, 6.0) for n in (4, 5, 6, 8)))
    models = {
        cells: quarter(
            side, cells, grading, {"shape": "sphere", "radius": radius, "depth": 1e-3}, outputs=outputs
        ).build(MPI.COMM_SELF, ("loads.indenter.depth",))
        for cells, grading in meshes
    }
    sys.stdout.write("Sphere of 3 mm, large strains: force (mN) and area (mm²) by an axisymmetric code; ratios to it\n")
    for depth in (0.5e-3, 1e-3, 1.5e-3):
        other = indented(across * side, side, radius, depth, C1, D1, thin(16, 0.21))
        sys.stdout.write(f"{1e3 * depth:.1f} mm  {1e3 * other.force:.4f}  {1e6 * other.area:.3f}\n")
        for cells, model in models.items():
            force, area = model.solve(np.array([depth])).outputs
            sys.stdout.write(f"    {cells}: {force / other.force:.4f}  {4 * area / other.area:.4f}\n")
            sys.stdout.flush()


def stiffness(draws: int = 1000) -> None:
    """C1 from forces by the axisymmetric code, by the linear model with the error of the mesh as inversions know it."""
    side, radius, across, to_C1 = 12e-3, 3e-3, 2 / math.sqrt(math.pi), np.array([0.0, C1])
    points = np.column_stack([np.linspace(0.3e-3, 1.5e-3, 9), np.full(9, C1)])
    truth = np.array(
        [indented(across * side, side, radius, depth, *(C1, D1), thin(16, 0.21)).force for depth, _ in points]
    )
    sets = {"five depths, twice": np.tile(np.arange(0, 9, 2), 2), "nine depths": np.arange(9)}
    sys.stdout.write("C1 within 2.5 deviations; these over those without an error of the mesh; its bias over them\n")
    tool = {"shape": "sphere", "radius": radius, "depth": 1e-3}
    outputs = [{"name": "force", "kind": "force", "times": 4}]
    for cells, grading in [(3, 2.0), (3, 3.0), (3, 6.0), (3, 10.0), (4, 3.0), (4, 6.0), (4, 10.0)]:
        spec = quarter(side, (cells,) * 3, grading, tool, outputs=outputs)
        model = spec.build(MPI.COMM_SELF, ("loads.indenter.depth", "material.C1"))
        finer = extrapolated(model).of(model)
        found = [(model.solve(point), finer.solve(point)) for point in points]
        rows = np.array([[*a.outputs, *b.outputs, a.tangent(to_C1)[0], b.tangent(to_C1)[0]] for a, b in found])
        for (name, which), noise in product(sets.items(), (0.01, 0.02, 0.03)):
            own, fine, between, _, slope_fine = rows[which].T
            sigma = np.full(len(which), noise * np.sqrt((truth[which] ** 2).mean()))
            data = Measurements.of(np.zeros(len(which)), sigma, which, which, [f"force.{k}" for k in which], some=True)
            look = Look(fine, between, slope_fine[:, None])
            known = Noise(sigma, model=error_of(look, own, data))
            A = known.whitened(slope_fine / known.scale)
            measured = truth[which] + sigma * np.random.default_rng(1).standard_normal((draws, len(which)))
            off = known.whitened((measured - fine) / known.scale) @ A / np.sqrt(A @ A)
            held, wider = (np.abs(off) <= 2.5).mean(), np.sqrt(((slope_fine / sigma) ** 2).sum() / (A @ A))
            case = f"{cells}³, {grading:g}, {name}, {100 * noise:g} %"
            sys.stdout.write(f"{case}: {held:.2f} (x {wider:.1f}; {off.mean():+.1f})\n")
            sys.stdout.flush()


def cost(draws: int = 12) -> None:
    """Predict and correct against Newton's method, from the same predictions and from zero."""
    sys.stdout.write(
        f"CPU time (s) of a sample, mean of {draws} (3,993 unknowns); random by 10 %, radius by 5 %: corrected, Newton"
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
        means = "  ".join(f"{value:.3f}" for value in np.mean(times, axis=0))
        sys.stdout.write(f"{what:24s} {means}\n")
        sys.stdout.flush()


def main(words: Sequence[str] = ()) -> None:
    """Print the tables that are asked for."""
    tables: dict[str, Callable[[], None]] = {
        "closed-forms": lambda: closed_forms(options.meshes, options.shapes),
        "rough": rough,
        "large-strains": large_strains,
        "stiffness": stiffness,
        "cost": cost,
        "phases": phases,
        "materials": telling,
    }
    parser = argparse.ArgumentParser(prog="python -m benchmarks indentation")
    parser.add_argument("--tables", nargs="*", choices=tables, default=list(tables))
    parser.add_argument("--shapes", nargs="*", choices=TOOLS, default=list(TOOLS))
    parser.add_argument("--meshes", nargs="*", type=Mesh.read, default=MESHES)
    parser.add_argument("--random", type=int, default=1000)
    parser.add_argument("--own", type=int, default=0, help="random ones on a mesh from a file")
    parser.add_argument("--kept", type=Path, default=Path("indentations.jsonl"))
    options = parser.parse_args(words)
    for name in options.tables:
        tables[name]()
    if options.random or options.own:
        random(options.random, options.kept, options.own)
