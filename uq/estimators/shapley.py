"""Shapley effects of expansions in parameters that depend on each other.

With c(S) = Var E[ψ | ω_S], the Shapley effect of parameter i is the mean of c(S ∪ i) − c(S) over all orders in which
parameters may become known, over Var ψ. Effects are shares: they add up to 1, dependent as parameters may be, and of
independent ones lie between first-order and total Sobol' indices (A. B. Owen, SIAM/ASA J. Uncertain. Quantif. 2 (2014)
245–251; E. Song, B. L. Nelson, J. Staum, the same 4 (2016) 1060–1083).

E[ψ | ω_S] is the projection of the expansion on polynomials of ω_S, by least squares over the draws: exact for normal
draws, whose conditional expectations of polynomials are polynomials. A regression on Q functions explains (Q − 1)/(N −
1) of what is independent of them, which is taken off ("adjusted" R²). So c(S) is a quadratic form of the coefficients.

Parameters U with distributions of their own multiply functions of draws, and these need them: v(S) = [U ⊂ S] g(S ∩ D).
With g(T) = Σ_{W ⊂ T} m(W), each m(W) is shared by W ∪ U in equal parts (J. C. Harsanyi's dividends).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.estimators.indices import moments, shares
from uq.surrogates.basis import Basis, hermite, hyperbolic, hyperbolic_count

if TYPE_CHECKING:
    from uq.inputs.draws import Draws

MOST = 10  # dependent parameters: their sets are 2 to this power
PARTS = 10  # of the draws, which are left out in turn to find the errors
RANK = 1e-8  # singular value, over the largest, of functions that draws do not tell apart
SPARE = 10  # draws for each function on which is regressed, at least


@dataclass(frozen=True)
class Shapley:
    """Quadratic forms of the coefficients of functions of the draws.

    Attributes
    ----------
    basis
        All functions (P, d).
    forms
        For each of 1 + PARTS sets of draws, the whole and without one part: the parts of dependent parameters
        (U, k, Q, Q), of any other parameter in a product of U of them (U, Q, Q), and of the variance (Q, Q).
    """

    basis: Basis
    forms: tuple[tuple[FloatArray, FloatArray, FloatArray], ...]

    @classmethod
    def of(cls, basis: Basis, draws: Draws) -> Shapley:
        """Prepare the forms of a basis with a joint part."""
        assert basis.joint is not None
        start = int(basis.joint.members[0])
        most = int((basis.indices[:, :start] > 0).sum(axis=1).max(initial=0)) if start else 0
        joint = Basis(basis.coordinates, basis.alpha, basis.beta, _alone(basis), basis.joint)
        points = np.ones((len(draws.values), start + len(draws.names)))
        points[:, start:] = draws.values
        phi, x = joint.values(points), draws.standardised(draws.values)
        whole = np.arange(len(x))
        chosen = [whole, *(np.setdiff1d(whole, part) for part in np.array_split(whole, PARTS))]
        degree = int(basis.joint.indices.sum(axis=1).max(initial=1))
        forms = []
        for which in chosen:
            weights = draws.weights[which] / draws.weights[which].sum()
            worth = draws.effective * len(which) / len(x)
            forms.append(_forms(phi[which], x[which], weights, worth, degree, most))
        return cls(basis, tuple(forms))

    def effects(self, coefficients: FloatArray, indices: NDArray[np.int64], form: int = 0) -> FloatArray:
        """Return the effects (…, d) of coefficients (…, P) of functions with these indices (P, d)."""
        joint = self.basis.joint
        assert joint is not None
        of_draws, of_others, variance = self.forms[form]
        start, Q = int(joint.members[0]), len(joint.indices)
        own, number = indices[:, :start], joint.number(indices)
        kinds, which = np.unique(own, axis=0, return_inverse=True)
        found = np.zeros((*coefficients.shape[:-1], self.basis.indices.shape[1]))
        total = np.zeros(coefficients.shape[:-1])
        for kind, degrees in enumerate(kinds):
            here = np.flatnonzero(which.ravel() == kind)
            c = np.zeros((*coefficients.shape[:-1], Q))
            c[..., number[here]] = coefficients[..., here]
            active = np.flatnonzero(degrees)
            u = len(active)
            found[..., start:] += np.einsum("...q,kqr,...r->...k", c, of_draws[u], c)
            if u:
                found[..., active] += np.einsum("...q,qr,...r->...", c, of_others[u], c)[..., None]
                total += (c**2).sum(axis=-1) if form == 0 else np.einsum("...q,qr,...r->...", c, variance[1], c)
            else:
                total += np.einsum("...q,qr,...r->...", c, variance[0], c)
        return shares(found, total[..., None])

    def analysis(self, coefficients: FloatArray, indices: NDArray[np.int64]) -> dict[str, FloatArray]:
        """Return mean, standard deviation and effects (…, d) of coefficients (…, P), in place of Sobol' indices."""
        return moments(coefficients, indices) | {"shapley": self.effects(coefficients, indices)}

    def error(self, coefficients: FloatArray, indices: NDArray[np.int64]) -> FloatArray:
        """Return standard errors (…, d) of the effects because draws are few: the jackknife over parts of them."""
        left = np.array([self.effects(coefficients, indices, form) for form in range(1, len(self.forms))])
        return np.asarray(np.sqrt((PARTS - 1) / PARTS * ((left - left.mean(axis=0)) ** 2).sum(axis=0)))


