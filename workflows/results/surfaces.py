"""Surfaces where a function is zero, cells cut into tetrahedra, and rigid tools as surfaces, at their depth."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator
from itertools import product
from math import comb
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.bodies.mesh import TETRAHEDRA
from forward.model import FloatArray
from workflows.results.vtu import Grid

if TYPE_CHECKING:
    import xarray as xr

    from forward.terms.indenter import Indenter

IntArray = NDArray[np.int64]
TRIANGLE = 5  # of VTK
POINTS = 40  # of the lattice on which distances are computed, along each axis
SHOWN = 0.35  # part of the body's extent that a tool without end is drawn over, to each side


def tools_of(dataset: xr.Dataset) -> Iterator[Indenter]:
    """Return the tools of a study, along a path at the last step."""
    model = tomllib.loads(dataset.attrs.get("config", "")).get("model", {})
    loads = [load for load in model.get("loads", ()) if load.get("kind") == "indenter"]
    if not loads:
        return
    from forward.terms.indenter import Indenter

    means: dict[str, float] = {}
    if "parameter_mean" in dataset:
        names = [str(name) for name in dataset["parameter"].values]
        means = dict(zip(names, map(float, dataset["parameter_mean"].values), strict=True))
    means |= {path: values[-1] for path, values in model.get("steps", {}).items()}
    for load in loads:
        block = load | {"depth": np.ravel(load["depth"])[-1].item()}
        label = Indenter.model_construct(**block).label
        own = {path.rpartition(".")[2]: v for path, v in means.items() if path.rpartition(".")[0] == f"loads.{label}"}
        block["at"] = [own.pop(axis, value) for axis, value in zip("xyz", block["at"], strict=True)]
        yield Indenter.model_validate(block | own)


def surface(tool: Indenter, points: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return points (n, 3) and triangles (t, 3) of the surface of a tool at its depth: where the distance is zero.

    Tools without end are drawn as far as the body reaches, which has these points (n, 3) (m).
    """
    low, high = points.min(axis=0), points.max(axis=0)
    extent, d = float((high - low).max()), np.array(tool.along)
    tip, middle = np.array(tool.at) + tool.depth * d, (low + high) / 2
    if tool.shape == "plane":
        centre = tip + (np.eye(3) - np.outer(d, d)) @ (middle - tip)
        one = np.cross(d, np.eye(3)[int(np.abs(d).argmin())])
        one *= 0.55 * extent / np.linalg.norm(one)
        other = np.cross(d, one) / np.linalg.norm(d)
        corners = centre + np.array([one + other, other - one, -one - other, one - other])
        return corners, np.array([[0, 1, 2], [0, 2, 3]])
    half = min(1.2 * (tool.radius or np.inf), SHOWN * extent)
    lengths = np.full(3, half)
    if tool.axis is not None:  # it is longer than the body
        along = np.abs(tool.axis) / np.linalg.norm(tool.axis)
        lengths = np.maximum(lengths, along * (extent / 2 + 0.2 * half))
        tip = tip + np.outer(tool.axis, tool.axis) @ (middle - tip) / np.dot(tool.axis, tool.axis)
    centre = tip - (half - 0.05 * half) * d
    return level(tool.gaps, centre - lengths, centre + lengths, POINTS)


def tool_grid(tool: Indenter, points: FloatArray) -> Grid:
    """Return the surface of a tool, in triangles."""
    places, triangles = surface(tool, points)
    return Grid(places, triangles, TRIANGLE)


HEXAHEDRA = (12, 29, 72)  # kinds of cells of VTK
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])  # of VTK


