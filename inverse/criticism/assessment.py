"""What is found of a posterior of few parameters around its mode, and what of it stands for the posterior.

Laplace's Gaussian is corrected by weighted points and, where they are asked for, by chains. Inversions and comparisons
of models call the same functions; how far each of the three can be trusted is said in `inverse.criticism.verdict`. What
is printed is one of them:

Chains were asked for, and count if they have mixed. Where the posterior is Gaussian at every point that was tried,
everything is Laplace's. Then come weighted points that are worth enough to stand in place of a Gaussian
(`inverse.criticism.weights.fewest`). Otherwise it is Laplace's Gaussian, whatever the verdict says of it: few points
are no better, and look as if they were.

The parameters ω are functions of a Gaussian x ~ N(x̂, C). Their moments are those of the linear functions
ω̂ + S(x − x̂), in closed form, corrected by what points of the Gaussian say of the difference, which is nothing for
normal priors. Each parameter is a monotone function of one combination of x, along S_i, so that its quantiles are those
of that combination.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from forward.model import FloatArray, ForwardModel
from inverse.criticism.chains import BUDGET, FEW, Chains, chains_of_few, ensemble, gradient_chains, walkers
from inverse.criticism.weights import FEWEST, PER_UNKNOWN, fewest
from inverse.low_dimensional.evidence import LEAST, Evidence, evidence
from inverse.low_dimensional.laplace import Laplace
from inverse.low_dimensional.posterior import Density, Posterior
from inverse.low_dimensional.surrogate import operations
from uq.evaluation.evaluate import ALL_AGAIN, Steps
from uq.inputs.sampling import sobol_points

Source = Literal["laplace", "points", "chains"]
Kind = Literal["pcn", "emcee", "hmc"]
When = Literal["always", "needed"]
NEEDED: dict[Kind, tuple[str, ...]] = {"pcn": ("arviz",), "emcee": ("arviz",), "hmc": ("arviz", "mici")}

OUTERMOST = 0.01  # of the probability
MAPPED = 4096  # points of Laplace's Gaussian that correct the moments of the linear functions
RATE = 1.5e10  # operations a second of polynomials (docs/measurements.md)
SECONDS_PER_STEP = 5e-4  # of a path, besides solve and adjoint


@dataclass(frozen=True, eq=False)
class Assessment:
    """A posterior around its mode.

    Attributes
    ----------
    gaussian
        Laplace's.
    evidence
        Weighted points, and ln Z by them.
    chains
        None if they were not asked for.
    """

    gaussian: Laplace
    evidence: Evidence
    chains: Chains | None = None

    @property
    def source(self) -> Source:
        """What is printed."""
        if self.chains is not None and self.chains.mixed:
            return "chains"
        return "points" if self.evidence.route != "closed form" and counts(self.evidence) else "laplace"

    @property
    def log_evidence(self) -> tuple[float, float]:
        """Ln Z and its standard error: by chains where they tell and weighted points cannot be trusted."""
        return self._by_chains or (self.evidence.log_evidence, self.evidence.error)

    @property
    def known(self) -> bool:
        """Whether ln Z can be trusted."""
        return self.evidence.trusted or self._by_chains is not None

    @property
    def _by_chains(self) -> tuple[float, float] | None:
        """Ln Z and its error by chains, where they are what is printed and weighted points cannot be trusted."""
        return self.chains.evidence if self.chains and not self.evidence.trusted and self.chains.mixed else None

    def reweighted(self, change: Callable[[FloatArray], FloatArray]) -> tuple[float, float]:
        """Return ln Z and its error with ln of the prior density at x (n, c) changed by `change` (n,)."""
        if self._by_chains is None or self.chains is None:
            return self.evidence.reweighted(change(self.evidence.density.x))
        (log_evidence, error), chains = self._by_chains, self.chains
        changed = change(chains.x.reshape(-1, chains.x.shape[2]))
        top = changed.max()
        ratio = np.exp(changed - top)
        scatter = ratio.std() / ratio.mean() / np.sqrt(chains.ess)
        return log_evidence + float(top + np.log(ratio.mean())), float(np.hypot(error, scatter))


def assess(
    posterior: Posterior,
    gaussian: Laplace,
    samples: int,
    *,
    chains: Kind | None = None,
    when: When = "always",
    model: ForwardModel | None = None,
    seed: int = 0,
    steps: Steps = ALL_AGAIN,
) -> Assessment:
    """Correct Laplace's Gaussian by so many solves for weighted points, and by chains if they are asked for.

    That is always, or when they are "needed": where the points cannot be trusted. Those by "hmc" follow the gradients
    of the model, point by point. `steps` keep points, gradients and chains. Raises `SolveError` if the model has no
    answer at any of the points.
    """
    found = steps("points", lambda: evidence(posterior, gaussian, samples or LEAST, seed=seed))
    if chains is None or (when == "needed" and (found.route == "closed form" or counts(found))):
        return Assessment(gaussian, found)

    def run() -> Chains:
        if chains == "emcee":
            return ensemble(posterior, gaussian, seed=seed)
        if chains == "pcn":
            # Fewer points say little about a covariance.
            enough = found.ess >= max(FEWEST, 4 * len(gaussian.mode))
            return chains_of_few(posterior, gaussian, found if enough else None, seed=seed)
        if model is None:
            raise ValueError("chains = 'hmc' follow the gradients of a model itself, which is not given")
        return gradient_chains(posterior, gaussian, model, seed=seed, kept=steps.rows("gradients"))

    return Assessment(gaussian, found, steps("chains", run))


def solves_of(kind: Kind | None, size: int) -> int:
    """Return the most solves that chains for `size` unknown parameters take."""
    if kind is None:
        return 0
    if kind == "hmc":
        return BUDGET
    return (FEW if kind == "pcn" else walkers(size)).evaluations


def only_needed(chains: Kind | None, when: When, solves: int) -> list[str]:
    """Say in a line how many solves chains take at most that run only where they are needed; none otherwise."""
    if chains is None or when == "always":
        return []
    return [f"chains      where weighted points cannot be trusted: at most {solves:,} more solves"]


def own_seconds(size: int, outputs: int, samples: int, chains: Kind | None = None) -> float:
    """Predict the most processor time (s) that an assessment takes besides solves: of polynomials, and steps of chains.

    It is that of `size` unknown parameters and so many data; others as of `assess`.
    """
    return operations(size, outputs, samples) / RATE + (BUDGET * SECONDS_PER_STEP if chains == "hmc" else 0.0)


@dataclass(frozen=True, eq=False)
class Points:
    """Points that stand for a posterior.

    Attributes
    ----------
    x, values
        Points (n, c), and the parameters there in physical units.
    weights
        (n,), of sum 1.
    outputs, everything
        What was measured (n, m), corrected where the error of the mesh is known, and all outputs (n, M), which are not.
    """

    x: FloatArray
    values: FloatArray
    weights: FloatArray
    outputs: FloatArray
    everything: FloatArray


def weighted(posterior: Posterior, found: Evidence) -> Points:
    """Return the weighted points that were solved."""
    at = found.density
    return Points(at.x, posterior.physical(at.x), found.weights, at.outputs, at.everything)


def of_chains(posterior: Posterior, chains: Chains, count: int) -> Points:
    """Return at most `count` draws of chains, equally many from each, which are solved for their outputs."""
    each = max(count // len(chains.x), 1)
    steps = np.linspace(0, chains.x.shape[1] - 1, each).round().astype(int)
    at = posterior.at(chains.x[:, steps].reshape(-1, chains.x.shape[2])[:count])
    return Points(at.x, posterior.physical(at.x), even(len(at.x)), at.outputs, at.everything)


def of_gaussian(posterior: Posterior, gaussian: Laplace, at: Density, count: int) -> Points:
    """Return points of Laplace's Gaussian with the outputs of the model linearised at the mode, solved in `at`.

    These are exact where the posterior is Gaussian.
    """
    assert at.tangents is not None
    x, d = gaussian_points(gaussian, count), len(posterior.inputs.names)
    moved = (x - gaussian.mode)[:, :d]
    slopes = at.tangents[0] @ posterior.inputs.from_normals(at.x[:, :d])[1][0]
    outputs = at.outputs + moved @ posterior.output_slopes(at)[0].T
    return Points(x, posterior.physical(x), even(count), outputs, at.everything + moved @ slopes.T)


def even(count: int) -> FloatArray:
    """Return equal weights (count,) of sum 1."""
    return np.full(count, 1 / count)


# --- what is printed --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Answer:
    """Moments and quantiles of the parameters of a posterior, in physical units.

    Attributes
    ----------
    source
        What they are of.
    mean, covariance
        (c,) and (c, c).
    quantiles
        Levels (k,) → quantiles (c, k).
    outermost
        Share (c,) of each variance that comes from the outermost 1 % of the probability.
    """

    source: Source
    mean: FloatArray
    covariance: FloatArray
    quantiles: Callable[[Sequence[float]], FloatArray]
    outermost: FloatArray

    @property
    def std(self) -> FloatArray:
        """Standard deviations (c,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def counts(found: Evidence) -> bool:
    """Whether weighted points may stand in place of a Gaussian."""
    return found.trusted and found.ess >= fewest(found.density.x.shape[1])


def answer(posterior: Posterior, one: Assessment) -> Answer:
    """Return what is printed of a posterior."""
    if one.source == "laplace":
        return by_gaussian(posterior, one.gaussian)
    if one.source == "chains":
        assert one.chains is not None
        return by_points("chains", one.chains.flat, even(len(one.chains.flat)))
    x, weights = one.evidence.points
    return by_points("points", posterior.physical(x), weights)


def by_points(source: Source, points: FloatArray, weights: FloatArray) -> Answer:
    """Return moments and quantiles of points (n, c) with weights (n,) of sum 1, some of which may be negative."""
    used = weights != 0
    points, weights = points[used], weights[used]
    mean = weights @ points
    gaps = points - mean

    def ends(levels: Sequence[float]) -> FloatArray:
        return np.array([quantiles(column, weights, levels) for column in points.T])

    return Answer(source, mean, (weights[:, None] * gaps).T @ gaps, ends, outermost(points, weights))


def outermost(points: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the share (c,) of the variances of points (n, c) with weights (n,) that the farthest ones make.

    These are the outermost 1 % of the probability: 8 % of the variance of a normal quantity, 25 % of a log-normal one
    whose logarithm has a standard deviation of 0.58.
    """
    squares = (points - weights @ points) ** 2
    order = np.argsort(-squares, axis=0)
    far = np.maximum.accumulate(np.cumsum(weights[order], axis=0) - weights[order], axis=0) < OUTERMOST
    parts = weights[order] * np.take_along_axis(squares, order, axis=0)
    return np.asarray(np.clip((parts * far).sum(axis=0) / np.maximum(parts.sum(axis=0), 1e-300), 0.0, 1.0))


def by_gaussian(posterior: Posterior, gaussian: Laplace) -> Answer:
    """Return moments and quantiles of the parameters by Laplace's Gaussian."""
    best = posterior.physical(gaussian.mode[None])[0]
    slopes = posterior.slopes(gaussian.mode[None])[0]
    z = gaussian_points(gaussian, MAPPED)
    drawn, linear = posterior.physical(z), (z - gaussian.mode) @ slopes.T
    rest = drawn - best - linear
    mean = best + rest.mean(axis=0)
    more = np.cov(drawn.T, bias=True) - np.cov(linear.T, bias=True)
    covariance = slopes @ gaussian.covariance @ slopes.T + more.reshape(slopes.shape)
    far = outermost(drawn, even(len(drawn)))
    return Answer("laplace", mean, covariance, partial(_along, posterior, gaussian, slopes), far)


def _along(posterior: Posterior, gaussian: Laplace, slopes: FloatArray, levels: Sequence[float]) -> FloatArray:
    """Quantiles (c, k) of the parameters, each along the direction in which it varies."""
    from scipy.special import ndtri

    towards = gaussian.covariance @ slopes.T  # columns
    width = np.sqrt((slopes.T * towards).sum(axis=0))
    towards = np.divide(towards, width, out=np.zeros_like(towards), where=width > 0)
    places = [posterior.physical(gaussian.mode + float(ndtri(level)) * towards.T) for level in levels]
    return np.array([np.diag(place) for place in places]).T


def gaussian_points(gaussian: Laplace, count: int) -> FloatArray:
    """Return points (count, c) of Laplace's Gaussian, spread evenly; of enough of them mean and covariance are its."""
    from scipy.special import ndtri

    c = len(gaussian.mode)
    z = ndtri(sobol_points(0, 0, 0, count, c))
    if count > PER_UNKNOWN * c:
        z = z - z.mean(axis=0)
        z = np.linalg.solve(np.linalg.cholesky(z.T @ z / count), z.T).T
    return np.asarray(gaussian.mode + z @ gaussian.root.T)


def quantiles(values: FloatArray, weights: FloatArray, levels: Sequence[float]) -> FloatArray:
    """Return quantiles of values (n,) at points with weights (n,) of sum 1, some of which may be negative."""
    order = np.argsort(values)
    reached = np.maximum.accumulate(np.cumsum(weights[order]) - weights[order] / 2)
    return np.interp(levels, reached, values[order])


def with_nans(values: ArrayLike, count: int) -> FloatArray:
    """Return values (…, m) with NaN behind each row of them, up to so many (…, count)."""
    rows = np.asarray(values)
    more = [*((0, 0) for _ in rows.shape[1:]), (0, count - rows.shape[-1])]
    return np.pad(rows, more, constant_values=np.nan)