def _alone(basis: Basis) -> NDArray[np.int64]:
    """Multi-indices (Q, d) of the functions of draws alone."""
    assert basis.joint is not None
    indices = np.zeros((len(basis.joint.indices), basis.indices.shape[1]), dtype=np.int64)
    indices[:, basis.joint.members] = basis.joint.indices
    return indices


def _forms(
    phi: FloatArray, x: FloatArray, weights: FloatArray, worth: float, degree: int, most: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Forms of functions (N, Q) of draws x (N, k) that are worth so many, with up to `most` other parameters."""
    Q, k = phi.shape[1], x.shape[1]
    root = np.sqrt(weights)[:, None]
    columns = root * phi
    gram = columns.T @ columns
    mean = weights @ phi
    centred = gram - np.outer(mean, mean)
    tables = [hermite(column, degree) for column in x.T]
    of_draws, of_others = np.zeros((most + 1, k, Q, Q)), np.zeros((most + 1, Q, Q))
    dividends: dict[tuple[int, ...], FloatArray] = {}
    for size in range(k + 1):
        for members in combinations(range(k), size):
            if size == 0:
                known = np.outer(mean, mean)
            elif size == k:
                known = gram
            else:
                known = np.outer(mean, mean) + _explained(columns, centred, root, tables, members, worth, degree)
            below = [dividends[part] for s in range(size) for part in combinations(members, s)]
            dividends[members] = known - sum(below, np.zeros((Q, Q)))
            for u in range(most + 1):
                if size + u:
                    share = dividends[members] / (size + u)
                    of_draws[u, list(members)] += share
                    of_others[u] += share if u else 0.0
    return of_draws, of_others, np.array([centred, gram])


def _explained(
    columns: FloatArray,
    centred: FloatArray,
    root: FloatArray,
    tables: list[FloatArray],
    members: tuple[int, ...],
    worth: float,
    degree: int,
) -> FloatArray:
    """Covariance (Q, Q) of the projections of functions on polynomials of some parameters, adjusted."""
    size = len(members)
    while degree > 1 and SPARE * hyperbolic_count(size, degree, 1.0) > worth:
        degree -= 1
    indices = hyperbolic(size, degree, 1.0)[1:]
    powers = np.ones((len(root), len(indices)))
    for member, degrees in zip(members, indices.T, strict=True):
        powers *= tables[member][:, degrees]
    powers = root * (powers - (root[:, 0] ** 2) @ powers)
    left, singular, _ = np.linalg.svd(powers, full_matrices=False)
    span = left[:, singular > RANK * singular[0]]
    projected = span.T @ columns
    taken = min(span.shape[1] / max(worth - 1, 1.0), 0.5)
    return np.asarray((projected.T @ projected - taken * centred) / (1 - taken))
