"""Fields at the vertices of the mesh of a rank group: random ones, as functions in forms, and pressures of contact.

Random fields depend on the parameters, and have the transpose of that map.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl

from forward.bodies.geometry import Body
from forward.bodies.random_fields import Expansion, RandomField
from forward.fem import ranks
from forward.fem.dolfinx import spaces
from forward.fem.layout import gathered, sorted_by_place
from forward.model import FloatArray
from forward.terms import tools


class VertexField:
    """The factor of a random field on a mesh.

    Modes are split over the ranks of the group; white noise is mapped by the first rank.

    Parameters
    ----------
    field, body
        The random field, and the body that it is on.
    msh, comm
        This rank's part of the mesh, and the ranks that share it.
    parameters
        Names of all parameters; the field uses its own.

    Attributes
    ----------
    positions
        Indices (k,) of its coefficients among the parameters.
    function, log
        Logarithm of the factor, as the function that forms are written in, and as a variable of these.
    direction
        Change of the logarithm, as a function of forms.
    test
        Test function on the vertices.
    kept
        Fraction of the variance that the coefficients represent.
    """

    def __init__(self, field: RandomField, body: Body, msh: Any, comm: Any, parameters: tuple[str, ...]) -> None:
        self.field = field
        self._comm = comm
        self._space = spaces.scalar_space(msh, 1)
        _, _, self._vertices = sorted_by_place(self._space, comm)
        numbers = {path: i for i, path in enumerate(field.paths(body))}
        self._count = len(numbers)
        self.positions = np.array([i for i, path in enumerate(parameters) if path in numbers], dtype=np.int64)
        self._numbers = np.array([numbers[parameters[i]] for i in self.positions], dtype=np.int64)
        self._expansion: Expansion | None = field.on(body) if comm.rank == 0 else None
        on_first = self._expansion
        offset, self.kept, modes = comm.bcast(on_first and (on_first.offset, on_first.kept, on_first.modes))
        self._offset = offset[self._vertices]
        self._modes = None if modes is None else np.ascontiguousarray(modes[self._vertices])
        if self._modes is not None:
            self._expansion = None  # every rank keeps only its part
        self.function = spaces.function(self._space)
        self.log = ufl.variable(self.function)
        self.direction = spaces.function(self._space)
        self.test = ufl.TestFunction(self._space)
        self.set(np.zeros(len(parameters)))

    @property
    def factor(self) -> Any:
        """The factor, as a UFL expression."""
        return ufl.exp(self.log)

    def inside(self, integrand: Any) -> bool:
        """Whether an integrand depends on the field, and the field on parameters."""
        return len(self.positions) > 0 and self.function in ufl.algorithms.extract_coefficients(integrand)

    def set(self, parameters: FloatArray) -> None:
        """Set the field to parameters (d,); collective."""
        spaces.give(self.function, self._offset + self._values(parameters))

    def set_direction(self, direction: FloatArray) -> None:
        """Set the change of the field to that along a direction (d,) of the parameters; collective."""
        spaces.give(self.direction, self._values(direction))

    def vjp(self, slopes: FloatArray) -> FloatArray:
        """Return derivatives (k,) by this field's parameters from this rank's part of those by vertex values."""
        if self._modes is not None:
            return ranks.total(self._comm, slopes @ self._modes)[self._numbers]
        whole = gathered(self._comm, self._vertices, slopes[None])
        pulled = None
        if whole is not None and self._expansion is not None:
            pulled = self._expansion.vjp(whole[0])[self._numbers]
        return np.asarray(self._comm.bcast(pulled))

    def factors(self, points: FloatArray, space: Any) -> FloatArray | None:
        """Return the factors (n, nodes) at parameters (n, d) at the nodes of a space in canonical order; collective.

        On the first rank only.
        """
        _, _, positions = sorted_by_place(space, self._comm)
        rows = []
        for point in points:
            self.set(point)
            rows.append(np.exp(spaces.interpolate(self.function, space)))
        return gathered(self._comm, positions, np.array(rows))

    def _values(self, parameters: FloatArray) -> FloatArray:
        """Linear part of the logarithm at this rank's vertices."""
        coefficients = np.zeros(self._count)
        coefficients[self._numbers] = parameters[self.positions]
        if self._modes is not None:
            return np.asarray(self._modes @ coefficients)
        whole = None if self._expansion is None else self._expansion.values(coefficients)
        return np.asarray(self._comm.bcast(whole)[self._vertices])


class PressuresAtVertices:
    """Pressures (n_vertices,) (Pa) of a tool at this rank's own vertices: ∫p φ_i dS/∫φ_i dS with hat functions φ_i.

    Attributes
    ----------
    density, measure
        Pressure and its boundary, in UFL.
    areas
        ∫φ_i dS (n_vertices,) (m²); 0 away from the boundary.
    """

    def __init__(self, equations: Any, label: str) -> None:
        tool, at = equations.tool(label)
        self.density, self.measure = tools.pressure(at.ops, *tool.touch(at, at.X + at.u)), tool.measure(at)
        hat = ufl.TestFunction(spaces.scalar_space(equations.mesh, 1))
        self._forces = equations.by_vertices(self.density * hat * self.measure)
        self.areas: FloatArray = equations.by_vertices(hat * self.measure)()

    def __call__(self) -> FloatArray:
        """Return them at the state that is set."""
        return np.divide(self._forces(), self.areas, out=np.zeros_like(self.areas), where=self.areas > 0)
