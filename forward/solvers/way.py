"""The way in parameters from a reference state to the requested values, on which predictions are corrected."""

from __future__ import annotations

from typing import Any

import numpy as np

from forward.model import FloatArray, ReferenceSolution, Work
from forward.solvers.rotations import Turned
from forward.solvers.stability import NOT_SCREENED, Screened, draw
from forward.solvers.steps import Corrector, Steps
from forward.solvers.system import Residual

MANY = 16  # parameters, beyond which no derivatives by all of them are found


class Way:
    """The straight line in parameters from a reference, whose factor is available, to the requested values.

    Parameters
    ----------
    equations
        The discrete equations (`forward.fem.equations.Discretisation`).
    factor
        The factor at the reference (`forward.fem.reference.ReferenceFactor`).
    reference
        Its start.
    parameters
        Its end (d,).
    screen
        Whether equilibria at the end are screened for stability.

    Attributes
    ----------
    joined
        Whether the reference is joined to rest.
    length
        What the parameters move the state by, one by one: the norm of the norms; 0 if that is not known.
    reversed_from
        How far the reference is from a linear answer to its loads, if one of these is reversed on the path; else 0.
        That is the distance from what the tangent at rest predicts, over the size of its state.
    state
        The state (U_local,) of the reference.
    rotation
        Rotations of the nodes from the reference to the last prediction, (3, 3, n_owned).
    draw
        A number in [0, 1) that depends only on the parameters: eigenvalues are counted if it is small.
    """

    def __init__(
        self, equations: Any, factor: Any, reference: ReferenceSolution, parameters: FloatArray, *, screen: bool
    ) -> None:
        self._screen, self._fraction = screen, 1.0
        self._slopes = factor.slopes() if screen and len(parameters) <= MANY else None
        self.length = float(np.linalg.norm((parameters - reference.parameters) * factor.lengths())) if screen else 0.0
        turned = (reference.parameters * parameters < 0) & equations.pushing
        self.reversed_from = factor.from_rest() if screen and turned.any() else 0.0
        self.draw = draw(parameters)
        self._equations, self._factor = equations, factor
        self._from, self._to = reference.parameters, parameters
        self.reference, self.joined = reference, reference.joined
        self.state = reference.state
        self.rotation: FloatArray | None = None
        self._predicted: FloatArray | None = None

    @property
    def slope(self) -> FloatArray | None:
        """Derivative (U_local,) of the state by the fraction of the path, at the reference; None if not known."""
        return None if self._slopes is None else np.asarray((self._to - self._from) @ self._slopes)

    def corrector(self, u: FloatArray) -> Corrector:
        """Return the corrector at a prediction u (U_local,), whose rotations are remembered."""
        self._predicted, self.rotation = u, self._factor.rotation(u)
        return Turned(self.rotation, self._equations.fixed)

    def rotations(self, u: FloatArray) -> FloatArray:
        """Return the rotations (3, 3, n_owned) of the nodes from the reference to u (U_local,)."""
        return self.rotation if self.rotation is not None and u is self._predicted else self._factor.rotation(u)

    def screen(self, u: FloatArray, residual: Residual) -> Steps[Screened]:
        """Find the result of the screen for an equilibrium; not screened if that is not asked for."""
        if not self._screen or self.rotation is None:
            return NOT_SCREENED
        seen: Screened = yield from self._factor.screen(u, residual.vector, self.rotation)
        return seen

    def definite(self, u: FloatArray, residual: Residual) -> Steps[bool]:
        """Whether Lanczos' process shows that the stiffness at an equilibrium is positive definite."""
        if not self._screen or self.rotation is None:
            return False
        return bool((yield from self._factor.definite(u, residual.vector, self.rotation)))

    def at(self, fraction: float) -> None:
        """Set the parameters of the equations to those after a fraction of the path."""
        self._fraction = fraction
        self._equations.set_parameters(self._to if fraction == 1 else self._from + fraction * (self._to - self._from))
        self._equations.at_load(1.0)

    def resume(self, work: Work, solved: int) -> None:
        """Set the equations to where they were on this path, and count their work and back-substitutions there."""
        work.back_substitutions += solved
        self._equations.work = work
        self.at(self._fraction)
