"""Whether answers are joined to rest: samples of bodies with several stable states, and of bodies with one.

The truth of each sample is found apart from the program's own paths: its loads are raised from zero in small steps, by
Newton's method with sparse factors of SciPy, which count negative eigenvalues too. A step is halved until it ends where
its tangent predicts it, in a stable state; where that fails, the branch from rest has ended. An answer is wrong if it
is another state than that and no jump is said.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI

from forward.fem.model import HyperelasticModel
from forward.hyperelastic import Hyperelastic
from forward.model import FloatArray, Guess, Solution, SolveError, Work
from uq.estimators import failure_domain
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Request, audited
from uq.inputs.distributions import Distribution, Uniform
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import random_points
from uq.surrogates.linearisation import linearise

STEPS = 64  # of the load, at least
SHORTEST = 1 / 64  # of such a step
NEWTON = 12  # iterations in each
LEAVES = 0.5  # distance from the tangent's prediction, over the step
TIGHT = 1e-9  # relative residual
SAME = 1e-5  # relative distance of two states that are one
LIMIT = 2e-3  # of the load, to which the end of a branch is known
SAMPLES, OWN = 30, 12  # of a case whose samples lie on one path from rest, and of one where each has its own

ONE_STATE = 64  # samples of each body with one state
RATIOS = {"Jm", "b", "k2", "alpha1", "alpha2", "alpha3", "fibres"}  # constants that are no moduli

SIZE = "loads.traction.size"
MATERIALS: dict[str, dict[str, Any]] = {
    "mooney-rivlin": {"C1": 800.0, "C2": 200.0, "D1": 2e4},
    "neo-hookean": {"C1": 1e3, "D1": 2e4},
    "neo-hookean-coupled": {"mu": 2e3, "lmbda": 4e4},
    "yeoh": {"C10": 1e3, "C20": 100.0, "C30": 500.0, "D1": 2e4},
    "gent": {"mu": 2e3, "Jm": 6.0, "D1": 2e4},
    "demiray": {"a": 1600.0, "b": 2.0, "D1": 2e4},
    "ogden": {"mu1": 1e3, "alpha1": 2.0, "mu2": 400.0, "alpha2": 9.0, "mu3": 200.0, "alpha3": -2.0, "D1": 2e4},
    "holzapfel-gasser-ogden": {"c": 2e3, "k1": 500.0, "k2": 0.3, "D1": 2e4, "fibres": ((1.0, 0.3, 0.0),)},
}
WITHOUT_PRESSURES = {"neo-hookean-coupled"}  # no volumetric part of its own
SCALED = {"neo-hookean-coupled": "mu", "gent": "mu", "demiray": "a", "yeoh": "C10", "ogden": "mu1"}


class Reached(NamedTuple):
    """Where raising the loads leads: the state (U,) and the fraction of the load, below 1 where the branch ends."""

    state: FloatArray
    load: float


class Small:
    """Small steps along a branch of equilibria of a model, with factors of SciPy."""

    def __init__(self, model: HyperelasticModel) -> None:
        self.equations = model.equations

    def factor(self, u: FloatArray) -> tuple[Any, bool]:
        """Factorise the stiffness at u (U,); say whether it is stable."""
        from scipy.sparse import csc_matrix
        from scipy.sparse.linalg import splu

        equations = self.equations
        equations.set_state(u)
        K = csc_matrix(equations.sparse_stiffness())
        if not np.isfinite(K.data).all():
            return None, False
        n = 3 * equations.nodes_owned
        S = ((K + K.T) / 2).toarray()
        if equations.unknowns.pressures:  # stable with the pressures condensed
            S = S[:n, :n] - S[:n, n:] @ np.linalg.solve(S[n:, n:], S[n:, :n])
        try:
            factor = splu(K)
            np.linalg.cholesky(S)
        except RuntimeError:  # singular
            return None, False
        except np.linalg.LinAlgError:
            return factor, False
        return factor, True

    def step(self, u: FloatArray, load: float) -> FloatArray | None:
        """Return the stable equilibrium at a load that the tangent at u (U,), an equilibrium, predicts; or None."""
        equations = self.equations
        equations.at_load(load)
        v = equations.on_target(u)
        first: FloatArray | None = None
        for _ in range(NEWTON):
            residual = equations.residual(v)
            if not np.isfinite(residual.size):
                return None
            factor, stable = self.factor(v)
            if factor is None:
                return None
            move = factor.solve(-residual.vector)
            if first is None:
                first = v + move
            if max(residual.size, residual.volume) <= TIGHT * residual.scale:
                v = v + move
                apart, length = equations.norm(v - first), equations.norm(first - u)
                near = apart <= LEAVES * length or length <= SAME * equations.norm(v)
                return v if stable and near and equations.smallest_jacobian(v) > 0 else None
            v = v + move
            if equations.smallest_jacobian(v) <= 0:
                return None
        return None

    def follow(self, u: FloatArray, start: float, end: float) -> Iterator[Reached]:
        """Follow the branch from one load to another, perhaps downwards, as far as it goes."""
        whole = (end - start) / STEPS
        at, step = start, whole
        while at != end:
            target = end if abs(end - at) <= abs(step) * (1 + 1e-9) else at + step
            there = self.step(u, target)
            if there is None:
                step /= 2
                if abs(step) < SHORTEST * abs(whole):
                    return
                continue
            u, at = there, target
            yield Reached(u, at)
            step = whole if abs(step) > whole else min(abs(2 * step), abs(whole)) * np.sign(whole)


@dataclass(frozen=True)
class Case:
    """A body and the parameters in whose range it may have several states.

    Attributes
    ----------
    spec, inputs
        The body and its random parameters.
    most
        The load above all samples', where one load of dead forces is the only parameter: one path serves all samples.
    """

    spec: Hyperelastic
    inputs: Inputs
    most: float | None = None

    @property
    def samples(self) -> int:
        """How many."""
        return OWN if self.most is None else SAMPLES


def case(parameters: dict[str, tuple[float, float]], *, most: float | None = None, **blocks: Any) -> Case:
    """Return a case of uniform parameters."""
    usual = {"outputs": [{"kind": "strain-energy", "name": "W"}]}
    spec = Hyperelastic.model_validate(usual | blocks)
    ranges: dict[str, Distribution] = {path: Uniform(lower=low, upper=high) for path, (low, high) in parameters.items()}
    return Case(spec, Inputs(ranges), most)


def truths(case: Case, model: HyperelasticModel, points: FloatArray) -> list[Reached]:
    """Return where raising the loads from zero leads at points (n, d)."""
    small, equations = Small(model), model.equations
    zero = np.zeros(equations.size)
    if case.most is None:
        found = []
        for point in points:
            equations.set_parameters(point)
            last = Reached(zero, 0.0)
            for last in small.follow(zero, 0.0, 1.0):  # noqa: B007 - the last one counts
                pass
            found.append(last)
        return found
    equations.set_parameters(np.array([case.most]))
    path = [Reached(zero, 0.0), *small.follow(zero, 0.0, 1.0)]
    found = []
    for load in points[:, 0] / case.most:
        before = max((one for one in path if one.load <= load), key=lambda one: one.load)
        equations.set_parameters(np.array([case.most]))
        there = small.step(before.state, load) if before.load < load else before.state
        found.append(Reached(before.state, before.load / load) if there is None else Reached(there, 1.0))
    return found


def others(case: Case, model: HyperelasticModel, points: FloatArray, known: list[Reached]) -> int:
    """Return at how many points (n, 1) a state beyond the jump is stable too, found by lowering the load from above."""
    if case.most is None:
        return 0
    small, equations = Small(model), model.equations
    try:
        above = np.array(model.solve(np.array([case.most])).state)
    except SolveError:
        return 0
    equations.set_parameters(np.array([case.most]))
    path = [Reached(above, 1.0), *small.follow(above, 1.0, 0.25 * points.min() / case.most)]
    count = 0
    for load, one in zip(points[:, 0] / case.most, known, strict=True):
        near = min(path, key=lambda there: abs(there.load - load))
        equations.set_parameters(np.array([case.most]))
        there = small.step(near.state, load) if near.load != load else near.state
        if there is not None and one.load == 1 and not same(model, there, one.state):
            count += 1
    return count


def same(model: HyperelasticModel, u: FloatArray, v: FloatArray) -> bool:
    """Whether two states (U,) are one."""
    norm = model.equations.norm
    return norm(u - v) <= SAME * max(norm(u), norm(v))


@dataclass
class Row:
    """What came of a case.

    Attributes
    ----------
    samples, two
        How many, and how many have two states, as far as lowering the load shows.
    joined, beyond
        Answers that are joined to rest, and answers beyond the end of the branch from rest that say so.
    wordless
        Answers that are not joined to rest, without a word.
    cried
        Answers that are joined to rest and are said to be beyond a jump.
    replaced
        Answers where another state was found first.
    refused, lost
        Samples without an answer, and those of them where the branch from rest reaches the whole load.
    edge
        Samples as close to the end of the branch as that is known, which count for nothing else.
    work
        Their operations.
    why
        Reasons of lost samples, and points of wrong ones.
    """

    samples: int = 0
    two: int = 0
    joined: int = 0
    beyond: int = 0
    wordless: int = 0
    cried: int = 0
    replaced: int = 0
    refused: int = 0
    lost: int = 0
    edge: int = 0
    work: Work = field(default_factory=Work)
    why: list[str] = field(default_factory=list)


def judged(case: Case, seed: int = 0) -> Row:
    """Solve the samples of a case as a study does, and judge their states."""
    model = case.spec.build(MPI.COMM_SELF, case.inputs.names)
    points = case.inputs.points(random_points(seed, 0, case.samples, len(case.inputs.names)))
    known = truths(case, model, points)
    row = Row(len(points), others(case, model, points, known))
    found = list(answers(case, model, points))
    for point, one, truth in zip(points, found, known, strict=True):
        row.work = Work.sum_of([row.work, one.work])
        reached = truth.load == 1
        if not reached and truth.load > 1 - LIMIT:
            row.edge += 1
        elif isinstance(one, SolveError):
            row.refused += 1
            row.lost += reached
            row.why += [f"{point}: {one.reason}"] if reached else []
        else:
            row.replaced += one.work.others > 0
            right = reached and same(model, one.state, truth.state)
            row.joined += right and not one.work.snaps
            row.cried += right and one.work.snaps > 0
            row.beyond += not right and one.work.snaps > 0
            if not right and not one.work.snaps:
                row.wordless += 1
                row.why.append(f"{point}: wrong, the branch from rest reaches {truth.load:.4g}")
    return row


def answers(case: Case, model: HyperelasticModel, points: FloatArray) -> Iterator[Solution | SolveError]:
    """Solve at points (n, d) from the tangent at the means, or without where that has no state."""
    chosen, guess = audited(points), None
    with suppress(SolveError):
        prediction = linearise(case.inputs, SerialEvaluate(model)).prediction
        guess = None if prediction is None else prediction.on(model)
    guesses = [replace(Guess() if guess is None else guess(point), audit=chosen(point)) for point in points]
    return model.solve_many(points, guesses)


# --- bodies with several states --------------------------------------------------------------------------------------


def pulled(material: str, form: str) -> Case:
    """A block between three roller planes, pulled by a dead load to stretches of 1.5 to 2.5."""
    numbers = MATERIALS[material]
    blocks: dict[str, Any] = {
        "body": {"size": (0.1, 0.1, 0.1), "cells": (1, 1, 1), "degree": 2},
        "material": {"kind": material, **numbers},
        "formulation": form,
        "displacements": ({"on": "x-min", "x": 0.0}, {"on": "y-min", "y": 0.0}, {"on": "z-min", "z": 0.0}),
        "loads": ({"kind": "traction", "on": "x-max", "direction": (1.0, 0.0, 0.0), "size": 1e3},),
        "outputs": ({"kind": "mean-displacement", "name": "ux", "on": "x-max", "component": "x"},),
    }
    load, loads = 2e3, np.zeros(0)
    while len(loads) < 2 and load < 1e7:
        path = along(case({SIZE: (0.0, load)}, **blocks), load)
        loads = np.array([at for at, stretched in path if 0.05 <= stretched <= 0.15])
        load = 2 * load if path[-1][1] < 0.15 else load
        loads = loads if path[-1][1] >= 0.15 else loads[:0]
    ranges = {SIZE: (float(loads.min()), float(loads.max()))}
    return case(ranges, most=1.02 * float(loads.max()), **blocks)


def along(one: Case, load: float) -> list[tuple[float, float]]:
    """Loads and first outputs on the branch from rest of a case with one load."""
    model = one.spec.build(MPI.COMM_SELF, one.inputs.names)
    small, equations = Small(model), model.equations
    equations.set_parameters(np.array([load]))
    found = []
    for there in small.follow(np.zeros(equations.size), 0.0, 1.0):
        equations.set_state(there.state)
        found.append((there.load * load, float(model.functionals[0].value())))
    return found


ARCHES: dict[str, tuple[float, float, float, float]] = {  # rise, thickness, of the crown beside the middle, kink
    "shallow arch": (0.075, 0.04, 0.0, 0.0),
    "skew arch": (0.1, 0.045, 0.25, 0.0),
    "two struts": (0.09, 0.05, 0.0, 1.0),
}
OF_ARCHES = {"shallow arch": "neo-hookean", "skew arch": "yeoh", "two struts": "mooney-rivlin"}


def arched(name: str, form: str, middle: float) -> Case:
    """An arch that snaps, loaded on its crown around a multiple of the load where the branch from rest ends."""
    numbers = MATERIALS[OF_ARCHES[name]] | {"D1": 2e4 if form == "mixed" else 2e3}
    blocks: dict[str, Any] = {
        "body": {"kind": "mesh", "file": str(arch_file(*ARCHES[name])), "degree": 2},
        "material": {"kind": OF_ARCHES[name], **numbers},
        "formulation": form,
        "clamp": ("ends",),
        "loads": ({"kind": "traction", "on": "crown", "direction": (0.0, -1.0, 0.0), "size": 1.0},),
    }
    load = 2.0
    while (path := along(case({SIZE: (0.0, load)}, **blocks), load))[-1][0] >= 0.9 * load:
        load *= 3
    limit = path[-1][0]
    ranges = {SIZE: ((middle - 0.5) * limit, (middle + 0.5) * limit)}
    return case(ranges, most=2 * limit, **blocks)


def arch_file(rise: float, thick: float, beside: float, kink: float) -> Path:
    """Write the mesh of an arch of a row of cells between x = 0 and 1; return its path."""
    import meshio

    n, width = 10, 0.1
    s = np.linspace(0, 1, n + 1)
    height = rise * ((1 - kink) * 4 * s * (1 - s) * (1 + beside * (2 * s - 1)) + kink * (1 - np.abs(2 * s - 1)))
    points = [
        (x, y + thick * (j - 0.5), width * k) for x, y in zip(s, height, strict=True) for j in (0, 1) for k in (0, 1)
    ]
    around = ((0, 0), (1, 0), (1, 1), (0, 1))
    cells = [[c for k in (0, 1) for c in (4 * e + k, 4 * e + 4 + k, 4 * e + 6 + k, 4 * e + 2 + k)] for e in range(n)]
    ends = [[4 * i + 2 * j + k for j, k in around] for i in (0, n)]
    crown = [[4 * e + 2, 4 * e + 6, 4 * e + 7, 4 * e + 3] for e in (n // 2 - 1, n // 2)]
    tags = [np.full(n, 1), np.array([2, 2, 3, 3])]
    path = Path(tempfile.mkdtemp()) / "arch.msh"
    mesh = meshio.Mesh(
        points,
        [("hexahedron", cells), ("quad", ends + crown)],
        cell_data={"gmsh:physical": tags, "gmsh:geometrical": tags},
        field_data={"body": np.array([1, 3]), "ends": np.array([2, 2]), "crown": np.array([3, 2])},
    )
    meshio.write(path, mesh, file_format="gmsh22", binary=True)
    return path


def column(form: str, aside: tuple[float, float] | None) -> Case:
    """A column under a dead load about that at which it buckles, perhaps with a force aside."""
    body = {"size": (1.0, 0.1, 0.1), "cells": (6, 1, 1), "degree": 2}
    loads: list[dict[str, Any]] = [{"kind": "traction", "on": "x-max", "direction": (-1, 0, 0), "size": 110}]
    parameters = {SIZE: (70.0, 150.0)}
    if aside is not None:
        loads[0]["name"] = "push"
        loads.append({"kind": "traction", "name": "aside", "on": "x-max", "direction": (0, 1, 0), "size": 1.0})
        parameters = {"loads.push.size": (70.0, 150.0), "loads.aside.size": aside}
    material = {"kind": "neo-hookean", "C1": 1e4, "D1": 1e5}
    most = 152.0 if aside is None else None
    return case(parameters, most=most, body=body, material=material, clamp=("x-min",), formulation=form, loads=loads)


def plate(form: str, under: tuple[float, float]) -> Case:
    """A plate between clamps, pressed together beyond buckling, under a pressure from below or from either side."""
    body = {"size": (1.0, 0.06, 0.3), "cells": (6, 1, 1), "degree": 2}
    moved = ({"on": "x-max", "x": -0.02, "y": 0.0, "z": 0.0},)
    parameters = {"displacements.x-max.x": (-0.03, -0.004), "loads.pressure.size": under}
    return case(
        parameters,
        body=body,
        material={"kind": "neo-hookean", "C1": 1e4, "D1": 1e5},
        clamp=("x-min",),
        displacements=moved,
        formulation=form,
        loads=({"kind": "pressure", "on": "y-min", "size": 20.0},),
    )


def squeezed(form: str, material: str) -> Case:
    """A block compressed between clamps until it may buckle."""
    numbers = MATERIALS[material]
    name = SCALED.get(material, next(iter(numbers)))
    body = {"size": (1.0, 0.7, 0.8), "cells": (3, 2, 2), "degree": 2}
    parameters = {
        "displacements.x-max.x": (-0.62, -0.35),
        f"material.{name}": (0.9 * numbers[name], 1.1 * numbers[name]),
    }
    return case(
        parameters,
        body=body,
        material={"kind": material, **numbers},
        clamp=("x-min",),
        displacements=({"on": "x-max", "x": -0.5, "y": 0.0, "z": 0.0},),
        formulation=form,
    )


# --- bodies with one state -------------------------------------------------------------------------------------------


def single() -> dict[str, Callable[[], Case]]:
    """Twenty bodies with one state, however far they bend, by name."""
    box = {
        "cantilever": ((1.0, 0.1, 0.1), (6, 1, 1)),
        "block": ((0.1, 0.1, 0.1), (2, 2, 2)),
        "plate": ((1, 0.06, 0.3), (6, 1, 1)),
    }
    hung = {"kind": "gravity", "direction": (0.0, -1.0, 0.0), "density": 100.0}
    along, aside = (
        {"kind": "traction", "name": name, "on": "x-max", "direction": direction, "size": size}
        for name, direction, size in (("along", (1, 0, 0), 50.0), ("aside", (0, 1, 0), 5.0))
    )
    under = {"kind": "pressure", "name": "under", "on": "y-min", "size": 5.0}
    gravity, size = "loads.gravity.density", "loads.{}.size"
    kinds = list(MATERIALS)
    shapes: list[tuple[str, str, tuple[Any, ...], tuple[Any, ...], dict[str, tuple[float, float]]]] = [
        ("hung", "cantilever", (hung,), (), {gravity: (20.0, 300.0)}),
        (
            "hung and pulled",
            "cantilever",
            (hung, along),
            (),
            {gravity: (20.0, 200.0), size.format("along"): (-40.0, 500.0)},
        ),
        ("bent to either side", "cantilever", (aside,), (), {size.format("aside"): (-6.0, 9.0)}),
        (
            "pushed a little and bent",
            "cantilever",
            (along, aside),
            (),
            {size.format("along"): (-50.0, 30.0), size.format("aside"): (-3.0, 5.0)},
        ),
        ("under pressure", "plate", (under,), (), {size.format("under"): (-4.0, 8.0)}),
        (
            "between clamps, under pressure",
            "plate",
            (under,),
            ({"on": "x-max", "x": 0.02, "y": 0.0, "z": 0.0},),
            {"displacements.x-max.x": (0.0, 0.1), size.format("under"): (-20.0, 60.0)},
        ),
        (
            "sheared",
            "block",
            (),
            ({"on": "x-max", "x": 0.0, "y": 0.03, "z": 0.0},),
            {"displacements.x-max.y": (-0.04, 0.08)},
        ),
        (
            "stretched",
            "block",
            (),
            ({"on": "x-max", "x": 0.05, "y": 0.0, "z": 0.0},),
            {"displacements.x-max.x": (-0.02, 0.1)},
        ),
        (
            "turned and sheared",
            "block",
            (hung,),
            ({"on": "x-max", "x": 0.0, "y": 0.0, "z": 0.04},),
            {"displacements.x-max.z": (-0.02, 0.08), gravity: (0.0, 2e3)},
        ),
        ("pressed", "block", (under,), (), {size.format("under"): (-300.0, 900.0)}),
    ]
    found: dict[str, Callable[[], Case]] = {}
    for i, (name, shape, loads, moved, ranges) in enumerate(shapes):
        for form in FORMS:
            kind = kinds[(3 * i + (form == "mixed")) % len(kinds)]
            kind = "neo-hookean" if form == "mixed" and kind in WITHOUT_PRESSURES else kind
            numbers = {key: 10 * value if key not in RATIOS else value for key, value in MATERIALS[kind].items()}
            stiff = SCALED.get(kind, next(iter(numbers)))
            found[f"{shape} {name}, {kind}, {form}"] = partial(
                case,
                ranges | {f"material.{stiff}": (0.7 * numbers[stiff], 1.3 * numbers[stiff])},
                body={"size": box[shape][0], "cells": box[shape][1], "degree": 2},
                material={"kind": kind, **numbers},
                clamp=("x-min",),
                displacements=moved,
                loads=loads,
                formulation=form,
            )
    return found


def findings(case: Case) -> tuple[int, int, list[str]]:
    """Samples without an answer, audits that a screen called for, and the findings of other states."""
    model = case.spec.build(MPI.COMM_SELF, case.inputs.names)
    points = case.inputs.points(random_points(1, 0, ONE_STATE, len(case.inputs.names)))
    evaluate = SerialEvaluate(model)
    found = evaluate(Request(points, start=linearise(case.inputs, evaluate).prediction))
    jumps = [one.text for one in failure_domain.of_jumps([found])]
    return len(found.failures), int(found.counted("calls").sum()), jumps


FORMS = ("displacement", "mixed")


def cases() -> dict[str, Callable[[], Case]]:
    """The cases by name."""
    found: dict[str, Callable[[], Case]] = {}
    for form in FORMS:
        for name in ARCHES:
            for where, middle in (("before", 0.8), ("beyond", 1.2)):
                found[f"{name}, {form}, mean {where} the jump"] = partial(arched, name, form, middle)
        for material in MATERIALS:
            if form == "displacement" or material not in WITHOUT_PRESSURES:
                found[f"rollers, {material}, {form}"] = partial(pulled, material, form)
        found[f"column, {form}"] = partial(column, form, None)
        found[f"column pushed aside, {form}"] = partial(column, form, (0.2, 2.0))
        found[f"column pushed to either side, {form}"] = partial(column, form, (-0.7, 1.7))
        found[f"plate, {form}"] = partial(plate, form, (3.0, 30.0))
        found[f"plate pressed from either side, {form}"] = partial(plate, form, (-10.0, 25.0))
        for material in ("neo-hookean", "mooney-rivlin"):
            found[f"clamped block, {material}, {form}"] = partial(squeezed, form, material)
    return found


def main(words: Sequence[str] = ()) -> None:
    """Print the table; with words, of the cases whose names have one of them."""
    print(
        "| case | samples | two states | joined | beyond, said | wrong without a word | jump said wrongly | replaced "
        "| refused | of these joined | at the limit | calls | audits |"
    )
    print("|" + "---|" * 13)
    for name, make in cases().items():
        if words and not any(word in name for word in words):
            continue
        row = judged(make())
        counted = (row.samples, row.two, row.joined, row.beyond, row.wordless, row.cried, row.replaced)
        more = (row.refused, row.lost, row.edge, row.work.calls, row.work.audits)
        print(f"| {name} | {' | '.join(map(str, counted + more))} |", flush=True)
        for why in row.why[:6]:
            print("   ", why, flush=True)
    print("\n| body with one state | samples | refused | calls | findings of other states |\n|---|---|---|---|---|")
    for name, make in single().items():
        if words and not any(word in name for word in words):
            continue
        refused, calls, said = findings(make())
        print(f"| {name} | {ONE_STATE} | {refused} | {calls} | {'; '.join(said) or 'none'} |", flush=True)
