"""Random indentations on coarse meshes: each is verified by independent checks, or refused with a reason.

Checks use the state and NumPy where they can: forces of the tool against reactions, gaps of the deformed boundary,
p ≥ 0 and p g ≈ 0 at quadrature points, negative eigenvalues of the dense stiffness, and for some the same depth by
another way. Finished ones are kept in a file, so that the same command goes on where it was stopped.
"""

from __future__ import annotations

import json
import re
import sys
import time
from collections import Counter
from itertools import product
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI

from forward.bodies.mesh import CORNERS, FACES, TETRAHEDRA
from forward.fem.invariants import OPS
from forward.hyperelastic import Hyperelastic
from forward.model import Guess, SolveError
from forward.terms import tools

SIDE = 20e-3
TOOLS: dict[str, dict[str, Any]] = {
    "sphere": {"radius": 5e-3},
    "flat": {"radius": 4e-3},
    "cone": {"angle": 60.0},
    "cylinder": {"radius": 5e-3, "axis": [1.0, 0.5, 0.0]},
    "plane": {},
}
MATERIALS: dict[str, dict[str, Any]] = {
    "neo-hookean": {"C1": 1e3, "D1": 2e3},
    "mooney-rivlin": {"C1": 6e2, "C2": 4e2, "D1": 4e3},
    "demiray": {"a": 2e3, "b": 2.0, "D1": 4e3},
}
KINDS = [  # shape, cell, material, formulation
    ("sphere", "hexahedron", "neo-hookean", "displacement"),
    ("flat", "hexahedron", "mooney-rivlin", "displacement"),
    ("cone", "hexahedron", "neo-hookean", "displacement"),
    ("cylinder", "tetrahedron", "demiray", "displacement"),
    ("sphere", "tetrahedron", "mooney-rivlin", "mixed"),
    ("plane", "hexahedron", "neo-hookean", "mixed"),
    ("flat", "tetrahedron", "neo-hookean", "displacement"),
    ("cone", "tetrahedron", "mooney-rivlin", "mixed"),
]
OWN = [  # of a mesh from a file
    ("sphere", "mesh", "neo-hookean", "displacement"),
    ("cylinder", "mesh", "mooney-rivlin", "mixed"),
]
EVERY = [*KINDS, *OWN]
FIRST_OWN = 10**6  # of these
CELLS, SHAKEN = 3, 0.2  # of the block, and how far vertices inside lie from those of a grid, over an edge
BALANCED = 1e-5  # relative difference of forces and reactions that counts as none
OTHER_WAY, ALIKE = 5, 0.01  # every so many are solved by another way, whose force may differ by so much
REFUSED, VERIFIED = "refused", "verified"


def box(cell: str) -> dict[str, Any]:
    """Return the block as tissuq makes it."""
    return {"kind": "box", "size": [SIDE] * 3, "cells": [CELLS] * 3, "degree": 2, "cell": cell}


