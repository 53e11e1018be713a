"""Whether intervals hold the truth of data that have no mesh in common with the inversion.

Specimens are drawn from the prior: a ball in a cube; `benchmarks.meshes_of_fields` does so for a stiffness field.
Their data are those of another code (`benchmarks.other_code`), on tetrahedra of degree 4, 24 times thinner at the held
face; inversions are on 4 quadratic hexahedra along an edge, or on what is asked for, by the defaults of studies. Of
posteriors that are linear at the truth it is known in closed form how often intervals hold it, over all noise. What is
made and found is kept in results/meshes-*, so that a run that is stopped goes on where it was, and one with more truths
adds to what is there.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from mpi4py import MPI

from benchmarks.other_code import Cube
from forward.fem.finer import extrapolated
from forward.fem.joined import SpecimenModel
from forward.model import FloatArray, SolveError
from forward.specimen import Specimen
from inverse.criticism.doubts import of_mesh
from inverse.criticism.finer import Finer
from inverse.data.measurements import Measurements
from inverse.data.noise import ModelError, Noise
from inverse.methods.infer import Problem
from inverse.methods.invert import Invert
from inverse.methods.invert_few import Nearby, invert_few
from inverse.methods.mesh_correction import Treatment, error_of
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Distribution, LogNormal, LogUniform, Uniform
from uq.inputs.random_parameters import Inputs
from workflows.results.summary import NEITHER

if TYPE_CHECKING:
    import xarray as xr


Factor = Callable[[FloatArray], FloatArray]  # places (n, 3) → (n,)

CELLS, OVERKILL = 4, 5  # along an edge, of the inversion and of the data
WIDE = 1.959964  # deviations of an interval of 95 %
TRUTHS, ALSO_INVERTED, SEED = 20, 5, 17
NOISES = (0.01, 0.03)  # of the root mean square of the displacements of each load case
LMBDA, WIDTH = 4e4, 0.15
FOLDER = Path("results")
INVERT = Invert(starts=1)
WORDS: dict[Treatment, str] = {"correct": "corrected", "report": "left as it is"}
HEAD = (
    "noise",
    "error of the mesh",
    "that error over the noise",
    "95 % intervals hold",
    "of each parameter (%)",
    "their shift over deviation (rms)",
)
INVERTED = (
    "noise",
    "95 % intervals hold",
    "mean less truth over deviation (rms)",
    "can be trusted",
    "of these, hold",
    "CPU time of each (s)",
)
PRIORS: dict[str, Distribution] = {
    "inclusions.lump.x": Uniform(lower=0.3, upper=0.7),
    "inclusions.lump.z": Uniform(lower=0.35, upper=0.75),
    "inclusions.lump.radius": Uniform(lower=0.2, upper=0.35),
    "inclusions.lump.contrast": LogUniform(lower=2.0, upper=8.0),
    "material.mu": LogNormal(mean=1e4, std=2e3),
}
PARAMETERS = tuple(PRIORS)
BALL = {"name": "lump", "x": 0.5, "y": 0.5, "z": 0.55, "radius": 0.28, "contrast": 4.0, "width": WIDTH}
FIELD = {"of": "stiffness", "length": 0.5, "std": 0.6, "basis": "nodes"}
CASES = {"shear": (1500.0, 0.0, 0.0), "compression": (0.0, 0.0, -2000.0)}  # tractions (Pa)


def specimen(cells: int = CELLS, degree: int = 2, *, field: bool = False) -> Specimen:
    """Return a cube with a ball or a random stiffness inside, sheared and pressed, observed at points of four faces."""
    lines = np.linspace(0.06, 0.94, 5).tolist()
    faces = [((0.0, a, b), (1.0, a, b), (a, 1.0, b), (a, b, 1.0)) for a, b in product(lines, lines)]
    cases = [
        {"name": name, "clamp": ("z-min",), "loads": ({"kind": "traction", "on": "z-max", **_acting(traction)},)}
        for name, traction in CASES.items()
    ]
    return Specimen.model_validate(
        {
            "body": {"size": (1.0, 1.0, 1.0), "cells": (cells,) * 3, "degree": degree},
            "material": {"kind": "neo-hookean-coupled", "mu": 1e4, "lmbda": LMBDA},
            **({"fields": (FIELD,)} if field else {"inclusions": (BALL,)}),
            "cases": cases,
            "observed": ({"at": tuple(sorted({point for four in faces for point in four}))},),
        }
    )


def _acting(traction: tuple[float, ...]) -> dict[str, Any]:
    size = float(np.linalg.norm(traction))
    return {"direction": tuple(float(t / size) for t in traction), "size": size}


def ball(truth: FloatArray) -> Factor:
    """Return the factor on the stiffness of a ball, at places."""
    x, z, radius, contrast, _ = truth
    centre = np.array([x, BALL["y"], z])

    def factor(places: FloatArray) -> FloatArray:
        inside = (1 - np.tanh((np.linalg.norm(places - centre, axis=1) - radius) / WIDTH)) / 2
        return np.asarray(contrast**inside)

    return factor


def lattice(log: FloatArray, vertices: FloatArray) -> Factor:
    """Return the factor on the stiffness whose logarithm (N,) is linear between vertices (N, 3) of a regular grid."""
    from scipy.interpolate import RegularGridInterpolator

    n = round(len(vertices) ** (1 / 3))
    order = np.lexsort(vertices.round(9).T[::-1])
    grid = RegularGridInterpolator((np.linspace(0, 1, n),) * 3, log[order].reshape(n, n, n))
    return lambda places: np.asarray(np.exp(grid(places.clip(0, 1))))


def made(
    model: SpecimenModel,
    name: str,
    truths: FloatArray,
    factors: Sequence[Factor],
    mus: FloatArray,
    cube: Cube | None = None,
) -> FloatArray:
    """Return data (n, m) of truths (n, d) without noise; kept in a file as they are made, since they take minutes."""
    file = FOLDER / f"meshes-{name}.npz"
    found: list[FloatArray] = []
    if file.exists():
        there = np.load(file)
        same = min(len(there["truths"]), len(truths))
        if np.allclose(there["truths"][:same], truths[:same]):
            found = list(there["data"][:same])
    cube, states = cube or Cube(OVERKILL, 1.0), dict[str, FloatArray]()
    FOLDER.mkdir(parents=True, exist_ok=True)
    for k in range(len(found), len(truths)):
        moved = []
        for case, traction in CASES.items():
            states[case] = cube.solve(mus[k], LMBDA, factors[k], np.array(traction), states.get(case))
            moved.append(cube.observed(states[case], model.places))
        found.append(np.array(moved)[model.cases, np.arange(len(model.axes)), model.axes])
        np.savez(file, truths=truths[: k + 1], data=found)
    return np.array(found)


def balls(model: SpecimenModel, inputs: Inputs, count: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Return truths (n, d) drawn from the prior, and their data (n, m)."""
    truths = inputs.from_normals(np.random.default_rng(seed).standard_normal((count, len(PARAMETERS))))[0]
    return truths, made(model, f"balls-{seed}", truths, [ball(truth) for truth in truths], truths[:, -1])


