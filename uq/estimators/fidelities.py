"""Mean and standard deviation of one model from groups of samples of several, with weights that others determine.

There may be a control T of expectation zero and known variance V, the tangent of model 0. With the deviation w_k of
model k from a fixed value, the samples of both moments are the remainders of regressions

    r_k = w_k − β_k T,   r'_k = w_k² − γ_k T − δ_k (T² − V)

and their means follow from the groups by `uq.estimators.blue`. The coefficients and the covariances that determine the
weights come from the samples of all models together. Weights of a sample among these come from the others: they are cut
into `FOLDS` parts, each weighted by what the rest tells, so that the estimate has no bias from fitted weights, and the
scatter of what is averaged is an honest error. A sample without an answer of model 0 counts as the others do in the
mean: so the estimate is conditional on an answer, though cheap models were asked everywhere. What few degrees of
freedom leave open lengthens the error by Student's factor (B. L. Welch, Biometrika 34 (1947) 28–35).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.estimators.blue import Group, informations, weights
from uq.estimators.moments import Estimates, Z, combine, ratio, student, term
from uq.estimators.tails import influences, kurtosis

FOLDS = 10  # parts into which the samples of all models are cut
ROUNDS = 4  # in which the mean stands for answers of model 0 that are missing
FREE = 3  # degrees of freedom counted at least


@dataclass(frozen=True)
class Samples:
    """The samples of a group.

    Attributes
    ----------
    group
        Its models.
    deviations
        w_k (n, K, m); zero for models outside the group, NaN where model 0 has no answer.
    controls
        T (n, m).
    """

    group: Group
    deviations: FloatArray
    controls: FloatArray

    @property
    def count(self) -> int:
        """Number n of the samples."""
        return len(self.deviations)

    @property
    def answered(self) -> NDArray[np.bool_]:
        """At which samples (n,) model 0 has an answer, if it was asked."""
        return np.asarray(np.isfinite(self.deviations[:, 0]).all(axis=1))

    def filled(self, mean: FloatArray, square: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return w and w² (n, K, m), with these of model 0 (m,) where it has no answer."""
        w, squares, missing = self.deviations.copy(), self.deviations**2, ~self.answered
        w[missing, 0], squares[missing, 0] = mean, square
        return w, squares


def share_answered(samples: Sequence[Samples]) -> float:
    """Return the share of the samples of model 0 at which it has an answer."""
    own = np.concatenate([one.answered for one in samples if 0 in one.group])
    return float(own.mean())


@dataclass(frozen=True)
class Fitted:
    """Regressions on the controls for one output, and the covariances of what they leave.

    Attributes
    ----------
    slopes
        β, and γ and δ (K, 3).
    covariances
        Of the remainders r, and of the influences r' − 2⟨r⟩r on the variance (2, K, K).
    """

    slopes: FloatArray
    covariances: FloatArray

    @classmethod
    def of(cls, w: FloatArray, squares: FloatArray, T: FloatArray, V: float) -> Fitted:
        """Fit deviations w and w² (n, K) of all models, with the control T (n,) and its variance V."""
        n, K = w.shape
        slopes = np.zeros((K, 3))
        if T.any():  # without a control there is nothing to fit
            for k in range(K):
                slopes[k, 0] = _slopes(w[:, k], T[:, None])[0]
                slopes[k, 1:] = _slopes(squares[:, k], np.column_stack([T, T**2 - V]))
        first, second = remainders(w, squares, T, V, slopes)
        parts = np.array([first, second - 2 * first.mean(axis=0) * first])
        used = (slopes != 0).sum(axis=1).max()
        parts = parts - parts.mean(axis=1, keepdims=True)
        return cls(slopes, np.einsum("ank,anl->akl", parts, parts) / max(n - 1 - used / 2, 1))


def _slopes(y: FloatArray, x: FloatArray) -> FloatArray:
    """Slopes (q,) of the regression of y (n,) on x (n, q) and a constant; zero where chance explains as much."""
    n, q = x.shape
    centred, target = x - x.mean(axis=0), y - y.mean()
    scale = np.sqrt((centred**2).sum(axis=0))
    found = np.linalg.lstsq(centred / np.where(scale > 0, scale, 1.0), target, rcond=1e-10)[0]
    found = np.where(scale > 0, found / np.where(scale > 0, scale, 1.0), 0.0)
    left = ((target - centred @ found) ** 2).sum()
    helps = left * (n - 1) < (target**2).sum() * max(n - 1 - q, 0)
    return np.asarray(found if helps else np.zeros(q))


