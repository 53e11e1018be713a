"""The same as `benchmarks.meshes` for a random stiffness at the vertices of the cube.

The data are made on tetrahedra that lie in the cells of the inversion, between which the stiffness has kinks: meshes
that cross them have another stiffness, which the data tell. Expected of posteriors that are linear at the truth:
shares of intervals, over all noise and all truths of the prior, of the values at the vertices, of the mean over the
body, and along the directions of which the data say most.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from mpi4py import MPI

from benchmarks.meshes import (
    NOISES,
    SEED,
    WIDE,
    WORDS,
    kept,
    lattice,
    made,
    measured,
    row,
    shares,
    sigma_of,
    specimen,
    trusted,
)
from benchmarks.other_code import Cube
from forward.fem.finer import extrapolated
from forward.fem.joined import SpecimenModel
from forward.model import FloatArray, SolveError
from forward.specimen import Specimen
from inverse.criticism.finer import Finer
from inverse.data.measurements import Measurements
from inverse.data.noise import ModelError, Noise
from inverse.fields.field_posterior import FieldPosterior
from inverse.methods.infer import Problem as Asked
from inverse.methods.invert import Invert
from inverse.methods.invert_field import Vertices, invert_field
from inverse.methods.mesh_correction import along, error_of
from uq.evaluation.evaluate import SerialEvaluate

if TYPE_CHECKING:
    import xarray as xr

    from forward.bodies.random_fields import NodalPrior

CELLS, TRUTHS, ALSO_INVERTED = 3, 8, 3
DIRECTIONS = 4  # of which the data say most
EXPECTED = (
    "noise",
    "error of the mesh",
    "that error over the noise",
    "95 % intervals hold: vertices",
    f"the {DIRECTIONS} directions of which the data say most",
    "the mean over the body",
    "their shift over deviation (rms) of these",
)
INVERTED = (
    "noise",
    "error of the mesh over the noise",
    "95 % intervals hold: vertices",
    f"the {DIRECTIONS} directions of which the data say most",
    "the mean over the body",
    "mean less truth over deviation (rms) of these",
    "can be trusted",
    "CPU time of each (s)",
)


class Problem(NamedTuple):
    """A model of a field of N values, its prior, the offset (N,) of the logarithm, and finer meshes."""

    model: SpecimenModel
    prior: NodalPrior
    root: FloatArray
    offset: FloatArray
    finer: Finer


def main(words: Sequence[str] = ()) -> None:
    """Print how often intervals of fields hold the truth: expected of linear posteriors, and counted in inversions."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks meshes_of_fields")
    parser.add_argument("--truths", type=int, default=TRUTHS)
    parser.add_argument("--inverted", type=int, default=ALSO_INVERTED)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--cells", type=int, default=CELLS, help="of the inversion, along an edge")
    parser.add_argument("--degree", type=int, default=2, help="of the inversion")
    given = parser.parse_args(words)
    spec = specimen(given.cells, given.degree, field=True)
    problem, name = _problem(spec), f"field-{given.cells}-{given.degree}-{given.seed}"
    count = max(given.truths, given.inverted)
    coordinates = np.random.default_rng([given.seed, 1]).standard_normal((count, len(problem.root)))
    truths = problem.offset + coordinates @ problem.root.T
    factors = [lattice(truth, problem.model.vertices.coordinates) for truth in truths]
    data, cube = f"fields-within-{given.cells}-{given.seed}", Cube.around(given.cells, 1.0)
    clean = made(problem.model, data, truths, factors, np.full(count, 1e4), cube)
    if given.truths:
        _expect(problem, truths[: given.truths], clean[: given.truths], name)
    if given.inverted:
        _invert(problem, truths[: given.inverted], clean[: given.inverted], name)


def _problem(spec: Specimen) -> Problem:
    model: SpecimenModel = spec.build(MPI.COMM_SELF, spec.coefficients)
    prior = spec.fields[0].prior(spec.body)
    root = prior.root(np.eye(len(prior.variance))).T
    finer = Finer.by(SerialEvaluate(extrapolated(model, np.zeros(len(root))).of(model)))
    return Problem(model, prior, root, model.log_fields(np.zeros((1, len(root))))[0], finer)