def main(words: Sequence[str] = ()) -> None:
    """Print how often intervals hold the truth: expected of linear posteriors, and counted in inversions."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks meshes")
    parser.add_argument("--truths", type=int, default=TRUTHS)
    parser.add_argument("--inverted", type=int, default=ALSO_INVERTED)
    parser.add_argument("--seed", type=int, default=SEED, help="of the truths; what is uncertain was chosen on 16")
    parser.add_argument("--cells", type=int, default=CELLS, help="of the inversion, along an edge")
    parser.add_argument("--degree", type=int, default=2, help="of the inversion")
    given = parser.parse_args(words)
    inputs, mesh = Inputs(PRIORS), f"{given.cells}-{given.degree}-{given.seed}"
    model: SpecimenModel = specimen(given.cells, given.degree).build(MPI.COMM_SELF, PARAMETERS)
    case = Case(inputs, model, Finer.by(SerialEvaluate(extrapolated(model, inputs.mean).of(model))))
    truths, clean = balls(model, inputs, max(given.truths, given.inverted), given.seed)
    if given.truths:
        expect(case, [known(case, truth) for truth in truths[: given.truths]], clean[: given.truths])
    if given.inverted:
        invert(case, truths[: given.inverted], clean[: given.inverted], f"inverted-{mesh}")


def expect(case: Case, at: Sequence[Known], clean: FloatArray, noises: Sequence[float] = NOISES) -> None:
    """Print how often intervals are expected to hold truths, of what is known there and their data (n, m)."""
    row(HEAD, first=True)
    for noise in noises:
        for treatment, words in WORDS.items():
            rows = [expected(case, *both, noise, treatment) for both in zip(at, clean, strict=True)]
            size, held, shift = (np.array([row[k] for row in rows]) for k in range(3))
            row(
                (
                    f"{100 * noise:g} %",
                    words,
                    f"{np.sqrt((size**2).mean()):.2f}",
                    f"{100 * held.mean():.0f} %",
                    ", ".join(f"{100 * one:.0f}" for one in held.mean(axis=0)),
                    f"{np.sqrt((shift**2).mean()):.2f}",
                )
            )


def invert(
    case: Case,
    truths: FloatArray,
    clean: FloatArray,
    name: str,
    noises: Sequence[float] = NOISES,
    method: Invert = INVERT,
) -> None:
    """Print how many intervals of inversions hold truths (n, d), given their data (n, m)."""
    row(INVERTED, first=True)
    for noise in noises:
        rows = [
            kept(f"{name}-{k}-{noise:g}", truth, partial(inverted, case, truth, clean[k], noise, k, method))
            for k, truth in enumerate(truths)
        ]
        held, gaps, seconds, trust = (np.array([row[name] for row in rows]) for name in rows[0])
        row(
            (
                f"{100 * noise:g} %",
                f"{held.sum()} of {held.size} ({', '.join(str(one) for one in held.sum(axis=0))})",
                ", ".join(f"{one:.1f}" for one in np.sqrt((gaps**2).mean(axis=0))),
                f"{trust.sum()} of {trust.size}",
                f"{held[trust].sum()} of {held[trust].size}",
                f"{seconds.mean():.0f}",
            )
        )


def kept(name: str, truth: FloatArray, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return what was found of a truth, from its file if it is there."""
    file = FOLDER / f"meshes-{name}.json"
    if file.exists():
        found: dict[str, Any] = json.loads(file.read_text())
        if np.allclose(found.pop("truth"), truth):
            return found
    found = make()
    values = {key: np.asarray(value).tolist() for key, value in {"truth": truth, **found}.items()}
    file.write_text(json.dumps(values))
    return found


