"""Simulation-based calibration: whether posteriors of few parameters are right about the truth.

Parameters are drawn from their prior and measured with noise. The posterior probability of values below the truth is
uniform on [0, 1], for every parameter, if the posterior is right (S. R. Cook, A. Gelman,
D. B. Rubin, J. Comput. Graph. Stat. 15 (2006) 675–692; S. Talts et al., arXiv:1804.06788): too many near both ends
if it is too narrow, in the middle if it is too wide, at one end if it is biased.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray, SolveError
from inverse.low_dimensional.evidence import Evidence, evidence
from inverse.low_dimensional.laplace import Laplace, laplace
from inverse.low_dimensional.posterior import Posterior

if TYPE_CHECKING:
    import xarray as xr

BINS = 20
Kind = Literal["laplace", "corrected"]


@dataclass(frozen=True, eq=False)
class Calibration:
    """Ranks of the truth in the posteriors of n specimens; NaN rows where no posterior was found.

    Attributes
    ----------
    names
        Of the c coordinates.
    truths
        Physical parameters (n, c), and the noise where it is unknown.
    laplace, corrected
        Probabilities (n, c) of values below the truth, by Laplace's Gaussian and by weighted points.
    ess, pareto_k
        Effective sample sizes (n,), and k̂ (n,) of the weights.
    trusted
        Whether (n,) the weights can be trusted.
    failures
        Why specimens have no posterior, by number.
    """

    names: tuple[str, ...]
    truths: FloatArray
    laplace: FloatArray
    corrected: FloatArray
    ess: FloatArray
    pareto_k: FloatArray
    trusted: NDArray[np.bool_]
    failures: dict[int, str]

    def found(self, kind: Kind) -> FloatArray:
        """Probabilities (k, c) of the specimens that have a posterior."""
        values: FloatArray = getattr(self, kind)
        return np.asarray(values[np.isfinite(values).all(axis=1)])

    def probabilities(self, kind: Kind) -> FloatArray:
        """Probabilities (c,) that uniform ranks are as far from uniform (A. Kolmogorov, N. Smirnov)."""
        from scipy.stats import kstest

        return np.array([kstest(column, "uniform").pvalue for column in self.found(kind).T])

    def probability(self, kind: Kind) -> float:
        """The same for all coordinates together: the smallest, times their number (C. Bonferroni)."""
        return float(min(1.0, len(self.names) * self.probabilities(kind).min()))

    def counts(self, kind: Kind, bins: int = BINS) -> NDArray[np.int64]:
        """Histogram (c, bins) of the ranks."""
        columns = self.found(kind).T
        return np.array([np.histogram(column, bins, (0.0, 1.0))[0] for column in columns])

    def coverage(self, kind: Kind, level: float) -> FloatArray:
        """Share (c,) of specimens whose truth lies in the central interval of a level."""
        return np.asarray((np.abs(self.found(kind) - 0.5) <= level / 2).mean(axis=0))

    def dataset(self, bins: int = BINS) -> xr.Dataset:
        """Return everything that a plot needs."""
        import xarray as xr

        kinds: tuple[Kind, Kind] = ("laplace", "corrected")
        specimen = ("specimen", "parameter")
        return xr.Dataset(
            {
                "truth": (specimen, self.truths),
                "rank": (("posterior", *specimen), np.array([self.laplace, self.corrected])),
                "count": (("posterior", "parameter", "bin"), np.array([self.counts(kind, bins) for kind in kinds])),
                "probability": (("posterior", "parameter"), np.array([self.probabilities(kind) for kind in kinds])),
                "effective": ("specimen", self.ess),
                "tail": ("specimen", self.pareto_k),
                "trusted": ("specimen", self.trusted),
            },
            {"posterior": list(kinds), "parameter": list(self.names), "bin": (np.arange(bins) + 0.5) / bins},
        )


def calibrate(
    posterior: Posterior,
    specimens: int = 200,
    *,
    samples: int = 64,
    starts: int = 2,
    seed: int = 0,
    progress: Callable[[int], None] = lambda done: None,
) -> Calibration:
    """Draw specimens from the prior, measure and invert them.

    Parameters
    ----------
    posterior
        A posterior whose data are replaced by those of each specimen.
    specimens
        Their number n.
    samples
        Solves for the weighted points of each, at least 32.
    starts
        Of the search for each mode.
    seed
        Of parameters and noise.
    progress
        Told how many are done.
    """
    rng = np.random.default_rng(seed)
    c = len(posterior.names)
    x = rng.standard_normal((specimens, c))
    errors = rng.standard_normal((specimens, posterior.data.size))
    ties = rng.random((specimens, c))
    physical = posterior.physical(x)
    measured = posterior.at(x)
    scale = posterior.noise.sigma * (1.0 if posterior.noise.factor is None else physical[:, -1:])
    data = measured.outputs + scale * errors
    by_laplace, corrected = np.full((2, specimens, c), np.nan)
    ess, pareto_k = np.zeros(specimens), np.full(specimens, np.inf)
    trusted = np.zeros(specimens, dtype=bool)
    failures: dict[int, str] = {}
    for k in range(specimens):
        if not np.isfinite(measured.log_likelihood[k]):
            failures[k] = "the model has no answer at the truth"
            continue
        try:
            one = replace(posterior, data=data[k])
            gaussian = laplace(one, starts=starts, seed=k)
            by_laplace[k] = rank_by_laplace(gaussian, x[k])
            found = evidence(one, gaussian, samples, seed=seed + k)
            corrected[k] = rank_by_weights(found, x[k], ties[k])
            ess[k], pareto_k[k], trusted[k] = found.ess, found.pareto_k, found.trusted
        except SolveError as error:
            failures[k] = error.reason
        progress(k + 1)
    return Calibration(posterior.names, physical, by_laplace, corrected, ess, pareto_k, trusted, failures)


def rank_by_laplace(gaussian: Laplace, x: FloatArray) -> FloatArray:
    """Probabilities (c,) that a Gaussian gives to coordinates below x (c,)."""
    from scipy.special import ndtr

    return np.asarray(ndtr((x - gaussian.mode) / np.sqrt(np.diag(gaussian.covariance))))


def rank_by_weights(found: Evidence, x: FloatArray, tie: FloatArray) -> FloatArray:
    """Probabilities (c,) that weighted points give to coordinates below x (c,).

    The truth is one more draw: among m equivalent draws, its rank is uniform on 0 … m, so that (m P + u)/(m + 1) is
    uniform on [0, 1], with m the effective sample size and uniform numbers u (c,).
    """
    share = found.weights @ (found.density.x < x)
    return np.asarray((found.ess * share + tie) / (found.ess + 1))
