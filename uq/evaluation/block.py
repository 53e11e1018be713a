"""Blocks of a request, solved by one model, and added up in order."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from forward.model import WORK, FloatArray, ForwardModel, Guess, Solution, SolveError, gathered
from uq.evaluation.request import Evaluations, Failure, FieldSum, Request, audited, calibration

TOGETHER = 16  # realisations whose parts of a compact sum are formed at once


class BlockSolver:
    """Solves the blocks of one request on one group's model; collective over the group."""

    def __init__(self, model: ForwardModel, request: Request) -> None:
        self._model, self._request = model, request
        self._row = request.fields.on(model) if request.fields is not None else None
        self._compact = request.fields is not None and request.fields.compact
        self._joint = request.joint.on(model) if request.joint is not None else None
        self._together = 1 if request.joint is None else request.joint.size
        self._guess = None if request.start is None else request.start.on(model)
        self._audited = audited(request.points)
        self._plain = Guess(iterations=request.iterations, derivatives=request.tangents)

    def _guessed(self, point: FloatArray) -> Guess:
        """What is known about the solution at a point (d,)."""
        plain = replace(self._plain, audit=self._audited(point))
        if self._guess is None:
            return plain
        guess = self._guess(point)
        return replace(plain, state=guess.state, reference=guess.reference)

    def __call__(self, points: FloatArray, progress: Callable[[int, int], None]) -> Evaluations:
        """Solve at points (n, d); the fields are complete on the group's first rank only."""
        model, n = self._model, len(points)
        m, d = len(model.outputs), len(model.parameters)
        outputs = np.full((n, m), np.nan)
        tangents = np.full((n, m, d), np.nan) if self._request.tangents else None
        of_meshes = _MeshErrors(n, m, self._request.saturations) if self._request.mesh_errors else None
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
                lost = error.inadmissible
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
            if row is not None and (self._compact or not rows):
                rows.append(row.copy())
            elif row is not None:
                rows[0] += row  # in place: these are the largest arrays, and a new one for each sample takes longer
            seconds[i] = time.process_time() - begin - solving[i]
            finished(i + 1, len(failures))
        for some in (slice(i, i + model.together) for i in range(0, n, model.together)):
            seconds[some] += solving[some].mean()
        fields = gathered(model, np.concatenate(rows)) if rows else None
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
            np.zeros((0, 0)) if fields is None else fields,
            mesh_errors=None if of_meshes is None else of_meshes.errors,
            saturations=None if of_meshes is None else of_meshes.saturations,
        )


class _MeshErrors:
    """Errors of the mesh (n, m) of solutions, and what calibrates them (n,) where it is asked for."""

    def __init__(self, n: int, m: int, spare: float | None) -> None:
        self.errors = np.full((n, m), np.nan)
        self.saturations = np.full(n, np.nan, calibration(m)) if spare is not None else None
        self._spare = spare

    def take(self, i: int, solution: Solution) -> None:
        """Take those of one; collective. Errors that cannot be calibrated remain estimates.

        Raises `SolveError` if the estimate is worth nothing.
        """
        found = solution.mesh_error()
        if found is not None:
            if not found.nonlinearity < 1:
                reason = "richer elements move the body too far for a few Newton steps: the mesh is much too coarse"
                raise SolveError(reason)
            self.errors[i] = found.outputs
        if self.saturations is None or self._spare is None:
            return
        row = self.saturations[i]
        row["hidden"] = 0.0
        try:
            factors = solution.saturation(self._spare)
        except SolveError:
            return
        if factors is not None:
            row["factors"], row["state"], row["measured"] = factors.outputs, factors.state, factors.measured
            row["unstable"] = factors.unstable
            row["shifts"] = 0.0 if factors.shifts is None else factors.shifts
            row["doubts"] = np.nan if factors.doubts is None else factors.doubts
            if factors.hidden is not None:
                row["hidden"] = factors.hidden


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
        self._compact = fields if fields is not None and fields.compact else None
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
            self._sum(block.fields, block.sketches)
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
            self._sum(self._compact.total(points, rows), self._compact.sketch(rows))
            self._waiting.clear()

    def _sum(self, part: FloatArray, sketches: FloatArray | None) -> None:
        self._fields = part if self._fields.size == 0 else self._fields + part
        if sketches is not None:
            self._sketches.append(sketches)

    def result(self) -> Evaluations:
        """Return everything added so far as one."""
        self._form()
        parts = [block.rows for block in self._blocks]
        names = dict.fromkeys(name for part in parts for name in part)
        rows = {name: np.concatenate([part[name] for part in parts if name in part]) for name in names}
        sketches = np.concatenate(self._sketches) if self._sketches else None
        return Evaluations.of(rows, self._failures, self._fields, sketches)


def _together(progress: Callable[[int, int], None], size: int, n: int) -> Callable[[int, int], None]:
    """Tell a progress of n solves, by their numbers so far, when all are finished that are solved together."""
    told = [0, 0]

    def finished(solves: int, failures: int) -> None:
        if solves % size == 0 or solves == n:
            progress(solves - told[0], failures - told[1])
            told[:] = solves, failures

    return finished
