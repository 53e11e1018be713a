"""What is printed of a posterior of few parameters: by Laplace's Gaussian, by weighted points, or by chains.

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

from forward.model import FloatArray
from inverse.criticism.chains import Chains
from inverse.criticism.weights import PER_UNKNOWN, fewest
from inverse.low_dimensional.evidence import Evidence
from inverse.low_dimensional.laplace import Laplace
from inverse.low_dimensional.posterior import Posterior
from uq.inputs.sampling import sobol_points

Source = Literal["laplace", "points", "chains"]
MAPPED = 4096  # points of Laplace's Gaussian that correct the moments of the linear functions


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
    """

    source: Source
    mean: FloatArray
    covariance: FloatArray
    quantiles: Callable[[Sequence[float]], FloatArray]

    @property
    def std(self) -> FloatArray:
        """Standard deviations (c,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def counts(found: Evidence) -> bool:
    """Whether weighted points may stand in place of a Gaussian."""
    return found.trusted and found.ess >= fewest(found.density.x.shape[1])


def source_of(found: Evidence, chains: Chains | None = None) -> Source:
    """Return what is printed of a posterior, given weighted points, and chains if there are any."""
    if chains is not None and chains.mixed:
        return "chains"
    return "points" if found.route != "closed form" and counts(found) else "laplace"


def answer(posterior: Posterior, gaussian: Laplace, found: Evidence, chains: Chains | None = None) -> Answer:
    """Return what is printed of a posterior, given Laplace's Gaussian, weighted points, and chains if there are any."""
    source = source_of(found, chains)
    if source == "laplace":
        return by_gaussian(posterior, gaussian)
    if source == "chains":
        assert chains is not None
        return by_points("chains", chains.flat, np.full(len(chains.flat), 1 / len(chains.flat)))
    return by_points("points", posterior.physical(found.density.x), found.weights)


def by_points(source: Source, points: FloatArray, weights: FloatArray) -> Answer:
    """Return moments and quantiles of points (n, c) with weights (n,) of sum 1."""
    used = weights > 0
    points, weights = points[used], weights[used]
    mean = weights @ points
    gaps = points - mean

    def ends(levels: Sequence[float]) -> FloatArray:
        return np.array([quantiles(column, weights, levels) for column in points.T])

    return Answer(source, mean, (weights[:, None] * gaps).T @ gaps, ends)


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
    return Answer("laplace", mean, covariance, partial(_along, posterior, gaussian, slopes))


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
    """Return quantiles of values (n,) at points with weights (n,) of sum 1."""
    order = np.argsort(values)
    reached = np.cumsum(weights[order]) - weights[order] / 2
    return np.interp(levels, reached, values[order])