def row(cells: Sequence[str], *, first: bool = False) -> None:
    """Print a row of a table; the first with the line below its head."""
    print(f"{chr(10) if first else ''}| {' | '.join(cells)} |", flush=True)
    if first:
        print(f"|{'---|' * len(cells)}", flush=True)


class Case(NamedTuple):
    """What is inverted: unknowns, the model, and the same on finer meshes."""

    inputs: Inputs
    model: SpecimenModel
    finer: Finer


class Known(NamedTuple):
    """What is known at a truth: derivatives (m, d) of the data by normal coordinates, and the error of the mesh."""

    outputs: FloatArray
    slopes: FloatArray
    error: ModelError


def known(case: Case, truth: FloatArray) -> Known:
    """Solve at a truth (d,), on the mesh and on finer ones."""
    solution = case.model.solve(truth)
    look, why = case.finer.look(truth)
    if look is None:
        raise SolveError(why)
    x = np.array(
        [_coordinate(prior, value) for prior, value in zip(case.inputs.marginals.values(), truth, strict=True)]
    )
    slopes = solution.tangent(np.eye(len(truth))).T @ case.inputs.from_normals(x[None])[1][0]
    outputs, model = np.array(solution.outputs), case.model
    data = Measurements.of(outputs, outputs, model.cases, model.axes, places=model.places)
    return Known(outputs, slopes, error_of(look, outputs, data))


def _coordinate(prior: Distribution, value: float) -> float:
    """Standard normal coordinate of a value."""
    from scipy.optimize import brentq

    return float(brentq(lambda x: prior.from_normal(np.array([x]))[0][0] - value, -8, 8))


