"""What errors of a mesh tend to: a solution on a finer mesh at the same parameters, with its own estimate.

With ψ_h and the error e_h that elements of one degree more see of it, and ψ_f and e_f of the same elements on a mesh
whose cells are t times smaller, the richer values ψ_h + e_h and ψ_f + e_f err by a power of t. That power is the one
with which e itself falls, e_f = s e_h, where the same singularity (a held edge, a re-entrant corner, a jump of a load)
makes the errors of both degrees. So ψ = ψ_f + e_f + s/(1 − s) (ψ_f + e_f − ψ_h − e_h), Richardson's extrapolation with
the order that is observed (L. F. Richardson, Phil. Trans. R. Soc. A 226 (1927) 299–361). Where linear elements show an
order a, which is 2 at most, the richer ones have 2a − 1. Orders below 1, and estimates that change their sign, are not
believed: then it is 1, and the doubt is larger.

Where the estimate on the finer mesh would take too much, ψ_h, ψ_h + e_h and ψ_f are left. Beside such singularities
errors fall twice as fast with the degree p as with the size of cells (`forward.fem.solution`), as C (h/p²)^a: then
e_h/(ψ_f − ψ_h) = (1 − (p/(p+1))^2a)/(1 − t^−a), which tells a, and ψ − ψ_h = (ψ_f − ψ_h)/(1 − t^−a). For quadratic
elements and t = 3/2 richer elements are as good as a second such mesh, and this is Aitken's extrapolation. Where no
order shows, it is 3/2, and the doubt reaches from order 1 to 4.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from forward.bodies.mesh import contents
from forward.bodies.tetrahedra import MeshInMemory
from forward.fem.body import DiscreteBody
from forward.fem.dolfinx import spaces
from forward.fem.dolfinx.meshes import on_first
from forward.fem.enriched import Enriched, EnrichedState
from forward.fem.equations import Discretisation
from forward.fem.layout import sorted_by_place
from forward.fem.mesh_error_cost import Finer, finer
from forward.fem.solution import LEAST, MOST, FiniteElementSolution
from forward.loaded import LoadedBody
from forward.model import FloatArray, Guess, ModelError, ReferenceSolution, Saturation, SolveError
from forward.observables.observable import Functional

LOWEST, HIGHEST = 1.0, 4.0  # orders
USUAL = 1.5  # the same where none shows, and no estimate on the finer mesh bounds what is left there
ORDERS = np.linspace(HIGHEST, LOWEST, 400)
OF_REST, OF_ALL = 0.75, 0.1  # doubt of what is extrapolated from half the cells, and of the whole error
THOROUGH = {False: 2e-3, True: 1e-4}  # nonlinearity left where one step is not enough, without pressures and with them


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
    return Limit(errors, _doubts(errors, rest, times) + np.where(regular, 0.0, np.abs(e_there)))


def limit_alone(own: ArrayLike, seen: ArrayLike, finer: ArrayLike, times: float, degree: int = 2) -> Limit:
    """Extrapolate errors of outputs where there is no estimate on the finer mesh; parameters as of `limit`."""
    values, e, there = np.broadcast_arrays(*(np.asarray(part, dtype=float) for part in (own, seen, finer)))
    moved = there - values
    ratio = np.divide(e, moved, out=np.full(e.shape, np.nan), where=moved != 0)
    gone, regular = _gone(ratio, times, degree)
    errors = moved / np.where(regular, gone, 1 - times**-USUAL)
    errors = np.where(np.isnan(e), np.nan, errors)
    return Limit(errors, _doubts(errors, errors - moved, times) + np.where(regular, 0.0, np.abs(e - moved)))


def _gone(ratio: FloatArray, times: float, degree: int) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return the parts (m,) of errors that are gone on a finer mesh, and whether they show an order.

    By the ratios (m,) of what richer elements see to what is gone, which rise as the order falls; where they show none,
    those of the nearest one.
    """
    gone = 1 - times**-ORDERS
    ratios = (1 - (degree / (degree + 1)) ** (2 * ORDERS)) / gone
    return np.interp(ratio, ratios, gone), (ratio >= ratios[0]) & (ratio <= ratios[-1])


