"""Whether intervals hold the truth of data that have no mesh in common with the inversion.

Specimens are drawn from the prior; their data are those of graded hexahedra of degree 2, 12 along an edge, thinner at
the held face than any mesh that the inversion looks at. Of posteriors on 4 cells along an edge that are linear at the
truth it is known in closed form how often intervals hold it, over all noise; some are inverted as studies do.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI

from forward.fem.finer import extrapolated
from forward.fem.specimen import SpecimenModel
from forward.model import FloatArray, SolveError
from forward.specimen import Specimen
from inverse.criticism.finer import Finer
from inverse.data.approximation_error import ApproximationError, Places, Whitening
from inverse.data.errors import NORMAL
from inverse.data.observations import Components
from inverse.methods.invert import Invert
from inverse.methods.invert_few import Nearby, invert_by_group
from inverse.methods.mesh_correction import Treatment, error_of
from uq.inputs.distributions import Distribution, LogNormal, LogUniform, Uniform
from uq.inputs.random_parameters import Inputs
from workflows.studies.finer import solved_on

CELLS, OVERKILL = 4, 12
WIDE = 1.959964  # deviations of an interval of 95 %
TRUTHS = 24
NOISES = (0.01, 0.03)  # of the root mean square of the displacements of each load case
INVERTED = 2  # of the truths that are inverted too
FILE = Path("results/meshes.npz")
WORDS: dict[Treatment, str] = {"correct": "corrected", "report": "left as it is"}
HEAD = (
    "noise",
    "error of the mesh",
    "that error over the noise",
    "95 % intervals hold",
    "of each parameter (%)",
    "their shift over deviation (rms)",
)
PRIORS: dict[str, Distribution] = {
    "inclusions.lump.x": Uniform(lower=0.3, upper=0.7),
    "inclusions.lump.z": Uniform(lower=0.35, upper=0.75),
    "inclusions.lump.radius": Uniform(lower=0.2, upper=0.35),
    "inclusions.lump.contrast": LogUniform(lower=2.0, upper=8.0),
    "material.mu": LogNormal(mean=1e4, std=2e3),
}
PARAMETERS = tuple(PRIORS)


def specimen(cells: int, grading: dict[str, float]) -> Specimen:
    """Return a cube with a ball inside, sheared and pressed, observed at points of four faces."""
    lines = np.linspace(0.06, 0.94, 5).tolist()
    faces = [((0.0, a, b), (1.0, a, b), (a, 1.0, b), (a, b, 1.0)) for a, b in product(lines, lines)]
    acting = (("shear", (1.0, 0.0, 0.0), 1500.0), ("compression", (0.0, 0.0, -1.0), 2000.0))
    cases = [
        {
            "name": name,
            "clamp": ("z-min",),
            "loads": ({"kind": "traction", "on": "z-max", "direction": direction, "size": size},),
        }
        for name, direction, size in acting
    ]
    ball = {"name": "lump", "x": 0.5, "y": 0.5, "z": 0.55, "radius": 0.28, "contrast": 4.0, "width": 0.15}
    return Specimen.model_validate(
        {
            "body": {"size": (1.0, 1.0, 1.0), "cells": (cells,) * 3, "degree": 2, "grading": grading},
            "material": {"kind": "neo-hookean-coupled", "mu": 1e4, "lmbda": 4e4},
            "inclusions": (ball,),
            "cases": cases,
            "observed": ({"at": tuple(sorted({point for four in faces for point in four}))},),
        }
    )


def made(inputs: Inputs, count: int) -> tuple[FloatArray, FloatArray]:
    """Return truths (n, d) and their data (n, m) without noise; kept in a file, since they take minutes."""
    truths = inputs.from_normals(np.random.default_rng(16).standard_normal((count, len(PARAMETERS))))[0]
    if FILE.exists():
        kept = np.load(FILE)
        if len(kept["truths"]) >= count and np.allclose(kept["truths"][:count], truths):
            return truths, kept["data"][:count]
    sides = {f"{axis}-{end}": 8.0 for axis in "xy" for end in ("min", "max")}
    model: SpecimenModel = specimen(OVERKILL, {"z-min": 16.0} | sides).build(MPI.COMM_SELF, PARAMETERS)
    near = Nearby.at(model, inputs.mean, inputs.std).on(model)
    data = np.array([model.solve(truth, near(truth)).outputs for truth in truths])
    FILE.parent.mkdir(parents=True, exist_ok=True)
    np.savez(FILE, truths=truths, data=data)
    return truths, data


def main(options: Sequence[str] = ()) -> None:
    """Print how often intervals hold the truth, expected of posteriors that are linear there; and some inversions."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks meshes")
    parser.add_argument("--truths", type=int, default=TRUTHS)
    parser.add_argument("--inverted", type=int, default=INVERTED)
    given = parser.parse_args(list(options))
    inputs = Inputs(PRIORS)
    truths, clean = made(inputs, given.truths)
    model: SpecimenModel = specimen(CELLS, {}).build(MPI.COMM_SELF, PARAMETERS)
    case = Case(inputs, model, solved_on(extrapolated(model, inputs.mean).observing(model)))
    known = [_known(case, truth) for truth in truths]
    print(f"| {' | '.join(HEAD)} |\n|{'---|' * len(HEAD)}")
    for noise in NOISES:
        for treatment, words in WORDS.items():
            rows = [_expected(case, *both, noise, treatment) for both in zip(known, clean, strict=True)]
            size, held, shift = (np.array([row[k] for row in rows]) for k in range(3))
            cells = (
                f"{100 * noise:g} %",
                words,
                f"{np.sqrt((size**2).mean()):.2f}",
                f"{100 * held.mean():.0f} %",
                ", ".join(f"{100 * one:.0f}" for one in held.mean(axis=0)),
                f"{np.sqrt((shift**2).mean()):.2f}",
            )
            print(f"| {' | '.join(cells)} |", flush=True)
    for noise in NOISES:
        for treatment, words in WORDS.items():
            some = list(zip(truths, clean, strict=True))[: given.inverted]
            rows = [_inverted(case, *both, noise, treatment, seed) for seed, both in enumerate(some)]
            held, gaps = (np.array([row[name] for row in rows]) for name in ("held", "gaps"))
            print(
                f"\n{100 * noise:g} % noise, {words}: {held.sum()} of {held.size} truths in 95 % intervals of "
                f"inversions; mean less truth over deviation {np.sqrt((gaps**2).mean()):.1f} (rms), "
                f"{rows[0]['solves']:.0f} solves on finer meshes, {rows[0]['seconds']:.0f} s of CPU.",
                flush=True,
            )


