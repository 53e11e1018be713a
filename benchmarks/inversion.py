"""Inversion of a stiffness field of a cube in three load cases: what its mode and its posterior cost as meshes grow."""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import product

import numpy as np
from mpi4py import MPI

from forward.bodies.random_fields import RandomField
from forward.fem.joined import SpecimenModel
from forward.model import FloatArray
from forward.specimen import Specimen
from inverse.data.noise import Noise
from inverse.fields.field_posterior import FieldPosterior
from inverse.fields.low_rank import LowRankPosterior
from inverse.fields.newton_cg import find_mode

CELLS = (7, 12, 16, 24)  # along each edge: 512 to 15 625 vertices
PAIRS = 100
NOISE = 0.01  # of the root mean square of the displacements of each load case
CONTRAST = 3.0
FIELD = RandomField(of="stiffness", length=0.5, std=0.6, basis="nodes")


def specimen(cells: int, points_along: int = 5) -> Specimen:
    """Return the unit cube, held below and pulled above along three directions, observed at points of four faces."""
    lines = np.linspace(0, 1, points_along).tolist()
    faces = [((0.0, a, b), (1.0, a, b), (a, 1.0, b), (a, b, 1.0)) for a, b in product(lines, lines)]
    points = sorted({point for four in faces for point in four if point[2] > 0})
    directions = {"shear": (1.0, 0.0, 0.0), "extension": (0.0, 0.0, 1.0), "compression": (0.0, 0.0, -1.0)}
    cases = [
        {
            "name": name,
            "clamp": ("z-min",),
            "loads": ({"kind": "traction", "on": "z-max", "direction": direction, "size": 1500.0},),
        }
        for name, direction in directions.items()
    ]
    return Specimen.model_validate(
        {
            "body": {"size": (1.0, 1.0, 1.0), "cells": (cells, cells, cells), "degree": 1},
            "material": {"kind": "neo-hookean-coupled", "mu": 1e4, "lmbda": 4e4},
            "fields": (FIELD,),
            "cases": cases,
            "observed": ({"at": tuple(points)},),
        }
    )


def truth(places: FloatArray) -> FloatArray:
    """Logarithm (N,) of a stiff inclusion, over the median of the prior."""
    distance = ((places - [0.55, 0.5, 0.6]) ** 2).sum(axis=1) / 0.28**2
    return np.asarray(np.log(CONTRAST) * np.exp(-(distance**2)) + FIELD.log_std**2 / 2)


def problem(cells: int) -> tuple[FieldPosterior, FloatArray]:
    """Return the posterior of data that the same mesh has made (what is measured is the cost), and the truth (N,)."""
    spec = specimen(cells)
    model: SpecimenModel = spec.build(MPI.COMM_SELF, spec.coefficients)
    true = truth(model.space.coordinates)
    clean = model.solve(true).outputs
    sizes = [np.sqrt((part**2).mean()) for part in np.split(clean, np.flatnonzero(np.diff(model.cases)) + 1)]
    sigma = NOISE * np.array(sizes)[model.cases]
    data = clean + sigma * np.random.default_rng(0).standard_normal(len(clean))
    return FieldPosterior(model, data, Noise(sigma), FIELD.prior(spec.body)), true


@dataclass(frozen=True)
class Cost:
    """What one mesh took."""

    unknowns: int
    solves: int
    mode_products: int
    pair_products: int
    seconds: tuple[float, ...]  # of CPU: prior, mode, pairs
    values: FloatArray
    determined: float
    inside: float

    @property
    def work(self) -> float:
        """Solves of the model and its linearisations: a product is a tangent and an adjoint, two of the latter."""
        return self.solves + 2.0 * (self.mode_products + self.pair_products)


def cost(cells: int) -> Cost:
    """Find mode and pairs on one mesh."""
    posterior, true = problem(cells)
    times = [time.process_time()]
    posterior.values(np.zeros(posterior.size))
    times.append(time.process_time())
    mode = find_mode(posterior)
    times.append(time.process_time())
    found = LowRankPosterior.at(mode.point, rank=PAIRS)
    times.append(time.process_time())
    inside = float((np.abs(found.mean - true) < 2 * found.std).mean())
    values, seconds = found.spectrum.values, tuple(np.diff(times).tolist())
    products = mode.products, found.spectrum.products
    return Cost(posterior.size, mode.solves, *products, seconds, values, found.spectrum.determined, inside)


def main(cells: tuple[int, ...] = CELLS) -> None:
    """Print counts, CPU times and the spectrum for each mesh."""
    print(
        "| unknowns of the field | solves | products: mode | pairs | linear solves in each case | CPU time (s): prior "
        "| mode | pairs | λ_1 | λ_20 | λ_50 | λ_100 | directions determined | truth within 2 std |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|---|---|")
    rows = []
    for n in cells:
        row = cost(n)
        rows.append(row)
        seconds = " | ".join(f"{t:.1f}" for t in row.seconds)
        values = " | ".join(f"{row.values[i - 1]:.3g}" for i in (1, 20, 50, 100))
        counts = f"{row.unknowns} | {row.solves} | {row.mode_products} | {row.pair_products} | {row.work:.0f}"
        print(f"| {counts} | {seconds} | {values} | {row.determined:.1f} | {100 * row.inside:.0f} % |", flush=True)
    for what, numbers in (("solves", [row.solves for row in rows]), ("linear solves", [row.work for row in rows])):
        off = max(numbers) / np.mean(numbers) - 1, 1 - min(numbers) / np.mean(numbers)
        print(f"\n{what}: {min(numbers):g} to {max(numbers):g}, within {100 * max(off):.0f} % of their mean", end="")
    for row in rows:
        if row.unknowns == 2197:
            print(
                f"\n{row.unknowns} unknowns: {sum(row.seconds):.0f} s of CPU for prior, mode and {PAIRS} pairs", end=""
            )
    if len(rows) > 1:
        change = [f"{rows[-1].values[i - 1] / rows[-2].values[i - 1] - 1:+.0%}" for i in (1, 20, 50, 100)]
        print(f"\nλ_1, λ_20, λ_50, λ_100 from the second finest mesh to the finest: {', '.join(change)}")
