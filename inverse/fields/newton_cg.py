"""The mode of a posterior of a field: inexact Gauss–Newton steps by conjugate gradients, and a line search.

Conjugate gradients on (I + AᵀA) δ = −g are those of the density of m, preconditioned by the prior covariance. If they
need many products, the directions that the data constrain most are computed (`inverse.fields.low_rank`), and
P = I + UΛUᵀ from these preconditions all later steps. They end at ‖(I + AᵀA) δ + g‖ ≤ η‖g‖ with
η = min(0.1, √(‖g‖/‖g_0‖)), in the norm of P⁻¹: S. C. Eisenstat, H. F. Walker, SIAM J. Sci. Comput. 17 (1996) 16–32.
Steps are halved until the decrease is a share of that predicted by the slope (L. Armijo, Pacific J. Math. 16 (1966)
1–3), also if the model has no answer.

In this norm the gradient bounds the distance to the mode: P ≤ I + AᵀA, so that ‖g‖ is at least the length of the step
to the mode in standard deviations of the posterior.

Second derivatives of the model are neglected. Their weights are the residuals, which are noise at the mode; there the
steps converge fast enough without them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from forward.model import FloatArray, Guess, SolveError
from forward.phases import phase
from inverse.fields.field_posterior import FieldPosterior, Point
from inverse.fields.low_rank import Spectrum, leading_pairs

ARMIJO = 1e-4
HALVINGS = 20
ROUNDING = 1e-12  # of the cost: smaller decreases cannot be expected
CLOSE = 1e-2  # ‖g‖ at which the search ends
FORCING = 0.1  # largest η: a solve costs as much as many products
STEPS = 50
LONG, LONGEST = 20, 500  # products at which a step ends, and pairs are computed; and once there are pairs
STRONG = 10.0  # λ of these pairs: with them as preconditioner a step takes few products
ROUGH = 0.5  # their accuracy


class Iteration(NamedTuple):
    """One step of the search.

    Attributes
    ----------
    misfit, penalty
        ½ r·r and ½ ξ·ξ where the step starts.
    gradient
        ‖g‖ there, in the norm of P⁻¹.
    pairs
        Number of pairs in P.
    products
        Hessian products of the step, with those for new pairs.
    length
        Fraction of the step that was taken; zero in the last row.
    solves
        Solves of the line search.
    """

    misfit: float
    penalty: float
    gradient: float
    pairs: int
    products: int
    length: float
    solves: int


@dataclass(frozen=True, eq=False)
class Mode:
    """The result of the search for the mode.

    Attributes
    ----------
    point
        The mode.
    converged
        Whether the gradient has fallen to the tolerance.
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


@phase("searching for the mode")
def find_mode(posterior: FieldPosterior, start: FloatArray | None = None, *, tolerance: float = CLOSE) -> Mode:
    """Find the mode of a posterior whose model has derivatives, from ξ (N,) or the centre of the prior.

    The search ends where the distance to the mode, in standard deviations of the posterior, is below the tolerance.
    Raises `SolveError` if the model has no answer at the start.
    """
    here = posterior.at(np.zeros(posterior.size) if start is None else start)
    pairs: Spectrum | None = None
    largest, used = 0.0, 0
    table: list[Iteration] = []
    for number in range(STEPS + 1):
        spent = 0
        if pairs is None and used == LONG:
            pairs = leading_pairs(here.jvp, here.vjp, posterior.size, cutoff=STRONG, accuracy=ROUGH)
            largest, spent = 0.0, pairs.products  # in another norm
        size = _norm(here.gradient, pairs)
        largest = max(largest, size)
        rank = 0 if pairs is None else len(pairs.values)
        row = Iteration(here.misfit, here.penalty, size, rank, spent, 0.0, 0)
        if size <= tolerance or number == STEPS:
            break
        forcing = min(FORCING, float(np.sqrt(size / largest)))
        step, used = conjugate_gradients(here, pairs, forcing, LONG if pairs is None else LONGEST)
        row = row._replace(products=spent + used)
        there, length, solves = _search(here, step)
        row = row._replace(length=length, solves=solves)
        if there is None:
            break
        table.append(row)
        here = there
    return Mode(here, row.gradient <= tolerance, (*table, row))


def _norm(g: FloatArray, pairs: Spectrum | None) -> float:
    return float(np.sqrt(g @ (g if pairs is None else pairs.solve(g))))


def conjugate_gradients(here: Point, pairs: Spectrum | None, forcing: float, products: int) -> tuple[FloatArray, int]:
    """Solve (I + AᵀA) δ = −g to a relative residual; return δ (N,) and the number of products."""
    residual = -here.gradient
    step = np.zeros_like(residual)
    direction = residual if pairs is None else pairs.solve(residual)
    square = float(residual @ direction)
    target = forcing**2 * square
    for used in range(products):
        if square <= target:
            return step, used
        along = direction + here.product(direction)
        length = square / float(direction @ along)
        step = step + length * direction
        residual = residual - length * along
        conditioned = residual if pairs is None else pairs.solve(residual)
        before, square = square, float(residual @ conditioned)
        direction = conditioned + square / before * direction
    return step, products


def _search(here: Point, step: FloatArray) -> tuple[Point | None, float, int]:
    """Return the next point (None if there is none), the fraction of the step to it, and the number of solves."""
    slope = float(here.gradient @ step)
    change = here.predicted(step)
    length = 1.0
    for solves in range(1, HALVINGS + 1):
        try:
            there = here.posterior.at(here.whitened + length * step, Guess(here.solution.state + length * change))
        except SolveError:
            pass
        else:
            if there.cost <= here.cost + ARMIJO * length * slope + ROUNDING * here.cost:
                return there, length, solves
        length /= 2
    return None, 0.0, HALVINGS
