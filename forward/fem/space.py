"""The space in which the states of a finite-element body live, with the factors of its random fields."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forward.bodies.geometry import tolerance
from forward.bodies.mesh_file import MeshFile
from forward.fem.dolfinx import meshes, spaces
from forward.fem.equations import Discretisation
from forward.model import FloatArray


class BodySpace:
    """The `NodalSpace` of a body."""

    def __init__(self, equations: Discretisation) -> None:
        self._equations = equations
        self._layout = layout = equations.layout
        self.coordinates, self.displacements = layout.coordinates, layout.coordinates.size
        self.cells, self.gather, self.scatter = layout.cells, layout.gather, layout.scatter

    def regions(self) -> NDArray[np.int64] | None:
        """Return the number of the region of each cell, in the order of `cells`; None without regions; collective."""
        equations = self._equations
        if not isinstance(equations.spec.body, MeshFile):
            return None
        numbers = self._layout.by_cell(meshes.region_numbers(equations.comm, equations.spec.body, equations.mesh))
        return np.asarray(numbers, dtype=np.int64)

    def interpolation(self, points: FloatArray) -> tuple[list[tuple[NDArray[np.int64], FloatArray]], FloatArray]:
        """Return nodes and weights that interpolate at each of points (n, 3), and how far (n,) these lie outside.

        Collective; on every rank.

        Raises
        ------
        ValueError
            If a point is farther (m) from the mesh than the mesh can be from the body.
        """
        equations, spec = self._equations, self._equations.spec.body
        if not len(points):
            return [], np.zeros(0)
        found, distances = spaces.point_weights(equations.space, points)
        far = np.flatnonzero(distances > max(tolerance(spec), spec.longest_edge))
        if len(far):
            where = ", ".join(f"{x:g}" for x in points[far[0]])
            message = f"({where}) lies {distances[far[0]]:.3g} m outside the mesh"
            raise ValueError(message)
        numbers = self._layout.nodes()
        mine = {i: (numbers[here[0]], here[1]) for i, here in enumerate(found) if here is not None}
        held: dict[int, tuple[NDArray[np.int64], FloatArray]] = {}
        for part in equations.comm.allgather(mine):
            held |= part
        return [held[i] for i in range(len(points))], distances

    def factors(self, points: FloatArray, degree: int | None = None) -> dict[str, FloatArray]:
        """Return the factors (n, N) of each random field at parameters (n, d), by its name.

        Collective; empty but on the first rank. The nodes are those of displacements, or of another degree: 1 is for
        the vertices.
        """
        equations = self._equations
        equations.latest.forget_parameters()
        space = spaces.scalar_space(equations.mesh, degree or equations.spec.body.degree)
        found = {field.field.label: field.factors(points, space) for field in equations.fields}
        return {label: factors for label, factors in found.items() if factors is not None}

    @property
    def variance_kept(self) -> dict[str, float]:
        """Fraction of the variance of each random field that its modes make."""
        return {field.field.label: field.kept for field in self._equations.fields}


def gather_each(spaces: Sequence[BodySpace], parts: Sequence[FloatArray]) -> FloatArray | None:
    """Collect states of several bodies, each (k, U_local), side by side (k, U) on the first rank; collective."""
    whole = [found for space, part in zip(spaces, parts, strict=True) if (found := space.gather(part)) is not None]
    return np.concatenate(whole, axis=1) if whole else None


def scatter_each(spaces: Sequence[BodySpace], rows: FloatArray) -> FloatArray:
    """Take this rank's part (k, U_local) of states (k, U) of several bodies with equally many unknowns."""
    parts = np.split(rows, len(spaces), axis=1)
    return np.concatenate([space.scatter(part) for space, part in zip(spaces, parts, strict=True)], axis=1)


def log_factor(model: Any, points: FloatArray, of: str) -> FloatArray:
    """Return ln (n, N) of the random factor on a quantity at the vertices, on every rank; collective.

    Parameters
    ----------
    model
        A body, a path or a specimen.
    points
        Parameters (n, d).
    of
        "stiffness" or "density": the factor is the product of all random fields that multiply it.
    """
    found = np.zeros((len(points), model.spec.body.vertex_count))
    labels = [field.label for field in model.spec.fields if field.of == of]
    if labels:
        factors = model.equations.comm.bcast(model.space.factors(points, 1))
        found += sum(np.log(factors[label]) for label in labels)
    return found