def _expect(problem: Problem, truths: FloatArray, clean: FloatArray, name: str) -> None:
    """Print what is expected of posteriors that are linear at the truths (n, N), with their data (n, m)."""
    found = [
        kept(f"{name}-linear-{k}", truth, partial(_linear, problem, truth, clean[k])) for k, truth in enumerate(truths)
    ]
    row(EXPECTED, first=True)
    for noise in NOISES:
        for treatment, words in WORDS.items():
            of = [one[f"{noise:g} {treatment}"] for one in found]
            size, held, shift = (np.array([one[key] for one in of]) for key in ("size", "held", "shift"))
            parts = (slice(0, -1 - DIRECTIONS), slice(-1 - DIRECTIONS, -1), slice(-1, None))
            row(
                (
                    f"{100 * noise:g} %",
                    words,
                    f"{np.sqrt((size**2).mean()):.2f}",
                    *(f"{100 * held[:, part].mean():.0f} %" for part in parts),
                    ", ".join(f"{np.sqrt((shift[:, part] ** 2).mean()):.2f}" for part in parts),
                )
            )


def _linear(problem: Problem, truth: FloatArray, clean: FloatArray) -> dict[str, Any]:
    """Shares and shifts, by noise and treatment, at the vertices, along the first directions, and of the mean."""
    model, root = problem.model, problem.root
    values = truth - problem.offset
    solution = model.solve(values)
    look, why = problem.finer.look(values)
    if look is None:
        raise SolveError(why)
    slopes = solution.tangent(root.T).T  # by coordinates that are standard normal a priori
    outputs = np.array(solution.outputs)
    where = Measurements.of(outputs, outputs, model.cases, model.axes, places=model.places)
    plain = error_of(look, outputs, where)
    mass = problem.prior.matern.mass
    found: dict[str, Any] = {}
    for noise in NOISES:
        sigma = sigma_of(model, clean, noise)
        images, _, directions = np.linalg.svd(slopes / sigma[:, None], full_matrices=False)
        wanted = np.vstack([root, directions[:DIRECTIONS], mass @ root / mass.sum()])
        more = along(images.T, look.between, Noise(sigma))
        error = replace(plain, root=np.concatenate([plain.root, more]))
        size = float(np.sqrt((((clean - outputs) / sigma) ** 2).mean()))
        for treatment in WORDS:
            mesh: ModelError | None = error if treatment == "correct" else None
            held, shift = shares(slopes, wanted, sigma, clean - outputs, mesh)
            found[f"{noise:g} {treatment}"] = {"size": size, "held": held.tolist(), "shift": shift.tolist()}
    return found


def _invert(problem: Problem, truths: FloatArray, clean: FloatArray, name: str) -> None:
    """Print what is counted in inversions by the defaults."""
    vertices = Vertices(problem.offset, problem.prior.matern.mass)
    row(INVERTED, first=True)
    for noise in NOISES:
        rows = []
        for k, truth in enumerate(truths):
            data = measured(problem.model, clean[k], noise, k)
            find = partial(_inverted, problem, data, vertices, truth)
            rows.append(kept(f"{name}-{k}-{noise:g}", truth, find))
        size, nodes, mean, modes, trust, seconds = (np.array([row[name] for row in rows]) for name in rows[0])
        within = [f"{100 * (np.abs(gaps) < WIDE).mean():.0f} %" for gaps in (nodes, modes)]
        row(
            (
                f"{100 * noise:g} %",
                f"{np.sqrt((size**2).mean()):.2f}",
                *within,
                f"{(np.abs(mean) < WIDE).sum()} of {len(truths)}",
                ", ".join(f"{np.sqrt((gaps**2).mean()):.2f}" for gaps in (nodes, modes, mean)),
                f"{trust.sum()} of {len(truths)}",
                f"{seconds.mean():.0f}",
            )
        )


def _inverted(problem: Problem, data: Measurements, vertices: Vertices, truth: FloatArray) -> dict[str, Any]:
    """Invert one data set for a field."""
    begin = time.process_time()
    posterior = FieldPosterior(problem.model, data.values, Noise(data.sigma), problem.prior)
    found = invert_field(posterior, Asked(data, Invert(), finer=problem.finer), vertices)
    rest = _of_field(found, truth, problem.prior.matern.mass, problem.root)
    return rest | {"s": time.process_time() - begin}


def _of_field(found: xr.Dataset, truth: FloatArray, mass: FloatArray, root: FloatArray) -> dict[str, Any]:
    """Mean less truth, over deviations: at the vertices, in the first directions, and of the mean over the body."""
    gap = found["stiffness_mean"].to_numpy() - truth
    values = found["eigenvalue"].to_numpy()[:DIRECTIONS]
    along = np.linalg.solve(root, found["direction_stiffness"].to_numpy()[:DIRECTIONS].T)
    whitened = np.linalg.solve(root, gap) @ (along / np.linalg.norm(along, axis=0))
    return {
        "size": float(np.sqrt((found["mesh_error"].to_numpy() ** 2).mean())),
        "nodes": gap / found["stiffness_std"].to_numpy(),
        "mean": float(mass @ gap / mass.sum() / found["std"].to_numpy()[0]),
        "modes": whitened * np.sqrt(1 + values),
        "trust": trusted(found),
    }
