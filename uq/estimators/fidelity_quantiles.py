"""Quantiles of one model from groups of samples of several.

The share of outputs below a threshold t is the mean of an indicator, which groups of models tell as they tell that of
the output (`uq.estimators.fidelities`): F(t) = Σ_g Σ_k a_gk ⟨1(w_k ≤ t)⟩_g, without bias for any weights that sum to 1
for model 0 and to 0 for the others. The weights are those for the mean, since a pilot has too few samples in a tail to
tell others; what scatters is a sample's indicators, so that the error is honest where the weights are not the best. Of
few samples in which the indicators of two models differ, half a sample more is counted. Where model 0 has no answer,
F(t) stands for its indicator, as the mean for its output in `uq.estimators.fidelities`. Models are compared at the same
distance from their outputs at the mean parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.estimators.blue import Group, informations, weights
from uq.estimators.chosen import Chosen, Pooled
from uq.estimators.fidelities import ROUNDS, Samples, folds, share_answered
from uq.estimators.quantiles import Quantiles, quantiles_of_shares

THRESHOLDS = 129
FEWER = 0.5  # samples that may differ unseen
EQUIVALENT = 2001  # values that stand for the distribution


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

    return _between(known, offset, probabilities)


def quantiles_of_chosen(
    pooled: Pooled, found: Chosen, offset: FloatArray, probabilities: tuple[float, ...]
) -> Quantiles:
    """Return quantiles of the outputs of model 0, of pools of which some points were chosen (`uq.estimators.chosen`).

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

    return _between(known, offset, probabilities)


def _thresholds(values: FloatArray) -> FloatArray:
    return np.asarray(np.unique(np.quantile(values, np.linspace(0, 1, THRESHOLDS))))


def _between(
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
