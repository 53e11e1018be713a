"""A polynomial surrogate of a model in the bulk of a posterior, and points drawn from the posterior of the surrogate.

The outputs are fitted by least squares to values and derivatives at points that were solved, in Hermite polynomials
about the weighted mean of these points; far points count less. The degree, and whether the polynomials are of the
parameters or of their standard normal coordinates, are chosen to predict left-out points best. The posterior of the
polynomial is cheap, so it can be sampled as densely as needed: from a mixture of Gaussians, each as wide as the
posterior around its centre, with centres drawn from the points of the previous round (population Monte Carlo: O. Cappé
et al., Stat. Comput. 18 (2008) 447–459).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import comb
from typing import Any

import numpy as np

from forward.model import WORK, FloatArray, SolveError
from inverse.criticism.weights import OfWeights
from inverse.low_dimensional.laplace import WIDER, Laplace, Mixture
from inverse.low_dimensional.posterior import Density, Posterior
from uq.evaluation.evaluate import OfEvaluate
from uq.evaluation.request import Evaluate, Evaluations, Failure, Request
from uq.inputs.coordinates import Coordinates
from uq.inputs.distributions import Normal
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.surrogates.basis import Basis, hyperbolic

DEGREE = 6
ROWS_PER_TERM = 1.5
FOLDS = 4
NEAR = 0.5  # effective sample size of the weights of the fit, over the number of points
COUNTED = 1e-3  # weight, over the largest, from which a point counts as within the range of the polynomial
MARGIN = 0.3  # added on either side of the box of these points, over its size
NEXT = 0.05  # of the size of the box, along each parameter, that is next to one of its ends
BEYOND = "outside the range of the polynomial"
CENTRES = 64
REACH = 0.4  # largest width of a Gaussian in the mixture, in standard deviations of the prior
SCRAMBLES = 8
FIRST, LAST = 2**11, 2**13  # points in the first clouds and in the last one
ROUNDS = 4
MOST_TERMS = 500  # of degree 2: beyond 30 unknowns a cloud is worth few of its points, and a fit takes minutes
ENOUGH = 0.2  # effective share of a cloud from which no better proposal is needed


@dataclass(frozen=True)
class Surrogate(OfEvaluate):
    """A polynomial for the outputs of a model, as a cheap evaluation.

    Attributes
    ----------
    basis
        The P polynomials.
    coefficients
        (P, m).
    lower, upper
        The box (d,) beyond which there is no answer: far from its points a polynomial is meaningless.
    """

    _evaluate: Evaluate
    basis: Basis
    coefficients: FloatArray
    lower: FloatArray
    upper: FloatArray

    def on(self, model: str) -> Surrogate:
        """Return itself: there is one model."""
        return self

    def __call__(self, request: Request) -> Evaluations:
        """Evaluate the polynomial at all points of a request."""
        points = request.points
        n = len(points)
        outside = ((points < self.lower) | (points > self.upper)).any(axis=1)
        outputs = self.basis.values(points) @ self.coefficients
        outputs[outside] = np.nan
        tangents = None
        if request.tangents:
            slopes = self.basis.derivatives(points) @ self.coefficients
            tangents = np.swapaxes(slopes / self.basis.coordinates.scale[:, None], 1, 2)
            tangents[outside] = np.nan
        failures = tuple(Failure(int(i), (), BEYOND) for i in np.flatnonzero(outside))
        work = np.zeros((n, len(WORK)), dtype=np.int64)
        residuals = np.where(outside, np.nan, 0.0)
        rows = (np.zeros(n), work, residuals, ~outside, np.zeros(n, dtype=np.int8))
        return Evaluations(points, outputs, tangents, failures, *rows, np.zeros((0, 0)))


def terms(size: int, degree: int) -> int:
    """Return the number of polynomials of at most a degree in `size` variables."""
    return comb(size + degree, degree)


def affordable(size: int) -> bool:
    """Whether outputs are fitted by polynomials of as many unknowns, of degree 2 at least."""
    return terms(size, 2) <= MOST_TERMS


def fit(posterior: Posterior, solved: Density) -> Posterior:
    """Return the posterior of a polynomial that is fitted to values and derivatives at solved points.

    Raises `SolveError` if fewer points have an answer than a polynomial needs.
    """
    assert solved.tangents is not None
    good = np.isfinite(solved.log_likelihood)
    n, d = int(good.sum()), len(posterior.inputs.names)
    if n < 2 * FOLDS:
        raise SolveError(f"{n} points have an answer, too few for a polynomial")
    weights = _tempered(solved.log_posterior[good], NEAR * n)
    x, outputs = solved.x[good, :d], solved.everything[good]
    slopes = posterior.inputs.from_normals(x)[1]
    normals = Inputs(dict.fromkeys(posterior.inputs.names, Normal(mean=0.0, std=1.0)))
    near = weights > COUNTED * weights.max()
    fits = [
        (*_regression(points, outputs, tangents, weights), points[near], inputs)
        for inputs, points, tangents in (
            (posterior.inputs, solved.parameters[good], solved.tangents[good]),
            (normals, x, solved.tangents[good] @ slopes),
        )
    ]
    _, basis, coefficients, box, inputs = min(fits, key=lambda fitted: fitted[0])
    ends = np.array([box.min(axis=0), box.max(axis=0)])
    lower, upper = ends + MARGIN * np.ptp(ends, axis=0) * np.array([[-1.0], [1.0]])
    surrogate = Surrogate(posterior.evaluate, basis, coefficients, lower, upper)
    return replace(posterior, inputs=inputs, evaluate=surrogate, start=None)


def _regression(
    points: FloatArray, outputs: FloatArray, tangents: FloatArray, weights: FloatArray
) -> tuple[float, Basis, FloatArray]:
    """Fit values and derivatives with the degree of the smallest error at left-out points; return that error too."""
    n, d = points.shape
    centre = weights @ points
    scale = np.sqrt(weights @ (points - centre) ** 2)
    root = np.sqrt(np.maximum(weights / weights.max(), 1e-8))[:, None, None]
    right = np.concatenate([outputs[:, None, :], np.swapaxes(tangents, 1, 2) * scale[:, None]], axis=1) * root
    spread = np.sqrt((root[:, 0] ** 2 * (outputs - weights @ outputs) ** 2).sum(axis=0))
    size = np.where(spread > 0, spread, 1.0)
    fold = np.arange(n) % FOLDS
    best: tuple[float, Basis, FloatArray] | None = None
    for degree in _degrees(d, len(np.unique(points, axis=0))):  # points drawn several times tell once
        alpha, beta = np.zeros((d, degree + 1)), np.tile(np.maximum(np.arange(degree + 1.0), 1.0), (d, 1))
        basis = Basis(Coordinates.linear(centre, scale), alpha, beta, hyperbolic(d, degree, 1.0))
        left = np.concatenate([basis.values(points)[:, None, :], basis.derivatives(points)], axis=1) * root
        missed = 0.0
        for k in range(FOLDS):
            kept, out = fold != k, fold == k
            error = left[out, 0] @ _solve(left[kept], right[kept]) - right[out, 0]
            missed += float(((error / size) ** 2).sum())
        if best is None or missed < 0.8 * best[0]:
            best = missed, basis, _solve(left, right)
    assert best is not None
    return best


def _degrees(size: int, count: int) -> Iterator[int]:
    """Degrees that `count` points with derivatives by `size` variables are enough for."""
    for degree in range(1, DEGREE + 1):
        if degree > 1 and ROWS_PER_TERM * terms(size, degree) > count * (size + 1) * (FOLDS - 1) / FOLDS:
            return
        yield degree


def operations(size: int, outputs: int, samples: int) -> float:
    """Return about how many operations polynomials of `size` unknowns take where all `samples` points ask for them.

    Least squares of rows × terms take about 2 rows terms²; clouds evaluate polynomials and Gaussians.
    """
    if not affordable(size):
        return 0.0
    found = 0.0
    for count in (samples // 4, samples // 2, 3 * samples // 4):
        rows, columns = count * (size + 1), [terms(size, degree) for degree in _degrees(size, count)]
        found += sum(2 * 2 * FOLDS * rows * column * (column + outputs) for column in columns)  # two coordinates
        points = ROUNDS * FIRST + 2 * LAST
        found += points * (2 * columns[-1] * (outputs + size) + 2 * CENTRES * size**2)
    return found


def _solve(left: FloatArray, right: FloatArray) -> FloatArray:
    terms, m = left.shape[2], right.shape[2]
    return np.asarray(np.linalg.lstsq(left.reshape(-1, terms), right.reshape(-1, m), rcond=1e-10)[0])


def _tempered(log_density: FloatArray, least: float) -> FloatArray:
    """Weights (n,) of sum 1, ∝ density^β with the largest β ≤ 1 with an effective sample size of at least `least`.

    Where the density is zero they are zero too, also if so few points are left that β = 0. Raises `SolveError` if it is
    zero everywhere.
    """
    there = np.isfinite(log_density)
    if not there.any():
        raise SolveError("a polynomial has no answer at any point that was drawn")
    gaps = np.where(there, log_density - log_density[there].max(), 0.0)

    def weights(power: float) -> FloatArray:
        w = np.where(there, np.exp(power * gaps), 0.0)
        return np.asarray(w / w.sum())

    if 1 / (weights(1.0) ** 2).sum() >= least:
        return weights(1.0)
    low, high = 0.0, 1.0
    for _ in range(50):
        power = (low + high) / 2
        low, high = (power, high) if 1 / (weights(power) ** 2).sum() >= least else (low, power)
    return weights(low)


@dataclass(frozen=True)
class Cloud(OfWeights):
    """Many points with their weights in the posterior of a polynomial, in eight independent scrambles.

    Of ten points picked from it, nine are drawn by their weights w, and one by √w, which reaches farther out.

    Attributes
    ----------
    surrogate
        The posterior of the polynomial.
    mixture
        The proposal from which the points were drawn.
    x
        Points (N, c).
    log_weights
        ln p(y | x) N(x; 0, I)/q(x), (N,), by the polynomial.
    """

    surrogate: Posterior
    mixture: Mixture
    x: FloatArray
    log_weights: FloatArray

    @property
    def cut(self) -> float:
        """Largest share of the posterior next to an end of the polynomial's range: about as much is missing beyond."""
        box: Any = self.surrogate.evaluate
        points = self.surrogate.inputs.from_normals(self.x[:, : len(box.lower)])[0]
        inside = (points - box.lower) / (box.upper - box.lower)
        return float(max((self.weights @ (inside < NEXT)).max(), (self.weights @ (inside > 1 - NEXT)).max()))

    @property
    def log_evidence(self) -> float:
        """Ln of the mean weight: ln Z by the polynomial."""
        from scipy.special import logsumexp

        return float(logsumexp(self.log_weights) - np.log(len(self.x)))

    @property
    def error(self) -> float:
        """Standard error of the logarithm of the mean weight, from the scatter of the scrambles."""
        means = self.weights.reshape(SCRAMBLES, -1).mean(axis=1)
        return float(means.std(ddof=1) / np.sqrt(SCRAMBLES) / means.mean())

    def pick(self, seed: int, count: int) -> FloatArray:
        """Draw points (count, c), in eight independent sweeps."""
        chance = np.exp(self._log_picked(self.log_weights)) / len(self.x)
        # Neighbours along the longest axis of the cloud are adjacent, so that a sweep covers it evenly.
        w = self.weights
        deviation = self.x - w @ self.x
        axis = np.linalg.eigh((deviation * w[:, None]).T @ deviation)[1][:, -1]
        order = np.argsort(deviation @ axis, kind="stable")
        ends = np.cumsum(chance[order])
        each = count // SCRAMBLES
        offsets = np.random.default_rng([seed, count]).random(SCRAMBLES)
        places = np.concatenate([(np.arange(each) + offset) / each for offset in offsets])
        picked = order[np.minimum(np.searchsorted(ends, places * ends[-1]), len(w) - 1)]
        return np.asarray(self.x[picked])

    def log_over_prior(self, x: FloatArray) -> FloatArray:
        """Ln of the density of picked points at x (n, c) over that of the prior, (n,)."""
        over = self.mixture.log_over_prior(x)
        return np.asarray(over + self._log_picked(self.surrogate.at(x).log_likelihood - over))

    def _log_picked(self, log_weights: FloatArray) -> FloatArray:
        """Ln of the density of picked points over q, from ln w."""
        top = self.log_weights.max()
        mean, mean_root = (np.exp(power * (self.log_weights - top)).mean() for power in (1.0, 0.5))
        parts = (0.9 * np.exp(log_weights - top) / mean, 0.1 * np.exp((log_weights - top) / 2) / mean_root)
        return np.asarray(np.log(np.maximum(parts[0] + parts[1], 1e-300)))


