"""Quantiles with 95 % intervals, without assumptions on their distribution: of samples, and of groups of models.

Of one model from groups of samples of several: the share of outputs below a threshold t is the mean of an indicator,
which groups of models tell as they tell that of the output (`uq.estimators.fidelities`): F(t) = Σ_g Σ_k a_gk ⟨1(w_k ≤
t)⟩_g, without bias for any weights that sum to 1 for model 0 and to 0 for the others. The weights are those for the
mean, since a pilot has too few samples in a tail to tell others; what scatters is a sample's indicators, so that the
error is honest where the weights are not the best. Of few samples in which the indicators of two models differ, half a
sample more is counted. Where model 0 has no answer, F(t) stands for its indicator, as the mean for its output in
`uq.estimators.fidelities`. Models are compared at the same distance from their outputs at the mean parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.estimators.blue import Group, informations, weights
from uq.estimators.estimate import Variables
from uq.estimators.fidelities import ROUNDS, Samples, folds, share_answered
from uq.estimators.moments import ONE_SIDED, Z, student
from uq.estimators.subsampled_difference import Chosen, Pooled

THRESHOLDS = 129
FEWER = 0.5  # samples that may differ unseen
EQUIVALENT = 2001  # values that stand for the distribution


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
    def variables(self) -> Variables:
        """The quantiles as variables of results."""
        by = ("quantile", "output")
        return {
            "quantiles": (by, self.central),
            "quantiles_error": (by, self.error),
            "quantiles_lower": (by, self.lower),
            "quantiles_upper": (by, self.upper),
        }


def quantiles(values: FloatArray, probabilities: tuple[float, ...], worth: float | None = None) -> Quantiles:
    """Quantiles of independent samples (n, m), or as many as they are worth, with 95 % intervals of order statistics.

    X_(a) lies below the p-quantile with probability I_p(a, n + 1 − a), which is also defined for a between whole
    numbers (A. D. Hutson, J. Appl. Stat. 26 (1999) 343–353). If a < 1 the interval extends beyond the samples: there
    the tail is assumed exponential, with the mean distance of the outermost quarter.
    """
    counts = np.full((len(probabilities), values.shape[1]), len(values) if worth is None else worth)
    return _between(values, np.array(probabilities), counts, Z)


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


def quantiles_of_groups(
    samples: Sequence[Samples], offset: FloatArray, probabilities: tuple[float, ...], apart: Samples | None = None
) -> Quantiles:
    """Return quantiles of the outputs of model 0.

    Parameters
    ----------
    samples
        Of each group.
    offset
        What the deviations of model 0 are from (m,).
    probabilities
        Of the quantiles.
    apart
        Samples of all models that tell the weights, and nothing else; by default the first group does.
    """

    def known(j: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        every = np.concatenate([one.deviations[:, list(one.group), j].ravel() for one in samples])
        thresholds = _thresholds(every[np.isfinite(every)])
        return thresholds, *below(samples, j, thresholds, apart)

    return _of_thresholds(known, offset, probabilities)


def quantiles_of_chosen(
    pooled: Pooled, found: Chosen, offset: FloatArray, probabilities: tuple[float, ...]
) -> Quantiles:
    """Return quantiles of the outputs of model 0, of pools of which some points were chosen.

    How they are chosen: `uq.estimators.subsampled_difference`.

    The share below a threshold is that of the predictions, and what the chosen points say they miss.
    """
    ok = np.isfinite(pooled.values).all(axis=1)

    def known(j: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        values = found.predicted[:, j]
        thresholds = _thresholds(np.concatenate([values, pooled.values[ok, j]]))
        predicted = (values[:, None] <= thresholds).astype(float)
        rows, weights = pooled.rows, 1 / pooled.expected[:, None]
        inside = (pooled.values[:, j, None] <= thresholds).astype(float)
        share = inside[ok].mean(axis=0)
        for _ in range(1 if ok.all() else ROUNDS):
            inside[~ok] = share
            parts = predicted / len(values)
            parts[rows] += weights * (inside - predicted[rows])
            share = parts.sum(axis=0)
        variance = FEWER / ok.sum() ** 2 + np.zeros(len(thresholds))
        for a, b in zip(pooled.starts[:-1], pooled.starts[1:], strict=True):
            variance += parts[a:b].var(axis=0, ddof=1) * (b - a)
        return thresholds, share, np.sqrt(variance) / pooled.answered

    return _of_thresholds(known, offset, probabilities)


def _thresholds(values: FloatArray) -> FloatArray:
    return np.asarray(np.unique(np.quantile(values, np.linspace(0, 1, THRESHOLDS))))


def _of_thresholds(
    known: Callable[[int], tuple[FloatArray, FloatArray, FloatArray]],
    offset: FloatArray,
    probabilities: tuple[float, ...],
) -> Quantiles:
    """Quantiles from thresholds, shares below them and errors of these, by output."""
    p, levels = np.array(probabilities), (np.arange(EQUIVALENT) + 0.5) / EQUIVALENT
    values, errors = np.empty((EQUIVALENT, offset.size)), np.empty((len(p), offset.size))
    for j in range(offset.size):
        thresholds, share, error = known(j)
        # Differences of shares may fall where they should rise; between the largest before and the least after.
        up, down = np.maximum.accumulate(share), np.minimum.accumulate(share[::-1])[::-1]
        rising = np.clip((up + down) / 2, 0, 1)
        values[:, j] = offset[j] + np.interp(levels, rising, thresholds)
        errors[:, j] = np.interp(np.interp(p, rising, thresholds), thresholds, error)
    return quantiles_of_shares(values, probabilities, errors)


def below(
    samples: Sequence[Samples], j: int, thresholds: FloatArray, apart: Samples | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the shares (t,) of output j of model 0 below thresholds (t,), as deviations, and their standard errors."""
    whole = apart or samples[0]
    groups, counts = [one.group for one in samples], np.array([float(one.count) for one in samples])
    indicators = [(one.deviations[:, :, j, None] <= thresholds).astype(float) for one in samples]
    answered = [one.answered for one in samples]
    own = [g for g, group in enumerate(groups) if 0 in group]
    share = np.concatenate([indicators[g][answered[g], 0] for g in own]).mean(axis=0)
    cut = []
    for kept, portion in folds(whole, inner=apart is None):
        w = whole.deviations[kept & whole.answered, :, j]
        cut.append((kept, portion, weights(informations(groups, np.atleast_2d(np.cov(w.T))), counts)))
    for _ in range(1 if all(one.all() for one in answered) else ROUNDS):
        for g in own:
            indicators[g][~answered[g], 0] = share
        parts = _parts(indicators, groups, cut, inner=apart is None)
        share = np.sum([one.mean(axis=0) for one in parts], axis=0)
    variance = np.sum([one.var(axis=0, ddof=1) / len(one) for one in parts], axis=0)
    variance += sum(FEWER / len(one) ** 2 for one, group in zip(parts, groups, strict=True) if 0 in group)
    return share, np.sqrt(variance) / share_answered(samples)


def _parts(
    indicators: Sequence[FloatArray],
    groups: Sequence[Group],
    cut: Sequence[tuple[NDArray[np.bool_], float, FloatArray]],
    *,
    inner: bool,
) -> list[FloatArray]:
    """Return the summands (n, t) of the shares by group, from indicators (n, K, t) and the weights of each fold."""
    parts = [np.zeros((len(one), one.shape[2])) for one in indicators]
    middle = np.array(
        [
            np.concatenate([i[:, k] for i, group in zip(indicators, groups, strict=True) if k in group]).mean(axis=0)
            for k in range(indicators[0].shape[1])
        ]
    )
    for kept, share, a in cut:
        for g, (found, values) in enumerate(zip(parts, indicators, strict=True)):
            of_fold = g == 0 and inner
            rows = ~kept if of_fold else slice(None)
            group = list(groups[g])
            combined = np.tensordot(values[rows][:, group] - middle[group], a[g][group], (1, 0))
            found[rows] += (1.0 if of_fold else share) * (combined + (middle[0] if g == 0 else 0.0))
    return parts
