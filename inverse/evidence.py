"""The evidence Z = ∫ p(y | x) N(x; 0, I) dx of a model by importance sampling, with its error.

Points are drawn from a mixture of the Gaussian of Laplace, made wider, and of the prior, at independent scrambles of
Sobol' points. A point that either half could have drawn is weighted by the whole mixture,

    w = p(y | x) N(x; 0, I) / (α N(x; x̂, τ² H⁻¹) + (1 − α) N(x; 0, I)) ≤ p(y | x)/(1 − α),

so that no weight is large because the Gaussian is narrow (T. Hesterberg, Technometrics 37 (1995) 185–194). The mean
weight of a scramble is an unbiased estimate of Z; their scatter gives the error. What the weights are worth beside that
is told by the effective sample size (Σw)²/Σw² and the shape k̂ of their tail (A. Vehtari et al., J. Mach. Learn. Res. 25
(2024) 72): above 0.7 they are not to be trusted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from forward.model import FloatArray
from inverse.laplace import Laplace
from inverse.posterior import Density, Posterior
from uq.sampling import sobol_points

WIDER = 1.3  # τ: standard deviations of the proposal over those of Laplace
SHARE = 0.7  # α: of the points from the Gaussian
SCRAMBLES = 8
TRUSTED = 0.7  # k̂ up to which weights are worth what they say


@dataclass(frozen=True)
class Evidence:
    """An estimate of ln Z by weighted points.

    Attributes
    ----------
    log_evidence, error
        ln Z, and its standard error from the scatter of the scrambles.
    effective
        Effective number of points.
    tail
        k̂ of the largest weights; infinite where there are too few points to say.
    density
        The posterior at the points.
    log_weights
        ln w (n,).
    """

    log_evidence: float
    error: float
    effective: float
    tail: float
    density: Density
    log_weights: FloatArray

    @property
    def trusted(self) -> bool:
        """Whether the weights are worth what they say."""
        return bool(self.tail <= TRUSTED)

    @property
    def weights(self) -> FloatArray:
        """Weights (n,) of the points in the posterior, of sum 1."""
        w = np.exp(self.log_weights - self.log_weights.max())
        return np.asarray(w / w.sum())


def importance(posterior: Posterior, gaussian: Laplace, samples: int, *, seed: int = 0) -> Evidence:
    """Estimate the evidence at `samples` points around a Gaussian.

    Parameters
    ----------
    posterior, gaussian
        What is weighted, and where.
    samples
        Number of solves, rounded down to 8 scrambles of as many points.
    seed
        Of the scrambles.
    """
    from scipy.special import ndtri

    each = samples // SCRAMBLES
    if each < 2:
        message = f"{samples} samples, expected at least {2 * SCRAMBLES}"
        raise ValueError(message)
    c = gaussian.mode.size
    cubes = np.concatenate([sobol_points(seed, r, 0, each, c + 1) for r in range(SCRAMBLES)])
    z = ndtri(cubes[:, 1:])
    from_gaussian = cubes[:, 0] < SHARE
    x = np.where(from_gaussian[:, None], gaussian.mode + WIDER * z @ gaussian.root.T, z)
    density = posterior.at(x)
    log_weights = density.log_likelihood - _log_mixture_over_prior(x, gaussian)
    return weighed(density, log_weights)


def weighed(density: Density, log_weights: FloatArray) -> Evidence:
    """Make an estimate of weights (n,) of which every eighth part, in order, is an independent replicate."""
    shift = log_weights.max()
    w = np.exp(log_weights - shift)
    means = w.reshape(SCRAMBLES, -1).mean(axis=1)
    total = float(means.mean())
    error = float(means.std(ddof=1) / np.sqrt(SCRAMBLES) / total)
    return Evidence(
        float(shift + np.log(total)), error, float(w.sum() ** 2 / (w**2).sum()), tail_shape(w), density, log_weights
    )


def _log_mixture_over_prior(x: FloatArray, gaussian: Laplace) -> FloatArray:
    """Ln of (α N(x; x̂, τ²H⁻¹) + (1 − α) N(x; 0, I)) / N(x; 0, I), (n,)."""
    deviation = (x - gaussian.mode) / WIDER
    exponent = -np.einsum("zi,ij,zj->z", deviation, gaussian.hessian, deviation) / 2
    log_gaussian = exponent + np.linalg.slogdet(gaussian.hessian)[1] / 2 - gaussian.mode.size * np.log(WIDER)
    log_prior = -(x**2).sum(axis=1) / 2
    return np.asarray(np.logaddexp(np.log(SHARE) + log_gaussian - log_prior, np.log(1 - SHARE)))


def tail_shape(weights: FloatArray) -> float:
    """Shape k̂ of the generalised Pareto distribution of the largest weights; infinite where they are fewer than 5.

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
