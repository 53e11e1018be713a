"""The error of the mesh: what is claimed over what it is, in nine problems; and what an estimate costs.

References are cubic elements on three finer meshes each, boxes with thin cells at their faces, extrapolated with the
order that the three show. Curved bodies are the same polyhedra on all meshes: what a coarse mesh cuts off is no error
here.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI

from benchmarks.beams import beam
from forward.hyperelastic import Hyperelastic
from forward.model import FloatArray
from uq.accuracy.budget import estimates_for, spare_for
from uq.accuracy.effects import UNCALIBRATED, unknown_of
from uq.accuracy.mesh_errors import estimate
from uq.estimators.moments import Z
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs
from uq.surrogates.linearisation import linearise
from workflows.config.study import load

CONFIGS = Path(__file__).parent.parent / "configs"
SOLVER = {"tolerance": 1e-10}
SAMPLES = 8
AFFORDED = spare_for(50)  # a calibration as in a study of 50 solves
SIDES = ("x-min", "x-max", "y-min", "y-max", "z-min", "z-max")
GRADING = 8.0
ORDERS = np.geomspace(0.8, 8.0, 400)  # below, of point values at the edges of these polyhedra, there is none
SIZES = (
    ((20, 4, 4), "tetrahedron"),
    ((12, 3, 6), "hexahedron"),
    ((28, 6, 6), "tetrahedron"),
    ((20, 5, 8), "hexahedron"),
    ((48, 8, 10), "tetrahedron"),
)
MOST_DIRECT = 30_000  # unknowns up to which the enriched equations are solved directly too
CUBE = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])[[0, 1, 3, 2, 4, 5, 7, 6]]  # VTK's order
FACES = ((0, 3, 7, 4), (1, 2, 6, 5), (0, 1, 5, 4), (3, 2, 6, 7), (0, 1, 2, 3), (4, 5, 6, 7))  # x-min, x-max, y-min, …


Map = Callable[[FloatArray], FloatArray]


class Case(NamedTuple):
    """A problem on a coarse mesh, and on those of its reference, with how many times the cells along each edge."""

    name: str
    coarse: Hyperelastic
    fine: dict[float, Hyperelastic]


class Exact(NamedTuple):
    """Outputs (m,) without an error of the mesh, and how far they may be wrong."""

    outputs: FloatArray
    doubts: FloatArray


def at(name: str, place: tuple[float, float, float], component: str) -> dict[str, Any]:
    """An output: a displacement."""
    return {"name": name, "kind": "displacement", "at": place, "component": component}


ENERGY = {"name": "energy", "kind": "strain-energy"}
VOLUME = {"name": "volume", "kind": "volume-change"}
SOFT = {"kind": "neo-hookean", "C1": 1e4, "D1": 2e4}


def boxed(name: str, blocks: dict[str, Any], times: tuple[float, ...], *, towards: tuple[str, ...] = SIDES) -> Case:
    """A body with a mesh of its own, and some that are graded."""
    coarse = Hyperelastic.model_validate({"solver": SOLVER} | blocks)
    fine = {}
    for t in times:
        body = coarse.body.finer(t, towards, GRADING, GRADING / 2)
        layers = tuple(1 if n == 1 else m for n, m in zip(coarse.body.cells, body.cells, strict=True))  # plane strain
        fine[t] = coarse.model_copy(update={"body": body.model_copy(update={"cells": layers})}).enriched()
    return Case(name, coarse, fine)


def beams() -> Case:
    """The published beam at its mean parameters."""
    spec = beam((12, 2, 4)).model
    outputs = (
        {"name": "uy", "kind": "max-displacement", "component": "y"},
        at("middle", (0.14, 0.01, 0.04), "y"),
        ENERGY,
    )
    return boxed("beam", spec.model_dump() | {"outputs": outputs}, (1.0, 1.5, 2.0), towards=("x-min",))


def cook(name: str, changes: dict[str, Any], n: int, times: tuple[float, ...]) -> Case:
    """Cook's membrane of one layer."""
    spec = load(CONFIGS / "cook.toml").model
    outputs = (at("rise", (0.048, 0.060, 0.0), "y"), ENERGY)
    body = spec.body.model_dump() | {"cells": (n, n, 1)}
    return boxed(name, spec.model_dump() | {"outputs": outputs, "body": body} | changes, times)


