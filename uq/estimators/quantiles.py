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
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from forward.findings import Finding, entries
from forward.model import FloatArray
from uq.estimators.blue import Group, informations, weights
from uq.estimators.fidelities import ROUNDS, Samples, folds, pooled_means, share_answered
from uq.estimators.moments import ONE_SIDED, Z, student
from uq.estimators.subsampled_difference import Chosen
from uq.findings import add

if TYPE_CHECKING:
    import xarray as xr

THRESHOLDS = 129
FEWER = 0.5  # samples that may differ unseen
NEAR = 4  # samples at least that tell what predictions miss at a quantile
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

    def on(self, dataset: xr.Dataset, probabilities: Sequence[float]) -> xr.Dataset:
        """Return results with these quantiles, and say which of their intervals have no end."""
        by, found = ("quantile", "output"), self._rising(probabilities)
        dataset = dataset.assign_coords(quantile=list(probabilities)).assign(
            quantiles=(by, found.central),
            quantiles_error=(by, found.error),
            quantiles_lower=(by, found.lower),
            quantiles_upper=(by, found.upper),
        )
        endless = np.isinf(found.error)
        if endless.any():
            levels = ", ".join(f"{100 * p:g} %" for p in np.array(probabilities)[endless.any(axis=1)])
            names = dataset["output"].to_numpy()[endless.any(axis=0)].tolist()
            add(dataset, Finding("quantiles-endless", "note", {"levels": levels}, about=entries(names)))
        return dataset

    def wider(self, below: FloatArray, above: FloatArray) -> Quantiles:
        """Return the same with further independent errors, the sides (k, m) of their 95 % intervals."""
        lower, upper = np.hypot(self.central - self.lower, below), np.hypot(self.upper - self.central, above)
        error = np.hypot(self.error, np.maximum(below, above) / Z)
        return Quantiles(self.central, self.central - lower, self.central + upper, error)

    def moved(self, by: FloatArray) -> Quantiles:
        """Return those of the quantities plus numbers (m,)."""
        return Quantiles(self.central + by, self.lower + by, self.upper + by, self.error)

    def or_shorter(self, other: Quantiles, usable: NDArray[np.bool_]) -> Quantiles:
        """Return quantiles with the shorter one of two intervals; the other is usable for some quantities (m,)."""
        which = usable & (other.upper - other.lower < self.upper - self.lower)
        return Quantiles(*(np.where(which, *pair) for pair in zip(other, self, strict=True)))

    def _rising(self, probabilities: Sequence[float]) -> Quantiles:
        """Return quantiles that rise with the probability, between ends that do: each end bounds its neighbours too."""
        order = np.argsort(probabilities)
        back = np.argsort(order)
        central = np.sort(self.central[order], axis=0)[back]
        lower = np.maximum.accumulate(self.lower[order])[back]
        upper = np.minimum.accumulate(self.upper[order][::-1])[::-1][back]
        before, after = (np.maximum(up - at, at - low) for at, low, up in (self[:3], (central, lower, upper)))
        known = np.isfinite(before) & (before > 0)
        error = np.where(known, self.error / np.where(known, before, 1.0), 1 / Z) * after
        return Quantiles(central, lower, upper, error)


