"""Evaluation of a model at many points: the requests of sampling methods, and the answers.

Work is cut into blocks of fixed size; sums of fields are formed in index order inside a block and the blocks are added
in order. So the result does not depend on which rank computed which block.

Requests, evaluations and their serial implementation are one contract, hence one file.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from forward.model import (
    WORK,
    FloatArray,
    ForwardModel,
    Guess,
    InadmissibleError,
    MeshError,
    ModelError,
    ReferenceSolution,
    Solution,
    SolveError,
    displacements,
    gathered,
    scattered,
)
from uq.inputs.coordinates import Coordinates

OWN = ""  # name of the first model of an evaluation
LARGEST = 1e60  # size of outputs, and its inverse the smallest: fourth powers must not overflow or underflow
MANY = 8  # points among which at least one should have an output that is not small by chance
TOGETHER = 16  # realisations whose parts of a compact sum are formed at once
COMPANY, FEW = 16, 16  # points in a block that begin from predictions, and blocks that there are before it is so large
BLOCKS = 128  # an evaluation is cut into at most this many blocks, unless another number is asked for


@dataclass(frozen=True)
class Failure:
    """A point without an answer, and why: the model is not defined there, or no solution was found."""

    index: int
    parameters: tuple[float, ...]
    reason: str
    history: tuple[str, ...] = ()
    inadmissible: bool = False


@dataclass(frozen=True)
class Evaluations:
    """Outputs of a model at n points.

    Attributes
    ----------
    points
        Parameters (n, d).
    outputs
        Outputs (n, m); NaN in the rows that failed, but for what was known before they did (`SolveError.reached`).
    tangents
        dψ/dω (n, m, d) if requested, NaN where a solve failed.
    failures
        The points that failed, by index.
    seconds
        Processor time (n,) of each point on one rank group, times the ranks of the group.
    work
        Numbers (n, k) of the operations in `forward.model.WORK`.
    residuals
        Relative residuals (n,) of the states, in the solver's measure; NaN where a solve failed.
    converged
        Whether the states (n,) meet the solver's tolerance: all that did not fail, unless its iterations were limited.
    stability
        Whether the stability of each state (n,) was counted or screened, or refused: `forward.model.Stability`.
    fields
        Sum over the points that did not fail of the rows (k, U) of the requested field sum; in a block of a
        `CompactSum`, the rows of these points themselves, one point after the other.
    sketches
        What a `CompactSum` keeps of each point that did not fail (n_ok, r, k), once its blocks are merged.
    mesh_errors
        Estimated errors of the mesh (n, m) if requested, NaN where a solve failed or nothing is estimated.
    saturations
        What calibrates estimated errors (n, 3m + 2), where it was asked for: factors of outputs, what is added then,
        and how far that may be wrong; the factor of the state; whether they were measured here (1) or are typical
        ones (0). NaN where there is none.
    """

    points: FloatArray
    outputs: FloatArray
    tangents: FloatArray | None
    failures: tuple[Failure, ...]
    seconds: FloatArray
    work: NDArray[np.int64]
    residuals: FloatArray
    converged: NDArray[np.bool_]
    stability: NDArray[np.int8]
    fields: FloatArray
    sketches: FloatArray | None = None
    mesh_errors: FloatArray | None = None
    saturations: FloatArray | None = None

    @property
    def ok(self) -> NDArray[np.bool_]:
        """Which points (n,) have an answer."""
        good = np.ones(len(self.points), dtype=bool)
        good[[failure.index for failure in self.failures]] = False
        return good


class FieldSum(Protocol):
    """A quantity of each realisation's state that is summed while realisations are computed."""

    def on(self, model: ForwardModel) -> Callable[[Solution, FloatArray], FloatArray]:
        """Return the function (solution, parameters) → rows (k, U_local) to be summed, for one group's model."""


@runtime_checkable
class CompactSum(FieldSum, Protocol):
    """A sum whose terms have many rows that follow from a few rows of each realisation: blocks hold those few.

    `on` returns these few; the sum is formed when blocks are added, so that files and messages stay small.
    """

    def total(self, points: FloatArray, rows: FloatArray) -> FloatArray:
        """Return the sum (K, U) over some realisations, from their parameters (n, d) and their rows (n, r, U)."""

    def sketch(self, rows: FloatArray) -> FloatArray | None:
        """Return a few numbers (n, r, k) to be kept of the rows (n, r, U) of some realisations; or None."""


