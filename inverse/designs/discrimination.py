"""Observations that tell models apart: the expected ln Bayes factor of the true model against the others.

Model k predicts values, over the standard deviations of their errors, by a normal distribution with mean μ_k and
covariance I + A_kA_kᵀ, the second part from its unknowns. If k is true, the expected ln Bayes factor against l is the
divergence of their predictions,

    ½ [tr(Σ_l⁻¹Σ_k) − n + (μ_k − μ_l)ᵀΣ_l⁻¹(μ_k − μ_l) + ln det Σ_l − ln det Σ_k]

(G. E. P. Box, W. J. Hill, Technometrics 9 (1967) 57–71). With P_l = I + A_lᵀA_l and Σ_l⁻¹ = I − A_lP_l⁻¹A_lᵀ all of it
follows from products of columns of A and μ summed over the observations, and so do sets of them: each candidate is the
matrix of these products of its own values.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from forward.model import FloatArray
from inverse.designs.criteria import Criterion, IntArray

TOGETHER = 256  # candidates that are looked at at once
NEGLIGIBLE = 1e-3  # of the standard deviation of the errors: what the unknowns of a model change less


def predicted(
    outputs: FloatArray, sigma: FloatArray, errors: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return mean μ (m,) and root A (m, r) of the covariance of outputs (draws, m), over standard deviations (m,).

    What is uncertain beside the draws adds errors (draws, g, m) that the outputs share, a row for a standard deviation.
    Directions in which no output varies by more than `NEGLIGIBLE` are left out.
    """
    scaled = outputs / sigma
    mean = scaled.mean(axis=0)
    rows = scaled - mean if errors is None else np.vstack([scaled - mean, *(errors / sigma)])
    left, sizes, _ = np.linalg.svd(rows.T / np.sqrt(len(outputs)), full_matrices=False)
    kept = sizes > NEGLIGIBLE
    return mean, left[:, kept] * sizes[kept]


def expected_log_bayes_factor(
    kk: FloatArray, ll: FloatArray, lk: FloatArray, toward: FloatArray, apart: FloatArray
) -> FloatArray:
    """Return the expected ln Bayes factor (...) of k, if it is true, against l.

    Parameters
    ----------
    kk, ll, lk
        A_kᵀA_k (..., r_k, r_k), A_lᵀA_l (..., r_l, r_l), A_lᵀA_k (..., r_l, r_k).
    toward
        A_lᵀ(μ_k − μ_l) (..., r_l).
    apart
        |μ_k − μ_l|² (...).
    """
    P_k, P_l = np.eye(kk.shape[-1]) + kk, np.eye(ll.shape[-1]) + ll
    sides = np.concatenate([ll + lk @ np.swapaxes(lk, -1, -2), toward[..., None]], axis=-1)
    solved = np.linalg.solve(P_l, sides)
    spread = np.trace(kk, axis1=-2, axis2=-1) - np.trace(solved[..., :-1], axis1=-2, axis2=-1)
    distance = apart - (toward * solved[..., -1]).sum(axis=-1)
    volumes = np.linalg.slogdet(P_l)[1] - np.linalg.slogdet(P_k)[1]
    return np.asarray((spread + distance + volumes) / 2)


class Discrimination(Criterion):
    """The expected ln Bayes factor of the true model against another, by their probabilities before (nat).

    Parameters
    ----------
    means, roots
        μ_k (m,) and A_k (m, r_k) of each model, over the standard deviations of the errors.
    probabilities
        Of the models, before the observations.
    which
        Number (m,) of the candidate that each value belongs to; -1 of none.
    count
        Number of candidates.
    """

    def __init__(
        self,
        means: Sequence[FloatArray],
        roots: Sequence[FloatArray],
        probabilities: Sequence[float],
        which: IntArray,
        count: int,
    ) -> None:
        centre = np.mean(means, axis=0)
        self._columns = np.column_stack([*roots, *(mean - centre for mean in means)])
        ends = np.cumsum([root.shape[1] for root in roots])
        self._places = [slice(end - root.shape[1], end) for end, root in zip(ends, roots, strict=True)]
        self._means = [int(ends[-1]) + k for k in range(len(means))]
        self._p = np.array(probabilities) / np.sum(probabilities)
        order = np.argsort(which, kind="stable")
        starts = np.searchsorted(which[order], np.arange(count + 1))
        self._rows = [order[a:b] for a, b in pairwise(starts)]
        self._sum = np.zeros((self._columns.shape[1],) * 2)
        self._worth = 0.0

    def _products(self, one: int) -> FloatArray:
        mine = self._columns[self._rows[one]]
        return np.asarray(mine.T @ mine)

    def pairs(self, sums: FloatArray | None = None) -> FloatArray:
        """Return the expected ln Bayes factor (..., K, K) of each model, if it is true, against each other one.

        Parameters
        ----------
        sums
            Products of columns (..., R, R) summed over observations; by default over those that were taken.
        """
        G = self._sum if sums is None else sums
        found = np.zeros((*G.shape[:-2], len(self._means), len(self._means)))
        for k, (of_k, at_k) in enumerate(zip(self._places, self._means, strict=True)):
            for l, (of_l, at_l) in enumerate(zip(self._places, self._means, strict=True)):
                if k == l:
                    continue
                apart = G[..., at_k, at_k] - 2 * G[..., at_k, at_l] + G[..., at_l, at_l]
                toward = G[..., of_l, at_k] - G[..., of_l, at_l]
                products = (G[..., of_k, of_k], G[..., of_l, of_l], G[..., of_l, of_k])
                found[..., k, l] = expected_log_bayes_factor(*products, toward, apart)
        return found

    def _value(self, sums: FloatArray) -> FloatArray:
        others = self._p / (1 - self._p[:, None])
        return np.asarray((self._p[:, None] * others * self.pairs(sums)).sum(axis=(-2, -1)))

    def gains(self, which: IntArray) -> FloatArray:
        parts = [which[i : i + TOGETHER] for i in range(0, len(which), TOGETHER)]
        return np.concatenate(
            [self._value(self._sum + np.array([self._products(int(one)) for one in part])) for part in parts]
        ) - (self._worth)

    def take(self, one: int) -> None:
        self._sum = self._sum + self._products(one)
        self._worth = float(self._value(self._sum))
