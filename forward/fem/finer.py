"""A body on finer meshes: what error its own mesh makes of what is observed.

Its own grading with as many cells as the body has tells how fast the error falls: as h^p, and where the cells of the
finer mesh are t times smaller, it still misses the difference ψ_f − ψ_c times 1/(t^p − 1) (L. F. Richardson, Phil.
Trans. R. Soc. A 226 (1927) 299–361). The difference itself is an output too: it says how far that may be wrong, and
where no order is known it counts as a whole (`WHOLE`) and nothing is extrapolated. Where
thin cells at a rim are squeezed until there is no equilibrium, meshes without them take their place. Random fields are
those of the mesh itself, interpolated.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, identity, kron

from forward.bodies.location import locate, shapes
from forward.bodies.mesh import X_FIRST
from forward.combine import CombinedSolution, Joined, Mapped, OfOne, Rows, sums_of
from forward.finer_meshes import OF_EQUAL, TIMES, finer, graded, on_mesh, share
from forward.joined_models import JoinedMeshes
from forward.model import FloatArray, ForwardModel, Guess, Solution, SolveError, gathered, scattered
from forward.pointwise import OneByOne

if TYPE_CHECKING:
    from forward.fem.joined import PathModel, SpecimenModel
    from forward.fem.model import HyperelasticModel

    AnyModel = HyperelasticModel | PathModel | SpecimenModel

# Iterations at a load, and the smallest step of it, after which thin cells are given up: answers took 10 and 1/8.
ITERATIONS, LOAD_STEP = 12, 1 / 16
# States with their derivatives as rows; or none, and why: the reason, and the history of the solver.
Begun = tuple[tuple[FloatArray, ...], tuple[str, tuple[str, ...]] | None]
# By the name of the meshes; what a run begun before has found, whole on all ranks.
Keep = Callable[[str, Callable[[], Begun]], Begun]
WHOLE = 2.0  # times the difference between meshes that show no order, of which nearly a half counts otherwise
TANGENTS = 20  # parameters up to which a state is predicted from the first one with its derivatives


def extrapolated(
    model: Any, start: FloatArray | None = None, keep: Keep = lambda name, begin: begin()
) -> FinerMeshes | JoinedMeshes:
    """Return a body on finer meshes; these are made when they are first solved on.

    Parameters
    ----------
    model
        The body: a specimen, one with outputs, or mapped models that are joined, each of which is looked at by itself.
    start
        Parameters (d,) that are solved for first.
    keep
        Where the states there are kept and found.

    Raises
    ------
    ModelError
        If there is no finer mesh of it.
    """
    if type(model) is Joined:
        parts: Any = model.models
        starts = [None if start is None else part.by.values(start[None])[0] for part in parts]
        pairs = [(part.model, own) for part, own in zip(parts, starts, strict=True)]

        def part(k: int, one: Any, own: FloatArray | None) -> Any:
            return extrapolated(one, own, lambda name, begin: keep(f"{name} of part {k}", begin))

        return JoinedMeshes(
            tuple(None if one.space is None else part(k, one, own) for k, (one, own) in enumerate(pairs))
        )
    spec = model.spec
    fine, beside = finer(spec), graded(spec)
    otherwise = None
    thin = not fine.body.structured or fine.body.grading != spec.body.grading  # cells, at some faces
    if spec.body.structured and thin:
        both = (on_mesh(spec, times, thin=False) for times in (TIMES, 1.0))
        equal, less = (_hurried(one, spec.solver.minimum_load_step) for one in both)
        times = (equal.body.cell_count / less.body.cell_count) ** (1 / 3)
        other = None if less.body == spec.body else OtherMesh(model, less)
        otherwise = FinerMeshes(
            OtherMesh(model, equal), other, 1 / (times**OF_EQUAL - 1), start, partial(keep, "equal")
        )
        fine, beside = _hurried(fine, LOAD_STEP), None if beside is None else _hurried(beside, LOAD_STEP)
    coarse = None if beside is None else OtherMesh(model, beside)
    return FinerMeshes(OtherMesh(model, fine), coarse, share(spec), start, partial(keep, "finer"), otherwise)


def _hurried(spec: Any, smallest: float) -> Any:
    """Return a body whose solver gives up sooner: at a load, and at a smallest step of it, where other meshes wait."""
    known = spec.solver
    limits = {
        "iterations": min(known.iterations, ITERATIONS),
        "minimum_load_step": max(known.minimum_load_step, smallest),
    }
    return spec.model_copy(update={"solver": known.model_copy(update=limits)})


def limit(model: ForwardModel, observed: csr_matrix, outputs: tuple[str, ...], share: float) -> Rows:
    """Return the model of what is observed in the limit of finer meshes.

    Parameters
    ----------
    model
        On a fine and a coarse mesh: its outputs (2m,) are those on the one and then those on the other.
    observed, outputs
        Weights (n, m) of the outputs in what is observed, and its names.
    share
        1/(t^p − 1); 0 where p is not known.

    Returns
    -------
    Rows
        With 2n outputs: ψ_f + share (ψ_f − ψ_c), and then ψ_f − ψ_c, times `WHOLE` where the share is 0.
    """
    names = (*outputs, *(f"{name} (between the meshes)" for name in outputs))
    one = identity(len(outputs))
    gaps = Rows(model, kron([[1, 0], [1, -1]], observed, format="csr"), names)
    return Rows(gaps, kron([[1, share], [0, 1.0 if share else WHOLE]], one, format="csr"), names)


@dataclass(frozen=True)
class Otherwise(OfOne):
    """A model, and another one where it has no answer."""

    model: ForwardModel
    other: ForwardModel

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> Solution:
        """Solve at `parameters` (d,).

        Raises
        ------
        SolveError
            Where neither has an answer.
        """
        try:
            return self.model.solve(parameters)
        except SolveError:
            return self.other.solve(parameters)


@dataclass(frozen=True)
class FromStart(OfOne):
    """Models whose solves begin at what the linearisation at a start predicts.

    Parameters
    ----------
    model
        The models.
    start
        Parameters (d,) that are solved for first; None: every solve begins at rest.
    keep
        As of `extrapolated`.
    begun
        States there, and their derivatives, once they are known, and why there are none; models of the same meshes
        share it.
    needed
        Whether there is no answer anywhere without one at the start: then searches end at once, which may take minutes.
    """

    model: Joined
    start: FloatArray | None = None
    keep: Callable[[Callable[[], Begun]], Begun] = lambda begin: begin()
    begun: list[Begun] = field(default_factory=list)
    needed: bool = False

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> CombinedSolution:
        """Solve at `parameters` (d,).

        Raises
        ------
        SolveError
            Where there is no answer.
        """
        if self.start is None:
            return self.model.solve(parameters)
        here: list[tuple[CombinedSolution, tuple[FloatArray, ...]]] = []
        at_start = not self.begun and np.array_equal(parameters, self.start)
        if not self.begun:
            known, reason = self.keep(partial(self._begin, self.start, here))
            pairs = zip(self.model.models, known, strict=False)  # none without an answer
            parts = here[0][1] if here else tuple(scattered(_meshed(model), rows) for model, rows in pairs)
            self.begun.append((parts, reason))
        begun, reason = self.begun[0]
        if reason is not None and (at_start or self.needed):
            raise SolveError(*reason)
        if at_start or reason is not None:  # where states were kept, this solve was not: it is done as it was begun
            return here[0][0] if here else self.model.solve(parameters)
        step = parameters - self.start
        guesses = [Guess(rows[0] + step @ rows[1:] if len(rows) > 1 else rows[0]) for rows in begun]
        return self.model.solve_each(parameters, guesses)

    def _begin(self, start: FloatArray, here: list[tuple[CombinedSolution, tuple[FloatArray, ...]]]) -> Begun:
        """Solve at the start, for all to begin from; states are returned whole, and added with the rank's own part."""
        try:
            found = self.model.solve(start)
        except SolveError as error:
            return (), (error.reason, tuple(error.history))
        few = len(start) <= TANGENTS and self.differentiable
        every = np.eye(len(start))
        rows = tuple(np.vstack([one.state, *(one.state_tangent(every) if few else ())]) for one in found.solutions)
        here.append((found, rows))
        whole = map(gathered, map(_meshed, self.model.models), rows)
        return tuple(np.zeros((0, 0)) if one is None else one for one in whole), None  # the former on other ranks


