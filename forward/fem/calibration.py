"""What errors of a mesh tend to: a solution on a finer mesh at the same parameters, with its own estimate.

With ψ_h and the error e_h that elements of one degree more see of it, and ψ_f and e_f of the same elements on a mesh
whose cells are t times smaller, the richer values ψ_h + e_h and ψ_f + e_f err by a power of t. That power is the one
with which e itself falls, e_f = s e_h, where the same singularity (a held edge, a re-entrant corner, a jump of a load)
makes the errors of both degrees. So ψ = ψ_f + e_f + s/(1 − s) (ψ_f + e_f − ψ_h − e_h), Richardson's extrapolation with
the order that is observed (L. F. Richardson, Phil. Trans. R. Soc. A 226 (1927) 299–361). Where linear elements show an
order a, which is 2 at most, the richer ones have 2a − 1. Orders below 1, and estimates that change their sign, are not
believed: then it is 1, and the doubt is larger.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from forward.fem.affordable import Finer, finer
from forward.fem.dolfinx import spaces
from forward.fem.layout import sorted_by_place
from forward.fem.model import HyperelasticModel
from forward.model import FloatArray, Guess, ReferenceSolution, Saturation

if TYPE_CHECKING:
    from forward.fem.equations import Discretisation
    from forward.fem.model import FiniteElementSolution
    from forward.hyperelastic import Hyperelastic

LOWEST, HIGHEST = 1.0, 4.0  # orders
OF_REST, OF_ALL = 0.75, 0.1  # doubt of what is extrapolated from half the cells, and of the whole error
LEAST, MOST = 0.5, 3.0  # ratios of errors to what is seen of them that hold at other parameters too
THOROUGH = {False: 1e-3, True: 1e-4}  # nonlinearity that is left, without pressures and with them


class Limit(NamedTuple):
    """Errors (m,) of a mesh, exact minus computed, and how far they may be wrong."""

    errors: FloatArray
    doubts: FloatArray


def limit(
    own: ArrayLike, seen: ArrayLike, finer: ArrayLike, seen_there: ArrayLike, times: float, degree: int = 2
) -> Limit:
    """Extrapolate errors of outputs on a mesh.

    Parameters
    ----------
    own, seen
        Outputs (m,) on the mesh, and their errors as elements of one degree more see them.
    finer, seen_there
        The same on the finer mesh.
    times
        Cells there along each edge, over those of the mesh.
    degree
        Of the body.
    """
    parts = (np.asarray(part, dtype=float) for part in (own, seen, finer, seen_there))
    values, e, there, e_there = np.broadcast_arrays(*parts)
    ratio = np.divide(e_there, e, out=np.full(e.shape, np.nan), where=e != 0)
    regular = (ratio > 0) & (ratio <= times**-LOWEST)
    share = np.where(regular, np.maximum(ratio, times**-HIGHEST), times**-LOWEST)
    if degree == 1:  # whose own order is at most 2, and that of richer elements more where the solution is smooth
        share = share**2 * times
    rest = share / (1 - share) * (there + e_there - values - e)
    errors = there + e_there - values + rest
    doubts = (
        OF_REST * (2 / times) ** 0.5 * np.abs(rest) + OF_ALL * np.abs(errors) + np.where(regular, 0.0, np.abs(e_there))
    )
    return Limit(errors, doubts)


def saturation(seen: FloatArray, found: Limit, of_state: float) -> Saturation:
    """Return what makes errors (m,) as they are usually seen those that were found."""
    ratio = np.divide(found.errors, seen, out=np.zeros(seen.shape), where=seen != 0)
    together = (ratio >= LEAST) & (ratio <= MOST)
    outputs = np.where(np.isnan(found.errors), np.nan, np.where(together, ratio, 1.0))
    shifts = np.where(together | np.isnan(found.errors), 0.0, found.errors - seen)
    return Saturation(outputs, of_state, of_state, shifts=shifts, doubts=found.doubts)


class FinerMesh:
    """A body on a finer mesh, made when it is first solved on.

    Parameters
    ----------
    model
        The body.
    spare
        How many solves it may cost (`forward.fem.affordable.allowance`).
    """

    def __init__(self, model: HyperelasticModel, spare: float = math.inf) -> None:
        self._model, self._spare = model, spare
        self._scalars = [i for i, path in enumerate(model.parameters) if path in model.spec.scalars]

    @cached_property
    def _finer(self) -> Finer | None:
        return finer(self._model.spec, self._spare)

    @cached_property
    def _tested(self) -> HyperelasticModel:
        """The body there."""
        assert self._finer is not None
        return self._built(self._finer.spec)

    @cached_property
    def _untested(self) -> HyperelasticModel:
        """The same, whose solutions are not tested for stability: one factorisation less."""
        assert self._finer is not None
        spec = self._finer.spec
        solver = spec.solver.model_copy(update={"kind": "predict-correct", "accept_unstable": True})
        return self._built(spec.model_copy(update={"solver": solver}))

    def _built(self, spec: Hyperelastic) -> HyperelasticModel:
        names = tuple(self._model.parameters[i] for i in self._scalars)
        return HyperelasticModel(spec, self._model.equations.comm, names)

    def calibrated(self, solution: FiniteElementSolution) -> Saturation | None:
        """Calibrate estimates by the finer mesh at the parameters of a solution; collective.

        None where that takes too much, or where coefficients of random fields are not zero: every mesh has its own.

        Raises
        ------
        SolveError
            If there is no such solution on the finer mesh.
        """
        model, point = self._model, solution.parameters
        if np.delete(point, self._scalars).any() or self._finer is None:
            return None
        usual, bent = solution.mesh_error().outputs, THOROUGH[model.spec.mixed]
        own = solution.estimated(model.enriched, (solution.enriched_state, bent))
        seen = model.enriched.values(solution, own) - solution.outputs
        other, there = self._solved(point[self._scalars], own.state)
        richer = there.estimated(other.enriched, (there.enriched_state, bent))
        seen_there = other.enriched.values(there, richer) - there.outputs
        times, degree = self._finer.times, model.spec.body.degree
        found = limit(solution.outputs, seen, there.outputs, seen_there, times, degree)
        before = _everywhere(model.equations, np.array([solution.state, model.enriched.down(own.change)]))
        moved = np.array([there.state, other.enriched.down(richer.change)])
        after = _moved(other.equations, model.equations, moved)
        n = model.space.displacements
        return saturation(usual, found, of_states(before[:, :n], after[:, :n], times, degree))

    def _solved(self, parameters: FloatArray, richer: FloatArray) -> tuple[HyperelasticModel, FiniteElementSolution]:
        """Solve from what richer elements say of the state, (U⁺_local,), with the one factor of the stiffness there.

        Where that has negative eigenvalues, only the equilibrium can tell whether it is stable.
        """
        other = self._untested
        there = _moved(self._model.enriched.equations, other.equations, richer[None])
        start = other.equations.layout.scatter(there)[0]
        near = ReferenceSolution(parameters, start)
        if other.take_reference(near).indefinite():
            return self._tested, self._tested.solve(parameters, Guess(start))
        return other, other.solve(parameters, Guess(start, near))


def of_states(before: FloatArray, after: FloatArray, times: float, degree: int) -> float:
    """Return the factor between the error of a state and what is seen of it.

    Parameters
    ----------
    before, after
        State and estimate (2, U) on the mesh, and on the finer one.
    times, degree
        As of `limit`.
    """
    (own, seen), (there, seen_there) = before, after
    square = float(seen @ seen)
    if not square > 0:
        return 1.0
    along = [float(x @ seen) / square for x in (there - own, seen_there)]
    return float(np.clip(limit(0.0, 1.0, along[0], along[1], times, degree).errors, LEAST, MOST))


def _everywhere(equations: Discretisation, rows: FloatArray) -> FloatArray:
    """Return rows (k, U_local) as (k, U) on every rank."""
    return np.asarray(equations.comm.bcast(equations.layout.gather(rows)))


def _moved(here: Discretisation, there: Discretisation, rows: FloatArray) -> FloatArray:
    """Return rows (k, U_local), interpolated at the nodes of another mesh, as (k, U') on every rank; collective."""
    whole, start, parts = _everywhere(here, rows), 0, []
    pairs = (
        (here.unknowns.displacement, there.unknowns.displacement, 3),
        (here.unknowns.pressure, there.unknowns.pressure, 1),
    )
    for source, target, components in pairs:
        if source is None:
            continue
        points, *_ = sorted_by_place(target, there.comm)
        nodes, canonical, _ = sorted_by_place(source, here.comm)
        values = whole[:, start : start + components * len(nodes)].reshape(len(rows), -1, components)
        start += components * len(nodes)
        numbers = canonical[spaces.global_node_numbers(source)]
        mine, of_points, weights, _ = spaces.point_rows(source, points)
        moved = np.zeros((len(rows), len(points), components))
        some = values[:, numbers[of_points[mine]]]
        moved[:, mine] = np.einsum("nk,rnkc->rnc", weights[mine], some, optimize=True)
        parts.append(moved.reshape(len(rows), -1))
    return np.asarray(here.comm.allreduce(np.concatenate(parts, axis=1)))
