"""What methods ask of a model at many points, and what they are told: requests and evaluations.

Work is cut into blocks of fixed size; sums of fields are formed in index order inside a block and the blocks are added
in order. So the result does not depend on which rank computed which block.
"""

from __future__ import annotations

import hashlib
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from forward.model import WORK, FloatArray, ForwardModel, Guess, ReferenceSolution, Solution, scattered
from uq.inputs.coordinates import Coordinates

OWN = ""  # name of the first model of an evaluation
COMPANY, FEW = 16, 16  # points in a block that begin from predictions, and blocks that there are before it is so large
AUDITED, ENOUGH = 0.005, 64  # share of samples whose path is followed; from how many samples on at least one is
BLOCKS = 128  # an evaluation is cut into at most this many blocks, unless another number is asked for

ON_REQUEST = ("tangents", "mesh_errors", "saturations")
# Arrays with a row for each point.
ROWS = ("points", "outputs", "seconds", "work", "residuals", "converged", "stability", *ON_REQUEST)


def calibration(outputs: int) -> np.dtype[Any]:
    """Names and sizes of what calibrates errors of the mesh.

    `factors` of the errors of outputs (m,); `shifts`, what is added then; `doubts`, how far that may be wrong; what is
    `hidden` by the facets of a curved surface; the factor of the `state`; whether they were `measured` here (1) or are
    typical ones (0); and whether the equilibrium is `unstable` on a finer mesh (1).
    """
    whole = [(name, float, (outputs,)) for name in ("factors", "shifts", "doubts", "hidden")]
    return np.dtype([*whole, ("state", float), ("measured", float), ("unstable", float)])


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
        compact `FieldSum`, the rows of these points themselves, one point after the other.
    sketches
        What a compact `FieldSum` keeps of each point that did not fail (n_ok, r, k), once its blocks are merged.
    mesh_errors
        Estimated errors of the mesh (n, m) if requested, NaN where a solve failed or nothing is estimated.
    saturations
        What calibrates estimated errors (n,), where it was asked for, by the names of `calibration`; NaN where there is
        nothing.
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
    saturations: NDArray[Any] | None = None

    @property
    def rows(self) -> dict[str, NDArray[Any]]:
        """Arrays with a row for each point, by their names."""
        return {name: array for name in ROWS if (array := getattr(self, name)) is not None}

    @classmethod
    def of(
        cls,
        rows: Mapping[str, Any],
        failures: Sequence[Failure],
        fields: FloatArray,
        sketches: FloatArray | None = None,
    ) -> Evaluations:
        """Return evaluations from arrays with a row for each point, by their names."""
        known: dict[str, Any] = {**dict.fromkeys(ON_REQUEST), **rows}
        return cls(**known, failures=tuple(failures), fields=fields, sketches=sketches)

    @property
    def joined(self) -> NDArray[np.bool_]:
        """Which states (n,) a path of loads from rest leads to without a jump, as far as is known."""
        return np.asarray(self.counted("snaps") == 0)

    def counted(self, name: str) -> NDArray[np.int64]:
        """Return one of the counts (n,) in `work`; zeros where it was not counted."""
        column = WORK.index(name)
        return self.work[:, column] if column < self.work.shape[1] else np.zeros(len(self.work), dtype=np.int64)

    @property
    def ok(self) -> NDArray[np.bool_]:
        """Which points (n,) have an answer."""
        good = np.ones(len(self.points), dtype=bool)
        good[[failure.index for failure in self.failures]] = False
        return good

    @property
    def why(self) -> str:
        """Why some points have no answer, the first three reasons; empty if all have one."""
        return "; ".join(sorted({failure.reason for failure in self.failures})[:3])


