"""Weights of points in a density: their normalisation, their quality, and draws by them.

The quality is measured by the effective sample size (Σw)²/Σw² and the shape k̂ of the tail (A. Vehtari et al., J. Mach.
Learn. Res. 25 (2024) 72). `trustworthy` is the only rule by which weights are trusted, in evidences, posteriors,
left-out scores and findings.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray

TRUSTED = 0.7  # k̂ up to which weights can be trusted
ALIKE = 0.8  # effective share above which weights are practically equal
FEWEST = 20.0  # effective sample size below which weights say nothing
PER_UNKNOWN = 2.0  # points that weights must be worth for each unknown, to stand in place of a Gaussian
MORE = 4.0  # times the points
LEAST_TRIED, EACH = 256, 8  # points that are tried by default: at least, and for each unknown
RULE = (
    f"Weights are to be trusted where they are worth {FEWEST:.0f} points or more, and k̂ is {TRUSTED:g} or less or more "
    f"than {100 * ALIKE:.0f} % of the points count."
)


def normalised(log_weights: FloatArray) -> FloatArray:
    """Return weights (n,) of sum 1 from their logarithms up to a constant."""
    w = np.exp(log_weights - log_weights.max())
    return np.asarray(w / w.sum())


class OfWeights:
    """What is known of points by ln of their weights (n,), up to a constant."""

    log_weights: FloatArray

    @property
    def weights(self) -> FloatArray:
        """Weights (n,) of sum 1."""
        return normalised(self.log_weights)

    @property
    def ess(self) -> float:
        """Effective sample size."""
        return effective_sample_size(self.weights)


def distinct(points: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the weights (k,) of the k different ones among points (n, c), those of copies added.

    Points that were drawn several times from a cloud of others have told the posterior once only.
    """
    _, which = np.unique(points, axis=0, return_inverse=True)
    return np.asarray(np.bincount(which.ravel(), weights), dtype=float)


def quality(points: FloatArray, weights: FloatArray) -> tuple[float, float]:
    """Return what weights (n,) of points (n, c) are worth, and k̂: those of the distinct points.

    Where copies cost less than a fifth of the worth, k̂ is that of the points as they were drawn: a few pairs among
    even weights look like a tail that is not there.
    """
    counted = distinct(points, weights)
    ess = effective_sample_size(counted)
    few = ess >= ALIKE * effective_sample_size(weights)
    return ess, pareto_shape(weights if few else counted)


def fewest(size: int) -> float:
    """Return how many points weighted ones must be worth to stand in place of a Gaussian of as many unknowns.

    A covariance of fewer points than unknowns is singular, and of twice as many still off by a third.
    """
    return max(FEWEST, PER_UNKNOWN * size)


def usual(size: int) -> int:
    """Return how many points are tried by default for so many unknowns: fewer may miss how good they would be."""
    return max(LEAST_TRIED, 32 * -(-EACH * size // 32))


def effective_sample_size(weights: FloatArray) -> float:
    """Return the number of equally weighted points that points with weights (n,) of sum 1 are worth."""
    return float(1 / (weights**2).sum())


def trustworthy(pareto_k: float, ess: float, count: int) -> bool:
    """Whether the weights of `count` points can be trusted."""
    # The tail of almost equal weights says nothing.
    return ess >= FEWEST and (pareto_k <= TRUSTED or ess > ALIKE * count)


def worth(pareto_k: float, ess: float, count: int) -> str:
    """Say in words how good the weights of `count` points are."""
    shape = "∞" if np.isinf(pareto_k) else f"{pareto_k:.2f}".replace("-", "−")
    return f"weights worth {ess:.0f} of {count} points, k̂ = {shape}"


def enough(ess: float, count: int, needed: float = FEWEST) -> int:
    """Return how many points to try where the weights of `count` points cannot be trusted, a multiple of 32.

    Four times as many, since points that are drawn from what the others have told become better too, or as many as
    would be worth the number that is needed if they did not.
    """
    return int(32 * np.ceil(count * max(MORE, needed / max(ess, 1.0)) / 32))


def resampled(weights: FloatArray, count: int, seed: int) -> NDArray[np.intp]:
    """Return points (count,): each as often as its weight says, by systematic resampling, in any order."""
    places = (np.arange(count) + np.random.default_rng(seed).uniform()) / count
    chosen = np.searchsorted(np.cumsum(weights), places).clip(max=len(weights) - 1)
    return np.random.default_rng(seed + 1).permutation(chosen)


def pareto_shape(weights: FloatArray) -> float:
    """Shape k̂ of the generalised Pareto distribution of the largest weights; infinite if there are fewer than 5.

    The fit is the empirical Bayes estimate of J. Zhang, M. A. Stephens, Technometrics 51 (2009) 316–325, drawn a little
    towards 1/2 as Vehtari et al. do.
    """
    n = weights.size
    count = int(np.ceil(min(0.2 * n, 3 * np.sqrt(n))))
    ordered = np.sort(weights)
    exceed = ordered[n - count :] - ordered[n - count - 1] if n > count else np.empty(0)
    exceed = exceed[exceed > 0]
    m = exceed.size
    if m < 5:
        return float("inf")
    # A grid of θ = −k/σ, each weighted by its profile likelihood.
    grid = 30 + int(np.sqrt(m))
    j = np.arange(1, grid + 1)
    theta = 1 / exceed[-1] + (1 - np.sqrt(grid / (j - 0.5))) / (3 * exceed[int(m / 4 + 0.5) - 1])
    k = np.log1p(-theta[:, None] * exceed).mean(axis=1)
    profile = m * (np.log(-theta / k) - k - 1)
    share = 1 / np.exp(profile - profile[:, None]).sum(axis=1)
    mean = float(theta @ share / share.sum())
    shape = float(np.log1p(-mean * exceed).mean())
    return float((shape * m + 0.5 * 10) / (m + 10))