def expected(
    case: Case, known: Known, clean: FloatArray, noise: float, treatment: Treatment
) -> tuple[float, FloatArray, FloatArray]:
    """Error over the noise (rms), shares (d,) of data of a truth whose intervals hold it, and shifts (d,) of these.

    The posterior is linearised at the truth, which is drawn from the prior: of its error Gain·(rest + noise) the noise
    and the prior make the variance, what is left of the error of the mesh the shift.
    """
    sigma = sigma_of(case.model, clean, noise)
    mesh = known.error if treatment == "correct" else None
    held, shift = shares(known.slopes, np.eye(known.slopes.shape[1]), sigma, clean - known.outputs, mesh)
    return float(np.sqrt((((clean - known.outputs) / sigma) ** 2).mean())), held, shift


def shares(
    slopes: FloatArray, wanted: FloatArray, sigma: FloatArray, missed: FloatArray, mesh: ModelError | None
) -> tuple[FloatArray, FloatArray]:
    """Return shares (q,) of data whose intervals hold the truth, and the shifts (q,) of these over deviations.

    Parameters
    ----------
    slopes
        Derivatives (m, d) of the data by coordinates that are standard normal a priori.
    wanted
        Rows (q, d) of what is asked for, in these coordinates.
    sigma, missed
        Standard deviations (m,) of the errors, and what the model misses (m,) in the data without them.
    mesh
        What it is corrected by.
    """
    from scipy.special import ndtr

    white = Noise(sigma, model=mesh)
    A = white.whitened((slopes / white.scale[:, None]).T).T
    covariance = wanted @ np.linalg.inv(np.eye(A.shape[1]) + A.T @ A)
    deviations = np.sqrt((covariance * wanted).sum(axis=1))
    gain = white.whitened(covariance @ A.T) / white.scale
    shift = gain @ (missed - (0.0 if mesh is None else mesh.error)) / deviations
    spread = np.sqrt(((gain * sigma) ** 2).sum(axis=1) + (covariance**2).sum(axis=1)) / deviations
    return ndtr((WIDE - shift) / spread) - ndtr((-WIDE - shift) / spread), shift


def sigma_of(model: SpecimenModel, clean: FloatArray, noise: float) -> FloatArray:
    """Standard deviations (m,) of the errors: a share of the root mean square of each load case."""
    sizes = np.array([np.sqrt((part**2).mean()) for part in np.split(clean, np.flatnonzero(np.diff(model.cases)) + 1)])
    return noise * sizes[model.cases]


def inverted(
    case: Case, truth: FloatArray, clean: FloatArray, noise: float, seed: int, method: Invert
) -> dict[str, Any]:
    """Invert one data set."""
    begin = time.process_time()
    inputs, model, finer = case
    data = measured(model, clean, noise, seed)
    start = partial(Nearby.at, model, spread=inputs.std)
    problem = Problem(data, method, finer=finer, start=start, model=model)
    found = invert_few(inputs, SerialEvaluate(model), problem).dataset
    lower, upper, mean, std = (found[name].to_numpy() for name in ("lower", "upper", "mean", "std"))
    return {
        "held": (lower <= truth) & (truth <= upper),
        "gaps": (mean - truth) / std,
        "seconds": time.process_time() - begin,
        "trust": trusted(found),
    }


def measured(model: SpecimenModel, clean: FloatArray, noise: float, seed: int) -> Measurements:
    """Add errors to data (m,)."""
    sigma = sigma_of(model, clean, noise)
    values = clean + sigma * np.random.default_rng([seed, 7]).standard_normal(len(clean))
    return Measurements.of(values, sigma, model.cases, model.axes, places=model.places)


def trusted(found: xr.Dataset) -> bool:
    """Whether a study would say that the posterior can be trusted, as far as its weights and the mesh are concerned."""
    doubts = of_mesh(found, found["mesh_error"].to_numpy(), settled=bool(found["mesh_settled"]))
    return int(found["trust"]) < NEITHER and all(doubt.severity == "note" for doubt in doubts)
