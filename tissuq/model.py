"""A model by the names of its numbers, for scripts and notebooks without a study."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from html import escape
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from forward import model as contract
from forward.errors import UnknownError
from forward.model import FloatArray, Guess, ModelError, ReferenceSolution, SolveError, gathered
from forward.settings import nearest

SHOWN = 8  # outputs that are written


class Model:
    """A model that is built, ready to be solved repeatedly.

    Parameters
    ----------
    spec
        Its specification: `study.model`, or a block as in study files.
    parameters
        Paths of the numbers that can change, such as "material.C1"; by default all.
    comm
        mpi4py communicator of the ranks that share it; by default each process has its own model.

    Raises
    ------
    StudyError
        Lists every mistake in the block.
    UnknownError
        If a parameter is not a number of the model.
    ModelError
        If the model cannot be made.

    Attributes
    ----------
    model
        The model as methods see it: vectors in, vectors out.
    parameters
        The numbers that can change, with their values in the specification, by path.
    units
        Of the outputs, by name.
    nodes
        Coordinates (N, 3) of the nodes (m), sorted by x, then y, then z; None for a model without a body. All fields in
        results have this order, on any number of ranks.
    """

    def __init__(self, spec: Any, parameters: Sequence[str] | None = None, comm: Any = None) -> None:
        if comm is None:
            from mpi4py import MPI

            comm = MPI.COMM_SELF
        if isinstance(spec, Mapping):
            from tissuq.studies import checked, model_of

            spec = checked(model_of, spec, place="model")
        self.spec = spec
        names = tuple(spec.scalars if parameters is None else parameters)
        for path in names:
            if path not in spec.scalars:
                raise UnknownError(f"'{path}' is not a number of the model; {nearest(path, tuple(spec.scalars))}")
        self.model: contract.ForwardModel = spec.build(comm, names)
        self.parameters = {name: spec.scalars[name].value for name in names}
        self.units = {output.name: output.unit for output in spec.returned}
        self.nodes = None if self.model.space is None else self.model.space.coordinates

    def __repr__(self) -> str:
        """Its kind, how many numbers can change, and its outputs."""
        return f"Model({self.spec.kind}: {len(self.parameters)} numbers that can change; {_first(self.units)})"

    def _repr_html_(self) -> str:
        """The same, with its numbers and their units."""
        rows = (
            f"<tr><td>{escape(path)}</td><td>{value:.6g}</td><td>{escape(self.spec.scalars[path].unit)}</td></tr>"
            for path, value in self.parameters.items()
        )
        return f"<details><summary>{escape(repr(self))}</summary><table>{''.join(rows)}</table></details>"

    def solve(self, values: Mapping[str, float] | None = None, near: Solution | None = None) -> Solution:
        """Solve with some numbers changed; collective over the ranks that share the model.

        Parameters
        ----------
        values
            The numbers by path; all others are as specified.
        near
            An earlier solution, whose factor may save time; it changes the answer only within the tolerance of the
            solver.

        Raises
        ------
        UnknownError
            For a number that the model does not have.
        SolveError
            If there is no answer.
        """
        values = values or {}
        for path in values:
            if path not in self.parameters:
                message = f"'{path}' is not among the numbers that change; {nearest(path, tuple(self.parameters))}"
                raise UnknownError(message)
        point = np.array([values.get(path, value) for path, value in self.parameters.items()])
        guess = None if near is None else Guess(near.solved.state, ReferenceSolution(near.point, near.solved.state))
        return Solution(self, point, self.model.solve(point, guess))


def _first(words: Iterable[str]) -> str:
    """Write words one after another; of many the first."""
    listed = [*words]
    return ", ".join(listed) if len(listed) <= SHOWN else f"{', '.join(listed[:SHOWN])} and {len(listed) - SHOWN} more"


class Solution(Mapping[str, float]):
    """A solution of a model: its outputs by name, its displacements, and derivatives of the outputs.

    Attributes
    ----------
    point
        The parameters (d,) at which it was solved.
    solved
        The solution as methods see it.
    """

    def __init__(self, model: Model, point: FloatArray, solved: contract.Solution) -> None:
        self._of, self.point, self.solved = model, point, solved
        self._outputs = dict(zip(model.model.outputs, map(float, solved.outputs), strict=True))

    def __getitem__(self, output: str) -> float:
        return self._outputs[output]

    def __iter__(self) -> Any:
        return iter(self._outputs)

    def __len__(self) -> int:
        return len(self._outputs)

    def __repr__(self) -> str:
        return f"Solution({_first(f'{name} = {value:.6g} {self._of.units[name]}' for name, value in self.items())})"

    def gradient(self, output: str) -> dict[str, float]:
        """Return the derivatives of an output with respect to all numbers that can change, by path.

        Raises
        ------
        DerivativeError
            If the model or the output has none.
        """
        weights = np.array([float(name == output) for name in self])
        if not weights.any():
            raise UnknownError(f"'{output}' is not an output; {nearest(output, tuple(self))}")
        return dict(zip(self._of.parameters, map(float, self.solved.adjoint(weights)), strict=True))

    @cached_property
    def mesh_error(self) -> dict[str, float]:
        """Errors of the mesh by output, exact minus computed, as estimates: add them to correct. Collective.

        NaN where there is no estimate, of the largest stress for example; empty for a model without a mesh. What flat
        facets of a curved surface hide is not in them: studies count it among their doubts.

        Raises
        ------
        SolveError
            If there is no estimate at this solution.
        """
        found = self.solved.mesh_error()
        if found is None:
            return {}
        if not found.nonlinearity < 1:
            message = "richer elements move the body too far for a few Newton steps: the mesh is much too coarse"
            raise SolveError(message)
        calibration = self.solved.saturation()
        found = found if calibration is None else found.calibrated(calibration)
        return dict(zip(self, map(float, found.outputs), strict=True))

    @cached_property
    def displacement(self) -> FloatArray:
        """Displacements (N, 3) of the nodes (m), in the order of `Model.nodes`; on the first rank only."""
        if self._of.nodes is None:
            raise ModelError("this model has no body")
        whole = gathered(self._of.model, self.solved.state[None, :])
        return np.zeros((0, 3)) if whole is None else whole[0, : self._of.nodes.size].reshape(-1, 3)

    def displacement_at(self, points: ArrayLike) -> FloatArray:
        """Return the displacements (n, 3) at points (n, 3) of the undeformed body (m); collective.

        Raises
        ------
        ModelError
            If a point is not in the body.
        """
        from forward.fem.space import interpolation

        places = np.atleast_2d(np.asarray(points, dtype=float))
        equations = self._of.model.equations  # type: ignore[attr-defined]
        along = np.tile(np.eye(3), (len(places), 1))
        rows = interpolation(equations, np.repeat(places, 3, axis=0), along)
        found: FloatArray = equations.total(rows @ self.solved.state)
        return found.reshape(-1, 3)