def own_mesh() -> dict[str, Any]:
    """Return the block as a mesh of irregular tetrahedra in a file of VTK's."""
    import meshio

    grid = np.stack(np.meshgrid(*[np.arange(CELLS + 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = ((grid > 0) & (grid < CELLS)).all(axis=1)
    points = grid + SHAKEN * np.random.default_rng(0).uniform(-1, 1, grid.shape) * inside[:, None]
    corner = {tuple(place): k for k, place in enumerate(grid.astype(int).tolist())}
    cubes = [[corner[tuple(i)] for i in (np.array(at) + CORNERS).tolist()] for at in product(range(CELLS), repeat=3)]
    cells = np.array(cubes)[:, TETRAHEDRA["hexahedron"]].reshape(-1, 4)
    faces = cells[:, FACES["tetrahedron"]].reshape(-1, 3)
    sides = [faces[(grid[faces][:, :, 2] == z).all(axis=1)] for z in (0, CELLS)]
    numbers = [np.full(len(cells), 9), np.repeat([1, 2], [len(side) for side in sides])]
    triangles = ("triangle", np.concatenate(sides))
    path = Path(mkdtemp()) / "block.vtu"
    mesh = meshio.Mesh(points, [("tetra", cells), triangles], cell_data={"part": numbers})
    mesh.write(path)
    names = {"z-min": 1, "z-max": 2}
    return {"kind": "mesh", "file": str(path), "unit": SIDE / CELLS, "names": names, "degree": 2}


def specification(shape: str, cell: str, material: str, formulation: str) -> Hyperelastic:
    """A block bonded below, with a tool above its middle."""
    load = {"kind": "indenter", "shape": shape, "on": "z-max", "at": [SIDE / 2, SIDE / 2, SIDE], "depth": 2e-3}
    outputs: list[dict[str, Any]] = [{"name": f"force-{a}", "kind": "force", "component": a} for a in "xyz"]
    outputs += [{"name": f"below-{a}", "kind": "reaction", "on": "z-min", "component": a} for a in "xyz"]
    return Hyperelastic.model_validate(
        {
            "body": own_mesh() if cell == "mesh" else box(cell),
            "material": {"kind": material, **MATERIALS[material]},
            "formulation": formulation,
            "clamp": ["z-min"],
            "loads": [load | TOOLS[shape] | {"direction": [0.0, 0.0, -1.0]}],
            "outputs": outputs,
        }
    )


def contact_values(equations: Any, label: str) -> Any:
    """Return what finds pressures (Pa) and gaps (m), (n, 2), at the quadrature points under a tool."""
    load, at = equations.tool(label)
    touch = load.touch(at, at.X + at.u)
    return equations.on_facets(ufl.as_vector([tools.pressure(OPS, *touch), touch.gap]), load.on, load.degree)


class Kind:
    """A model whose numbers are drawn: place, depth and size of the tool, and the constants of the material."""

    def __init__(self, which: int) -> None:
        self.shape, self.cell, self.material, self.form = EVERY[which]
        spec = specification(*EVERY[which])
        self.tool: Any = spec.loads[0]
        sizes = [name for name in TOOLS[self.shape] if name != "axis"]
        self.names = [f"loads.indenter.{name}" for name in ("x", "y", "depth", *sizes)]
        self.names += [f"material.{name}" for name in MATERIALS[self.material]]
        self.nominal = np.array([spec.scalars[name].value for name in self.names])
        self.model = spec.build(MPI.COMM_SELF, tuple(self.names))
        self.pressure = contact_values(self.model.equations, "indenter")

    def draw(self, rng: np.random.Generator) -> Any:
        """Draw a point (d,)."""
        point = self.nominal * rng.uniform(0.6, 1.4, len(self.nominal))
        point[:2] = rng.uniform(0.1 * SIDE, 0.9 * SIDE, 2)
        point[2] = rng.uniform(0.1e-3, 5e-3)
        return point

    def judged(self, point: Any, *, another_way: bool) -> dict[str, Any]:
        """Solve at a point; say whether the answer is verified, or why there is none."""
        begun = time.process_time()
        try:
            found = self.model.solve(point)
        except SolveError as error:
            return {"verdict": REFUSED, "why": error.reason, "seconds": time.process_time() - begun}
        record: dict[str, Any] = {"seconds": time.process_time() - begun, "factors": found.work.factorisations}
        record |= {"stiffer": found.stiffer, "force": found.outputs[2]}
        wrong = list(self._wrong(found, record))
        if another_way:
            wrong += self._otherwise(point, found, record)
        return record | {"verdict": "; ".join(wrong) if wrong else VERIFIED}

    def _wrong(self, found: Any, record: dict[str, Any]) -> Any:
        equations = found.visit()
        numbers = {name.rpartition(".")[2]: value for name, value in zip(self.names, found.parameters, strict=True)}
        own = {name: value for name, value in numbers.items() if name in self.tool.scalars}
        pushed, held = found.outputs[:3], found.outputs[3:]
        record["apart"] = float(np.linalg.norm(pushed + held * [1, 1, 1]) / max(np.linalg.norm(pushed), 1e-30))
        if not record["apart"] < BALANCED:
            yield f"forces and reactions are apart by {record['apart']:.1e}"
        p, gap = self.pressure().T
        depth = own["depth"]
        record["entered"] = float(-gap.min() / depth)
        record["product"] = float(np.abs(p * gap).max() / max(p.max() * depth, 1e-30))
        if not (p >= 0).all() or record["entered"] > 1e-3 or record["product"] > 1e-3:
            yield f"complementarity is missed: penetration {record['entered']:.1e}, p g {record['product']:.1e}"
        if not p.any():
            yield "nothing touches"
        nodes = self.model.space.coordinates
        moved = nodes + self.model.space.gather(found.state[None])[0, : nodes.size].reshape(-1, 3)
        on_top = np.abs(nodes[:, 2] - SIDE) < 1e-9
        record["between"] = float(max(0.0, -self.tool.gaps(moved[on_top], **own).min() / depth))
        equations.set_state(found.state)
        dense = equations.sparse_stiffness().toarray()
        scale = 1 / np.sqrt(np.abs(dense.diagonal()))  # forces and volumes differ by many orders of magnitude
        dense = scale[:, None] * dense * scale
        negative = int((np.linalg.eigvalsh(dense) < 0).sum()) - equations.unknowns.pressures
        if negative:
            yield f"the stiffness has {negative} negative eigenvalues"

    def _otherwise(self, point: Any, found: Any, record: dict[str, Any]) -> list[str]:
        """Reach the same depth by another way, from half of it."""
        half = point.copy()
        half[2] /= 2
        try:
            other = self.model.solve(point, Guess(self.model.solve(half).state))
        except SolveError:
            return []
        record["otherwise"] = float(abs(other.outputs[2] / found.outputs[2] - 1))
        if record["otherwise"] > ALIKE:
            return [f"another way leads to a force that differs by {record['otherwise']:.1%}"]
        return []


def random(count: int, kept: Path, own: int = 0, seed: int = 1) -> None:
    """Judge random indentations that are not kept yet, `own` more on a mesh from a file; print what became of all."""
    lines = kept.read_text().splitlines() if kept.exists() else []
    records = {one["number"]: one for one in map(json.loads, lines)}
    asked = [range(which, count, len(KINDS)) for which in range(len(KINDS))]
    asked += [range(FIRST_OWN + which, FIRST_OWN + own, len(OWN)) for which in range(len(OWN))]
    for which, numbers in enumerate(asked):
        mine = [i for i in numbers if i not in records]
        if not mine:
            continue
        kind = Kind(which)
        for i in mine:
            point = kind.draw(np.random.default_rng([seed, i]))
            one = {"number": i, "kind": which} | kind.judged(point, another_way=i // len(KINDS) % OTHER_WAY == 0)
            records[i] = one
            with kept.open("a") as file:
                file.write(json.dumps(one) + "\n")
    _print([records[i] for numbers in asked for i in numbers])


def _print(records: list[dict[str, Any]]) -> None:
    sys.stdout.write(
        "Random indentations (1,029 displacements): answers, verified; CPU time (s); factors; largest difference of"
        " forces and reactions,\npenetration over depth, p g over largest p times depth, penetration at nodes; with"
        " stiffer tools; by another way alike\n"
    )
    for which, kind in enumerate(EVERY):
        mine = [one for one in records if one["kind"] == which]
        answers = [one for one in mine if one["verdict"] != REFUSED]
        if not answers:
            continue
        largest = {name: max(one[name] for one in answers) for name in ("apart", "entered", "product", "between")}
        ways = [one["otherwise"] for one in answers if "otherwise" in one]
        sys.stdout.write(
            f"{', '.join(kind):48s} {len(mine)}: {len(answers)}, {sum(one['verdict'] == VERIFIED for one in answers)}; "
            f"{np.median([one['seconds'] for one in mine]):.2f}; {np.median([one['factors'] for one in answers]):.0f}; "
            f"{largest['apart']:.0e}, {largest['entered']:.1e}, {largest['product']:.1e}, {largest['between']:.1e}; "
            f"{sum(one['stiffer'] > 1 for one in answers)}; {sum(w < ALIKE for w in ways)} of {len(ways)}"
            f"{' (check warns of its edge)' if specification(*kind).findings else ''}\n"
        )
    for said, times in Counter(_short(one) for one in records if one["verdict"] != VERIFIED).most_common():
        sys.stdout.write(f"{times:5d} {said}\n")


def _short(record: dict[str, Any]) -> str:
    words = f"refused: {record['why']}" if record["verdict"] == REFUSED else f"not verified: {record['verdict']}"
    return re.sub(r"-?\d[\d.e+-]*", "N", words)
