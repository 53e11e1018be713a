"""Quantiles of samples with 95 % intervals, without assumptions on their distribution."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.estimators.moments import ONE_SIDED, Z, student


class Quantiles(NamedTuple):
    """Quantiles (k, m) of m quantities, with the ends of 95 % intervals and errors.

    Attributes
    ----------
    central, lower, upper
        The quantiles and the ends of their intervals.
    error
        The longer of the two sides over the factor of `half_width`, as a standard error.
    """

    central: FloatArray
    lower: FloatArray
    upper: FloatArray
    error: FloatArray

    @property
    def variables(self) -> dict[str, tuple[tuple[str, ...], FloatArray]]:
        """The quantiles as variables of results."""
        by = ("quantile", "output")
        return {
            "quantiles": (by, self.central),
            "quantiles_error": (by, self.error),
            "quantiles_lower": (by, self.lower),
            "quantiles_upper": (by, self.upper),
        }


def quantiles(values: FloatArray, probabilities: tuple[float, ...]) -> Quantiles:
    """Quantiles of independent samples (n, m), with 95 % intervals between order statistics.

    X_(a) lies below the p-quantile with probability I_p(a, n + 1 − a), which is also defined for a between whole
    numbers (A. D. Hutson, J. Appl. Stat. 26 (1999) 343–353). If a < 1 the interval extends beyond the samples: there
    the tail is assumed exponential, with the mean distance of the outermost quarter.
    """
    return _between(values, np.array(probabilities), np.full((len(probabilities), values.shape[1]), len(values)), Z)


def quantiles_worth(values: FloatArray, probabilities: tuple[float, ...], worth: float) -> Quantiles:
    """Quantiles of values (n, m), with the intervals of as many independent samples as they are worth."""
    return _between(values, np.array(probabilities), np.full((len(probabilities), values.shape[1]), worth), Z)


def quantiles_from_replicates(
    values: FloatArray, replicate: NDArray[np.int64], probabilities: tuple[float, ...]
) -> Quantiles:
    """Quantiles of all values (n, m), with intervals from the scatter of the replicates (n,) that they belong to.

    As `quantiles`, with n replaced by the number of independent samples that give the share of values below the
    quantile as accurately: p(1 − p) over the variance of this share by the replicates, times (1.96/t)², since the
    scatter of R replicates has R − 1 degrees of freedom (E. L. Korn, B. I. Graubard, Surv. Methodol. 24 (1998)
    193–201). A share of n/R values has at least a rounding error of 1/√12 of R/n.
    """
    p = np.array(probabilities)
    central = np.quantile(values, p, axis=0)
    names = np.unique(replicate)
    R = len(names)
    below = values[None, :, :] <= central[:, None, :]
    shares = np.array([below[:, replicate == name].mean(axis=1) for name in names])
    floor = R / len(values) / np.sqrt(12 * R)
    spread = np.maximum(shares.std(axis=0, ddof=1) / np.sqrt(R), floor)
    t = student(R - 1)
    return _between(values, p, (p * (1 - p))[:, None] / spread**2 * (Z / t) ** 2, t)


def quantiles_of_shares(values: FloatArray, probabilities: tuple[float, ...], errors: FloatArray) -> Quantiles:
    """Quantiles of values (n, m) that stand for a distribution, with standard errors (k, m) of the shares below them.

    As `quantiles_from_replicates`, with the intervals of so many independent samples as give these shares as well.
    """
    p = np.array(probabilities)[:, None]
    counts = p * (1 - p) / np.maximum(errors, 1e-3 / len(values)) ** 2
    return _between(values, p[:, 0], np.minimum(counts, 1e9), Z)


def _between(values: FloatArray, p: FloatArray, counts: FloatArray, factor: float) -> Quantiles:
    """Quantiles of values (n, m), with intervals as from these numbers of independent samples (k, m)."""
    ordered = np.sort(values, axis=0)
    central = np.quantile(values, p, axis=0)
    lower = _order_statistic(ordered, _level(p[:, None], counts))
    upper = -_order_statistic(-ordered[::-1], _level(1 - p[:, None], counts))
    # Quantiles of few samples are interpolated in another way, and may lie outside.
    lower, upper = np.minimum(lower, central), np.maximum(upper, central)
    return Quantiles(central, lower, upper, np.maximum(upper - central, central - lower) / factor)


def _level(p: FloatArray, n: FloatArray) -> FloatArray:
    """Share a/(n + 1) of the order statistic that lies below the p-quantile with a probability of 97.5 %."""
    from scipy.special import betainc

    low, high = np.zeros(np.broadcast_shapes(p.shape, n.shape)), (n + 1) * np.ones_like(p)
    for _ in range(50):
        middle = (low + high) / 2
        more = betainc(np.maximum(middle, 1e-300), np.maximum(n + 1 - middle, 1e-300), p) > ONE_SIDED
        low, high = np.where(more, middle, low), np.where(more, high, middle)
    return np.asarray(low / (n + 1))


def _order_statistic(ordered: FloatArray, share: FloatArray) -> FloatArray:
    """Return X_(a) (k, m) with a = share·(n + 1), between order statistics (n, m) or below all of them."""
    n, m = ordered.shape
    place = share * (n + 1) - 1
    below = np.clip(np.floor(place).astype(int), 0, n - 1)
    above = np.minimum(below + 1, n - 1)
    columns = np.arange(m)
    at = ordered[below, columns]
    inside = at + np.clip(place - below, 0, 1) * (ordered[above, columns] - at)
    few = min(max(2, n // 4), n - 1)
    # The relative error of the mean of so few is one over the root of their number.
    tail = (1 + few**-0.5) * (ordered[few] - ordered[:few].mean(axis=0))
    return np.asarray(np.where(place < 0, ordered[0] + tail * np.log(np.maximum(place + 1, 1e-12)), inside))
