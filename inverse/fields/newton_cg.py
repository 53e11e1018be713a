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

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from forward.model import FloatArray, Guess, SolveError
from forward.phases import phase
from inverse.fields.field_posterior import FieldPosterior, Point
from inverse.fields.low_rank import CUTOFF, LowRankPosterior, Spectrum, leading_pairs
from uq.inputs.distributions import Distribution

ARMIJO = 1e-4
HALVINGS = 20
ROUNDING = 1e-12  # of the cost: smaller decreases cannot be expected
CLOSE = 1e-2  # ‖g‖ at which the search ends
FORCING = 0.1  # largest η: a solve costs as much as many products
STEPS = 50
LONG, LONGEST = 20, 500  # products at which a step ends, and pairs are computed; and once there are pairs
STRONG = 10.0  # λ of these pairs: with them as preconditioner a step takes few products
ROUGH = 0.5  # their accuracy
ROUNDS = 10
STANDS = 0.1  # change of ln s, over its standard deviation, that ends the rounds
FARTHEST = 8.0  # of s, in standard deviations of its normal coordinate
GRID, ZOOMS = 401, 4  # points of the integral over s, and number of times that they are moved closer to its bulk
VANISHING = 1e-16  # density over the largest one


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
        g = here.gradient
        size = float(np.sqrt(g @ (g if pairs is None else pairs.solve(g))))
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


@dataclass(frozen=True, eq=False)
class SolvedField:
    """The mode of a posterior of a field, with the most probable size of its noise where that is inferred.

    Attributes
    ----------
    mode, found
        The mode, of the posterior with the standard deviations sσ, and the Gaussian there.
    converged
        Whether the mode was found, and s has converged.
    factor
        s.
    log_std
        Standard deviation of ln s.
    log_evidence
        ln p(y) with s integrated out; exact for linear models, up to the neglected pairs. None where s is known.
    """

    mode: Mode
    found: LowRankPosterior
    converged: bool
    factor: float = 1.0
    log_std: float = 0.0
    log_evidence: float | None = None


def infer_noise(
    posterior: FieldPosterior,
    *,
    start: FloatArray | None = None,
    tolerance: float = STANDS,
    cutoff: float = CUTOFF,
    rank: int | None = None,
) -> SolvedField:
    """Find the most probable size of the noise, with the mode and the Gaussian of the field there.

    The most probable s is the noise of the next mode, until s converges; linear models need one round, and one to
    confirm it. Neglecting the uncertainty of s in the posterior of the field is an error of second order: s is known to
    about 1/√(2n).

    The most probable value of its prior is that of the standard normal coordinate; the first search starts at ξ (N,).
    Rounds end where ln s changes by less than the tolerance, over its standard deviation; others as of `leading_pairs`.
    Raises `SolveError` if the model has no answer at the start, and `ValueError` if the median of the prior is not
    positive.
    """
    prior, sigma = posterior.noise.factor, posterior.noise.sigma
    assert prior is not None
    best = float(prior.from_normal(np.zeros(1))[0][0])
    if best <= 0:
        raise ValueError(f"the median of the prior of the noise is {best:g}, expected a positive one")
    for _ in range(ROUNDS):
        factor = best
        scaled = replace(posterior, noise=replace(posterior.noise, sigma=factor * sigma))
        mode = find_mode(scaled, start)
        found = LowRankPosterior.at(mode.point, cutoff=cutoff, rank=rank)
        marginal = Marginal.at(mode.point, found.spectrum)
        best, log_std, log_evidence = marginal.integrated(prior, factor)
        stands = abs(np.log(best / factor)) <= tolerance * log_std
        if stands:
            break
        start = mode.point.whitened
    return SolvedField(mode, found, stands and mode.converged, factor, log_std, log_evidence)


@dataclass(frozen=True)
class Marginal:
    """ln p(y | s) of the model linearised at a mode, with standard deviations sσ and the field integrated out.

    With residuals r + A(ξ − ξ̂) of s = 1 and AᵀA u = λu it is (D. J. C. MacKay, Neural Comput. 4 (1992) 415–447)

        −ln p(y | s) = ½ dᵀ(s²I + AAᵀ)⁻¹d + n ln s + ½ Σ ln(1 + λ/s²) + const,   d = r − Aξ̂,

    in closed form for all s at once, since the pairs of s are those of s = 1 with λ/s².

    Attributes
    ----------
    values
        λ (r,).
    along
        Squares (r,) of d along the eigenvectors of AAᵀ.
    rest
        The remainder of |d|².
    count
        Number n of data.
    constant
        As of the posterior.
    """

    values: FloatArray
    along: FloatArray
    rest: float
    count: int
    constant: float

    @classmethod
    def at(cls, mode: Point, spectrum: Spectrum) -> Marginal:
        """Linearise at a mode with the pairs there."""
        gap = mode.residual - mode.jvp(mode.whitened)
        values = spectrum.values
        along = (spectrum.images @ gap) ** 2 / np.where(values > 0, values, 1.0)
        rest = max(float(gap @ gap) - float(along.sum()), 0.0)
        return cls(values, along, rest, int(mode.posterior.measured.sum()), mode.posterior.constant)

    def log_density(self, s: FloatArray) -> FloatArray:
        """Ln p(y | s) (k,) at factors (k,) on the standard deviations at the mode."""
        square = np.maximum(np.asarray(s, dtype=float), 0)[:, None] ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            misfit = (self.along / (square + self.values)).sum(axis=1) + self.rest / square[:, 0]
            spread = np.log1p(self.values / square).sum(axis=1) + self.count * np.log(square[:, 0])
        return np.where(square[:, 0] > 0, -(misfit + spread) / 2 - self.constant, -np.inf)

    def integrated(self, prior: Distribution, unit: float) -> tuple[float, float, float]:
        """Return the most probable s, the deviation of ln s, and ln p(y) without s; at the mode s is the unit."""
        low, high = -FARTHEST, FARTHEST
        for _ in range(ZOOMS):
            x = np.linspace(low, high, GRID)
            s = prior.from_normal(x)[0]
            log_density = self.log_density(s / unit) - x**2 / 2 - np.log(2 * np.pi) / 2
            top = log_density.max()
            density = np.exp(log_density - top)
            seen = np.flatnonzero(density > VANISHING)
            low, high = x[max(seen[0] - 1, 0)], x[min(seen[-1] + 1, GRID - 1)]
        weights = density / density.sum()
        log_s = np.log(np.where(s > 0, s, 1.0))
        log_std = float(np.sqrt(weights @ (log_s - weights @ log_s) ** 2))
        log_evidence = float(top + np.log(density.sum() * (x[1] - x[0])))
        return self._peak(prior, unit, x, log_density), log_std, log_evidence

    def _peak(self, prior: Distribution, unit: float, x: FloatArray, log_density: FloatArray) -> float:
        from scipy.optimize import minimize_scalar

        i = int(log_density.argmax())
        ends = x[max(i - 1, 0)], x[min(i + 1, len(x) - 1)]

        def minus(at: float) -> float:
            s = prior.from_normal(np.array([at]))[0]
            return float(at**2 / 2 - self.log_density(s / unit)[0])

        best = minimize_scalar(minus, bounds=ends, method="bounded", options={"xatol": 1e-10})
        return float(prior.from_normal(np.array([best.x]))[0][0])
