"""Questions to the shape: how often a right model is accused, and how often what a wrong one lacks is found."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from mpi4py import MPI

from benchmarks.assumptions import cube_spec
from forward.enlargements import QUARTICS, enlarged, quartics
from forward.model import FloatArray
from forward.specimen import Specimen
from inverse.criticism.questions import CALLED, asked
from inverse.data.measurements import Measurements
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.methods.infer import Problem
from inverse.methods.invert import Invert
from inverse.methods.record import noise_of
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import LogNormal, Uniform
from uq.inputs.random_parameters import Inputs
from uq.surrogates.linearisation import linearise
from workflows.data.measured import observing
from workflows.studies.inversion_job import asking

SIZE, SEEN, NOISE = 0.05, 4, 0.003  # of the cube (m), points along an edge of each face that is seen, errors
INPUTS = Inputs(
    {
        "material.mu": LogNormal(mean=1000, std=300),
        "inclusions.lump.contrast": LogNormal(mean=3, std=2),
        "inclusions.lump.x": Uniform(lower=0.01, upper=0.04),
    }
)
LUMP = {"name": "lump", "x": 0.025, "y": 0.025, "z": 0.03, "radius": 0.014, "contrast": 3, "width": 8e-3}
SECOND = {"name": "second", "y": 0.025, "radius": 0.01, "contrast": 3, "width": 8e-3}
LAYER = {"kind": "ellipsoid", "name": "layer", "x": 0.025, "y": 0.025, "z": 0.05, "a": 1, "b": 1, "c": 8e-3}
LAYER |= {"contrast": 2, "width": 3e-3}
BALL = {name: value for name, value in LUMP.items() if name != "radius"}
ALONG, MODULUS = np.array([0.6, 0.8, 0.0]), 1500.0  # of fibres (Pa)
# What the truth has, by name: how its lumps differ from what is assumed.
TRUTHS: dict[str, list[dict[str, Any]]] = {
    "nothing": [LUMP],
    "edge half as wide": [LUMP | {"width": 4e-3}],
    "ellipsoid": [BALL | {"kind": "ellipsoid", "a": 0.021, "b": 0.014, "c": 0.0095}],
    "near lump": [LUMP | {"x": 0.018}, SECOND | {"x": 0.036, "z": 0.03}],
    "far lump": [LUMP | {"x": 0.018}, SECOND | {"x": 0.038, "y": 0.038, "z": 0.012}],
    "layer": [LUMP, LAYER],
    "fibres": [LUMP],
}


def places() -> FloatArray:
    """Points (n, 3) of three faces of the cube."""
    steps = np.linspace(0.1, 0.9, SEEN) * SIZE
    u, v = (one.ravel() for one in np.meshgrid(steps, steps))
    end = np.full(len(u), SIZE)
    return np.concatenate([np.stack(three, axis=1) for three in ((end, u, v), (u, end, v), (u, v, end))])


def data_at(points: FloatArray) -> Measurements:
    """Return what is measured there in both load cases, without values."""
    n = len(points)
    names = [f"point {i}" for i in range(2 * n)]
    zeros = np.zeros((2 * n, 3))
    return Measurements.of_points(
        np.tile(points, (2, 1)), zeros, zeros + 1e-4, np.repeat([0, 1], n), names, ("shear", "pull")
    )  # fmt: skip


class Cube:
    """A lump in a cube that is inverted as if it were a ball with a known edge."""

    def __init__(self, cells: int) -> None:
        self.spec = cube_spec(cells)
        self.data = data_at(places())
        self.model = observing(self.spec.build(MPI.COMM_SELF, INPUTS.names), self.data)
        self.evaluate = SerialEvaluate(self.model)
        self.start = linearise(INPUTS, self.evaluate, INPUTS.mean).prediction
        self.asked = asking(self.spec, INPUTS.names, MPI.COMM_SELF)

    def right(self, name: str, point: FloatArray | None = None) -> FloatArray:
        """Return outputs of a truth, by name; of nothing wrong at parameters (d,)."""
        if point is not None:
            return np.asarray(self.model.solve(point).outputs)
        spec, paths = enlarged(Specimen.model_validate(self.spec.model_dump() | {"inclusions": TRUTHS[name]}))
        paths, values = paths[-len(QUARTICS) :], MODULUS * quartics(ALONG) * (name == "fibres")
        return np.asarray(observing(spec.build(MPI.COMM_SELF, paths), self.data).solve(values).outputs)

    def answers(self, right: FloatArray, rng: np.random.Generator) -> list[Any]:
        """Ask all questions to the posterior of data with errors."""
        sigma = np.full(len(right), NOISE * np.abs(right).max())
        data = replace(self.data, values=right + sigma * rng.standard_normal(len(right)), sigma=sigma)
        problem = Problem(data, Invert())
        posterior = Posterior(INPUTS, self.evaluate, data.values, noise_of(problem), start=self.start)
        gaussian = laplace(posterior, starts=1)
        at = posterior.at(gaussian.mode[None], derivatives=True)
        return asked(posterior, gaussian, at, self.asked(data), 0)


def main(words: Sequence[str] = ()) -> None:
    """Print what is said of right and wrong models."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks questions")
    parser.add_argument("--cells", type=int, default=4, help="along each edge")
    parser.add_argument("--sets", type=int, default=20, help="data sets of each truth")
    parser.add_argument("--only", choices=tuple(TRUTHS), nargs="*")
    given = parser.parse_args(words)
    cube = Cube(given.cells)
    print(
        f"{given.cells}³ cells, {given.sets} data sets each, errors of {100 * NOISE:g} % of the largest displacement\n"
    )
    print("| the truth has | said to lack something | the question | called for | largest ln Z | ln Z more, median |")
    print("|---|---|---|---|---|---|")
    for name in given.only or TRUTHS:
        right, found = cube.right(name) if name != "nothing" else None, []
        for seed in range(given.sets):
            rng = np.random.default_rng(seed)
            found.append(cube.answers(cube.right(name, INPUTS.drawn(rng, 1)[0]) if right is None else right, rng))
        said = np.mean([min(one.probability for one in each) <= CALLED for each in found])
        print(f"| {name} | {100 * said:.0f} % | | | | |", flush=True)
        for each in zip(*found, strict=True):
            called = np.mean([one.probability <= CALLED for one in each])
            best = np.mean([max(found[k], key=lambda one: one.log_evidence) is one for k, one in enumerate(each)])
            gain = np.median([one.log_evidence for one in each])
            print(f"| | | {each[0].name} | {100 * called:.0f} % | {100 * best:.0f} % | {gain:+.1f} |", flush=True)
