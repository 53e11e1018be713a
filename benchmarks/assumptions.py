"""What is taken for granted: how far it is said to move the answers, and inversions done again; and what that costs."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.sparse import eye

from forward.affine import Sparse
from forward.bodies.geometry import AXES
from forward.combine import Mapped
from forward.hyperelastic import Path
from forward.model import FloatArray, ForwardModel
from forward.specimen import Specimen
from inverse.criticism.assumptions import Assumption, by_evaluation
from inverse.data.measurements import Measurements
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.methods.infer import Problem
from inverse.methods.invert import Invert
from inverse.methods.invert_few import invert_few
from inverse.methods.record import noise_of
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import LogNormal, Uniform
from uq.inputs.random_parameters import Inputs
from workflows.data.measured import observing
from workflows.studies.assumptions import TakenForGranted, Uncertain, means

OF_SIZE = 0.1  # of what is taken for granted, by which it is changed in inversions done again
METHOD = Invert(samples=64, starts=1, mesh_error=False)
PLACES = [(0.048, y, z) for y in (0.01, 0.03) for z in (0.02, 0.035, 0.047)]
PLACES += [(0.02, 0.045, 0.03), (0.04, 0.02, 0.045)]


@dataclass(frozen=True)
class Case:
    """A model with unknown numbers, what was measured, and what is true (d,)."""

    name: str
    spec: Any
    inputs: Inputs
    data: Measurements
    truth: FloatArray


def cube_spec(cells: int) -> Specimen:
    """Return a lump in a cube, in two load cases."""
    lump = {"name": "lump", "x": 0.025, "y": 0.025, "z": 0.03, "radius": 0.014, "contrast": 3, "width": 8e-3}
    blocks = {
        "body": _block(0.05, cells),
        "material": {"kind": "neo-hookean-coupled", "mu": 1e3, "lmbda": 4e3},
        "inclusions": [lump],
        "cases": [
            {"name": "shear", "clamp": ["z-min"], "loads": [_traction([1, 0, 0], 150)]},
            {"name": "pull", "clamp": ["z-min"], "loads": [_traction([0, 0, 1], 200), _gravity(1000)]},
        ],
    }  # fmt: skip
    return Specimen.model_validate(blocks)


def cube(cells: int = 3) -> Case:
    """A lump in a cube, from displacements in two load cases with errors of 1 % of the largest."""
    spec = cube_spec(cells)
    inputs = Inputs(
        {
            "material.mu": LogNormal(mean=1000, std=300),
            "inclusions.lump.contrast": LogNormal(mean=3, std=2),
            "inclusions.lump.x": Uniform(lower=0.01, upper=0.04),
        }
    )
    n = len(PLACES)
    data = Measurements.of_points(
        np.array(PLACES * 2), np.zeros((2 * n, 3)), np.full((2 * n, 3), 1e-4), np.repeat([0, 1], n),
        [f"point {i}" for i in range(2 * n)], ("shear", "pull"),
    )  # fmt: skip
    return _measured("lump in a cube", spec, inputs, data, np.array([900.0, 4.0, 0.02]))


def ball(cells: int = 3) -> Case:
    """A material, from forces of a ball at four depths with errors of 1 %."""
    tool = {"kind": "indenter", "name": "ball", "shape": "sphere", "radius": 3e-3, "on": "z-max", "at": [0, 0, 0.01]}
    blocks = {
        "body": _block(0.01, cells) | {"grading": {"x-min": 2.0, "y-min": 2.0, "z-max": 2.0}},
        "material": {"kind": "mooney-rivlin", "C1": 500, "C2": 300, "D1": 2e4},
        "clamp": ["z-min"],
        "displacements": [{"on": "x-min", "x": 0}, {"on": "y-min", "y": 0}],
        "loads": [tool | {"direction": [0, 0, -1], "depth": [0.4e-3, 0.8e-3, 1.2e-3, 1.6e-3]}],
        "outputs": [{"name": "force", "kind": "force", "tool": "ball"}],
    }  # fmt: skip
    spec = Path.model_validate(blocks)
    inputs = Inputs({"material.C1": LogNormal(mean=500, std=200), "material.D1": LogNormal(mean=2e4, std=1e4)})
    names = [output.name for output in spec.returned]
    n = len(names)
    data = Measurements.of(np.ones(n), np.ones(n), [0] * n, range(n), names, parts=("force",), some=True)
    return _measured("ball on a block", spec, inputs, data, np.array([450.0, 1.8e4]))


def _block(size: float, cells: int) -> dict[str, Any]:
    return {"kind": "box", "size": [size] * 3, "cells": [cells] * 3, "cell": "hexahedron", "degree": 2}


def _traction(direction: list[int], size: float) -> dict[str, Any]:
    return {"kind": "traction", "on": "z-max", "direction": direction, "size": size}


def _gravity(density: float) -> dict[str, Any]:
    return {"kind": "gravity", "direction": [0, 0, -1], "density": density}


def _measured(name: str, spec: Any, inputs: Inputs, data: Measurements, truth: FloatArray) -> Case:
    """Fill in what a model gives at the truth, with errors of 1 % of the largest datum."""
    right = np.asarray(observing(spec.build(MPI.COMM_SELF, inputs.names), data).solve(truth).outputs)
    sigma = np.full(len(right), 0.01 * np.abs(right).max())
    values = right + sigma * np.random.default_rng(1).standard_normal(len(right))
    return Case(name, spec, inputs, replace(data, values=values, sigma=sigma), truth)


def told(case: Case, method: Invert = METHOD) -> tuple[list[Assumption], FloatArray, FloatArray, float]:
    """Return what is taken for granted, how far (k, d) it is said to move the answers, in their deviations (d,).

    And the processor time (s) of that, over that of the rest of the inversion.
    """
    taken, model = TakenForGranted(case.spec, case.inputs.names, [case.data]), _model(case, case.data)
    begin = time.process_time()
    held = taken.observed(taken.build(MPI.COMM_SELF), case.data)
    assert held is not None
    ask = by_evaluation(SerialEvaluate(held))
    spent = [time.process_time() - begin]

    def timed(points: FloatArray, values: FloatArray, start: Any) -> Any:
        begin = time.process_time()
        found = ask(points, values, start)
        spent.append(time.process_time() - begin)
        return found

    begin = time.process_time()
    problem = Problem(replace(case.data, some=False), method, assumed=taken.of(case.data, timed))
    found = invert_few(case.inputs, SerialEvaluate(model), problem).dataset
    rest = time.process_time() - begin - spent[1]
    assumed = [*taken.numbers, *taken.beside]
    return assumed, found["assumption_shift"].to_numpy(), found["std"].to_numpy(), sum(spent) / rest


def again(case: Case, assumed: Sequence[Assumption], std: FloatArray) -> Iterator[FloatArray]:
    """Yield how far (d,) the modes of inversions move in which each is larger and smaller by a part of its size.

    By central differences, as for the whole size.
    """
    taken = TakenForGranted(case.spec, case.inputs.names, [case.data])
    numbers, d = taken.build(MPI.COMM_SELF), len(case.inputs.names)
    for one in assumed:
        ends = []
        for sign in (OF_SIZE, -OF_SIZE):
            data, model = case.data, _model(case, case.data)
            if one.name.startswith("data.scale."):
                data = replace(data, values=data.values * (1 + sign * one.size))
            elif one.name.startswith("data.shift."):
                step = sign * one.size * np.eye(3)[AXES.index(one.name[-1])]
                model = _model(case, replace(data, places=data.places + step))
            else:
                moved = np.array([sign * one.size * (other == one) for other in taken.numbers])
                by = Sparse(eye(d + len(moved), d, format="csr"), np.append(np.zeros(d), taken.values + moved))
                model = Mapped(observing(numbers, data), by, case.inputs.names)
            problem = Problem(data, METHOD)
            posterior = Posterior(case.inputs, SerialEvaluate(model), data.values, noise_of(problem))
            ends.append(posterior.physical(laplace(posterior, starts=1).mode[None])[0])
        yield (ends[0] - ends[1]) / (2 * OF_SIZE) / std


def _model(case: Case, data: Measurements) -> ForwardModel:
    return observing(case.spec.build(MPI.COMM_SELF, case.inputs.names), data)


# What is uncertain of the cube, and what is wrong in turn: by its name, how uncertain it is, and the true factor on it.
UNCERTAIN = {
    "loads.traction.size": Uncertain(relative=0.05),
    "data.scale": Uncertain(std=0.03),
    "inclusions.lump.width": Uncertain(relative=0.3),
}
WRONG = {"loads.traction.size": 1.1, "data.scale": 1.05, "inclusions.lump.width": 0.5}


class Cube:
    """Inversions of the lump in a cube whose numbers are not quite what is stated."""

    def __init__(self, cells: int) -> None:
        self.case = cube(cells)
        self.taken = TakenForGranted(self.case.spec, self.case.inputs.names, [self.case.data], UNCERTAIN)
        build, data = self.taken.build(MPI.COMM_SELF), self.case.data
        self.model, self.whole = _model(self.case, data), observing(build, data)
        held = self.taken.observed(build, data)
        assert held is not None
        self.ask = by_evaluation(SerialEvaluate(held))

    def measured(self, truth: FloatArray, factors: Mapping[str, float], rng: np.random.Generator) -> Measurements:
        """Return data where something is so many times what is stated."""
        values = self.taken.values.copy()
        for name, factor in factors.items():
            values[[means(name, one.name) for one in self.taken.numbers]] *= factor
        right = np.asarray(self.whole.solve(np.append(truth, values)).outputs) / factors.get("data.scale", 1.0)
        return replace(self.case.data, values=right + self.case.data.sigma * rng.standard_normal(len(right)))

    def inverted(self, data: Measurements, *, uncertain: bool) -> Any:
        """Invert data, with what is uncertain or as if nothing were."""
        assumed = self.taken.of(data, self.ask)
        problem = Problem(data, METHOD, shared=assumed.shared if uncertain else None)
        return invert_few(self.case.inputs, SerialEvaluate(self.model), problem).dataset


def wrong(cells: int) -> None:
    """Print how many deviations answers are off where something is wrong, as if nothing were uncertain and with it."""
    it = Cube(cells)
    names = " | ".join(it.case.inputs.names)
    print(f"\n| what is wrong | | {names} | residuals |\n|---|---|{'---|' * len(it.case.truth)}---|")
    for name, factor in WRONG.items():
        data = it.measured(it.case.truth, {name: factor}, np.random.default_rng(2))
        for uncertain in (False, True):
            one = it.inverted(data, uncertain=uncertain)
            off = (one["mean"] - it.case.truth) / one["std"]
            said = "uncertain" if uncertain else "as stated"
            found = " | ".join(f"{float(value):+.1f}" for value in off)
            print(
                f"| {name} × {factor} | {said} | {found} | p = {float(one['residual_probability']):.2g} |", flush=True
            )


def coverage(cells: int, sets: int) -> None:
    """Print how often 95 % intervals hold the truth, drawn from the prior, with what is uncertain drawn too."""
    it = Cube(cells)
    hits: dict[bool, list[FloatArray]] = {False: [], True: []}
    for seed in range(sets):
        rng = np.random.default_rng(seed)
        truth = it.case.inputs.drawn(rng, 1)[0]
        factors = {
            name: 1 + (how.std or how.relative or 0.0) * rng.standard_normal() for name, how in UNCERTAIN.items()
        }
        data = it.measured(truth, {name: max(factor, 0.1) for name, factor in factors.items()}, rng)
        for uncertain, held in hits.items():
            one = it.inverted(data, uncertain=uncertain)
            held.append(((one["lower"] <= truth) & (truth <= one["upper"])).to_numpy())
    for uncertain, held in hits.items():
        each = zip(it.case.inputs.names, np.mean(held, axis=0), strict=True)
        shares = ", ".join(f"{name} {100 * share:.0f} %" for name, share in each)
        print(
            f"{sets} data sets, {'with what is uncertain' if uncertain else 'as if nothing were uncertain'}: {shares}"
        )


def main(words: Sequence[str] = ()) -> None:
    """Print how far each assumption moves each answer, as told and by inversions done again."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks assumptions")
    parser.add_argument("--cells", type=int, default=3, help="along each edge")
    parser.add_argument("--only", choices=("cube", "ball", "wrong", "coverage"), nargs="*")
    parser.add_argument("--sets", type=int, default=100, help="of which intervals are looked at")
    given = parser.parse_args(words)
    asked = given.only or ["cube", "ball", "wrong", "coverage"]
    for case in (make(given.cells) for name, make in (("cube", cube), ("ball", ball)) if name in asked):
        table(case, given.cells)
    if "wrong" in asked:
        wrong(given.cells)
    if "coverage" in asked:
        coverage(given.cells, given.sets)


def table(case: Case, cells: int) -> None:
    """Print what is told of each assumption beside inversions done again."""
    assumed, shifts, std, share = told(case)
    print(f"\n{case.name}, {cells}³ cells: {100 * share:.0f} % of the inversion\n")
    print(f"| if | {' | '.join(case.inputs.names)} |\n|---|{'---|' * len(std)}")
    worst = 0.0
    for one, said, right in zip(assumed, shifts, again(case, assumed, std), strict=True):
        pairs = [f"{a:+.3f} ({b:+.3f})" for a, b in zip(said, right, strict=True)]
        worst = max(worst, *np.abs(said - right) / np.maximum(0.05, 0.05 * np.abs(right)))
        print(f"| {one} | {' | '.join(pairs)} |", flush=True)
    print(f"\nlargest error, over the larger of 5 % and 0.05 deviations: {worst:.2f}")
