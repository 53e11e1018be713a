"""Quantiles of one model from groups of samples of several.

The share of outputs below a threshold t is the mean of an indicator, which groups of models tell as they tell that of
the output (`uq.estimators.fidelities`): F(t) = Σ_g Σ_k a_gk ⟨1(w_k ≤ t)⟩_g, without bias for any weights that sum to 1
for model 0 and to 0 for the others. The weights are those for the mean, since a pilot has too few samples in a tail to
tell others; what scatters is a sample's indicators, so that the error is honest where the weights are not the best. Of
few samples in which the indicators of two models differ, half a sample more is counted. Models are compared at the same
distance from their outputs at the mean parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from forward.model import FloatArray
from uq.estimators.blue import informations, weights
from uq.estimators.chosen import Chosen, Pooled
from uq.estimators.fidelities import Samples, folds
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
        thresholds = _thresholds(np.concatenate([one.deviations[:, list(one.group), j].ravel() for one in samples]))
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
        parts = (values[:, None] <= thresholds) / len(values)
        rows, weights = pooled.rows[ok], 1 / pooled.expected[ok, None]
        parts[rows] += weights * (
            (pooled.values[ok, j, None] <= thresholds).astype(float) - (values[rows, None] <= thresholds)
        )
        variance = FEWER / len(rows) ** 2 + np.zeros(len(thresholds))
        for a, b in zip(pooled.starts[:-1], pooled.starts[1:], strict=True):
            variance += parts[a:b].var(axis=0, ddof=1) * (b - a)
        return thresholds, parts.sum(axis=0), np.sqrt(variance)

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
    parts = [np.zeros((one.count, len(thresholds))) for one in samples]
    indicators = [(one.deviations[:, :, j, None] <= thresholds).astype(float) for one in samples]
    middle = np.array(
        [
            np.concatenate([i[:, k] for i, one in zip(indicators, samples, strict=True) if k in one.group]).mean(axis=0)
            for k in range(whole.deviations.shape[1])
        ]
    )
    for kept, portion_of in folds(whole, inner=apart is None):
        w = whole.deviations[kept, :, j]
        a = weights(informations(groups, np.atleast_2d(np.cov(w.T))), counts)
        for g, (found, values) in enumerate(zip(parts, indicators, strict=True)):
            inner = g == 0 and apart is None
            rows = ~kept if inner else slice(None)
            portion = 1.0 if inner else portion_of
            group = list(groups[g])
            combined = np.tensordot(values[rows][:, group] - middle[group], a[g][group], (1, 0))
            found[rows] += portion * (combined + (middle[0] if g == 0 else 0.0))
    share = np.sum([one.mean(axis=0) for one in parts], axis=0)
    variance = np.sum([one.var(axis=0, ddof=1) / len(one) for one in parts], axis=0)
    variance += sum(FEWER / len(one) ** 2 for one, group in zip(parts, groups, strict=True) if 0 in group)
    return share, np.sqrt(variance)