def _doubts(errors: FloatArray, rest: FloatArray, times: float) -> FloatArray:
    """How far errors (m,) may be wrong of which a part was extrapolated."""
    return np.asarray(OF_REST * (2 / times) ** 0.5 * np.abs(rest) + OF_ALL * np.abs(errors))


def saturation(seen: FloatArray, found: Limit, of_state: float) -> Saturation:
    """Return what makes errors (m,) as they are usually seen those that were found."""
    ratio = np.divide(found.errors, seen, out=np.zeros(seen.shape), where=seen != 0)
    together = (ratio >= LEAST) & (ratio <= MOST)
    outputs = np.where(np.isnan(found.errors), np.nan, np.where(together, ratio, 1.0))
    shifts = np.where(together | np.isnan(found.errors), 0.0, found.errors - seen)
    return Saturation(outputs, of_state, of_state, shifts=shifts, doubts=found.doubts)


Body = DiscreteBody[FiniteElementSolution]


def _once(model: Body, spec: LoadedBody, parameters: tuple[str, ...]) -> Body:
    """Return a body for one solution: not tested for stability, which is one factorisation less, nor is its factor."""
    solver = {"kind": "predict-correct", "accept_unstable": True, "precision": "double"}
    changes = {"solver": spec.solver.model_copy(update=solver), "adapt": None}
    return type(model)(spec.over({}).model_copy(update=changes), model.equations.comm, parameters)