class JointSum(Protocol):
    """A quantity of the states of several consecutive points, summed while these rows of points are computed.

    Blocks hold whole rows; a row with a failed solve adds nothing.
    """

    @property
    def size(self) -> int:
        """Number K of points in a row."""

    def on(self, model: ForwardModel) -> Callable[[FloatArray], FloatArray]:
        """Return the function states (K, U_local) → rows (k, U_local) to be summed, for one group's model."""


class Start(Protocol):
    """A prediction of the state: initial guess of the solver at every point, with the reference that corrects it.

    A dataclass; its fields are part of the keys of the blocks that were started from it.
    """

    def on(self, model: ForwardModel) -> Callable[[FloatArray], Guess]:
        """Return the function parameters (d,) → predicted state (U_local,) and its reference, for one group's model."""


@dataclass(frozen=True)
class Prediction:
    """A prediction of the state that is linear in the coordinates, with the factor at `point`.

    Attributes
    ----------
    point
        Parameters (d,) of the expansion.
    state
        State (U,) there, in canonical order.
    slopes
        Derivatives (d, U) of the state along the coordinates; empty (0, U) if the solver starts from the state at
        `point`.
    coordinates
        The coordinates.
    spread
        Standard deviations (d,) of the parameters, for the screen of stability.
    """

    point: FloatArray
    state: FloatArray
    slopes: FloatArray
    coordinates: Coordinates
    spread: FloatArray | None = None

    def on(self, model: ForwardModel) -> Callable[[FloatArray], Guess]:
        """Return the function parameters (d,) → predicted state (U_local,) and its reference, for one group's model."""
        state, slopes = scattered(model, self.state[None, :])[0], scattered(model, self.slopes)
        reference = ReferenceSolution(self.point, state, self.spread)
        if len(slopes) == 0:
            return lambda _: Guess(state, reference)
        here = self.coordinates.of(self.point)
        return lambda parameters: Guess(state + (self.coordinates.of(parameters) - here) @ slopes, reference)


