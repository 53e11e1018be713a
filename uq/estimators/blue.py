"""Best linear unbiased estimates of the mean of one model from samples of several, and how many of each to take.

A group g is a set of models that get the same n_g random parameters; the groups are independent. With C_g the
covariance of the models of a group and R_g the matrix that picks them from all of them, the estimate of E[ψ_0]

    Σ_g a_g · ⟨y⟩_g,   a_g = n_g C_g⁻¹ R_g z,   z = Φ⁻¹e_0,   Φ = Σ_g n_g R_gᵀ C_g⁻¹ R_g

has the least variance, e_0ᵀΦ⁻¹e_0 = z_0, of all linear ones without bias: Σ_g R_gᵀ a_g = e_0 (D. Schaden, E. Ullmann,
SIAM/ASA J. Uncertain. Quantif. 8 (2020) 601–635). Approximate control variates are of the kind, and multifidelity Monte
Carlo (B. Peherstorfer, K. Willcox, M. Gunzburger, SIAM J. Sci. Comput. 38 (2016) A3163–A3194), whose groups are nested.
With other sums of means than E[ψ_0], e has their factors in place of e_0. So differences between meshes are quantities
that are alone in their groups, of whose means the sum is estimated (multilevel Monte Carlo): z_l = V_l/n_l and a_l = 1.

The variance is convex in the numbers n. Those with the least largest variance of several quantities for a cost come
from multiplicative steps on the shares of the cost (S. D. Silvey, D. M. Titterington, B. Torsney, Commun. Stat. Theory
Methods 7 (1978) 1379–1389), with weights of the quantities that follow the largest; a duality gap says when they are
good enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from forward.model import FloatArray

RIDGE = 1e-10  # added to correlations: models that are the same, up to rounding, make them singular
GAP = 0.01  # relative duality gap at which shares of the cost are good enough
STEPS = 3000
NEGLIGIBLE = 1e-4  # share of the cost below which a group is left out

Group = tuple[int, ...]


def subsets(count: int) -> list[Group]:
    """Return all sets of models 0 … count − 1, the largest first."""
    return [group for size in range(count, 0, -1) for group in combinations(range(count), size)]


def informations(groups: Sequence[Group], covariance: FloatArray) -> FloatArray:
    """Return R_gᵀ C_g⁻¹ R_g (G, K, K): what a sample of each group tells, from the covariance (K, K) of the models."""
    count = len(covariance)
    scale = np.sqrt(np.diag(covariance))
    scale = np.where(scale > 0, scale, scale.max() * RIDGE or 1.0)
    correlation = covariance / np.outer(scale, scale)
    np.fill_diagonal(correlation, 1 + RIDGE)
    found = np.zeros((len(groups), count, count))
    for g, group in enumerate(groups):
        at = np.ix_(group, group)
        found[g][at] = np.linalg.inv(correlation[at]) / np.outer(scale[list(group)], scale[list(group)])
    return found


def weights(told: FloatArray, counts: FloatArray) -> FloatArray:
    """Return a_g (G, K), zero for models outside a group, from what each group tells (G, K, K) and n (G,).

    Model 0 is in a group with samples. The sums over the groups are 1 for model 0 and 0 for the others, to rounding.
    """
    precision = np.einsum("g,gkl->kl", counts, told)
    sampled = np.flatnonzero(np.diag(precision))
    z = np.zeros(len(precision))
    z[sampled] = _solved(precision[np.ix_(sampled, sampled)], np.eye(1, sampled.size)[0])
    return np.asarray(np.einsum("g,gkl,l->gk", counts, told, z))


def alone(variances: FloatArray) -> FloatArray:
    """Return what a sample of each of G groups tells of J quantities (J, G, G, G): each its own variance (J, G)."""
    each = np.arange(variances.shape[1])
    found = np.zeros((*variances.shape, each.size, each.size))
    found[:, each, each, each] = 1 / variances
    return found


def _solved(precision: FloatArray, e: FloatArray) -> FloatArray:
    """Return Φ⁻¹e (…, K), scaled for rounding."""
    root = np.sqrt(np.einsum("...kk->...k", precision))
    scaled = precision / (root[..., :, None] * root[..., None, :])
    return np.asarray(np.linalg.solve(scaled, (e / root)[..., None])[..., 0] / root)


@dataclass(frozen=True)
class Problem:
    """How to spend on groups so that the largest of several variances, each in its own unit, is least.

    Attributes
    ----------
    told
        What a sample of each group tells of each of J quantities (J, G, K, K), over the square of its unit.
    costs
        Of one sample of each group (G,).
    taken
        Samples (G,) that there are already: of none, or of all models.
    summed
        Factors (K,) of the means whose sum is estimated; by default it is that of model 0.
    """

    told: FloatArray
    costs: FloatArray
    taken: FloatArray
    summed: FloatArray | None = None

    def variances(self, counts: FloatArray) -> FloatArray:
        """Return the variances (J,) with so many samples (G,) of the groups in all."""
        return np.asarray(self._solved(counts) @ self._e)

    @property
    def _e(self) -> FloatArray:
        return np.eye(1, self.told.shape[-1])[0] if self.summed is None else self.summed

    def _solved(self, counts: FloatArray) -> FloatArray:
        """Return z (J, K)."""
        return _solved(np.einsum("g,jgkl->jkl", counts, self.told), self._e)

    def best(self, cost: float, first: FloatArray | None = None) -> FloatArray:
        """Return the numbers (G,) of further samples for a cost, from shares (G,) of it that may be good already."""
        count = len(self.costs)
        shares = np.full(count, 1 / count) if first is None else 0.9 * first + 0.1 / count
        mixed = np.full(len(self.told), 1 / len(self.told))
        best, least = shares, np.inf
        for _ in range(STEPS):
            further = cost * shares / self.costs
            z = self._solved(self.taken + further)
            found = z @ self._e
            # What one more unit of cost in each group is worth, of the mixture of the quantities.
            gains = np.einsum("j,jk,jgkl,jl->g", mixed, z, self.told, z) * cost / self.costs
            largest = float(found.max())
            if largest < least:
                best, least = shares, largest
            bound = float(mixed @ found) - (float(gains.max()) - float(gains @ shares))
            if largest - bound <= GAP * largest:
                break
            shares = shares * np.sqrt(gains)
            shares = shares / shares.sum()
            mixed = mixed * np.sqrt(found)
            mixed = mixed / mixed.sum()
        kept = np.where(best >= NEGLIGIBLE, best, 0.0)
        return np.asarray(cost * kept / kept.sum() / self.costs)

    def needed(self, target: float, most: float) -> float:
        """Return the cost at which the largest variance is `target`, or `most` if that is not enough."""
        low, high, shares = 0.0, most, None
        if self.taken.any() and float(self.variances(self.taken).max()) <= target:
            return 0.0
        cost = min(most, max(float(self.taken @ self.costs), float(self.costs.min())))
        for _ in range(40):
            further = self.best(cost, shares)
            shares = further * self.costs / cost
            reached = float(self.variances(self.taken + further).max())
            if reached > target:
                low = cost
                if cost >= most:
                    return most
                cost = min(high, cost * min(max(1.2, reached / target), 10.0))
            else:
                high = cost
                cost = np.sqrt(max(low, cost / 10) * cost)
            if high < 1.05 * low or high <= self.costs.min():
                break
        return high
