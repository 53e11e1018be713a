"""Reduced models of a block under a ball whose depth, radius and place are random, and of a nearly incompressible one.

Errors at unseen samples, estimates of them, and times.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import numpy as np
from mpi4py import MPI

from forward.hyperelastic import Hyperelastic
from forward.model import SolveError
from forward.reduced.model import ReducedModel
from forward.reduced.reduction import Reduction, Sizes
from forward.reduced.snapshots import solved

BALL = {"kind": "indenter", "shape": "sphere", "on": "z-max", "at": [0.05, 0.03, 0.03], "direction": [0, 0, -1]}
BODY = {
    "body": {"kind": "box", "size": [0.1, 0.06, 0.03], "cells": [6, 4, 2], "cell": "hexahedron", "degree": 2},
    "material": {"kind": "neo-hookean", "C1": 1e3, "D1": 5e3},
    "formulation": "displacement",
    "clamp": ["z-min"],
    "loads": [BALL | {"depth": 0.004, "radius": 0.015}],
    "outputs": [
        {"name": "force", "kind": "force"},
        {"name": "beside", "kind": "displacement", "at": [0.05, 0.048, 0.03], "component": "z"},
        {"name": "energy", "kind": "strain-energy"},
        {"name": "stress", "kind": "max-von-mises"},
    ],
}
MEANS = {"material.C1": 1e3, "material.D1": 5e3, "loads.indenter.depth": 0.004, "loads.indenter.radius": 0.015}
SPREADS = {"material.C1": 100, "material.D1": 1e3, "loads.indenter.depth": 1e-3, "loads.indenter.radius": 2e-3}
REACH, UNSEEN = 1.7, 1.5  # deviations up to which snapshots and unseen samples go
MIXED = BODY | {
    "body": {"kind": "box", "size": [0.1, 0.06, 0.03], "cells": [4, 2, 2], "cell": "hexahedron", "degree": 2},
    "material": {"kind": "neo-hookean", "C1": 1e3, "D1": 1e7},
    "formulation": "mixed",
    "loads": [
        {"kind": "gravity", "density": 1000},
        {"kind": "spot", "on": "z-max", "direction": [0, 0, -1], "size": 0.5, "x": 0.05, "y": 0.03, "z": 0.03}
        | {"width": 0.02},
    ],
    "outputs": [
        {"name": "top", "kind": "displacement", "at": [0.05, 0.03, 0.03], "component": "z"},
        {"name": "volume", "kind": "volume-change"},
        {"name": "energy", "kind": "strain-energy"},
        {"name": "stress", "kind": "max-von-mises"},
        {"name": "force", "kind": "reaction", "on": "z-min", "component": "z"},
    ],
}
OF_MIXED = {
    "material.C1": (1e3, 100),
    "material.D1": (1e7, 1e6),
    "loads.spot.size": (0.5, 0.15),
    "loads.spot.x": (0.05, 0.012),
}
PLACE = 0.05  # m, of the ball along x


def main(words: Sequence[str] = ()) -> None:
    """Print a row for each number of modes and output."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks reduced_bodies")
    parser.add_argument("--snapshots", type=int, default=20)
    parser.add_argument("--unseen", type=int, default=24)
    parser.add_argument("--modes", type=int, nargs="+", default=[20])
    parser.add_argument("--moving", type=float, default=0.0, help="standard deviation (m) of the place of the ball")
    parser.add_argument("--cells", type=int, nargs=3, help="of the body; by default few")
    parser.add_argument("--mixed", action="store_true", help="the nearly incompressible block, κ/μ = 10⁴")
    given = parser.parse_args(words)
    names, nominal, spread = tuple(MEANS), [*MEANS.values()], [*SPREADS.values()]
    if given.moving:
        names, nominal, spread = (*names, "loads.indenter.x"), [*nominal, PLACE], [*spread, given.moving]
    if given.mixed:
        names, (nominal, spread) = tuple(OF_MIXED), zip(*OF_MIXED.values(), strict=True)  # type: ignore[assignment]
    mean, deviation, rng = np.array(nominal), np.array(spread), np.random.default_rng(1)
    body = MIXED if given.mixed else BODY
    if given.cells:
        body = body | {"body": body["body"] | {"cells": given.cells}}  # type: ignore[operator]
    full = Hyperelastic.model_validate(body).build(MPI.COMM_SELF, names)
    begin = time.process_time()
    snapshots = solved(full, mean + deviation * rng.uniform(-REACH, REACH, (given.snapshots, len(names))), deviation)
    taken = time.process_time() - begin
    points = mean + deviation * rng.uniform(-UNSEEN, UNSEEN, (given.unseen, len(names)))
    begin = time.process_time()
    truth = np.array([full.solve(point).outputs for point in points])
    alone = (time.process_time() - begin) / len(points)
    print(
        f"{full.equations.size:,} unknowns, {given.snapshots} snapshots in {taken:.0f} s; a solve {alone:.2g} s; "
        f"errors in % of the spread at {given.unseen} unseen samples\n"
    )
    columns = "output | error | after correction | effectivity | estimate over error, 5, 50, 95 % of the samples"
    print(f"| modes, points of the body | {columns} | a solve (ms) | truncation |")
    print("|---|---|---|---|---|---|---|---|")
    reduction = Reduction(full, mean, deviation)
    for modes in given.modes:
        data = reduction.reduced(snapshots, Sizes(modes=modes, cubature=1e-3))
        model = ReducedModel(data, names)
        found, good = [], []
        begin = time.process_time()
        for i, point in enumerate(points):
            try:
                found.append(model.solve(point))
                good.append(i)
            except SolveError as error:
                print(error)
        each = 1e3 * (time.process_time() - begin) / len(points)
        e = truth[good] - np.array([one.outputs for one in found])
        x = np.array([one.estimate.outputs for one in found])
        errors, left = (100 * np.sqrt((one**2).mean(axis=0)) / truth.std(axis=0) for one in (e, e - x))
        effectivity = (e * x).sum(axis=0) / (e**2).sum(axis=0)
        size = f"{data.about['modes']}, {data.about['points']}"
        quantiles = np.quantile(x / e, (0.05, 0.5, 0.95), axis=0).T
        for name, one, after, share, of in zip(model.outputs, errors, left, effectivity, quantiles, strict=True):
            ratios = ", ".join(f"{q:.2f}" for q in of)
            print(
                f"| {size} | {name} | {one:.2g} | {after:.2g} | {share:.2f} | {ratios} | {each:.2g} | "
                f"{data.about['truncation']:.1e} |",
                flush=True,
            )
