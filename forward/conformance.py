"""A check of the derivatives of any `ForwardModel`: every model inherits it as a test.

Taylor: ψ(ω + hδ) − ψ(ω) − h ψ'δ falls with h², unless the tangent ψ'δ is wrong: its error is what the remainder divided
by h tends to. Adjoint: ⟨w, J v⟩ = ⟨Jᵀw, v⟩. A solution must also give the same derivatives after the model has solved
elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from forward.model import DerivativeError, FloatArray, ForwardModel, Solution

STEPS = tuple(2.0**-k for k in range(4, 11))
STATE = "state"

FAULT = 1e-5  # relative error of a tangent above which it is wrong
EXACT = 1e-10  # relative error allowed in linear algebra
ABOVE_ROUNDING = 100  # how much larger than rounding a remainder is that has an order
WINDOW = 3  # steps from which the error of a tangent is extrapolated


@dataclass(frozen=True)
class Conformance:
    """What was found about the derivatives of a model at one parameter vector.

    Columns are the m outputs and, where there is one, the norm of (this rank's part of) the state.

    Attributes
    ----------
    outputs
        Names of the columns.
    directions
        Names of the k directions.
    orders
        Orders (k, columns) of the Taylor remainders, 2 for correct tangents, at the smallest steps where the remainder
        is above rounding; NaN where it never is (an output that is linear in the parameters). A second derivative that
        vanishes, or nearly so, gives another order.
    faults
        Relative errors (k, columns) of the tangents, extrapolated from Taylor remainders; 0 where these are rounding.
    adjoint
        |⟨w, J v⟩ − ⟨Jᵀw, v⟩| (k, m) for the k directions v and the m unit weights w, relative to the largest change of
        the output along the directions plus 1 % of its size.
    linearity
        Violation of linearity by tangent and adjoint, in the same measure.
    stale
        Change of the derivatives of a solution while the model solves elsewhere, in the same measure.
    changed
        What changed in a solution after it was made: solutions must be immutable.
    """

    outputs: tuple[str, ...]
    directions: tuple[str, ...]
    orders: FloatArray
    faults: FloatArray
    adjoint: FloatArray
    linearity: float
    stale: float
    changed: tuple[str, ...]

    def mistakes(self) -> tuple[str, ...]:
        """Say what is wrong, one line each; empty for a model that conforms."""
        found = []
        for k, direction in enumerate(self.directions):
            for i, output in enumerate(self.outputs):
                fault = self.faults[k, i]
                if not fault <= FAULT:
                    order = f"Taylor remainder of order {self.orders[k, i]:.2f}"
                    found.append(f"tangent of '{output}' along {direction}: off by {fault:.1e} of itself ({order})")
                if output != STATE and not self.adjoint[k, i] <= EXACT:
                    off = f"off by {self.adjoint[k, i]:.1e}, expected ≤ {EXACT}"
                    found.append(f"adjoint of '{output}' along {direction}: {off}")
        if not self.linearity <= EXACT:
            found.append(f"tangent or adjoint is not linear: off by {self.linearity:.1e}, expected ≤ {EXACT}")
        if not self.stale <= EXACT:
            found.append(f"derivatives change after another solve: by {self.stale:.1e}, expected ≤ {EXACT}")
        changed = (
            f"{what} of a solution can change after it was made, expected to be immutable" for what in self.changed
        )
        return (*found, *changed)

    def require(self) -> None:
        """Raise an `AssertionError` that lists the mistakes, if there are any."""
        mistakes = self.mistakes()
        if mistakes:
            raise AssertionError("\n".join(mistakes))


def check_derivatives(
    model: ForwardModel,
    parameters: ArrayLike,
    scale: ArrayLike,
    *,
    directions: ArrayLike | None = None,
    steps: tuple[float, ...] = STEPS,
    accuracy: float = 1e-11,
    seed: int = 0,
) -> Conformance:
    """Check tangents and adjoints of a model; collective over its ranks, each of which checks its part of the state.

    Costs one solve for each step along each direction, and four more.

    Parameters
    ----------
    model
        Any differentiable model.
    parameters
        Parameter vector (d,) at which to check. Outputs must be smooth there: the place of a maximum must not jump
        within the largest step.
    scale
        Changes (d,) of the parameters that matter, such as their standard deviations; the unit of the steps.
    directions
        Directions (k, d) in units of `scale`; by default along each parameter, and a random one. Give a few random
        ones for a model of many parameters.
    steps
        Lengths of the steps, falling, at least 3.
    accuracy
        Relative accuracy of outputs and state: about the tolerance of an iterative solver. An output that is linear in
        the parameters leaves a remainder of this size, and passes.
    seed
        Of the random directions.

    Raises
    ------
    DerivativeError
        If the model has no derivatives.
    SolveError
        If the model has no answer within the steps.
    ValueError
        If there are too few steps.
    """
    if not model.differentiable:
        raise DerivativeError("the model has no derivatives to check")
    if len(steps) < WINDOW:
        raise ValueError(f"{len(steps)} steps given, expected at least {WINDOW}")
    rng = np.random.default_rng(seed)
    point, unit = np.array(parameters, dtype=float), np.array(scale, dtype=float)
    if directions is None:
        directions = np.vstack([np.eye(point.size), rng.uniform(-1, 1, point.size)])
    along = np.atleast_2d(np.asarray(directions, dtype=float)) * unit

    base = model.solve(point.copy())
    outputs, state = np.array(base.outputs), np.array(base.state)
    tangents = _rows([base.tangent(direction) for direction in along], "tangent", outputs.size)
    gradients = _rows([base.adjoint(weights) for weights in np.eye(outputs.size)], "adjoint", point.size)
    state_tangents = _rows([base.state_tangent(direction) for direction in along], "state_tangent", state.size)

    values, slopes = np.hstack([outputs, state]), np.hstack([tangents, state_tangents])
    changes = np.empty((len(steps), *slopes.shape))
    for j, step in enumerate(steps):
        for k, direction in enumerate(along):
            near = model.solve(point + step * direction)
            changes[j, k] = np.append(near.outputs, near.state) - values
    size = _columns(np.abs(values) + np.abs(changes).max(axis=(0, 1)), outputs.size)
    orders, faults = _taylor(np.array(steps), changes, slopes, outputs.size, accuracy * size)

    typical = np.abs(tangents).max(axis=0) + 0.01 * size[: outputs.size]
    typical[typical == 0] = 1
    mix = rng.uniform(-1, 1, len(along))
    weights = rng.uniform(-1, 1, outputs.size) / typical
    bend = np.abs(base.tangent(mix @ along) - mix @ tangents) / typical
    twist = np.abs((base.adjoint(weights) - weights @ gradients) @ along.T)
    stale, changed = _lasting(
        model, point, point + steps[0] * along[-1], along, tangents, state_tangents, gradients, typical
    )

    return Conformance(
        outputs=(*model.outputs, STATE)[: size.size],
        directions=tuple(_name(row, model.parameters) for row in along),
        orders=orders,
        faults=faults,
        adjoint=np.abs(tangents - along @ gradients.T) / typical,
        linearity=float(max(bend.max(initial=0.0), twist.max(initial=0.0))),
        stale=stale,
        changed=changed,
    )


def _columns(values: FloatArray, outputs: int) -> FloatArray:
    """Sizes of the outputs and, where there is one, the norm of the state, along the last axis."""
    parts = [np.abs(values[..., :outputs]), np.linalg.norm(values[..., outputs:], axis=-1, keepdims=True)]
    return np.concatenate(parts if values.shape[-1] > outputs else parts[:1], axis=-1)


def _taylor(
    steps: FloatArray, changes: FloatArray, slopes: FloatArray, outputs: int, accuracy: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the orders and the faults (k, columns), from changes (s, k, values) along directions of given slopes."""
    scaled = changes / steps[:, None, None] - slopes
    remainders = _columns(scaled, outputs) * steps[:, None, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        orders = np.log(remainders[:-1] / remainders[1:]) / np.log(steps[:-1] / steps[1:])[:, None, None]
    count = np.logical_and.accumulate(remainders > ABOVE_ROUNDING * accuracy, axis=0).sum(axis=0)
    last = np.take_along_axis(orders, np.maximum(count - 2, 0)[None], axis=0)[0]

    windows = np.array([steps[j : j + WINDOW] for j in range(len(steps) - WINDOW + 1)])
    # Weights of the polynomial through the steps of a window at step zero.
    weights = np.array([[np.prod([b / (b - a) for b in w if b != a]) for a in w] for w in windows])
    limits = np.array([np.tensordot(w, scaled[j : j + WINDOW], axes=1) for j, w in enumerate(weights)])
    allowed = 10 * np.abs(weights / windows).sum(axis=1)[:, None, None] * accuracy
    excess = _columns(limits, outputs) - allowed
    where = np.maximum(count - WINDOW, 0)
    defect = np.maximum(np.take_along_axis(excess, where[None], axis=0)[0], 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        faults = np.where(defect == 0, 0, defect / _columns(slopes, outputs))
    return np.where(count < 2, np.nan, last), faults


def _lasting(
    model: ForwardModel,
    point: FloatArray,
    elsewhere: FloatArray,
    along: FloatArray,
    tangents: FloatArray,
    state_tangents: FloatArray,
    gradients: FloatArray,
    typical: FloatArray,
) -> tuple[float, tuple[str, ...]]:
    """Solve and differentiate elsewhere while solutions wait; return how far derivatives move, and what changes."""
    vector = point.copy()
    waiting, asked = model.solve(vector), model.solve(point.copy())
    with suppress(ValueError):
        asked.tangent(along[0])[...] = np.nan  # arrays that a solution returns are no part of it
    before = [(solution, np.array(solution.outputs), np.array(solution.state)) for solution in (waiting, asked)]
    vector[:] = elsewhere
    other = model.solve(elsewhere)
    extent = np.abs(state_tangents).max(initial=0.0) or 1.0
    apart = [0.0]
    for solution, _, _ in before:
        other.tangent(along[0])
        for direction, tangent, state_tangent in zip(along, tangents, state_tangents, strict=True):
            apart += list(np.abs(solution.tangent(direction) - tangent) / typical)
            apart += list(np.abs(solution.state_tangent(direction) - state_tangent) / extent)
        other.tangent(along[0])
        for weights, gradient, unit in zip(np.eye(len(typical)), gradients, typical, strict=True):
            apart += list(np.abs((solution.adjoint(weights) - gradient) @ along.T) / unit)
    changed = {what for solution, outputs, state in before for what in _changed(solution, outputs, state)}
    return float(np.max(apart)), tuple(sorted(changed))


def _changed(solution: Solution, outputs: FloatArray, state: FloatArray) -> Iterator[str]:
    """Try to write into a solution; name what is no longer what it was."""
    with suppress(ValueError):
        solution.outputs[...] = np.nan
    with suppress(ValueError):
        solution.state[...] = np.nan
    if not np.array_equal(solution.outputs, outputs):
        yield "outputs"
    if not np.array_equal(solution.state, state):
        yield STATE


def _rows(rows: list[FloatArray], what: str, length: int) -> FloatArray:
    for row in rows:
        if np.shape(row) != (length,):
            raise AssertionError(f"{what} returned shape {np.shape(row)}, expected ({length},)")
    return np.array(rows, dtype=float).reshape(len(rows), length)


def _name(direction: FloatArray, parameters: tuple[str, ...]) -> str:
    moved = [name for name, component in zip(parameters, direction, strict=True) if component != 0]
    return f"'{moved[0]}'" if len(moved) == 1 else f"a direction of {len(moved)} parameters"
