"""Tetrahedra of a body as arrays, and meshes that are made from arrays: kept in memory, or in a file of ours (.npz)."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from itertools import permutations
from pathlib import Path
from typing import Self

import numpy as np
from pydantic import PrivateAttr

from forward.bodies.geometry import AXES, Body
from forward.bodies.mesh import Contents, Loaded
from forward.bodies.mesh_file import MeshFile
from forward.bodies.mesh_reading import BOUNDARY
from forward.model import FloatArray, ModelError

INDICATORS = "indicators"  # name of the array


def tetrahedra(body: Body) -> tuple[Loaded, Callable[[FloatArray], FloatArray]]:
    """Return the mesh of a body, and the map of its points (n, 3) into the body.

    Boxes and blocks have six tetrahedra around a diagonal of each cell, as DOLFINx makes them, in the box with equal
    cells, which `place` maps into the body. So what is put between vertices later follows faces that are not plane.
    """
    if isinstance(body, MeshFile):
        return body.load(), lambda points: points
    lattice = np.stack(np.meshgrid(*(np.arange(n + 1) for n in body.cells), indexing="ij"), axis=-1).reshape(-1, 3)
    stride = np.array([(body.cells[1] + 1) * (body.cells[2] + 1), body.cells[2] + 1, 1])
    first = (lattice[(lattice < body.cells).all(axis=1)] @ stride)[:, None]
    ways = [np.cumsum([0, *(stride[axis] for axis in way)]) for way in permutations(range(3))]
    cells = np.concatenate([first + way for way in ways])
    faces = np.concatenate([np.delete(cells, k, axis=1) for k in range(4)])
    boundaries = {
        f"{name}-{end}": faces[(lattice[faces][:, :, axis] == at).all(axis=1)]
        for axis, name in enumerate(AXES)
        for end, at in (("min", 0), ("max", body.cells[axis]))
    }
    points = lattice / np.array(body.cells) * np.array(body.meshed)
    return Loaded(points, cells, "tetrahedron", boundaries, ("body",), np.zeros(len(cells), dtype=np.int64)), body.place


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
        message = "a mesh in memory is not divided"
        raise ModelError(message)

    def load(self) -> Loaded:
        """Return the mesh; on the first rank."""
        assert self._mesh is not None
        return self._mesh


def packed(mesh: Loaded, indicators: FloatArray | None = None) -> bytes:
    """Return a mesh as a file (.npz) that a `MeshFile` can name; equal meshes give equal bytes.

    Parameters
    ----------
    mesh
        The mesh.
    indicators
        How much each cell (c,) adds to errors.
    """
    facets = {f"{BOUNDARY}{name}": facets for name, facets in mesh.boundaries.items()}
    shares = {} if indicators is None else {INDICATORS: indicators}
    arrays = {"points": mesh.points, "cells": mesh.cells, "regions": np.array(mesh.regions), "region": mesh.region}
    file = BytesIO()
    np.savez_compressed(file, **arrays, **facets, **shares)
    return file.getvalue()


def indicators_of(path: Path) -> FloatArray:
    """Return how much each cell of a mesh in a file adds to errors."""
    with np.load(path) as arrays:
        return np.asarray(arrays[INDICATORS], dtype=float)