def quantiles(values: FloatArray, probabilities: tuple[float, ...], worth: float | None = None) -> Quantiles:
    """Quantiles of independent samples (n, m), or as many as they are worth, with 95 % intervals of order statistics.

    X_(a) lies below the p-quantile with probability I_p(a, n + 1 − a), which is also defined for a between whole
    numbers (A. D. Hutson, J. Appl. Stat. 26 (1999) 343–353). If a < 1 the interval extends beyond the samples: there
    the tail is assumed exponential, with the mean distance of the outermost quarter. A quantile with less than one
    sample beyond it, by its probability, may be anywhere there: its interval has no end on that side.
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
    193–201). A share of n/R values has at least a rounding error of 1/√12 of R/n. Where less than one value of each
    replicate is beyond the quantile, replicates tell nothing of their own scatter, and values count as independent.
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
    worth = (p * (1 - p))[:, None] / spread**2 * (Z / t) ** 2
    few = np.minimum(p, 1 - p)[:, None] * len(values) < R
    return _between(values, p, np.where(few, len(values), worth), t)


def quantiles_of_predictions(
    drawn: FloatArray,
    part: NDArray[np.int64],
    predicted: FloatArray,
    left: FloatArray,
    weights: FloatArray,
    probabilities: tuple[float, ...],
    missing: FloatArray | None = None,
) -> Quantiles:
    """Quantiles of a function by predictions of it at many points, which no solve takes.

    No quantile moves by more than the function does where it has that value: by what predictions leave of those samples
    that are nearest to it, as many as the root of their number. Of a quantile with less than one sample beyond it, what
    is missed there may be the largest square of these in all of the part that one sample stands for. A function of norm
    τ that no sample shows has in a part of probability a at most the root mean square τ/√a.

    Parameters
    ----------
    drawn, part
        Predictions (N, m), and to which replicate (N,) of the distribution each belongs.
    predicted, left
        Predictions (n, m) at samples, and the outputs there minus these.
    weights
        Of the samples (n,).
    probabilities
        Of the quantiles.
    missing
        Norms τ (m,), if there are any.
    """
    found = quantiles_from_replicates(drawn, part, probabilities)
    n, m = left.shape
    near = min(n, max(NEAR, round(n**0.5)))
    order = np.argsort(predicted, axis=0)
    ordered = np.take_along_axis(predicted, order, axis=0)
    places = np.column_stack([np.searchsorted(one, at) for one, at in zip(ordered.T, found.central.T, strict=True)])
    first = np.clip(places - near // 2, 0, n - near)

    def nearby(summands: FloatArray) -> FloatArray:
        sums = np.concatenate([np.zeros((1, m)), np.cumsum(np.take_along_axis(summands, order, axis=0), axis=0)])
        return np.asarray(np.take_along_axis(sums, first + near, axis=0) - np.take_along_axis(sums, first, axis=0))

    each = np.broadcast_to(weights[:, None], left.shape)
    squares = nearby(each * left**2) / nearby(each)
    p = np.array(probabilities)[:, None]
    beyond = np.minimum(p, 1 - p)
    out = np.minimum(weights.sum() ** 2 / (weights**2).sum() * beyond, 1)
    outwards = np.take_along_axis(left**2, order, axis=0)
    low, high = outwards[:near].max(axis=0), outwards[-near:].max(axis=0)
    squares = np.where(out < 1, np.where(p < 0.5, low, high) / out, np.maximum(squares, 0))
    if missing is not None:
        squares = squares + missing**2 / beyond
    further = Z * np.sqrt(squares)
    return found.wider(further, further)


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
    shares = p[:, None], 1 - p[:, None]
    lower, upper = (
        np.where(np.minimum(counts, len(values)) * share < 1, -np.inf, _order_statistic(one, share, counts))
        for one, share in zip((ordered, -ordered[::-1]), shares, strict=True)
    )
    # Quantiles of few samples are interpolated in another way, and may lie outside.
    lower, upper = np.minimum(lower, central), np.maximum(-upper, central)
    error = np.maximum(upper - central, central - lower) / factor
    return Quantiles(central, lower, upper, error)


def _level(p: FloatArray, n: FloatArray) -> FloatArray:
    """Share a/(n + 1) of the order statistic that lies below the p-quantile with a probability of 97.5 %."""
    from scipy.special import betainc

    low, high = np.zeros(np.broadcast_shapes(p.shape, n.shape)), (n + 1) * np.ones_like(p)
    for _ in range(50):
        middle = (low + high) / 2
        more = betainc(np.maximum(middle, 1e-300), np.maximum(n + 1 - middle, 1e-300), p) > ONE_SIDED
        low, high = np.where(more, middle, low), np.where(more, high, middle)
    return np.asarray(low / (n + 1))


def _order_statistic(ordered: FloatArray, p: FloatArray, counts: FloatArray) -> FloatArray:
    """Return X_(a) (k, m) of as many samples, of order statistics (n, m), that lies below the p-quantile with 97.5 %.

    Between order statistics, or below all of them.
    """
    n, m = ordered.shape
    share, first = _level(p, counts), 1 / (np.minimum(counts, n) + 1)
    place = np.clip(np.maximum(share, first) * (n + 1) - 1, 0, n - 1)
    below = np.minimum(place.astype(int), max(n - 2, 0))
    columns = np.arange(m)
    inside = ordered[below, columns]
    inside = inside + (place - below) * (ordered[np.minimum(below + 1, n - 1), columns] - inside)
    few = min(max(2, n // 4), n - 1)
    # The relative error of the mean of so few is one over the root of their number.
    tail = (1 + few**-0.5) * (ordered[few] - ordered[:few].mean(axis=0))
    return np.asarray(inside + tail * np.log(np.clip(share / first, 1e-12, 1)))


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


def quantiles_of_chosen(found: Chosen, offset: FloatArray, probabilities: tuple[float, ...]) -> Quantiles:
    """Return quantiles of the outputs of model 0, of pools of which some points were chosen.

    How they are chosen: `uq.estimators.subsampled_difference`.

    The share below a threshold is that of the predictions, and what the chosen points say they miss.
    """
    pooled = found.pooled
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
    middle = pooled_means(groups, indicators)
    for kept, share, a in cut:
        for g, (found, values) in enumerate(zip(parts, indicators, strict=True)):
            of_fold = g == 0 and inner
            rows = ~kept if of_fold else slice(None)
            group = list(groups[g])
            combined = np.tensordot(values[rows][:, group] - middle[group], a[g][group], (1, 0))
            found[rows] += (1.0 if of_fold else share) * (combined + (middle[0] if g == 0 else 0.0))
    return parts
