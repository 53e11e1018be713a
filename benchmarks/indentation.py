"""Rigid tools: closed forms on a large block, large strains against another code, random indentations, and their cost.

Options: ``--meshes 40,0.6,6 …`` for the closed forms, side and first edge over the radius in contact and cells along an
edge (none leaves these tables out), ``--random 1000`` for the
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
from scipy.integrate import trapezoid
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq

from benchmarks.axisymmetric import indented
from benchmarks.indentations import random
from forward.hyperelastic import Hyperelastic
from forward.model import Guess, ReferenceSolution
from forward.terms.indenter import Indenter

C1, D1 = 1e3, 2e3  # ν = 2/7
CONTACT, DEPTH = 1e-3, 2e-6  # radius in contact and depth (m) of the closed forms
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


def half_space(tool: Indenter, modulus: float) -> float:
    """Force (N) on a half-space by a tool with its own profile f(r): L. A. Galin; I. N. Sneddon, 1965.

    δ = ∫ f'(r) a/√(a² − r²) dr and F = 2E* ∫ f'(r) r²/√(a² − r²) dr over the radius a of the area in contact, so what
    differs from Hertz's sphere, a punch and a cone (rounded edges and tips) is no error here.
    """
    end = min(0.999999 * (tool.radius or 1.0), 20 * CONTACT)
    r = end * np.sin(np.linspace(0, np.pi / 2, 4001))
    heights = np.array([_height(tool, one) for one in r])
    slope = PchipInterpolator(r, heights).derivative()
    angles = np.linspace(0, np.pi / 2, 20001)

    def of(a: float) -> tuple[float, float]:
        slopes = slope(a * np.sin(angles))
        return a * trapezoid(slopes, angles), 2 * modulus * a**2 * trapezoid(slopes * np.sin(angles) ** 2, angles)

    radius = brentq(lambda a: of(a)[0] - tool.depth, 1e-3 * CONTACT, end)
    return float(of(radius)[1])


def _height(tool: Indenter, r: float) -> float:
    """How far (m) the surface of a tool lies behind its tip, at a distance r (m) from its axis."""
    d = np.array(tool.along)
    beside = np.array(tool.at) + tool.depth * d + np.array([r, 0.0, 0.0])
    return float(brentq(lambda t: float(tool.gaps((beside - t * d)[None])[0]), -1e-6, 1e-1, xtol=1e-15))


def closed_forms(meshes: list[str]) -> None:
    """Forces over those on a half-space, on blocks of several sizes and meshes, and what they tend to."""
    angle = math.atan(math.pi / 2 * CONTACT / DEPTH)
    tools: dict[str, dict[str, Any]] = {
        "sphere": {"radius": CONTACT**2 / DEPTH},
        "flat": {"radius": CONTACT, "edge": CONTACT / 20},
        "cone": {"angle": math.degrees(angle), "tip": CONTACT / 20},
    }
    sys.stdout.write(
        "Force over that on a half-space; quarter of a block: side and first edge over the radius in contact, cells\n"
    )
    for shape, numbers in tools.items():
        ratios = {}
        for mesh in meshes:
            side, first, n = (float(part) for part in mesh.split(","))
            growth = brentq(lambda g: (g**n - 1) / (g - 1) - side / first, 1.01, 10.0)  # noqa: B023 - used at once
            grading = growth ** (n - 1)
            spec = quarter(side * CONTACT, (int(n),) * 3, grading, {"shape": shape, "depth": DEPTH, **numbers})
            tool: Any = spec.loads[0]
            model = spec.build(MPI.COMM_SELF, ())
            start = time.process_time()
            found = model.solve(np.zeros(0))
            seconds = time.process_time() - start
            ratios[side, first] = ratio = 4 * found.outputs[0] / half_space(tool, spec.contact_modulus)
            into = model.equations.penetrations()["indenter"] / DEPTH
            sys.stdout.write(
                f"{shape:6s} side {side:3g}, first edge {first:4g}, {spec.unknowns:7,d} unknowns: {ratio:.4f}; "
                f"penetration {into:.1e} of the depth; {found.work.factorisations} factors, {seconds:.1f} s\n"
            )
            sys.stdout.flush()
        _tend_to(shape, ratios)


def _tend_to(shape: str, ratios: dict[tuple[float, float], float]) -> None:
    """Print what blocks and cells do: errors of blocks fall with 1/side, those of meshes with the first edge."""
    pairs = [(p, q) for p in ratios for q in ratios if p[1] == q[1] and p[0] < q[0]]
    smallest = min(side for side, _ in ratios)
    meshes = sorted((edge, ratio) for (side, edge), ratio in ratios.items() if side == smallest)
    if not pairs or len(meshes) < 2:
        return
    p, q = pairs[-1]
    of_block = (ratios[p] - ratios[q]) / (1 / p[0] - 1 / q[0]) / smallest
    (fine, there), (coarse, here) = meshes[:2]
    limits = [there - (here - there) / ((coarse / fine) ** order - 1) - of_block for order in (2, 1)]
    of_mesh = there - of_block - limits[0]
    sys.stdout.write(
        f"{shape:6s} the block of {smallest:g} adds {of_block:+.4f}, the finest mesh on it {of_mesh:+.4f}; "
        f"without both {limits[0]:.4f} (errors of the mesh of order 2) or {limits[1]:.4f} (of order 1)\n"
    )


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
    parser.add_argument("--meshes", nargs="*", default=["40,0.6,6", "40,0.4,8", "40,0.27,10", "80,0.4,9"])
    parser.add_argument("--random", type=int, default=1000)
    parser.add_argument("--kept", type=Path, default=Path("indentations.jsonl"))
    options = parser.parse_args(arguments or [])
    if options.meshes:
        closed_forms(options.meshes)
        rough()
        large_strains()
    cost()
    if options.random:
        random(options.random, options.kept)