class FinerMesh:
    """A body on a finer mesh, made when it is first solved on.

    It may cost `spare` solves (`forward.fem.mesh_error_cost.allowance`).
    """

    def __init__(self, model: Body, spare: float = math.inf) -> None:
        self._model, self._spare = model, spare
        self._scalars = [i for i, path in enumerate(model.parameters) if path in model.spec.scalars]
        self._names = tuple(model.parameters[i] for i in self._scalars)

    @cached_property
    def _finer(self) -> Finer | None:
        return finer(self._model.spec, self._spare)

    @cached_property
    def _tested(self) -> Body:
        """The body there."""
        assert self._finer is not None
        return type(self._model)(self._finer.spec, self._model.equations.comm, self._names)

    @cached_property
    def _untested(self) -> Body:
        """The same for one solution."""
        assert self._finer is not None
        return _once(self._model, self._finer.spec, self._names)

    @cached_property
    def _lifted(self) -> LoadedBody | None:
        """The body with its surface moved by what its facets hide; None where they hide nothing.

        Outputs at points that do not lie in it are those at the nearest places, which lie in both.
        """
        spec, comm = self._model.spec, self._model.equations.comm
        file = spec.body
        if file.kind != "mesh":
            return None
        mesh = on_first(comm, file.lifted)
        held = comm.bcast(None if mesh is None else contents(mesh, ""))
        if held is None:
            return None
        body = MeshInMemory.of(mesh, held, file)
        outputs = comm.bcast(None if mesh is None else tuple(output.within(body) for output in spec.outputs))
        return spec.model_copy(update={"body": body, "outputs": outputs})

    @cached_property
    def _moved(self) -> tuple[Body, list[Functional]]:
        """That body for one solution, and its outputs on the mesh as it is."""
        assert self._lifted is not None
        here = [output.functional(self._model.equations) for output in self._lifted.outputs]
        return _once(self._model, self._lifted, self._names), here

    def hidden(self, solution: FiniteElementSolution) -> FloatArray | None:
        """Return what flat facets hide of a curved surface in the outputs (m,); collective.

        By one solution of the body with its surface moved (`forward.bodies.facets`). None where facets hide nothing;
        NaN where there is no such solution, or where coefficients of random fields are not zero.
        """
        unknown = np.full(len(solution.outputs), np.nan)
        try:
            if self._lifted is None:
                return None
            if np.delete(solution.parameters, self._scalars).any():
                return unknown
            body, here = self._moved
            moved = body.solve(solution.parameters[self._scalars], Guess(solution.state))
        except (ModelError, SolveError):
            return unknown
        solution.visit()
        return np.asarray(moved.outputs - [output.value() for output in here])

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
        usual, own = solution.mesh_error().outputs, solution.enriched_state
        if not (self._finer.estimated and own.straight):
            own = _thorough(solution, model.enriched)
        other, there, brought = self._solved(point[self._scalars], np.array([own.state, own.change]))
        times, degree, after = self._finer.times, model.spec.body.degree, [there.state]
        richer = there.enriched_state if self._finer.estimated else None
        # What single steps leave is nearly the same on both meshes; if only one of them goes on, it is taken for error.
        if richer is not None and not (own.straight and richer.straight):
            own = _thorough(solution, model.enriched) if own.straight else own
            richer = _thorough(there, other.enriched)
        seen = model.enriched.values(solution, own) - solution.outputs
        if richer is None:
            found = limit_alone(solution.outputs, seen, there.outputs, times, degree)
        else:
            seen_there = other.enriched.values(there, richer) - there.outputs
            found = limit(solution.outputs, seen, there.outputs, seen_there, times, degree)
            after.append(other.enriched.down(richer.change))
        n = other.space.displacements
        here, moved = brought[:, :n], _everywhere(other.equations, np.array(after))[:, :n]
        return saturation(usual, found, of_states(np.array([here[0] - here[1], here[1]]), moved, times, degree))

    def _solved(self, parameters: FloatArray, richer: FloatArray) -> tuple[Body, FiniteElementSolution, FloatArray]:
        """Solve from what richer elements say of the state, with the one factor of the stiffness there.

        Returns the rows (k, U⁺_local) of these, the first of which is the state, at its nodes (k, U) too. Where the
        factor has negative eigenvalues, only the equilibrium can tell whether it is stable.
        """
        other = self._untested
        there = moved(self._model.enriched.equations, other.equations, richer)
        start = other.equations.layout.scatter(there[:1])[0]
        near = ReferenceSolution(parameters, start)
        if other.reference.at(near).indefinite():
            return self._tested, self._tested.solve(parameters, Guess(start)), there
        return other, other.solve(parameters, Guess(start, near)), there


def _thorough(solution: FiniteElementSolution, enriched: Enriched) -> EnrichedState:
    """Return the state in richer elements, further to equilibrium there than is usual."""
    return solution.estimated(enriched, (solution.enriched_state, THOROUGH[enriched.equations.spec.mixed]))


def of_states(before: FloatArray, after: FloatArray, times: float, degree: int) -> float:
    """Return the factor between the error of a state and what is seen of it.

    Parameters
    ----------
    before, after
        State and estimate (2, U) on the mesh, and on the finer one, at the same nodes; (1, U) without an estimate.
    times, degree
        As of `limit`.
    """
    (own, seen), (there, *seen_there) = before, after
    square = float(seen @ seen)
    if not square > 0:
        return 1.0
    moved, *shrunk = [float(x @ seen) / square for x in (there - own, *seen_there)]
    if shrunk:
        factor = limit(0.0, 1.0, moved, shrunk[0], times, degree).errors
    else:  # errors of a whole state do not cancel as those of an output
        factor = moved / _gone(np.array(1 / moved if moved else np.inf), times, degree)[0]
    return float(np.clip(factor, LEAST, MOST))


def _everywhere(equations: Discretisation, rows: FloatArray) -> FloatArray:
    """Return rows (k, U_local) as (k, U) on every rank."""
    return np.asarray(equations.comm.bcast(equations.layout.gather(rows)))


def moved(here: Discretisation, there: Discretisation, rows: FloatArray) -> FloatArray:
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