def block() -> Case:
    """A block between two plates that hold it, pressed by a fifth."""
    blocks = {
        "body": {"size": (1.0, 1.0, 0.6), "cells": (4, 4, 3)},
        "material": SOFT,
        "clamp": ("z-min",),
        "displacements": ({"on": "z-max", "x": 0.0, "y": 0.0, "z": -0.12},),
        "outputs": (
            {"name": "force", "kind": "reaction", "on": "z-max", "component": "z"},
            at("bulge", (1.0, 0.5, 0.3), "x"),
            ENERGY,
        ),
    }
    return boxed("pressed block", blocks, (1.0, 1.5, 2.0))


def ball() -> Case:
    """A cube in shear, with a ball inside that is ten times as stiff."""
    blocks = {
        "body": {"size": (1.0, 1.0, 1.0), "cells": (4, 4, 4)},
        "material": SOFT,
        "inclusions": (
            {"kind": "sphere", "x": 0.5, "y": 0.5, "z": 0.5, "radius": 0.25, "width": 0.25, "contrast": 10.0},
        ),
        "clamp": ("z-min",),
        "loads": ({"kind": "traction", "on": "z-max", "direction": (1.0, 0.0, 0.0), "size": 3e3},),
        "outputs": (
            {"name": "shear", "kind": "mean-displacement", "on": "z-max", "component": "x"},
            at("corner", (1.0, 1.0, 1.0), "z"),
            ENERGY,
        ),
    }
    return boxed("cube with a stiff ball", blocks, (1.0, 1.5, 2.0))


def organ() -> Case:
    """The organ of the shipped study without its random field, with a tumour of another stiffness."""
    spec = load(CONFIGS / "organ.toml").model
    changes = {"fields": (), "outputs": (*(output.model_dump() for output in spec.outputs), ENERGY), "solver": SOLVER}
    coarse = Hyperelastic.model_validate(spec.model_dump() | changes)
    return Case("organ", coarse, {2.0: coarse.refined(1)})


def meshed(
    folder: str, name: str, shape: Map, cells: tuple[int, int, int], blocks: dict[str, Any],
    kept: Callable[[FloatArray], Any] | None = None,
) -> Case:  # fmt: skip
    """A body from a file: the image of cells of the unit cube whose middle is kept; refined, the same polyhedron."""
    import meshio

    def write(parts: int) -> str:
        points, corners, facets = [], [], {}
        numbers: dict[tuple[float, ...], int] = {}

        def number(x: FloatArray) -> int:
            key = tuple(np.round(x, 9) + 0.0)
            if key not in numbers:
                numbers[key] = len(points)
                points.append(x)
            return numbers[key]

        for cell in np.ndindex(*cells):
            local = (np.array(cell) + CUBE) / cells
            if kept is not None and not kept(local.mean(axis=0)):
                continue
            images = shape(local)
            for part in np.ndindex(parts, parts, parts):
                s = (np.array(part) + CUBE) / parts
                weights = np.array([np.prod(np.where(CUBE == 1, x, 1 - x), axis=1) for x in s])
                here = [number(x) for x in weights @ images]
                corners.append(here)
                for axis in range(3):
                    for end in (0, 1):
                        outer = part[axis] == end * (parts - 1) and cell[axis] == end * (cells[axis] - 1)
                        if outer:
                            facets.setdefault(2 * axis + end, []).append([here[k] for k in FACES[2 * axis + end]])
        quads = [quad for numbered in facets.values() for quad in numbered]
        tags = [10 + number for number, found in facets.items() for _ in found]
        names = {f"{'xyz'[k // 2]}-{('min', 'max')[k % 2]}": np.array([10 + k, 2]) for k in facets}
        data = [np.ones(len(corners), dtype=np.int32), np.array(tags, dtype=np.int32)]
        mesh = meshio.Mesh(
            np.array(points),
            [("hexahedron", np.array(corners)), ("quad", np.array(quads))],
            cell_data={"gmsh:physical": data, "gmsh:geometrical": data},
            field_data=names | {"all": np.array([1, 3])},
        )
        path = f"{folder}/{name.replace(' ', '-')}-{parts}.msh"
        meshio.write(path, mesh, file_format="gmsh22", binary=True)
        return path

    coarse, *fine = (
        Hyperelastic.model_validate({"solver": SOLVER} | blocks | {"body": {"kind": "mesh", "file": write(parts)}})
        for parts in (1, 2, 3, 4)
    )
    return Case(name, coarse, {float(times): spec.enriched() for times, spec in zip((2, 3, 4), fine, strict=True)})


