"""Meshes that are made here from arrays: of a body, within it, kept in memory, or in a file of ours (.npz)."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from io import BytesIO
from itertools import permutations
from pathlib import Path
from typing import Self

import numpy as np
from pydantic import PrivateAttr

from forward.bodies.bisection import Bisected
from forward.bodies.geometry import AXES, Block, Body, Box
from forward.bodies.mesh import CORNERS, Contents, IntArray, Loaded, contents, faces_of
from forward.bodies.mesh_file import MOST_NODES, MeshFile
from forward.bodies.mesh_reading import BOUNDARY, LIFT
from forward.model import FloatArray, ModelError

INDICATORS = "indicators"  # name of the array
RATIO = 0.35  # size of a layer of hexahedra at a rim over that of the next one
THINNEST = 1 / 32  # of an edge of the body
HALVED = 3  # bisections that halve all edges of a tetrahedron


def tetrahedra(body: Body) -> tuple[Loaded, Callable[[FloatArray], FloatArray]]:
    """Return the mesh of a body, and the map of its points (n, 3) into the body.

    Boxes and blocks have six tetrahedra around a diagonal of each cell, as DOLFINx makes them, in the box with equal
    cells, which `place` maps into the body. So what is put between vertices later follows faces that are not plane.
    """
    if body.kind == "mesh":
        return body.load(), lambda points: points
    lattice, stride, first = _lattice(np.array(body.cells) + 1)
    ways = [np.cumsum([0, *(stride[axis] for axis in way)]) for way in permutations(range(3))]
    cells = np.concatenate([first + way for way in ways])
    boundaries = _ends(lattice, np.concatenate([np.delete(cells, k, axis=1) for k in range(4)]))
    points = lattice / np.array(body.cells) * np.array(body.meshed)
    return Loaded(points, cells, "tetrahedron", boundaries, ("body",), np.zeros(len(cells), dtype=np.int64)), body.place


def _lattice(counts: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Return a lattice (n, 3) of so many points along each axis, the steps between their numbers, and first corners."""
    lattice = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    stride = np.array([counts[1] * counts[2], counts[2], 1])
    return lattice, stride, (lattice[(lattice < counts - 1).all(axis=1)] @ stride)[:, None]


def _ends(lattice: IntArray, faces: IntArray) -> dict[str, IntArray]:
    """Return which faces (k, 3 or 4) of cells on a lattice lie at its ends, by the names of the boundaries there."""
    return {
        f"{name}-{end}": faces[(lattice[faces][..., axis] == at).all(axis=1)]
        for axis, name in enumerate(AXES)
        for end, at in (("min", 0), ("max", lattice[-1, axis]))
    }


class MeshInMemory(MeshFile):
    """A body whose mesh was made here: the first of the ranks that share it holds the arrays."""

    file: str = ""
    _mesh: Loaded | None = PrivateAttr(default=None)

    @classmethod
    def of(cls, mesh: Loaded | None, found: Contents, like: Body) -> Self:
        """Make a body of a mesh, with the elements of another body; `found` says on all ranks what the mesh holds."""
        body = cls(contents=found, degree=like.degree, quadrature_degree=like.quadrature_degree)
        body._mesh = mesh
        return body

    def refined(self, level: int) -> Self:
        """Refuse: there is no file to begin with.

        Raises
        ------
        ModelError
            Always.
        """
        raise ModelError("a mesh in memory is not divided")

    def load(self) -> Loaded:
        """Return the mesh; on the first rank."""
        assert self._mesh is not None
        return self._mesh


def packed(mesh: Loaded, indicators: FloatArray | None = None) -> bytes:
    """Return a mesh as a file (.npz) that a `MeshFile` can name; equal meshes give equal bytes.

    It holds how much each cell (c,) adds to errors too, and what facets hide, where that is known.
    """
    facets = {f"{BOUNDARY}{name}": facets for name, facets in mesh.boundaries.items()}
    shares = {} if indicators is None else {INDICATORS: indicators}
    shares |= {} if mesh.lift is None else {LIFT: mesh.lift}
    arrays = {"points": mesh.points, "cells": mesh.cells, "regions": np.array(mesh.regions), "region": mesh.region}
    file = BytesIO()
    np.savez_compressed(file, **arrays, **facets, **shares)
    return file.getvalue()


