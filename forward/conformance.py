"""A check of the derivatives of any `ForwardModel`: every model inherits it as a test.

Taylor: ‖ψ(ω + hδ) − ψ(ω) − h ψ'(ω)δ‖ falls with h². Adjoint: ⟨w, J v⟩ = ⟨Jᵀw, v⟩. Both hold for wrong derivatives of a
stale state only by accident, so a solution must also give the same derivatives after the model has solved elsewhere.
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

ORDER = 2.0, 0.1  # of Taylor remainders: expected, and how far off it may be
SETTLED = 0.05  # a higher order is right where it no longer changes: the second derivative vanishes there
EXACT = 1e-10  # what linear algebra must fulfil
ABOVE_NOISE = 100  # a remainder that is this much larger than the noise has an order


@dataclass(frozen=True)
class Conformance:
    """What was found about the derivatives of a model at one parameter vector.

    The columns of Taylor remainders are the m outputs and, where there is one, the norm of (this rank's part of) the
    state.

    Attributes
    ----------
    outputs
        Names of the columns.
    directions
        Names of the k directions.
    steps
        Lengths (s,) of the steps along them, falling.
    remainders
        Taylor remainders (s, k, columns).
    noise
        Remainders (columns,) from which on an order can be told.
    adjoint
        |⟨w, J v⟩ − ⟨Jᵀw, v⟩| (k, m) for the k directions v and the m unit weights w, relative to the largest change of
        the output along the directions plus 1 % of its size.
    linearity
        Violation of linearity by tangent and adjoint, in the same measure.
    stale
        Change of the derivatives of a solution while the model solves elsewhere, in the same measure.
    changed
        What changed of a solution after it was made, expected to be immutable.
    """

    outputs: tuple[str, ...]
    directions: tuple[str, ...]
    steps: FloatArray
    remainders: FloatArray
    noise: FloatArray
    adjoint: FloatArray
    linearity: float
    stale: float
    changed: tuple[str, ...]

    @property
    def orders(self) -> FloatArray:
        """Orders (k, columns) of the remainders at the smallest steps where there is one; NaN where all are noise."""
        return self._last_orders()[0]

    def mistakes(self) -> tuple[str, ...]:
        """Say what is wrong, one line each; nothing for a model that conforms."""
        return tuple(self._mistakes())

    def require(self) -> None:
        """Raise an `AssertionError` that lists the mistakes, if there are any."""
        mistakes = self.mistakes()
        if mistakes:
            raise AssertionError("\n".join(mistakes))

    def _last_orders(self) -> tuple[FloatArray, FloatArray]:
        """Return the order at the smallest steps that have one, and at the steps before; NaN where there is none."""
        usable = np.logical_and.accumulate(self.remainders > self.noise, axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = np.log(self.remainders[:-1] / self.remainders[1:])
        orders = ratios / np.log(self.steps[:-1] / self.steps[1:])[:, None, None]
        count = usable.sum(axis=0)  # the orders 0 … count−2 are usable
        absent = np.full((1, *count.shape), np.nan)
        padded = np.concatenate([absent, absent, orders])
        before = np.maximum(count - 1, 0)
        return np.take_along_axis(padded, count[None], axis=0)[0], np.take_along_axis(padded, before[None], axis=0)[0]

    def _mistakes(self) -> Iterator[str]:
        last, before = self._last_orders()
        expected, slack = ORDER
        for k, direction in enumerate(self.directions):
            for i, output in enumerate(self.outputs):
                order, name = last[k, i], f"tangent of '{output}' along {direction}"
                settled = order > expected and abs(order - before[k, i]) <= SETTLED
                if not np.isfinite(self.remainders[:, k, i]).all():
                    yield f"{name}: not a number"
                elif abs(order - expected) > slack and not settled:
                    yield f"{name}: Taylor remainder of order {order:.2f}, expected {expected} ± {slack}"
                if output != STATE and not self.adjoint[k, i] <= EXACT:
                    off = f"off by {self.adjoint[k, i]:.1e}, expected ≤ {EXACT}"
                    yield f"adjoint of '{output}' along {direction}: {off}"
        if not self.linearity <= EXACT:
            yield f"tangent or adjoint is not linear: off by {self.linearity:.1e}, expected ≤ {EXACT}"
        if not self.stale <= EXACT:
            yield f"derivatives change after another solve: by {self.stale:.1e}, expected ≤ {EXACT}"
        for what in self.changed:
            yield f"{what} of a solution can change after it was made, expected to be immutable"


def check_derivatives(
    model: ForwardModel,
    parameters: ArrayLike,
    scale: ArrayLike,
    *,
    directions: ArrayLike | None = None,
    steps: tuple[float, ...] = STEPS,
    noise: float = 1e-11,
    seed: int = 0,
) -> Conformance:
    """Check tangents and adjoints of a model; collective over its ranks, each of which checks its part of the state.

    Costs one solve for each step along each direction, and four more.

    Parameters
    ----------
    model
        Any differentiable model.
    parameters
        Where (d,). Outputs must be smooth there: the place of a maximum must not jump within the largest step.
    scale
        Changes (d,) of the parameters that matter, such as their standard deviations; the unit of the steps.
    directions
        Directions (k, d) in units of `scale`; by default along each parameter, and a random one. Give a few random
        ones for a model of many parameters.
    steps
        Lengths of the steps, falling.
    noise
        What outputs and state are exact to, relative to their size: about the tolerance of an iterative solver. An
        output that is linear in the parameters leaves a remainder of this size, and passes.
    seed
        Of the random directions.

    Raises
    ------
    DerivativeError
        If the model has no derivatives.
    SolveError
        If the model has no answer within the steps.
    """
    if not model.differentiable:
        raise DerivativeError("the model has no derivatives to check")
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

    size = np.append(np.abs(outputs), np.linalg.norm(state))
    remainders = np.empty((len(steps), len(along), size.size))
    for j, step in enumerate(steps):
        for k, direction in enumerate(along):
            near = model.solve(point + step * direction)
            remainders[j, k, :-1] = np.abs(near.outputs - outputs - step * tangents[k])
            remainders[j, k, -1] = np.linalg.norm(near.state - state - step * state_tangents[k])
            size = np.maximum(size, np.append(np.abs(near.outputs), np.linalg.norm(near.state)))

    typical = np.abs(tangents).max(axis=0) + 0.01 * size[:-1]
    typical[typical == 0] = 1
    mix = rng.uniform(-1, 1, len(along))
    weights = rng.uniform(-1, 1, outputs.size) / typical
    bend = np.abs(base.tangent(mix @ along) - mix @ tangents) / typical
    twist = np.abs((base.adjoint(weights) - weights @ gradients) @ along.T)
    stale, changed = _lasting(
        model, point, point + steps[0] * along[-1], along, tangents, state_tangents, gradients, typical
    )

    columns = slice(None) if state.size else slice(-1)
    return Conformance(
        outputs=(*model.outputs, STATE)[columns],
        directions=tuple(_name(row, model.parameters) for row in along),
        steps=np.array(steps),
        remainders=remainders[:, :, columns],
        noise=ABOVE_NOISE * noise * size[columns],
        adjoint=np.abs(tangents - along @ gradients.T) / typical,
        linearity=float(max(bend.max(initial=0.0), twist.max(initial=0.0))),
        stale=stale,
        changed=changed,
    )


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
        asked.tangent(along[0])[...] = np.nan  # what a solution gives away is no part of it
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
    for what, expected in (("outputs", outputs), (STATE, state)):
        with suppress(ValueError):
            getattr(solution, what)[...] = np.nan
        if not np.array_equal(getattr(solution, what), expected):
            yield what


def _rows(rows: list[FloatArray], what: str, length: int) -> FloatArray:
    for row in rows:
        if np.shape(row) != (length,):
            message = f"{what} returned shape {np.shape(row)}, expected ({length},)"
            raise AssertionError(message)
    return np.array(rows, dtype=float).reshape(len(rows), length)


def _name(direction: FloatArray, parameters: tuple[str, ...]) -> str:
    moved = [name for name, component in zip(parameters, direction, strict=True) if component != 0]
    return f"'{moved[0]}'" if len(moved) == 1 else f"a direction of {len(moved)} parameters"