def _meshed(model: ForwardModel) -> ForwardModel:
    """Return the body whose states are those of a model."""
    return model._model if isinstance(model, OtherMesh) else model


@dataclass(frozen=True)
class FinerMeshes:
    """A body on finer meshes.

    Parameters
    ----------
    fine, coarse
        On the finest, and on the other one; None where that is its own.
    share, start, keep, otherwise
        As of `limit` and `FromStart`, and what takes their place (`Otherwise`).
    begun
        As of `FromStart`.
    """

    fine: OtherMesh
    coarse: OtherMesh | None
    share: float
    start: FloatArray | None = None
    keep: Callable[[Callable[[], Begun]], Begun] = lambda begin: begin()
    otherwise: FinerMeshes | None = None
    begun: list[Begun] = field(default_factory=list)

    def of(self, observed: ForwardModel) -> ForwardModel:
        """Return the model of what a model of the body has as outputs; collective when it is first solved.

        Parameters
        ----------
        observed
            The body itself, what is observed of a specimen, or `Rows` of either.
        """
        body, weights = sums_of(observed)
        fine, coarse = (body if mesh is None else mesh.of(body) for mesh in (self.fine, self.coarse))
        both = Joined((fine, coarse), (*body.outputs, *(f"{name} (coarse)" for name in body.outputs)))
        begun = FromStart(both, self.start, self.keep, self.begun, self.otherwise is not None)
        found = limit(begun, weights, observed.outputs, self.share)
        return found if self.otherwise is None else Otherwise(found, self.otherwise.of(observed))


