"""Sobol' indices of expansions, of exchanged samples, and of their fields.

With the variance V of a quantity ψ, V_g = Var E[ψ | ω_g] and T_g = E Var(ψ | ω_~g) for a parameter or a group g, the
first-order index is V_g/V, and the total index T_g/V. Generalised indices of a field are ∫V_g/∫V and ∫T_g/∫V over the
body, summed over the components (F. Gamboa, A. Janon, T. Klein, A. Lagnoux, Electron. J. Stat. 8 (2014) 575–603).

For an expansion in orthonormal polynomials all these are sums of squares of coefficients (B. Sudret, Reliab. Eng. Syst.
Safety 93 (2008) 964–979). For samples they come from rows of points: A and B, independent, AB_g, which is A with ω_g
taken from B, and for pairs of parameters BA_i:

    V_g = ⟨B (AB_g − A)⟩              A. Saltelli et al., Comput. Phys. Commun. 181 (2010) 259–270
    T_g = ⟨(A − AB_g)²⟩/2             M. J. W. Jansen, Comput. Phys. Commun. 117 (1999) 35–43
    V_ij = ⟨BA_i AB_j − A B⟩ − V_i − V_j      A. Saltelli, Comput. Phys. Commun. 145 (2002) 280–297

where the letters stand for values of ψ minus their mean over all points. Everything follows from the means over rows of
the values and of some of their products, which are sums and so can be added in any grouping.

Shapley effects of expansions in parameters that depend on each other.

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

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.estimators.estimate import Variables
from uq.surrogates.basis import Basis, hermite, hyperbolic, hyperbolic_count

if TYPE_CHECKING:
    from uq.inputs.draws import Draws

Analysis = Callable[[FloatArray, NDArray[np.int64]], dict[str, FloatArray]]
MOVES = 1e-12  # of the largest variance: below, a variance at a node is rounding error
MOST = 10  # dependent parameters: their sets are 2 to this power
PARTS = 10  # of the draws, which are left out in turn to find the errors
RANK = 1e-8  # singular value, over the largest, of functions that draws do not tell apart
SPARE = 10  # draws for each function on which is regressed, at least


def partial_variances(
    squares: FloatArray, indices: NDArray[np.int64], members: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Variance (…), and its parts V_g and T_g (…, G), from squares of coefficients (…, P).

    Parameters
    ----------
    squares
        Of the coefficients, or sums of them over the entries of a field.
    indices
        Multi-indices (P, d) of the functions.
    members
        Which parameters (G, d) each group has.
    """
    active = indices > 0
    inside = (active[:, None, :] & members).any(axis=2)
    outside = (active[:, None, :] & ~members).any(axis=2)
    varying = active.any(axis=1).astype(float)
    return squares @ varying, squares @ (inside & ~outside).astype(float), squares @ inside.astype(float)


def pair_variances(squares: FloatArray, indices: NDArray[np.int64]) -> FloatArray:
    """Variance V_ij (…, d, d) due to interactions of two parameters, symmetric; zero on the diagonal."""
    active = indices > 0
    d = active.shape[1]
    both = np.zeros((len(indices), d, d))
    for term in np.flatnonzero(active.sum(axis=1) == 2):
        i, j = np.flatnonzero(active[term])
        both[term, i, j] = both[term, j, i] = 1
    return np.asarray(np.tensordot(squares, both, axes=1))


def coefficient_moments(coefficients: FloatArray, indices: NDArray[np.int64]) -> dict[str, FloatArray]:
    """Mean, standard deviation and Sobol' indices (…, d) of coefficients (…, P)."""
    variance, first, total = partial_variances(coefficients**2, indices, np.eye(indices.shape[1], dtype=bool))
    constant = (indices == 0).all(axis=1)
    return {
        "mean": coefficients[..., constant].sum(axis=-1),
        "std": np.sqrt(variance),
        "sobol_first": shares(first, variance[..., None]),
        "sobol_total": shares(total, variance[..., None]),
    }


def sobol_indices(
    coefficients: FloatArray, indices: NDArray[np.int64], members: NDArray[np.bool_], *, pairs: bool
) -> dict[str, FloatArray]:
    """Return `coefficient_moments`, and indices of groups (…, G) of `members` (G, d), and of pairs (…, d, d)."""
    found, squares = coefficient_moments(coefficients, indices), coefficients**2
    variance, first, total = partial_variances(squares, indices, members)
    if len(members):
        found["sobol_group_first"] = shares(first, variance[..., None])
        found["sobol_group_total"] = shares(total, variance[..., None])
    if pairs:
        found["sobol_second"] = shares(pair_variances(squares, indices), variance[..., None, None])
    return found


def moments(coefficients: FloatArray, indices: NDArray[np.int64]) -> dict[str, FloatArray]:
    """Mean and standard deviation (…) of coefficients (…, P): what dependent parameters have too."""
    constant = (indices == 0).all(axis=1)
    varying = coefficients[..., ~constant]
    return {"mean": coefficients[..., constant].sum(axis=-1), "std": np.sqrt((varying**2).sum(axis=-1))}


def shares(parts: FloatArray, variance: FloatArray | float) -> FloatArray:
    """Parts over a variance; 0 where that is 0."""
    variance = np.asarray(variance)
    return np.asarray(np.where(variance > 0, parts / np.where(variance > 0, variance, 1.0), 0.0))


