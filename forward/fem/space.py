"""The space in which the states of a finite-element body live, with its random fields, and what is observed there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from forward.bodies.geometry import tolerance
from forward.fem.dolfinx import meshes, spaces
from forward.fem.equations import Discretisation
from forward.model import FloatArray, ModelError, NodalSpace


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
        if equations.spec.body.kind != "mesh":
            return None
        numbers = self._layout.by_cell(meshes.region_numbers(equations.comm, equations.spec.body, equations.mesh))
        return np.asarray(numbers, dtype=np.int64)

    def factors(self, points: FloatArray, degree: int | None = None) -> dict[str, FloatArray]:
        """Return the factors (n, N) of each random field at parameters (n, d), by its name.

        Collective; empty but on the first rank. The nodes are those of displacements, or of another degree: 1 is for
        the vertices.
        """
        equations = self._equations
        equations.linearisation_point.forget_parameters()
        space = spaces.scalar_space(equations.mesh, degree or equations.spec.body.degree)
        found = {field.field.label: field.factors(points, space) for field in equations.fields}
        return {label: factors for label, factors in found.items() if factors is not None}

    @property
    def variance_kept(self) -> dict[str, float]:
        """Fraction of the variance of each random field that its modes make."""
        return {field.field.label: field.kept for field in self._equations.fields}


class JoinedSpace:
    """The `NodalSpace` of several states of one body, side by side.

    Parameters
    ----------
    one
        That of the body.
    count
        Number of states.
    along
        Returns the parameters of the body that belong to parameters (n, d).
    displacements
        Number of displacements with which all of them begin; 0 if they are no displacement field.
    """

    def __init__(
        self, one: NodalSpace, count: int, along: Callable[[FloatArray], FloatArray], displacements: int
    ) -> None:
        self.coordinates, self.displacements = one.coordinates, displacements
        self.cells, self.regions, self.variance_kept = one.cells, one.regions, one.variance_kept
        self._one, self._count, self._along = one, count, along

    def gather(self, rows: FloatArray) -> FloatArray | None:
        """Collect (k, U_local) as (k, U) on the first rank."""
        parts = [self._one.gather(part) for part in np.split(rows, self._count, axis=1)]
        whole = [part for part in parts if part is not None]
        return np.concatenate(whole, axis=1) if whole else None

    def scatter(self, rows: FloatArray) -> FloatArray:
        """Take this rank's part (k, U_local) of (k, U)."""
        return np.concatenate([self._one.scatter(part) for part in np.split(rows, self._count, axis=1)], axis=1)

    def factors(self, points: FloatArray, degree: int | None = None) -> dict[str, FloatArray]:
        """Return the factors (n, N) of each random field at parameters (n, d); collective."""
        return self._one.factors(self._along(points), degree)


class Observation:
    """What is observed of a body, y = B u + S o: displacements at places, and some of its outputs o.

    Parameters
    ----------
    places
        Points (n, 3) of the undeformed body (m); those of outputs do not count.
    directions
        Unit vectors (n, 3) along which displacements are observed; zeros of outputs.
    which
        Numbers (n,) of the outputs; below 0 for displacements.
    """

    def __init__(self, places: FloatArray, directions: FloatArray, which: NDArray[np.int64]) -> None:
        self._places, self._directions = places, directions
        self._others = np.flatnonzero(which >= 0)
        self._which = which[self._others]
        self.of_outputs = len(self._others) > 0
        self._matrices: dict[int, csr_matrix] = {}

    def matrix(self, equations: Discretisation) -> csr_matrix:
        """Return B (n, U_local) in the elements of some equations of the body; collective when first asked for.

        Raises
        ------
        ValueError
            If a place is farther from the mesh than the mesh can be from the body.
        """
        degree = equations.spec.body.degree
        if degree not in self._matrices:
            self._matrices[degree] = interpolation(equations, self._places, self._directions)
        return self._matrices[degree]

    def of(self, equations: Discretisation, states: FloatArray, outputs: Callable[[], FloatArray]) -> FloatArray:
        """Return y (…, n) of states (…, U_local) and outputs (…, m), asked for where they count; collective."""
        return self.with_outputs(equations.total((self.matrix(equations) @ states.T).T), outputs)

    def with_outputs(self, displacements: FloatArray, outputs: Callable[[], FloatArray]) -> FloatArray:
        """Return y (…, n) of displacements (…, n), which this changes, and outputs (…, m)."""
        if self.of_outputs:
            displacements[..., self._others] = outputs()[..., self._which]
        return displacements

    def apart(self, equations: Discretisation, weights: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return weights (…, n) of y as those (…, U_local) of the state and those (…, count) of the outputs."""
        of_outputs = weights[..., self._others] @ (self._which[:, None] == np.arange(count))
        return (self.matrix(equations).T @ weights.T).T, of_outputs


def interpolation(equations: Discretisation, places: FloatArray, directions: FloatArray) -> csr_matrix:
    """Return B (n, U_local) of displacements at places (n, 3) along directions (n, 3); collective.

    Outside the mesh, the displacement of the nearest point is meant. Rows without a direction are empty.

    Raises
    ------
    ModelError
        If a place is farther (m) from the mesh than the mesh can be from the body.
    """
    layout, body, moving = equations.layout, equations.spec.body, np.flatnonzero(directions.any(axis=1))
    if not len(moving):
        return csr_matrix((len(places), equations.size))
    points, numbers = np.unique(places[moving], axis=0, return_inverse=True)
    mine, nodes, weights, distances = spaces.point_rows(equations.space, points)
    far = np.flatnonzero(distances > max(tolerance(body), body.longest_edge))
    if len(far):
        where = ", ".join(f"{x:g}" for x in points[far[0]])
        raise ModelError(f"({where}) lies {distances[far[0]]:.3g} m outside the mesh")
    at, w = np.empty(nodes.shape, dtype=np.int64), np.empty(weights.shape)
    for theirs, canonical, some in equations.comm.allgather((mine, layout.nodes()[nodes[mine]], weights[mine])):
        at[theirs], w[theirs] = canonical, some
    local = np.full(len(layout.coordinates), -1)
    local[layout.positions] = np.arange(len(layout.positions))
    which, axes = np.nonzero(directions[moving])
    columns = local[at[numbers.ravel()[which]]]
    owned = columns >= 0
    values = directions[moving][which, axes][:, None] * w[numbers.ravel()[which]]
    rows = np.repeat(moving[which], owned.sum(axis=1))
    entries = values[owned], (rows, (3 * columns + axes[:, None])[owned])
    return csr_matrix(entries, shape=(len(places), equations.size))


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
