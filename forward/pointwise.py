"""Models that solve one point at a time, and one made of a plain Python function."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import repeat
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from forward.model import (
    DerivativeError,
    FloatArray,
    ForwardModel,
    Guess,
    ModelError,
    Solution,
    SolveError,
    Stability,
    Work,
    displacements,
)


class OneByOne:
    """`solve_many` for models that solve one point at a time."""

    @property
    def together(self) -> int:
        """One."""
        return 1

    def solve_many(
        self: ForwardModel, points: FloatArray, guesses: Iterable[Guess | None] | None = None
    ) -> Iterator[Solution | SolveError]:
        """Yield the solution at each of points (n, d), or why there is none; each is solved on demand."""
        for point, guess in zip(points, guesses or repeat(None), strict=False):
            try:
                found: Solution | SolveError = self.solve(point, guess)
            except SolveError as error:
                found = error
            yield found


class OfModel:
    """What is said of the one `model` that something is made of."""

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
        """Whether solutions have tangents and adjoints."""
        return self.model.differentiable

    @property
    def displacements(self) -> int:
        """Number of displacements at the head of a state."""
        return displacements(self.model)


class Known(NamedTuple):
    """The values of a solution, as of `Solution`, without its linearisation."""

    outputs: FloatArray
    state: FloatArray
    residual: float
    converged: bool
    stability: Stability
    work: Work


class ExplicitSolution:
    """A solution without a mesh, of which the derivatives (m, d) of the outputs are known, or quickly found."""

    residual, converged, stability = 0.0, True, Stability.NOT_TESTED

    @property
    def state(self) -> FloatArray:
        """No state: an empty array."""
        return np.empty(0)

    @property
    def jacobian(self) -> FloatArray:
        """Derivatives (m, d) of the outputs."""
        raise NotImplementedError

    def tangent(self, direction: FloatArray) -> FloatArray:
        """Return the derivative of the outputs (m,) along `direction` (d,), or (k, m) for k of them."""
        return np.asarray(direction) @ self.jacobian.T

    def adjoint(self, weights: FloatArray) -> FloatArray:
        """Return the gradient (d,) of the outputs weighted by `weights` (m,), or (k, d) for k of them."""
        return np.asarray(weights) @ self.jacobian

    def state_tangent(self, direction: FloatArray) -> FloatArray:
        """No state: empty."""
        return np.empty((*np.shape(direction)[:-1], 0))

    def mesh_error(self, spare: float = math.inf) -> None:
        """No mesh."""
        return

    saturation = mesh_error


def real(returned: object, what: str) -> FloatArray:
    """Return what a user's function has returned as an array of real numbers.

    Raises
    ------
    ModelError
        If it is not such an array: text, complex numbers, rows of different lengths.
    """
    try:
        found = np.asarray(returned)
        if found.dtype.kind in "biufO":
            return found.astype(float)
        given = {"c": "complex numbers", "U": "text", "S": "bytes"}.get(found.dtype.kind, str(found.dtype))
    except (TypeError, ValueError, OverflowError):
        given = f"{type(returned).__name__} that holds more than numbers, or rows of different lengths"
    raise ModelError(f"the model's {what} returned {given}, expected real numbers")


@dataclass(frozen=True)
class FunctionModel(OneByOne):
    """A forward model made of a Python function of a parameter vector.

    Parameters
    ----------
    function
        (d,) → (m,), or a number when there is one output. It may raise `SolveError`.
    parameters, outputs
        Names.
    jacobian
        (d,) → (m, d); without it, solutions have no derivatives.
    """

    function: Callable[[FloatArray], ArrayLike]
    parameters: tuple[str, ...]
    outputs: tuple[str, ...]
    jacobian: Callable[[FloatArray], ArrayLike] | None = None

    space = None  # no states

    @property
    def differentiable(self) -> bool:
        """Whether a jacobian was given."""
        return self.jacobian is not None

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> FunctionSolution:
        """Evaluate the function at `parameters` (d,); there is no state to guess, and nothing to iterate on."""
        # Copies: neither the caller nor the function can change a solution afterwards.
        point = np.array(parameters, dtype=float)
        point.flags.writeable = False
        outputs = np.array(real(self.function(point), "function"), ndmin=1)
        if outputs.shape != (len(self.outputs),):
            raise ModelError(f"the model's function returned shape {outputs.shape}, expected ({len(self.outputs)},)")
        if not np.isfinite(outputs).all():
            raise SolveError("the model's function returned a value that is not finite")
        outputs.flags.writeable = False
        return FunctionSolution(self, point, outputs)


@dataclass(frozen=True)
class FunctionSolution(ExplicitSolution):
    """The value of a `FunctionModel` at one parameter vector."""

    model: FunctionModel
    parameters: FloatArray
    outputs: FloatArray
    work: Work = field(default_factory=Work)

    @property
    def jacobian(self) -> FloatArray:
        """Derivatives (m, d) of the outputs.

        Raises
        ------
        DerivativeError
            If there are none.
        """
        if self.model.jacobian is None:
            raise DerivativeError("this model was given without a jacobian, so it has no derivatives")
        jacobian = real(self.model.jacobian(self.parameters), "jacobian")
        expected = self.outputs.size, self.parameters.size
        if jacobian.size != np.prod(expected) or (jacobian.shape != expected and 1 not in expected):
            raise ModelError(f"the model's jacobian returned shape {jacobian.shape}, expected {expected}")
        return jacobian.reshape(expected)
