"""The space in which the states of a finite-element body live, with the factors of its random fields."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from forward.bodies.geometry import tolerance
from forward.bodies.mesh_file import MeshFile
from forward.fem.dolfinx import meshes, spaces
from forward.fem.equations import Discretisation
from forward.model import FloatArray


class BodySpace:
    """The `NodalSpace` of a body."""

    def __init__(self, body: Discretisation) -> None:
        self._body = body
        self._layout = body.layout
        self.coordinates = body.layout.coordinates
        self.displacements = body.layout.coordinates.size
        self.cells, self.gather, self.scatter = body.layout.cells, body.layout.gather, body.layout.scatter

    def regions(self) -> NDArray[np.int64] | None:
        """Return the number of the region of each cell, in the order of `cells`; None without regions; collective."""
        body = self._body
        if not isinstance(body.spec.body, MeshFile):
            return None
        return self._layout.by_cell(meshes.region_numbers(body.comm, body.spec.body, body.mesh))

    def interpolation(self, points: FloatArray) -> tuple[list[tuple[NDArray[np.int64], FloatArray]], FloatArray]:
        """Return nodes and weights that interpolate at each of points (n, 3), and how far (n,) these lie outside.

        Collective; on every rank.

        Raises
        ------
        ValueError
            If a point is farther (m) from the mesh than the mesh can be from the body.
        """
        body, spec = self._body, self._body.spec.body
        if not len(points):
            return [], np.zeros(0)
        found, distances = spaces.point_weights(body.space, points)
        far = np.flatnonzero(distances > max(tolerance(spec), spec.longest_edge))
        if len(far):
            where = ", ".join(f"{x:g}" for x in points[far[0]])
            message = f"({where}) lies {distances[far[0]]:.3g} m outside the mesh"
            raise ValueError(message)
        numbers = self._layout.nodes()
        mine = {i: (numbers[here[0]], here[1]) for i, here in enumerate(found) if here is not None}
        held: dict[int, tuple[NDArray[np.int64], FloatArray]] = {}
        for part in body.comm.allgather(mine):
            held |= part
        return [held[i] for i in range(len(points))], distances

    def factors(self, points: FloatArray, degree: int | None = None) -> dict[str, FloatArray]:
        """Return the factors (n, N) of each random field at parameters (n, d), by its name.

        Collective; empty but on the first rank. The nodes are those of displacements, or of another degree: 1 is for
        the vertices.
        """
        body = self._body
        body.latest.forget_parameters()
        space = spaces.scalar_space(body.mesh, degree or body.spec.body.degree)
        found = {field.field.label: field.factors(points, space) for field in body.fields}
        return {label: factors for label, factors in found.items() if factors is not None}

    @property
    def variance_kept(self) -> dict[str, float]:
        """Fraction of the variance of each random field that its modes make."""
        return {field.field.label: field.kept for field in self._body.fields}