def indicators_of(path: Path) -> FloatArray:
    """Return how much each cell of a mesh in a file adds to errors."""
    with np.load(path) as arrays:
        return np.asarray(arrays[INDICATORS], dtype=float)


def within(body: Box | Block, parts: int, towards: Collection[str], layers: Sequence[int]) -> MeshInMemory:
    """Return a body whose cells are divided, and thinner at the rims of some faces.

    All vertices of the body stay vertices, and every new cell lies in one of its cells. So a field that is linear
    between the vertices of the body is linear between those of the finer mesh too, and the same: the difference of what
    both predict is an error of the mesh, and of nothing else.

    Parameters
    ----------
    body
        The body.
    parts
        Into how many parts each edge is divided: of tetrahedra, a power of two.
    towards
        Names of these faces.
    layers
        For each axis: how often the first cells at such a face, and at those that meet it, are divided again; of
        tetrahedra, which are divided on all sides of a rim, the most of these.

    Raises
    ------
    ModelError
        If the mesh is too large.
    """
    nodes = math.prod(2 * (n * parts + 2 * extra) + 1 for n, extra in zip(body.cells, layers, strict=True))
    if nodes > MOST_NODES:
        message = f"a mesh with cells that are divided has up to {3 * nodes:,} unknowns, expected {3 * MOST_NODES:,}"
        raise ModelError(message)
    mesh = (_tetrahedra if body.cell == "tetrahedron" else _hexahedra)(body, parts, towards, layers)
    return MeshInMemory.of(mesh, contents(mesh, ""), body)


def layers_of(body: Box | Block, parts: int) -> tuple[int, int, int]:
    """Return how many layers make the first of cells that are divided into parts a `THINNEST` part of each edge."""
    a, b, c = (max(0, math.ceil(math.log(THINNEST * n * parts) / math.log(RATIO))) for n in body.cells)
    return a, b, c


def _hexahedra(body: Box | Block, parts: int, towards: Collection[str], layers: Sequence[int]) -> Loaded:
    """Divide along planes of the unit cube that is mapped into the body; cells are thinner on both sides of a rim."""
    thin = {face for face in body.boundaries if face in towards or any(face[0] != other[0] for other in towards)}
    lines = []
    for axis, n, extra in zip(AXES, body.cells, layers, strict=True):
        first = RATIO ** np.arange(1, extra + 1) / parts  # of the length of a cell
        ends = [first * (f"{axis}-min" in thin), n - first * (f"{axis}-max" in thin)]
        lines.append(np.unique(np.concatenate([np.arange(n * parts + 1) / parts, *ends])) / n)
    lattice, stride, origins = _lattice(np.array([len(line) for line in lines]))
    cells = origins + CORNERS @ stride
    boundaries = _ends(lattice, faces_of(cells, "hexahedron"))
    shares = np.column_stack([line[lattice[:, axis]] for axis, line in enumerate(lines)])
    points = body.place(shares * np.array(body.meshed))
    return Loaded(points, cells, "hexahedron", boundaries, ("body",), np.zeros(len(cells), dtype=np.int64))


def _tetrahedra(body: Box | Block, parts: int, towards: Collection[str], layers: Sequence[int]) -> Loaded:
    """Bisect all tetrahedra, and then again and again those at a rim."""
    first, place = tetrahedra(body)
    mesh = Bisected.of(replace(first, points=place(first.points)))
    for _ in range(round(np.log2(parts))):
        mesh = mesh.refined(np.arange(len(mesh.cells)), HALVED)
    for _ in range(max(layers)):
        found = mesh.loaded()
        at_rim = np.isin(found.cells, _rims(found, towards)).any(axis=1)
        mesh = mesh.refined(np.flatnonzero(at_rim), HALVED)
    return mesh.loaded()


def _rims(mesh: Loaded, towards: Collection[str]) -> IntArray:
    """Vertices that some faces share with others."""
    beside = [facets.ravel() for name, facets in mesh.boundaries.items() if name not in towards]
    of = [mesh.boundaries[name].ravel() for name in towards]
    return np.intersect1d(np.concatenate(of), np.concatenate(beside)) if of else np.zeros(0, dtype=np.int64)