def corner(folder: str) -> Case:
    """An L of three squares, clamped at one end, pulled at the other."""
    blocks = {
        "material": SOFT,
        "clamp": ("y-max",),
        "displacements": ({"on": "z-min", "z": 0.0}, {"on": "z-max", "z": 0.0}),
        "loads": ({"kind": "traction", "on": "x-max", "direction": (0.0, -1.0, 0.0), "size": 500.0},),
        "outputs": (at("tip", (2.0, 0.0, 0.0), "y"), at("elbow", (0.0, 0.0, 0.0), "x"), ENERGY),
    }
    return meshed(
        folder, "re-entrant corner", lambda x: x * [2.0, 2.0, 0.25], (4, 4, 1), blocks,
        lambda x: x[0] < 0.5 or x[1] < 0.5,
    )  # fmt: skip


def hole(folder: str) -> Case:
    """A quarter of a square plate with a round hole, pulled along x."""

    def shape(x: FloatArray) -> FloatArray:
        angle = math.pi / 2 * x[:, 1]
        square = np.minimum(1 / np.maximum(np.cos(angle), 1e-12), 1 / np.maximum(np.sin(angle), 1e-12))
        radius = 0.3 + (square - 0.3) * x[:, 0] ** 1.3
        return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0.2 * x[:, 2]])

    blocks = {
        "material": SOFT,
        "displacements": ({"on": "y-min", "y": 0.0}, {"on": "y-max", "x": 0.0}, {"on": "z-min", "z": 0.0}),
        "loads": ({"kind": "pressure", "on": "x-max", "size": -2e3},),
        "outputs": (at("hole", (0.3, 0.0, 0.0), "x"), at("top", (0.0, 0.3, 0.0), "y"), ENERGY),
    }
    return meshed(folder, "plate with a hole", shape, (3, 4, 1), blocks)


def tube(folder: str) -> Case:
    """A quarter of a tube with fibres along it under pressure inside, clamped at one end."""

    def shape(x: FloatArray) -> FloatArray:
        radius, angle = 0.7 + 0.3 * x[:, 0], math.pi / 2 * x[:, 1]
        return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 2 * x[:, 2]])

    blocks = {
        "material": {
            "kind": "holzapfel-gasser-ogden", "c": 1e4, "k1": 5e3, "k2": 0.8, "D1": 2e5,
            "fibres": ((0.0, 0.0, 1.0),),
        },
        "clamp": ("z-min",),
        "displacements": ({"on": "y-min", "y": 0.0}, {"on": "y-max", "x": 0.0}),
        "loads": ({"kind": "pressure", "on": "x-min", "size": 2e3},),
        "outputs": (at("widening", (1.0, 0.0, 1.0), "x"), at("end", (0.7, 0.0, 2.0), "x"), VOLUME, ENERGY),
    }  # fmt: skip
    return meshed(folder, "HGO tube", shape, (1, 3, 4), blocks)


def cases(folder: str) -> Iterator[Callable[[], Case]]:
    """All nine problems."""
    yield beams
    yield lambda: cook(
        "Cook, compressible", {"material": {"kind": "neo-hookean", "C1": 40e6, "D1": 80e6}}, 4, (2.0, 3.0, 4.0)
    )
    yield lambda: cook("Cook, nearly incompressible", {}, 8, (1.5, 2.0, 3.0))
    yield lambda: corner(folder)
    yield lambda: hole(folder)
    yield ball
    yield block
    yield organ
    yield lambda: tube(folder)