def lattice(places: FloatArray, *, hexahedral: bool) -> IntArray:
    """Return where (k, 3) nodes at places (k, 3) of a cell are in the reference cell, in steps from 0 to its degree.

    Cells of a body have straight sides, and nodes at equal distances; their corners come first, in VTK's order.
    """
    degree = 1
    while ((degree + 1) ** 3 if hexahedral else comb(degree + 3, 3)) < len(places):
        degree += 1
    steps = np.array([at for at in product(range(degree + 1), repeat=3) if hexahedral or sum(at) <= degree])
    if hexahedral:
        shares = np.prod(np.where(CORNERS, steps[:, None] / degree, 1 - steps[:, None] / degree), axis=2)
    else:
        shares = np.column_stack([1 - steps.sum(axis=1) / degree, steps / degree])
    images = shares @ places[: shares.shape[1]]
    nearest = np.linalg.norm(places[:, None] - images, axis=2).argmin(axis=1)
    assert len(set(nearest.tolist())) == len(places), "the nodes of a cell are not where they are expected"
    return np.asarray(steps[nearest])


def tetrahedra(cells: IntArray, kind: int) -> IntArray:
    """Return tetrahedra (t, 4) between the corners of cells."""
    return cells[:, TETRAHEDRA["hexahedron"]].reshape(-1, 4) if kind in HEXAHEDRA else cells[:, :4]


def level(
    distance: Callable[[FloatArray], FloatArray], low: FloatArray, high: FloatArray, count: int = 28
) -> tuple[FloatArray, IntArray]:
    """Return the points (n, 3) and triangles (t, 3) where a function of places (n, 3) is zero, within a box.

    By marching tetrahedra on a lattice of `count` points along each axis; inside, the function is negative.
    """
    axes = [np.linspace(low[i], high[i], count) for i in range(3)]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    values = np.asarray(distance(lattice), dtype=float)
    values = np.where(values == 0, 1e-300, values)
    numbers = np.arange(count**3).reshape(count, count, count)
    starts = numbers[:-1, :-1, :-1].ravel()
    corner_steps = np.array([numbers[tuple(corner)] for corner in CORNERS])
    cells = starts[:, None] + corner_steps
    signs = values[cells] < 0
    cells = cells[signs.any(axis=1) & ~signs.all(axis=1)]
    points, triangles = crossing(lattice, values, tetrahedra(cells, 12))
    # Outward is where the function grows.
    normal = np.cross(*(points[triangles[:, k]] - points[triangles[:, 0]] for k in (1, 2)))
    middle, step = points[triangles].mean(axis=1), 1e-3 * float(np.linalg.norm(high - low))
    length = np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    ahead, behind = (np.asarray(distance(middle + s * step * normal / length)) for s in (1, -1))
    triangles[ahead < behind] = triangles[ahead < behind][:, ::-1]
    return points, triangles


def crossing(nodes: FloatArray, values: FloatArray, four: IntArray) -> tuple[FloatArray, IntArray]:
    """Return the points (n, 3) and triangles (t, 3) where values at nodes (N, 3) are zero, linear in tetrahedra (m, 4).

    The triangles are turned either way.
    """
    inside = values[four] < 0
    counts = inside.sum(axis=1)
    pairs: list[IntArray] = []
    for how_many in (1, 3):
        chosen = counts == how_many
        odd = np.argsort(inside[chosen] != (how_many == 1), axis=1, kind="stable")  # the one that differs comes first
        t = np.take_along_axis(four[chosen], odd, axis=1)
        pairs.append(np.stack([t[:, [0, 1]], t[:, [0, 2]], t[:, [0, 3]]], axis=1))
    chosen = counts == 2
    t = np.take_along_axis(four[chosen], np.argsort(~inside[chosen], axis=1, kind="stable"), axis=1)
    pairs.append(np.stack([t[:, [0, 2]], t[:, [0, 3]], t[:, [1, 3]]], axis=1))
    pairs.append(np.stack([t[:, [0, 2]], t[:, [1, 3]], t[:, [1, 2]]], axis=1))
    ends = np.sort(np.concatenate(pairs).reshape(-1, 2), axis=1)
    unique, inverse = np.unique(ends, axis=0, return_inverse=True)
    v = values[unique]
    share = v[:, 0] / (v[:, 0] - v[:, 1])
    points = nodes[unique[:, 0]] + share[:, None] * (nodes[unique[:, 1]] - nodes[unique[:, 0]])
    return points, inverse.reshape(-1, 3)