def exchanged(A: FloatArray, B: FloatArray, members: NDArray[np.bool_], *, pairs: bool) -> FloatArray:
    """Return the rows (n, K, d) of points A, B, AB_g for each of G groups and, for pairs, BA_i for each parameter.

    Parameters
    ----------
    A, B
        Independent points (n, d).
    members
        Which parameters (G, d) each group has.
    pairs
        Whether interactions of two parameters are estimated.
    """
    points = [A, B, *(np.where(group, B, A) for group in members)]
    if pairs:
        points += [np.where(one, A, B) for one in np.eye(A.shape[1], dtype=bool)]
    return np.stack(points, axis=1)


@dataclass(frozen=True)
class RowProducts:
    """The products of values in a row that are averaged.

    Attributes
    ----------
    groups
        Number G of parameters and groups; the parameters come first.
    pairs
        Number d of parameters whose interactions are estimated, or 0.
    """

    groups: int
    pairs: int = 0

    @property
    def size(self) -> int:
        """Number K of points in a row."""
        return 2 + self.groups + self.pairs

    def of(self, row: FloatArray) -> FloatArray:
        """Return the values (K, …) of a row and their products, (J, …) in total."""
        A, B = row[0], row[1]
        AB = row[2 : 2 + self.groups]
        parts = [row, ((A**2 + B**2) / 2)[None], B * (AB - A), (A - AB) ** 2 / 2]
        if self.pairs:
            BA = row[2 + self.groups :]
            parts += [(A * B)[None], *((BA[i] * AB[j])[None] for i, j in combinations(range(self.pairs), 2))]
        return np.concatenate(parts)

    def variances(self, means: FloatArray) -> ExchangedVariances:
        """Return the variances that follow from means (J, …) over the rows."""
        G, K = self.groups, self.size
        values, square = means[:K], means[K]
        cross, total = means[K + 1 : K + 1 + G], means[K + 1 + G : K + 1 + 2 * G]
        A, B, AB, BA = values[0], values[1], values[2 : 2 + G], values[2 + G :]
        centre = values.mean(axis=0)
        first = cross - centre * (AB - A)
        second = None
        if self.pairs:
            rest = means[K + 1 + 2 * G :]
            second = np.zeros((self.pairs, self.pairs, *centre.shape))
            for (i, j), product in zip(combinations(range(self.pairs), 2), rest[1:], strict=True):
                together = product - rest[0] - centre * (BA[i] + AB[j] - A - B)
                second[i, j] = second[j, i] = together - first[i] - first[j]
        return ExchangedVariances(square - ((A + B) / 2) ** 2, first, total, second)


@dataclass(frozen=True)
class ExchangedVariances:
    """Variance (…), its parts V_g and T_g (G, …) and, if requested, V_ij (d, d, …)."""

    variance: FloatArray
    first: FloatArray
    total: FloatArray
    second: FloatArray | None = None


def bootstrap(sums: FloatArray, counts: FloatArray, seed: int, draws: int = 1000) -> FloatArray:
    """Means (J, draws, …) over resampled replicates, from sums (R, J, …) over each of R replicates.

    A replicate is a set of points that may depend on each other; resampling single points of quasi-random sets would
    treat them as independent, and give too large errors.

    Parameters
    ----------
    sums
        Sums over the points of each replicate.
    counts
        Number (R,) of points in each.
    seed
        Of the resampling.
    draws
        Number of times that R replicates are drawn.
    """
    R = len(counts)
    times = np.random.default_rng([seed, R]).multinomial(R, np.full(R, 1 / R), size=draws)
    drawn = np.tensordot(times, sums, axes=1) / (times @ counts).reshape(-1, *(1,) * (sums.ndim - 1))
    return np.asarray(np.swapaxes(drawn, 0, 1))


def bootstrap_error(drawn: FloatArray, replicates: int, axis: int) -> FloatArray:
    """Standard error from estimates drawn by `bootstrap`, with replicates − 1 degrees of freedom."""
    return np.asarray(drawn.std(axis=axis) * np.sqrt(replicates / (replicates - 1)))


def jackknife_error(left_out: FloatArray) -> FloatArray:
    """Standard error from estimates (R, …) that each leave out one of R replicates."""
    R = len(left_out)
    return np.asarray(np.sqrt((R - 1) / R * ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0)))


def field_indices(
    variance: FloatArray, first: FloatArray, total: FloatArray, volumes: FloatArray | None = None
) -> Variables:
    """Return the generalised indices of a field, its indices by node, and the dominating parameter at each node.

    Parameters
    ----------
    variance, first, total
        V (nodes,), and V_i and T_i (d, nodes) of d parameters, sums over the components.
    volumes
        Share (nodes,) of the body that each node represents in the integrals; by default all count equally.

    Returns
    -------
    dict
        `field_sobol_first` and `field_sobol_total` (parameter); `node_sobol_first` and `node_sobol_total` (parameter,
        node), zero where nothing moves; and `dominating` (node), the number of the parameter with the largest total
        index, or −1 where nothing moves.
    """
    moving = variance > MOVES * variance.max(initial=0.0)
    at_node = np.where(moving, variance, 0.0)
    v = np.ones(len(variance)) if volumes is None else volumes
    return {
        "field_sobol_first": (("parameter",), shares(first @ v, variance @ v)),
        "field_sobol_total": (("parameter",), shares(total @ v, variance @ v)),
        "node_sobol_first": (("parameter", "node"), shares(first, at_node)),
        "node_sobol_total": (("parameter", "node"), shares(total, at_node)),
        "dominating": (("node",), np.where(moving, total.argmax(axis=0), -1)),
    }


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
        alone = np.zeros((len(basis.joint.indices), basis.indices.shape[1]), dtype=np.int64)
        alone[:, basis.joint.members] = basis.joint.indices
        joint = replace(basis, indices=alone)
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
        return jackknife_error(left)


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