class FieldSum(Protocol):
    """A quantity of each realisation's state that is summed while realisations are computed.

    The terms of a `compact` one have many rows that follow from a few rows of each realisation: blocks hold those few.
    `on` returns these few; the sum is formed when blocks are added, so that files and messages stay small.
    """

    compact: ClassVar[bool] = False

    @abstractmethod
    def on(self, model: ForwardModel) -> Callable[[Solution, FloatArray], FloatArray]:
        """Return the function (solution, parameters) → rows (k, U_local) to be summed, for one group's model."""

    def total(self, points: FloatArray, rows: FloatArray) -> FloatArray:
        """Return the sum (K, U) over some realisations, from their parameters (n, d) and their rows (n, r, U)."""
        return np.asarray(rows.sum(axis=0))

    def sketch(self, rows: FloatArray) -> FloatArray | None:
        """Return a few numbers (n, r, k) to be kept of the rows (n, r, U) of some realisations; or None."""
        return None


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

    @property
    def reference(self) -> ReferenceSolution:
        """The reference, with its whole state in canonical order."""

    def on(self, model: ForwardModel) -> Callable[[FloatArray], Guess]:
        """Return the function parameters (d,) → predicted state (U_local,) and its reference, for one group's model."""


@dataclass(frozen=True)
class Prediction:
    """A prediction of the state that is linear in the coordinates, with the factor at the reference.

    Attributes
    ----------
    reference
        The point of the expansion.
    slopes
        Derivatives (d, U) of the state along the coordinates; empty (0, U) if the solver starts from the state there.
    coordinates
        The coordinates.
    """

    reference: ReferenceSolution
    slopes: FloatArray
    coordinates: Coordinates

    def on(self, model: ForwardModel) -> Callable[[FloatArray], Guess]:
        """Return the function parameters (d,) → predicted state (U_local,) and its reference, for one group's model."""
        reference, slopes = on_group(model, self.reference), scattered(model, self.slopes)
        state, here = reference.state, self.coordinates.of(reference.parameters)
        if len(slopes) == 0:
            return lambda _: Guess(state, reference)
        return lambda parameters: Guess(state + (self.coordinates.of(parameters) - here) @ slopes, reference)


def on_group(model: ForwardModel, whole: ReferenceSolution) -> ReferenceSolution:
    """Return a reference with the part of its state that a group's model has on this rank."""
    return replace(whole, state=scattered(model, whole.state[None, :])[0])


def company_of(samples: int, most: int = COMPANY) -> int:
    """How many samples that begin from predictions are in one block, of so many in all and at most."""
    return min(most, max(samples // FEW, 1))


def _draw(point: FloatArray) -> float:
    """Return a pseudo-random number in [0, 1) that depends only on a point (d,)."""
    digest = hashlib.sha256(b"audit" + np.ascontiguousarray(point, dtype=float).tobytes()).digest()
    return int.from_bytes(digest[:8], "little") / 2.0**64


def audited(points: FloatArray) -> Callable[[FloatArray], bool]:
    """Return which points (d,) of a request for points (n, d) are audited at random (`Guess.audit`).

    That depends on the points alone, so on no ranks and no blocks.
    """
    most = AUDITED
    if len(points) >= ENOUGH:
        most = max(most, min(map(_draw, points)))
    return lambda point: _draw(point) <= most


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
    at_once
        How many go together in a block in any case: what a model without states evaluates at once.
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
    at_once: int = 1

    def of(self, model: ForwardModel, name: str) -> Request:
        """Return what is asked of a model, by its name."""
        return replace(self, model=name, at_once=model.together if model.space is None else 1)

    def blocks(self, most: int | None = None) -> list[Request]:
        """Cut into blocks that depend only on the number of points, the size of rows, and `most`.

        Points that are predicted from a reference are cheaper in company: as long as no more blocks than usual are
        asked for, which is for many groups of ranks, there are several in each.
        """
        together, n = 1 if self.joint is None else self.joint.size, len(self.points)
        company = company_of(n, self.company) if self.start is not None and (most or BLOCKS) <= BLOCKS else self.at_once
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