def sample(surrogate: Posterior, gaussian: Laplace, seed: int) -> Cloud:
    """Draw a cloud from the posterior of a polynomial, with proposals adapted to it round by round."""
    mixture = Mixture.of(gaussian)
    cloud = _cloud(surrogate, mixture, seed, FIRST)
    for k in range(ROUNDS):
        if cloud.ess > ENOUGH * len(cloud.x):
            break
        better = _mixture(surrogate, cloud, seed + k)
        after = _cloud(surrogate, better, seed + 1 + k, FIRST)
        if k and after.ess < 1.1 * cloud.ess:
            break
        mixture, cloud = better, after
    return _cloud(surrogate, mixture, seed + ROUNDS + 1, LAST)


def _cloud(surrogate: Posterior, mixture: Mixture, seed: int, count: int) -> Cloud:
    c = mixture.centres.shape[1]
    each = count // SCRAMBLES
    cubes = np.concatenate([sobol_points(seed, r, 0, each, c + 1) for r in range(SCRAMBLES)])
    x = mixture.draw(cubes)
    over = mixture.log_over_prior(x)
    pieces = [surrogate.at(piece).log_likelihood for piece in np.array_split(x, max(1, count // 4096))]
    return Cloud(surrogate, mixture, x, np.concatenate(pieces) - over)


def _mixture(surrogate: Posterior, cloud: Cloud, seed: int) -> Mixture:
    """Gaussians around points of a cloud, with the covariances (H + I/ρ²)⁻¹ of the posterior around each."""
    tempered = _tempered(cloud.log_weights, 2 * CENTRES)
    places = (np.arange(CENTRES) + np.random.default_rng([seed, CENTRES]).random()) / CENTRES
    order = np.argsort(cloud.x[:, 0], kind="stable")
    centres = cloud.x[
        order[np.searchsorted(np.cumsum(tempered[order]), places * tempered.sum()).clip(0, len(order) - 1)]
    ]
    there = surrogate.at(centres, derivatives=True)
    values, vectors = np.linalg.eigh(there.curvature)
    spread = WIDER / np.sqrt(np.maximum(values, 1.0) + 1 / REACH**2)
    return Mixture(centres, vectors * spread[:, None, :])
