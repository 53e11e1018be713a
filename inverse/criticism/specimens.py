"""Whether several specimens are of one of the candidate materials, or some of one and some of another.

A comparison that adds up evidences over specimens asks which one material all of them are of. If they are not, it
answers all the same, and with many specimens it answers "above 99 %". So that question is held against another: that a
share r of the specimens, unknown and uniform on [0, 1], is of material i, and the others of material j. With evidences
Z_kg,

    Z_same = Σ_k π_k Π_g Z_kg,   Z_mixed = mean over pairs i < j of ∫ Π_g (r Z_ig + (1 − r) Z_jg) dr,

as random effects in K. E. Stephan et al., NeuroImage 46 (2009) 1004–1017. The integrand is a polynomial in r, which
Gauss's rule with enough points integrates exactly. If all are of one material, Z_mixed/Z_same exceeds B in one of B
comparisons at most, whatever the materials.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from forward.model import FloatArray
from uq.inputs.quadrature import gauss_legendre

DISAGREE = 3.0  # ln of the Bayes factor for two materials that is said: "strong" (Kass and Raftery 1995)


class Mixture(NamedTuple):
    """Two materials that specimens may be of.

    Attributes
    ----------
    log_bayes_factor
        ln of Z_mixed/Z_same.
    pair
        Numbers of the two candidates that explain the specimens best together.
    first
        Probability (G,) that each specimen is of the first of them.
    """

    log_bayes_factor: float
    pair: tuple[int, int]
    first: FloatArray


def mixture(log_evidence: FloatArray, weights: FloatArray) -> Mixture:
    """Compare that specimens are of two materials with that they are of one.

    Given are ln Z of at least two candidates for each specimen (K, G), and their prior probabilities (K,), π.
    """
    count, specimens = log_evidence.shape
    nodes, parts = gauss_legendre(specimens // 2 + 1)
    r, parts = (nodes + 1) / 2, parts / 2
    pairs = list(combinations(range(count), 2))
    found, shares = [], []
    for i, j in pairs:
        one = np.log(r)[:, None] + log_evidence[i]
        both = np.logaddexp(one, np.log1p(-r)[:, None] + log_evidence[j])
        at_nodes = np.log(parts) + both.sum(axis=1)
        found.append(logsumexp(at_nodes))
        shares.append(np.exp(at_nodes - found[-1]) @ np.exp(one - both))
    same = logsumexp(np.log(weights / weights.sum()) + log_evidence.sum(axis=1))
    best = int(np.argmax(found))
    return Mixture(float(logsumexp(found) - np.log(len(pairs)) - same), pairs[best], shares[best])