def remainders(
    w: FloatArray, squares: FloatArray, T: FloatArray, V: float, slopes: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return r and r' (n, K) of deviations w and w² (n, K), with the control T (n,), V and the slopes (K, 3)."""
    (beta, gamma, delta), T = slopes.T, T[:, None]
    return w - beta * T, squares - gamma * T - delta * (T**2 - V)


@dataclass(frozen=True)
class Found:
    """Estimates of all outputs from all groups.

    Attributes
    ----------
    estimates
        Of mean and standard deviation, by output; errors with Student's factor.
    moved
        By how much each sample (n, m) of each group moves the variance.
    fitted
        What all samples of all models tell, by output.
    relative
        Relative variances (2, m) of the squared errors of mean and variance, as estimates of these.
    """

    estimates: Estimates
    moved: tuple[FloatArray, ...]
    fitted: tuple[Fitted, ...]
    relative: FloatArray

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariances (m, K, K) of the remainders, by output."""
        return np.array([one.covariances[0] for one in self.fitted])


def folds(whole: Samples, *, inner: bool) -> list[tuple[NDArray[np.bool_], float]]:
    """Cut the samples of all models into parts, each of which the others weigh; if they count in the estimate.

    Returns which samples (n,) tell weights, and the share of the estimate that these are for.
    """
    n = whole.count
    if not inner:
        return [(np.ones(n, dtype=bool), 1.0)]
    part = np.arange(n) % min(FOLDS, n)
    return [(part != f, size / n) for f, size in enumerate(np.bincount(part))]


def estimated(
    samples: Sequence[Samples], offset: FloatArray, variances: FloatArray, apart: Samples | None = None
) -> Found:
    """Estimate the moments of model 0, given that it has an answer, from groups with at least two samples each.

    Parameters
    ----------
    samples
        Of each group.
    offset
        What the deviations of model 0 are from (m,).
    variances
        V (m,).
    apart
        Samples of all models that tell the weights, and nothing else; by default the first group does.
    """
    asked = np.concatenate([one.deviations[one.answered, 0] for one in samples if 0 in one.group])
    mean, square, answered = asked.mean(axis=0), (asked**2).mean(axis=0), share_answered(samples)
    for _ in range(1 if answered == 1.0 else ROUNDS):
        first, second, fitted = _combined(samples, apart, variances, (mean, square))
        mean, square = (np.sum([one.mean(axis=0) for one in parts], axis=0) for parts in (first, second))
    if answered < 1.0:  # of m = E[w 1]/E[1], to first order
        first, second = (
            [one.mean(axis=0) + (one - one.mean(axis=0)) / answered for one in parts] for parts in (first, second)
        )
    terms = [term(a, b) for a, b in zip(first, second, strict=True)]
    found = combine(offset, terms)
    mean = np.sum([one.first for one in terms], axis=0)
    moved = tuple(influences(a, b, mean) for a, b in zip(first, second, strict=True))
    factors, relative = zip(*(uncertainty(parts) for parts in (first, moved)), strict=True)
    estimates = replace(found, mean_error=found.mean_error * factors[0], std_error=found.std_error * factors[1])
    return Found(estimates, moved, tuple(fitted), np.array(relative))


def _combined(
    samples: Sequence[Samples], apart: Samples | None, variances: FloatArray, missing: tuple[FloatArray, FloatArray]
) -> tuple[list[FloatArray], list[FloatArray], list[Fitted]]:
    """Return the summands (n, m) of both moments by group, and the fits by output."""
    groups, counts = [one.group for one in samples], np.array([float(one.count) for one in samples])
    known = [one.filled(*missing) for one in samples]
    whole, (of_all, squares_of_all) = apart or samples[0], apart.filled(*missing) if apart else known[0]
    m = len(missing[0])
    cut = folds(whole, inner=apart is None)
    first, second = ([np.zeros((one.count, m)) for one in samples] for _ in range(2))
    fitted = []
    for j in range(m):
        V = float(variances[j])
        # About where deviations and their squares are: from there weights vary with little effect.
        middle = [pooled_means(groups, [one[which][:, :, j] for one in known]) for which in range(2)]
        parts = of_all[:, :, j], squares_of_all[:, :, j], whole.controls[:, j]
        for kept, share in cut:
            fit = Fitted.of(parts[0][kept], parts[1][kept], parts[2][kept], V)
            a = [weights(informations(groups, c), counts) for c in fit.covariances]
            for g, (one, (values, squares)) in enumerate(zip(samples, known, strict=True)):
                inner = g == 0 and apart is None
                rows = ~kept if inner else slice(None)
                w, q, T = values[rows, :, j], squares[rows, :, j], one.controls[rows, j]
                portion = 1.0 if inner else share
                for sums, r, by, centre in zip(
                    (first, second), remainders(w, q, T, V, fit.slopes), a, middle, strict=True
                ):
                    sums[g][rows, j] += portion * ((r - centre) @ by[g] + (centre[0] if g == 0 else 0.0))
        fitted.append(Fitted.of(*parts, V))
    return first, second, fitted


def pooled_means(groups: Sequence[Group], values: Sequence[FloatArray]) -> FloatArray:
    """Return the means (K, …) of each model over all samples of groups that have it, from values (n, K, …) of each."""
    by_model = (
        [one[:, k] for one, group in zip(values, groups, strict=True) if k in group] for k in range(values[0].shape[1])
    )
    return np.array([np.concatenate(one).mean(axis=0) for one in by_model])


def uncertainty(parts: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Student's factor (m,) of the error of a sum of means of samples (n, m), and relative variance of its square."""
    squares, spread, freedom = [], [], []
    for one in parts:
        n = len(one)
        squares.append(((one - one.mean(axis=0)) ** 2).sum(axis=0) / (n - 1) / n)
        spread.append(squares[-1] ** 2 * np.maximum(kurtosis(one) - 1, 0) / n)
        freedom.append(squares[-1] ** 2 / (n - 1))
    total = np.sum(squares, axis=0)
    degrees = np.maximum(ratio(total**2, np.sum(freedom, axis=0), empty=1e6), FREE)
    factor = np.array([student(float(d)) / Z for d in degrees])
    return factor, ratio(np.sum(spread, axis=0), total**2)


def correlations(covariance: FloatArray) -> FloatArray:
    """Return the correlations (m, K) of models with model 0 from covariances (m, K, K)."""
    scale = np.sqrt(np.einsum("mkk->mk", covariance))
    return ratio(covariance[:, 0], scale * scale[:, :1])