def company_of(samples: int, most: int = COMPANY) -> int:
    """How many samples that begin from predictions are in one block, of so many in all and at most."""
    return min(most, max(samples // FEW, 1))


@dataclass(frozen=True)
class Request:
    """What an evaluation is asked for.

    Attributes
    ----------
    points
        Parameters (n, d).
    tangents
        Whether the derivatives of the outputs are computed.
    fields
        Sum over the states.
    start
        Initial guesses of the solver.
    iterations
        Iterations of the solver after which its state is accepted as it is, see `ForwardModel.solve`.
    model
        Name of one of the models of the evaluation; `Evaluate.on` sets it.
    joint
        Sum over the states of consecutive points, instead of `fields`.
    mesh_errors
        Whether the errors of the mesh in the outputs are estimated (`Solution.mesh_error`).
    saturations
        How many solves it may cost to find what calibrates these too (`Solution.saturation`); None if it is not wanted.
    company
        How many points at most go together in a block, of those that begin from predictions.
    """

    points: FloatArray
    tangents: bool = False
    fields: FieldSum | None = None
    start: Start | None = None
    iterations: int | None = None
    model: str = OWN
    joint: JointSum | None = None
    mesh_errors: bool = False
    saturations: float | None = None
    company: int = COMPANY

    def blocks(self, most: int | None = None) -> list[Request]:
        """Cut into blocks that depend only on the number of points, the size of rows, and `most`.

        Points that are predicted from a reference are cheaper in company: as long as no more blocks than usual are
        asked for, which is for many groups of ranks, there are several in each.
        """
        together, n = 1 if self.joint is None else self.joint.size, len(self.points)
        company = company_of(n, self.company) if self.start is not None and (most or BLOCKS) <= BLOCKS else 1
        size = together * max(1, -(-n // (together * (most or BLOCKS))), -(-company // together))
        return [replace(self, points=self.points[i : i + size]) for i in range(0, len(self.points), size)]


class Evaluate(Protocol):
    """A model as seen by a sampling method: points in, evaluations out."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""

    @property
    def differentiable(self) -> bool:
        """Whether solutions have derivatives."""

    @property
    def displacements(self) -> int:
        """Number of displacements at the start of a state, see `NodalSpace.displacements`."""

    @property
    def node_volumes(self) -> FloatArray | None:
        """Share (n_nodes,) of the body that each node represents in integrals; None if all nodes count equally."""

    def __call__(self, request: Request) -> Evaluations:
        """Evaluate all points of a request."""

    def on(self, model: str) -> Evaluate:
        """Return the evaluation of another model (mesh, solver), by name; the first one is `OWN`."""


class OfModel:
    """What an evaluation of a model says of it."""

    if TYPE_CHECKING:  # a field, or a property

        @property
        def model(self) -> ForwardModel:
            """The model."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.model.parameters

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self.model.outputs

    @property
    def differentiable(self) -> bool:
        """Whether solutions have derivatives."""
        return self.model.differentiable

    @property
    def displacements(self) -> int:
        """Number of displacements at the head of a state."""
        return displacements(self.model)


class OfEvaluate:
    """What an evaluation that stands around another one passes on from it."""

    _evaluate: Evaluate

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self._evaluate.parameters

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self._evaluate.outputs

    @property
    def differentiable(self) -> bool:
        """Whether solutions have derivatives."""
        return self._evaluate.differentiable

    @property
    def displacements(self) -> int:
        """Number of displacements at the head of a state."""
        return self._evaluate.displacements

    @property
    def node_volumes(self) -> FloatArray | None:
        """Volume (n_nodes,) of the body that each node represents, see `Evaluate`."""
        return self._evaluate.node_volumes


@dataclass(frozen=True)
class SerialEvaluate(OfModel):
    """Evaluation of a model in this process, point by point.

    Parameters
    ----------
    model
        The model.
    progress
        Told the numbers of points that finished and that failed since the last call.
    others
        Other models that a method may ask for, by name.
    node_volumes
        See `Evaluate`.
    """

    model: ForwardModel
    progress: Callable[[int, int], None] = lambda done, failed: None
    others: Mapping[str, ForwardModel] = field(default_factory=dict)
    node_volumes: FloatArray | None = None

    def on(self, model: str) -> SerialEvaluate:
        """Return the evaluation of another of the models."""
        return self if model == OWN else replace(self, model=self.others[model])

    def __call__(self, request: Request) -> Evaluations:
        """Evaluate all points of a request."""
        solver = BlockSolver(self.model, request)
        return merge([solver(block.points, self.progress) for block in request.blocks()], request.fields)


class Recorder(OfEvaluate):
    """An evaluation that keeps what it returned, with the cost.

    Attributes
    ----------
    log
        Every evaluation, in order, of all models; shared by the evaluations of the other models.
    models
        The name of the model of each evaluation.
    first
        The complete first evaluation of this model, with derivatives and fields: methods begin at the mean parameters.
    """

    def __init__(self, evaluate: Evaluate, whole: Recorder | None = None, model: str = OWN) -> None:
        self._evaluate = evaluate
        self._model = model
        self.first: Evaluations | None = None
        self.log: list[Evaluations] = [] if whole is None else whole.log
        self.models: list[str] = [] if whole is None else whole.models

    def __call__(self, request: Request) -> Evaluations:
        """Evaluate all points of a request.

        Raises
        ------
        ModelError
            If outputs are so large or small that their fourth powers overflow or underflow.
        """
        evaluations = self._evaluate(request)
        _check_magnitude(evaluations, self.outputs)
        self.first = self.first or evaluations
        # Derivatives and fields are not kept: only methods need them.
        self.log.append(replace(evaluations, tangents=None, fields=evaluations.fields[:0], sketches=None))
        self.models.append(self._model)
        return evaluations

    def on(self, model: str) -> Recorder:
        """Return the evaluation of another of the models, with the same log."""
        return Recorder(self._evaluate.on(model), self, model)

    @property
    def solves(self) -> int:
        """Number of points so far."""
        return sum(len(evaluations.points) for evaluations in self.log)

    @property
    def seconds(self) -> float:
        """Processor time (s) of all points so far."""
        return float(sum(evaluations.seconds.sum() for evaluations in self.log))


def _check_magnitude(evaluations: Evaluations, names: Sequence[str]) -> None:
    """Raise a ModelError if fourth powers of outputs, from which errors are computed, overflow or vanish."""
    sizes = np.abs(evaluations.outputs[evaluations.ok]).max(axis=0, initial=0.0)
    for name, size in zip(names, sizes.tolist(), strict=True):
        if size > LARGEST or (0 < size < 1 / LARGEST and len(evaluations.points) >= MANY):
            message = (
                f"output {name} is of size {size:.3g}, expected 0 or {1 / LARGEST:g} to {LARGEST:g}, beyond which "
                "moments overflow or vanish; use another unit, or its logarithm"
            )
            raise ModelError(message)


def _together(progress: Callable[[int, int], None], size: int, n: int) -> Callable[[int, int], None]:
    """Tell a progress of n solves, by their numbers so far, when all are finished that are solved together."""
    told = [0, 0]

    def finished(solves: int, failures: int) -> None:
        if solves % size == 0 or solves == n:
            progress(solves - told[0], failures - told[1])
            told[:] = solves, failures

    return finished


class BlockSolver:
    """Solves the blocks of one request on one group's model; collective over the group."""

    def __init__(self, model: ForwardModel, request: Request) -> None:
        self._model = model
        self._tangents, self._mesh_errors = request.tangents, request.mesh_errors
        self._saturations = request.saturations
        self._row = request.fields.on(model) if request.fields is not None else None
        self._compact = isinstance(request.fields, CompactSum)
        self._joint = request.joint.on(model) if request.joint is not None else None
        self._together = 1 if request.joint is None else request.joint.size
        self._guess = None if request.start is None else request.start.on(model)
        self._plain = Guess(iterations=request.iterations, derivatives=request.tangents)

    def _guessed(self, point: FloatArray) -> Guess:
        """What is known about the solution at a point (d,)."""
        if self._guess is None:
            return self._plain
        plain = self._plain
        return replace(self._guess(point), iterations=plain.iterations, derivatives=plain.derivatives)

    def _keep(self, rows: list[FloatArray], row: FloatArray) -> None:
        """Add a row (k, U_local) to the sum, or to the rows of a compact one."""
        if self._compact or not rows:
            rows.append(row.copy())
        else:
            # In place: these are the largest arrays, and a new one for each sample takes longer.
            rows[0] += row

    def __call__(self, points: FloatArray, progress: Callable[[int, int], None]) -> Evaluations:
        """Solve at points (n, d); the fields are complete on the group's first rank only."""
        model, n = self._model, len(points)
        m, d = len(model.outputs), len(model.parameters)
        outputs = np.full((n, m), np.nan)
        tangents = np.full((n, m, d), np.nan) if self._tangents else None
        of_meshes = _MeshErrors(n, m, saturations=self._saturations) if self._mesh_errors else None
        seconds, solving, finished = np.empty(n), np.zeros(n), _together(progress, model.together, n)
        work = np.zeros((n, len(WORK)), dtype=np.int64)
        residuals, converged = np.full(n, np.nan), np.zeros(n, dtype=bool)
        stability = np.zeros(n, dtype=np.int8)
        failures: list[Failure] = []
        rows: list[FloatArray] = []  # of each point for compact sums, otherwise their sum
        states: list[FloatArray] = []  # of an incomplete row
        solutions = model.solve_many(points, map(self._guessed, points))
        for i, point in enumerate(points):
            begin = time.process_time()
            row = None
            try:
                solution = next(solutions)
                solving[i] = time.process_time() - begin
                if isinstance(solution, SolveError):
                    raise solution
                if of_meshes is not None:
                    of_meshes.take(i, solution)
                if self._row is not None:
                    row = self._row(solution, point)
                if tangents is not None:
                    # One derivative for each parameter or for each output, whichever is fewer.
                    tangents[i] = solution.adjoint(np.eye(m)) if m < d else solution.tangent(np.eye(d)).T
            except SolveError as error:
                row = None
                lost = isinstance(error, InadmissibleError)
                failures.append(Failure(i, tuple(map(float, point)), error.reason, error.history, lost))
                work[i], stability[i] = error.work.as_array(), error.stability
                outputs[i] = np.nan if error.reached is None else error.reached
            else:
                outputs[i] = solution.outputs
                work[i] = solution.work.as_array()
                residuals[i], converged[i] = solution.residual, solution.converged
                stability[i] = solution.stability
                states += [solution.state] if self._joint is not None else []
            if self._joint is not None and (i + 1) % self._together == 0:
                row = self._joint(np.array(states)) if len(states) == self._together else None
                states = []
            if row is not None:
                self._keep(rows, row)
            seconds[i] = time.process_time() - begin - solving[i]
            finished(i + 1, len(failures))
        for some in (slice(i, i + model.together) for i in range(0, n, model.together)):
            seconds[some] += solving[some].mean()
        fields = gathered(model, np.concatenate(rows)) if rows else np.zeros((0, 0))
        if fields is None:
            fields = np.zeros((0, 0))
        return Evaluations(
            points,
            outputs,
            tangents,
            tuple(failures),
            seconds,
            work,
            residuals,
            converged,
            stability,
            fields,
            mesh_errors=None if of_meshes is None else of_meshes.errors,
            saturations=None if of_meshes is None else of_meshes.saturations,
        )


class _MeshErrors:
    """Errors of the mesh (n, m) of solutions, and what calibrates them (n, 3m + 2) where it is asked for."""

    def __init__(self, n: int, m: int, *, saturations: float | None) -> None:
        self.errors = np.full((n, m), np.nan)
        self.saturations = np.full((n, 3 * m + 2), np.nan) if saturations is not None else None
        self._spare = saturations

    def take(self, i: int, solution: Solution) -> None:
        """Take those of one; collective. Errors that cannot be calibrated remain estimates.

        Raises
        ------
        SolveError
            If the estimate is worth nothing.
        """
        found = solution.mesh_error()
        if found is not None:
            self.errors[i] = _worth(found).outputs
        if self.saturations is None or self._spare is None:
            return
        try:
            factors = solution.saturation(self._spare)
        except SolveError:
            return
        if factors is not None:
            shifts, doubts = (
                np.full(len(factors.outputs), nothing) if known is None else known
                for known, nothing in ((factors.shifts, 0.0), (factors.doubts, np.nan))
            )
            self.saturations[i] = [*factors.outputs, *shifts, *doubts, factors.state, factors.measured]


def merge(blocks: Sequence[Evaluations], fields: FieldSum | None = None) -> Evaluations:
    """Merge the blocks of a request for these fields, or several evaluations, in order."""
    merger = Merger(fields)
    for block in blocks:
        merger.add(block)
    return merger.result()


class Merger:
    """Adds blocks in order, with one sum of fields.

    Parameters
    ----------
    fields
        The sum of which the blocks are parts; None if each of them is complete.

    Attributes
    ----------
    count
        Number of blocks added so far.
    """

    def __init__(self, fields: FieldSum | None = None) -> None:
        self._compact = fields if isinstance(fields, CompactSum) else None
        self._blocks: list[Evaluations] = []
        self._fields = np.zeros((0, 0))
        self._waiting: list[tuple[FloatArray, FloatArray]] = []
        self._sketches: list[FloatArray] = []
        self._points = 0
        self.count = 0
        self._failures: list[Failure] = []

    def add(self, block: Evaluations) -> None:
        """Append the next block."""
        if block.fields.size and self._compact is None:
            self._add(block.fields)
            self._keep(block.sketches)
        elif block.fields.size:
            solved = block.points[block.ok]
            self._waiting.append((solved, block.fields.reshape(len(solved), -1, block.fields.shape[1])))
            if sum(len(points) for points, _ in self._waiting) >= TOGETHER:
                self._form()
        self._failures += [replace(f, index=f.index + self._points) for f in block.failures]
        self._points += len(block.points)
        self.count += 1
        self._blocks.append(replace(block, fields=np.zeros((0, 0)), sketches=None))

    def _form(self) -> None:
        """Add the pending rows in one product: the sum is read and written only once."""
        if self._compact is not None and self._waiting:
            points, rows = (np.concatenate(parts) for parts in zip(*self._waiting, strict=True))
            self._add(self._compact.total(points, rows))
            self._keep(self._compact.sketch(rows))
            self._waiting.clear()

    def _add(self, part: FloatArray) -> None:
        self._fields = part if self._fields.size == 0 else self._fields + part

    def _keep(self, sketches: FloatArray | None) -> None:
        if sketches is not None:
            self._sketches.append(sketches)

    def result(self) -> Evaluations:
        """Return everything added so far as one."""
        self._form()

        def joined(pick: Callable[[Evaluations], FloatArray | None]) -> Iterator[FloatArray]:
            for block in self._blocks:
                part = pick(block)
                if part is not None:
                    yield part

        tangents, mesh_errors = list(joined(lambda b: b.tangents)), list(joined(lambda b: b.mesh_errors))
        saturations = list(joined(lambda b: b.saturations))
        return Evaluations(
            np.concatenate(list(joined(lambda b: b.points))),
            np.concatenate(list(joined(lambda b: b.outputs))),
            np.concatenate(tangents) if tangents else None,
            tuple(self._failures),
            np.concatenate(list(joined(lambda b: b.seconds))),
            np.concatenate([b.work for b in self._blocks]),
            np.concatenate(list(joined(lambda b: b.residuals))),
            np.concatenate([b.converged for b in self._blocks]),
            np.concatenate([b.stability for b in self._blocks]),
            self._fields,
            np.concatenate(self._sketches) if self._sketches else None,
            np.concatenate(mesh_errors) if mesh_errors else None,
            np.concatenate(saturations) if saturations else None,
        )


def _worth(found: MeshError) -> MeshError:
    """Return an estimate of the error of the mesh.

    Raises
    ------
    SolveError
        If it is worth nothing.
    """
    if not found.nonlinearity < 1:
        message = "richer elements move the body too far for a few Newton steps: the mesh is much too coarse"
        raise SolveError(message)
    return found
