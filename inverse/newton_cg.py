"""The mode of a posterior of a field: inexact Gauss–Newton steps by conjugate gradients, and a line search.

Conjugate gradients on (I + AᵀA) δ = −g are those of the density of m, preconditioned by the prior covariance. They end
at ‖(I + AᵀA) δ + g‖ ≤ η‖g‖ with η = min(½, √(‖g‖/‖g_0‖)): S. C. Eisenstat, H. F. Walker, SIAM J. Sci. Comput. 17
(1996) 16–32. Steps are halved until they descend by a share of what their slope promises (L. Armijo, Pacific J. Math.
16 (1966) 1–3), also where the model has no answer.

Second derivatives of the model are left out. They count as much as the residuals, which are noise at the mode; there
the steps converge fast enough without them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from forward.model import FloatArray, SolveError
from inverse.field_posterior import FieldPosterior, Point

ARMIJO = 1e-4
HALVINGS = 20
ROUNDING = 1e-12  # of the cost: what it cannot be expected to descend below


@dataclass(frozen=True)
class Iteration:
    """One step of the search.

    Attributes
    ----------
    misfit, penalty
        ½ r·r and ½ ξ·ξ where the step starts.
    gradient
        ‖g‖ there.
    products
        Hessian products that the step took.
    length
        Fraction of the step that was gone; zero in the last row.
    solves
        Solves that took.
    """

    misfit: float
    penalty: float
    gradient: float
    products: int
    length: float
    solves: int


@dataclass(frozen=True, eq=False)
class Mode:
    """Where the search for the mode ended.

    Attributes
    ----------
    point
        The mode.
    converged
        Whether the gradient has fallen to the tolerance, or the cost to rounding.
    iterations
        The steps; the last row is the mode.
    """

    point: Point
    converged: bool
    iterations: tuple[Iteration, ...]

    @property
    def products(self) -> int:
        """Hessian products of all steps."""
        return sum(row.products for row in self.iterations)

    @property
    def solves(self) -> int:
        """Solves of all steps, and the first."""
        return 1 + sum(row.solves for row in self.iterations)


def find_mode(
    posterior: FieldPosterior,
    start: FloatArray | None = None,
    *,
    tolerance: float = 1e-6,
    steps: int = 50,
    products: int = 500,
) -> Mode:
    """Find the mode.

    Parameters
    ----------
    posterior
        Of a model with derivatives.
    start
        ξ (N,) where the search starts; by default zero, the centre of the prior.
    tolerance
        ‖g‖ over ‖g_0‖ at the centre of the prior, or at the start, at which the search ends.
    steps
        Largest number of steps.
    products
        Largest number of Hessian products of one step.

    Raises
    ------
    SolveError
        If the model has no answer at the start.
    """
    here = posterior.at(np.zeros(posterior.size) if start is None else start)
    first = np.linalg.norm(here.gradient)
    table: list[Iteration] = []
    converged = False
    for _ in range(steps):
        size = float(np.linalg.norm(here.gradient))
        converged = size <= tolerance * first
        if converged:
            break
        forcing = min(0.5, float(np.sqrt(size / first)))
        step, used = conjugate_gradients(here, forcing, products)
        there, length, solves = _search(here, step)
        table.append(Iteration(here.misfit, here.penalty, size, used, length, solves))
        if there is None:
            converged = -float(here.gradient @ step) <= np.sqrt(ROUNDING) * max(here.cost, 1.0)
            break
        here = there
    table.append(Iteration(here.misfit, here.penalty, float(np.linalg.norm(here.gradient)), 0, 0.0, 0))
    return Mode(here, converged, tuple(table))


def conjugate_gradients(here: Point, forcing: float, products: int) -> tuple[FloatArray, int]:
    """Solve (I + AᵀA) δ = −g to a relative residual; return δ (N,) and the number of products."""
    residual = -here.gradient
    target = forcing * np.linalg.norm(residual)
    step = np.zeros_like(residual)
    direction = residual
    square = float(residual @ residual)
    for used in range(products):
        if np.sqrt(square) <= target:
            return step, used
        curved = direction + here.product(direction)
        along = square / float(direction @ curved)
        step = step + along * direction
        residual = residual - along * curved
        before, square = square, float(residual @ residual)
        direction = residual + square / before * direction
    return step, products


def _search(here: Point, step: FloatArray) -> tuple[Point | None, float, int]:
    """Return the next point, the fraction of the step that leads there and the number of solves; or no point."""
    slope = float(here.gradient @ step)
    change = here.predicted(step)
    length = 1.0
    for solves in range(1, HALVINGS + 1):
        try:
            there = here.posterior.at(here.noise + length * step, here.solution.state + length * change)
        except SolveError:
            pass
        else:
            if there.cost <= here.cost + ARMIJO * length * slope + ROUNDING * here.cost:
                return there, length, solves
        length /= 2
    return None, 0.0, HALVINGS