def main(words: Sequence[str] = ()) -> None:
    """Print effectivities, and costs unless problems are named."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks mesh_error")
    parser.add_argument("--only", nargs="*", default=[], help="parts of the names of problems")
    parser.add_argument("--costs", action="store_true", help="costs alone")
    asked = parser.parse_args(words)
    only = asked.only
    if asked.costs:
        costs()
        return
    print(
        "| problem | unknowns | output | value | error (%) | seen over true | calibrated over true | doubt over true |"
    )
    print("|---|---|---|---|---|---|---|---|")
    found: list[tuple[float, float]] = []
    with TemporaryDirectory() as folder:
        for make in cases(folder):
            case = make()
            if not only or any(word in case.name for word in only):
                found += effectivities(case)
    ratios, held = np.array(found).T
    within = [np.mean((low <= ratios) & (ratios <= high)) for low, high in ((0.8, 1.25), (0.6, 1.6))]
    print(f"\n{len(found)} outputs: {within[0]:.0%} within 0.8 and 1.25, {within[1]:.0%} within 0.6 and 1.6")
    print(f"the doubt covers what is left in {held.mean():.0%}\n")
    if not only:
        elsewhere()
        costs()


def exact(case: Case) -> Exact:
    """Extrapolate from the meshes of the reference."""
    values = np.array([spec.build(MPI.COMM_SELF, ()).solve(np.zeros(0)).outputs for spec in case.fine.values()])
    if len(values) < 3:  # the organ, whose finer mesh has half as long edges: of errors in corners and of smooth ones
        step = values[-1] - case.coarse.build(MPI.COMM_SELF, ()).solve(np.zeros(0)).outputs
        least, most = (step / (2**order - 1) for order in (2.0, 1.4))
        return Exact(values[-1] + (least + most) / 2, np.abs(most - least) / 2)
    first, second, third = (t**-ORDERS for t in case.fine)
    steps = np.diff(values, axis=0)
    # The first step over the second grows with the order.
    order = np.array([np.interp(a / b, (first - second) / (second - third), ORDERS) for a, b in steps.T])
    _, before, last = (t**-order for t in case.fine)
    rest = steps[1] * last / (before - last)
    return Exact(values[-1] + rest, np.abs(rest) / 2)


def effectivities(case: Case) -> list[tuple[float, bool]]:
    """Print a row for each output of a problem; return what is claimed, calibrated, over what is true."""
    solution = case.coarse.build(MPI.COMM_SELF, ()).solve(np.zeros(0))
    error, saturation, name = solution.mesh_error(), solution.saturation(AFFORDED), case.name
    if not saturation.measured and (longer := solution.saturation()).measured:
        saturation, name = longer, f"{case.name}, in a long study"
    calibrated = error.calibrated(saturation).outputs
    values, doubts = exact(case)
    true = values - solution.outputs
    left = UNCALIBRATED * np.abs(calibrated) if saturation.doubts is None else saturation.doubts
    unknowns = f"{case.coarse.unknowns:,} → {list(case.fine.values())[-1].unknowns:,}"
    for i, output in enumerate(case.coarse.outputs):
        print(
            f"| {name} | {unknowns} | {output.name} | {values[i]:.5g} ± {doubts[i]:.1g} "
            f"| {100 * true[i] / values[i]:.2g} | {error.outputs[i] / true[i]:.2f} | {calibrated[i] / true[i]:.2f} "
            f"| {left[i] / abs(true[i]):.2f} |",
            flush=True,
        )
    return list(zip(calibrated / true, np.abs(calibrated - true) <= left, strict=True))


def elsewhere(only: str = "") -> None:
    """Print what a study makes of estimates at other parameters, over what a calibration of their own makes of them.

    With the doubt that it states, as in a study of 50 solves, or in a long one where so few afford no calibration.
    """
    print("| problem | parameters, at their quantiles | output: by the study over its own (stated doubt) |")
    print("|---|---|---|")
    compressible = {"kind": "neo-hookean", "C1": 40e6, "D1": 80e6}
    of_cook = load(CONFIGS / "cook.toml").inputs
    of_tube = Inputs(
        {"material.c": Uniform(lower=8e3, upper=1.2e4), "loads.pressure.size": Uniform(lower=1.2e3, upper=1.9e3)}
    )
    found, covered = list[float](), list[bool]()
    with TemporaryDirectory() as folder:
        for case, inputs in (
            (beams(), load(CONFIGS / "beam.toml").inputs),
            (cook("Cook, compressible", {"material": compressible}, 4, ()), of_cook),
            (cook("Cook, nearly incompressible", {}, 8, ()), of_cook),
            (tube(folder), of_tube),
        ):
            if only not in case.name:
                continue
            model, names = case.coarse.build(MPI.COMM_SELF, inputs.names), ", ".join(inputs.names)
            evaluate = SerialEvaluate(model)
            centre, count = linearise(inputs, evaluate), estimates_for(50)
            spare = AFFORDED
            few = estimate(inputs, evaluate, centre, count, 0, fields=False, spare=spare)
            if not few.measured:  # a long study
                spare = math.inf
                few = estimate(inputs, evaluate, centre, count, 0, fields=False, spare=spare)
            unknown, at_mean = unknown_of(few), few.outputs[0]
            for quantiles in ((0.05, 0.05), (0.05, 0.95), (0.95, 0.05), (0.95, 0.95)):
                (point,) = inputs.points(np.array([quantiles]))
                solution = model.solve(point)
                error, shifts = solution.mesh_error(), np.nan_to_num(few.shifts)
                here = error.outputs * few.saturation + shifts * solution.outputs / at_mean
                own = solution.saturation(spare)
                its = error.calibrated(own).outputs
                left = np.zeros(len(its)) if own.doubts is None else own.doubts
                ratios, doubts = here / its, unknown * np.abs(here)
                found += ratios.tolist()
                covered += (np.abs(here - its) <= Z * np.hypot(doubts, left)).tolist()
                told = ", ".join(
                    f"{output.name} {r:.2f} ({d / abs(own):.2f})"
                    for output, r, d, own in zip(case.coarse.outputs, ratios, doubts, its, strict=True)
                )
                print(f"| {case.name} | {names}: {quantiles[0]}, {quantiles[1]} | {told} |", flush=True)
    print(f"\n{min(found):.2f} to {max(found):.2f}; at 95 % the doubts cover {np.mean(covered):.0%}\n")


def costs() -> None:
    """Print what an estimate takes, over a realisation by prediction and correction, medians of both on each draw."""
    print("| beam | form | unknowns | realisation (CPU s) | estimate (CPU s) | ratio | over a direct solve | how |")
    print("|---|---|---|---|---|---|---|---|")
    for cells, cell in SIZES:
        for form in ("displacement", "mixed") if math.prod(cells) < 1010 else ("displacement",):
            study = beam(cells, f'model.body.cell="{cell}"', f'model.formulation="{form}"')
            model = study.model.build(MPI.COMM_SELF, study.inputs.names)
            prediction = linearise(study.inputs, SerialEvaluate(model)).prediction
            assert prediction is not None
            guess = prediction.on(model)
            rows, size = [], model.equations.layout.size
            count = SAMPLES if size <= MOST_DIRECT else SAMPLES // 2
            for point in study.inputs.points(np.random.default_rng(0).uniform(size=(count + 1, 2))):
                begin = time.process_time()
                solution = model.solve(point, guess(point))
                middle = time.process_time()
                error = solution.mesh_error()
                rows.append([middle - begin, time.process_time() - middle])
            way, seconds = model.enriched.way, np.median(rows[1:], axis=0)  # the first compiles
            near = "–"
            if size <= MOST_DIRECT:
                model.enriched.way = type(way).FACTOR
                direct = model.solve(point, guess(point)).mesh_error()
                near = f"{error.outputs[0] / direct.outputs[0]:.3f}"
            print(
                f"| {'×'.join(map(str, cells))} {cell}s | {form} | {size:,} | {seconds[0]:.3f} "
                f"| {seconds[1]:.3f} | {seconds[1] / seconds[0]:.1f} | {near} | {way} |",
                flush=True,
            )
