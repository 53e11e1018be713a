"""Bodies on coarse meshes with meshes of their reference, and what their outputs are without an error of the mesh.

References are cubic elements on three finer meshes each, boxes with thin cells at their faces, extrapolated with the
order that the three show. Curved bodies are the same polyhedra on all meshes: what a coarse mesh cuts off is no error
here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI

from benchmarks.beams import beam
from forward.hyperelastic import Hyperelastic
from forward.model import FloatArray
from workflows.config.study import load

CONFIGS = Path(__file__).parent.parent / "configs"
SOLVER = {"tolerance": 1e-10}
SIDES = ("x-min", "x-max", "y-min", "y-max", "z-min", "z-max")
GRADING = 8.0
ORDERS = np.geomspace(0.8, 8.0, 400)  # below, of point values at the edges of these polyhedra, there is none
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


def twisted() -> Case:
    """A square bar that is twisted by two forces at its end: errors cancel in what it has of second order."""
    forces = tuple(
        {
            "name": name, "kind": "spot", "on": "z-max", "direction": (side, 0.0, 0.0), "size": 20.0,
            "x": 0.1, "y": 0.1 + 0.07 * side, "z": 0.6, "width": 0.06,
        }
        for name, side in (("left", 1.0), ("right", -1.0))
    )  # fmt: skip
    blocks = {
        "body": {"size": (0.2, 0.2, 0.6), "cells": (2, 2, 5)},
        "material": SOFT,
        "clamp": ("z-min",),
        "loads": forces,
        "outputs": (
            at("corner", (0.2, 0.2, 0.6), "x"),
            {"name": "shortening", "kind": "mean-displacement", "on": "z-max", "component": "z"},
            {"name": "drift", "kind": "mean-displacement", "on": "x-max", "component": "x"},
            VOLUME,
            ENERGY,
        ),
    }
    return boxed("twisted bar", blocks, (1.0, 1.5, 2.0))


def plate() -> Case:
    """A thin plate, clamped at one edge."""
    blocks = {
        "body": {"size": (1.0, 0.5, 0.02), "cells": (10, 5, 1)},
        "material": {"kind": "neo-hookean", "C1": 1e6, "D1": 2e6},
        "clamp": ("x-min",),
        "loads": ({"kind": "traction", "on": "z-max", "direction": (0.0, 0.0, 1.0), "size": 4.0},),
        "outputs": (
            at("tip", (1.0, 0.25, 0.0), "z"),
            {"name": "shortening", "kind": "mean-displacement", "on": "x-max", "component": "x"},
            ENERGY,
        ),
    }
    return boxed("thin plate", blocks, (1.0, 1.5, 2.0), towards=("x-min",))


def blown() -> Case:
    """A nearly incompressible block under a pressure that follows it, in the mixed form."""
    blocks = {
        "body": {"size": (1.0, 1.0, 0.3), "cells": (4, 4, 2)},
        "formulation": "mixed",
        "material": {"kind": "neo-hookean", "C1": 1e4, "D1": 5e6},
        "clamp": ("x-min", "x-max"),
        "loads": ({"kind": "pressure", "on": "z-min", "size": 1.5e3},),
        "outputs": (
            at("middle", (0.5, 0.5, 0.3), "z"),
            {"name": "force", "kind": "reaction", "on": "x-min", "component": "x"},
            ENERGY,
        ),
    }
    return boxed("mixed block under pressure", blocks, (1.0, 1.5, 2.0))


def pressed_beam() -> Case:
    """A beam under a pressure that follows it."""
    blocks = {
        "body": {"size": (1.0, 0.1, 0.1), "cells": (8, 1, 1)},
        "material": {"kind": "neo-hookean", "C1": 1e5, "D1": 2e5},
        "clamp": ("x-min",),
        "loads": ({"kind": "pressure", "on": "z-min", "size": 150.0},),
        "outputs": (at("tip", (1.0, 0.05, 0.05), "z"), at("back", (1.0, 0.05, 0.05), "x"), ENERGY),
    }
    return boxed("beam under pressure", blocks, (1.0, 1.5, 2.0), towards=("x-min",))


def locking() -> Case:
    """The published beam in linear elements."""
    spec = beam((14, 2, 4)).model
    outputs = (
        {"name": "uy", "kind": "max-displacement", "component": "y"},
        at("back", (0.28, 0.01, 0.04), "x"),
        ENERGY,
    )
    body = spec.body.model_dump() | {"degree": 1}
    blocks = spec.model_dump() | {"outputs": outputs, "body": body, "formulation": "displacement"}
    return boxed("beam of linear elements", blocks, (1.0, 1.5, 2.0), towards=("x-min",))


def far_bent() -> Case:
    """A slender beam that hangs down."""
    blocks = {
        "body": {"size": (0.4, 0.02, 0.02), "cells": (10, 1, 1)},
        "material": {"kind": "neo-hookean", "C1": 1e4, "D1": 4e4},
        "clamp": ("x-min",),
        "loads": ({"kind": "gravity", "direction": (0.0, -1.0, 0.0), "density": 100.0},),
        "outputs": (at("tip", (0.4, 0.01, 0.01), "y"), at("back", (0.4, 0.01, 0.01), "x"), ENERGY),
    }
    return boxed("far bent beam", blocks, (1.0, 1.5, 2.0), towards=("x-min",))


def tetrahedra() -> Case:
    """A block between plates, sheared and stretched, of tetrahedra in the mixed form."""
    blocks = {
        "body": {"size": (1.0, 0.6, 0.4), "cells": (5, 3, 2), "cell": "tetrahedron"},
        "material": {"kind": "neo-hookean", "C1": 1e4, "D1": 5e4},
        "clamp": ("z-min",),
        "displacements": ({"on": "z-max", "x": 0.15, "y": 0.0, "z": 0.02},),
        "outputs": (
            {"name": "along", "kind": "reaction", "on": "z-max", "component": "x"},
            {"name": "across", "kind": "reaction", "on": "z-max", "component": "z"},
            at("side", (1.0, 0.3, 0.2), "x"),
            VOLUME,
            ENERGY,
        ),
    }
    return boxed("sheared tetrahedra", blocks, (1.0, 1.5, 2.0))


def linear_corner(folder: str) -> Case:
    """The L in linear elements."""
    case = corner(folder)
    body = case.coarse.body.model_copy(update={"degree": 1})
    return case._replace(name="re-entrant corner, linear", coarse=case.coarse.model_copy(update={"body": body}))


def cases(folder: str) -> Iterator[Callable[[], Case]]:
    """All problems."""
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
    yield from (twisted, plate, blown, pressed_beam, locking, far_bent, tetrahedra)
    yield lambda: linear_corner(folder)


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
