"""Mixtures of models: of their predictions, by which data are predicted best, and of materials over specimens."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from forward.model import FloatArray
from uq.inputs.quadrature import gauss_legendre

REPEATS = 200
GAP = 1e-7  # of f: when the search ends
STEPS = 500
SMALLEST = 1e-6  # weight that is not zero
DISAGREE = 3.0  # ln of the Bayes factor for two materials that is said: "strong" (Kass and Raftery 1995)


def stacking(scores: FloatArray, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """Return the weights (K,) of models with scores ln p (K, n), and their standard errors.

    With ln p(y_j | y_{−j}, M_k) of n data by K models, none of which need be true, the weights w maximise

        f(w) = Σ_j a_j ln Σ_k w_k p(y_j | y_{−j}, M_k),   w_k ≥ 0, Σ w_k = 1, a_j = 1/n

    (Y. Yao, A. Vehtari, D. Simpson, A. Gelman, Bayesian Anal. 13 (2018) 917–1007). f is concave, and with its gradient
    g no weights are better than w by more than max_k g_k − 1, since w·g = 1. Their errors are standard deviations over
    random shares a of the data (D. B. Rubin, Ann. Stat. 9 (1981) 130–134).
    """
    count = scores.shape[1]
    weights = best_mixture(scores, np.full(count, 1 / count))
    shares = np.random.default_rng(seed).dirichlet(np.ones(count), REPEATS)
    return weights, np.std([best_mixture(scores, share) for share in shares], axis=0)


def best_mixture(scores: FloatArray, shares: FloatArray) -> FloatArray:
    """Return the weights (K,) that predict data best, which count by shares (n,) of sum 1.

    Newton's method with active constraints: weights of models that a step would make negative are zero until their
    gradient says otherwise; steps are shortened where they would not go up.
    """
    K = len(scores)
    p = np.exp(scores - scores.max(axis=0))
    w = np.full(K, 1 / K)
    for _ in range(STEPS):
        mixed = w @ p
        g = p @ (shares / mixed)
        if g.max() - 1 <= GAP:
            break
        free = (w > 0) | (g > 1)
        step = _newton(p[free] / mixed, shares, g[free])
        whole = np.zeros(K)
        whole[free] = step
        w = _moved(w, whole, p, shares)
    w = np.where(w > SMALLEST, w, 0.0)
    return np.asarray(w / w.sum())


def _newton(ratios: FloatArray, shares: FloatArray, gradient: FloatArray) -> FloatArray:
    """Return the step (k,) of sum zero to the maximum of the quadratic model of f."""
    k = len(gradient)
    hessian = (ratios * shares) @ ratios.T
    hessian += 1e-10 * np.trace(hessian) * np.eye(k)
    system = np.block([[hessian, np.ones((k, 1))], [np.ones((1, k)), np.zeros((1, 1))]])
    return np.asarray(np.linalg.solve(system, np.append(gradient, 0.0))[:k])


def _moved(w: FloatArray, step: FloatArray, p: FloatArray, shares: FloatArray) -> FloatArray:
    """Return weights (K,) that predict better: along a step as far as it goes, or those of a step that always does."""
    value = shares @ np.log(w @ p)
    length = 1.0
    while length > 1e-6:
        tried = np.maximum(w + length * step, 0.0)
        tried /= tried.sum()
        if shares @ np.log(np.maximum(tried @ p, 1e-300)) > value:
            return np.asarray(tried)
        length /= 2
    return np.asarray(w * (p @ (shares / (w @ p))))


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

    That all are of one is what added evidences ask, and they answer "above 99 %" even if it is not so. Against it is
    held that a share r of the specimens, unknown and uniform on [0, 1], is of material i, and the others of j,

        Z_same = Σ_k π_k Π_g Z_kg,   Z_mixed = mean over pairs i < j of ∫ Π_g (r Z_ig + (1 − r) Z_jg) dr,

    as random effects in K. E. Stephan et al., NeuroImage 46 (2009) 1004–1017. Gauss's rule is exact for the polynomial
    in r. If all are of one material, Z_mixed/Z_same exceeds B in one of B comparisons at most, whatever the materials.
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