class Case(NamedTuple):
    """What is inverted: unknowns, the model, and the same on finer meshes."""

    inputs: Inputs
    model: SpecimenModel
    finer: Finer


class Known(NamedTuple):
    """What is known at a truth: derivatives (m, d) of the data by normal coordinates, and the error of the mesh."""

    outputs: FloatArray
    slopes: FloatArray
    error: ApproximationError


def _known(case: Case, truth: FloatArray) -> Known:
    """Solve at a truth (d,), on the mesh and on finer ones."""
    solution = case.model.solve(truth)
    look, why = case.finer.look(truth)
    if look is None:
        raise SolveError(why)
    places = Places(3 * case.model.cases + case.model.axes, case.model.places)
    x = np.array([_coordinate(prior, value) for prior, value in zip(PRIORS.values(), truth, strict=True)])
    slopes = solution.tangent(np.eye(len(truth))).T @ case.inputs.from_normals(x[None])[1][0]
    outputs = np.array(solution.outputs)
    return Known(outputs, slopes, error_of(look, outputs, truth, places))


def _coordinate(prior: Distribution, value: float) -> float:
    """Standard normal coordinate of a value."""
    from scipy.optimize import brentq

    return float(brentq(lambda x: prior.from_normal(np.array([x]))[0][0] - value, -8, 8))


def _expected(
    case: Case, known: Known, clean: FloatArray, noise: float, treatment: Treatment
) -> tuple[float, FloatArray, FloatArray]:
    """Error over the noise (rms), shares (d,) of data of a truth whose intervals hold it, and shifts (d,) of these.

    The posterior is linearised at the truth, which is drawn from the prior: of its error Gain·(rest + noise) the noise
    and the prior make the variance, what is left of the error of the mesh the shift.
    """
    from scipy.special import ndtr

    sigma = _sigma(case, clean, noise)
    mesh = known.error if treatment == "correct" else None
    white = Whitening.of(sigma, mesh, NORMAL)
    A = white((known.slopes / white.sigma[:, None]).T).T
    covariance = np.linalg.inv(np.eye(A.shape[1]) + A.T @ A)
    deviations = np.sqrt(np.diag(covariance))
    gain = white(covariance @ A.T) / white.sigma
    rest = clean - known.outputs - (0.0 if mesh is None else mesh.error)
    shift = gain @ rest / deviations
    spread = np.sqrt(np.diag((gain * sigma) @ (gain * sigma).T + covariance @ covariance)) / deviations
    held = ndtr((WIDE - shift) / spread) - ndtr((-WIDE - shift) / spread)
    return float(np.sqrt((((clean - known.outputs) / sigma) ** 2).mean())), held, shift


def _sigma(case: Case, clean: FloatArray, noise: float) -> FloatArray:
    """Standard deviations (m,) of the errors: a share of the root mean square of each load case."""
    sizes = np.array([np.sqrt((part**2).mean()) for part in case.model.values(clean)])
    return noise * sizes[case.model.cases]


def _inverted(
    case: Case, truth: FloatArray, clean: FloatArray, noise: float, treatment: Treatment, seed: int
) -> dict[str, Any]:
    """Invert one data set."""
    begin = time.process_time()
    inputs, model, finer = case
    sigma = _sigma(case, clean, noise)
    values = clean + sigma * np.random.default_rng([seed, 7]).standard_normal(len(clean))
    data = Components(model.places, model.axes, model.cases, values, sigma)
    method = Invert(samples=32, starts=1, draws=50, mesh_error=treatment)
    found = invert_by_group(inputs, model, data, method, None, finer=finer)
    lower, upper, mean, std = (found[name].to_numpy() for name in ("lower", "upper", "mean", "std"))
    return {
        "held": (lower <= truth) & (truth <= upper),
        "gaps": (mean - truth) / std,
        "solves": float(found["mesh_solves"]),
        "seconds": time.process_time() - begin,
    }