class OtherMesh(OneByOne):
    """A body on another mesh, as a model of the parameters that it has on its own.

    Parameters
    ----------
    model
        The body on its own mesh.
    spec
        The same on the other one, as `finer` returns it.
    """

    def __init__(self, model: AnyModel, spec: Any) -> None:
        self.spec = spec
        self.parameters, self.outputs = model.parameters, model.outputs
        self.differentiable, self.space = True, None
        self._own = self._observed = model
        self._made: list[AnyModel] = []  # shared by all that observe

    def of(self, observed: Any) -> OtherMesh:
        """Return the same with the outputs of another model of the body; both share mesh, forms and factors."""
        other = copy.copy(self)
        other.outputs, other._observed = observed.outputs, observed
        other.__dict__.pop("_model", None)
        return other

    @property
    def _mesh(self) -> AnyModel:
        if not self._made:
            numbers = tuple(self._own.parameters[i] for i in self._scalars)
            self._made.append(self.spec.build(self._own.equations.comm, (*numbers, *self.spec.coefficients)))
        return self._made[0]

    @cached_property
    def _model(self) -> ForwardModel:
        mesh: Any = self._mesh
        if not hasattr(mesh, "observing"):
            return self._mesh
        observed: Any = self._observed
        axes, cases = observed.axes.tolist(), observed.cases.tolist()
        found: ForwardModel = mesh.observing(observed.places, axes, cases, observed.directions)
        return found

    @cached_property
    def _scalars(self) -> list[int]:
        """Places of the parameters that are no coefficients of fields."""
        return [i for i, path in enumerate(self._own.parameters) if path in self.spec.scalars]

    @cached_property
    def _interpolation(self) -> tuple[NDArray[np.int64], FloatArray]:
        """Vertices (n, k) of the body's mesh around each vertex of the other one, and weights (n, k)."""
        from forward.fem.layout import vertices_of  # not before there is a mesh: this module is what `check` asks too

        vertices = vertices_of(self._own.equations)
        cells, _ = vertices.cells()
        if cells.shape[1] == 8:
            cells = cells[:, X_FIRST]
        found = locate(vertices.coordinates[cells], vertices_of(self._mesh.equations).coordinates)
        return cells[found.cells], shapes(found.local, cells.shape[1])

    def values(self, points: FloatArray) -> FloatArray:
        """Return the parameters (n, D) on the other mesh of those (n, d) on the own one: an affine map; collective."""
        scalars = points[:, self._scalars]
        if not self.spec.fields:
            return scalars
        from forward.fem.space import log_factor

        around, weights = self._interpolation
        found = [scalars]
        for one in self.spec.fields:
            log = log_factor(self._own, points, one.of)[:, around]
            found.append((weights * log).sum(axis=2) - one.on(self.spec.body).offset)
        return np.concatenate(found, axis=1)

    def along(self, directions: FloatArray) -> FloatArray:
        """Return derivatives (n, D) of the parameters on the other mesh along directions (n, d); collective."""
        return self.values(directions) - self.values(np.zeros((1, directions.shape[1])))

    def back(self, gradients: FloatArray) -> FloatArray:
        """Return gradients (n, d) of those (n, D) by the parameters on the other mesh; collective."""
        return gradients @ self.along(np.eye(len(self.parameters))).T

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> CombinedSolution:
        """Solve at parameters (d,) of the body on its own mesh; collective.

        Raises
        ------
        SolveError
            If there is no answer, no such mesh, or a place is far from it.
        """
        try:
            model = self._model
        except ValueError as error:  # as on all ranks of the group
            raise SolveError(str(error)) from None
        return Mapped(model, self, self.parameters).solve(parameters, guess)
