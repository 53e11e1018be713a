"""What a set of observations tells, of models that are linear in standard normal unknowns.

A model is linearised at a draw of the prior, ψ(x + z) ≈ ψ(x) + A z with z ~ N(0, I) and rows of A over the standard
deviations of the errors. The observations S leave z with the covariance C = (I + A_SᵀA_S)⁻¹. What they tell (nat) is

    ½ ln det(I + A_SᵀA_S),

the expected divergence of the posterior from the prior (D. V. Lindley, Ann. Math. Stat. 27 (1956) 986–1005), largest
for D-optimal designs; the variance of goals G z that they take away is tr G(I − C)Gᵀ, largest for A-optimal ones (K.
Chaloner, I. Verdinelli, Statist. Sci. 10 (1995) 273–304). Both are averaged over draws. The first is submodular: what
an observation adds never grows as others are added.

Some of the unknowns, with columns N of A, may be of no interest: what is uncertain beside, or errors of the covariance
I + NNᵀ that the observations share. What these tell of the others is ½ ln det(I + AAᵀ) − ½ ln det(I + NNᵀ), by the
chain rule of information. It is not submodular: an observation that such unknowns alone move adds nothing at first, and
something once others depend on them.

Candidates are arrays (c, k, r) for each draw: k rows for each of c candidates, of which some may be zero.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from itertools import pairwise, permutations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray, ForwardModel, Solution
from inverse.data.noise import Noise
from inverse.fields.field_posterior import FieldPosterior, Point, Prior
from inverse.fields.low_rank import leading_pairs

if TYPE_CHECKING:
    import xarray as xr

IntArray = NDArray[np.int64]
TOGETHER = 256  # candidates that are looked at at once
NEGLIGIBLE = 1e-3  # of the standard deviation of the errors: what the unknowns of a model change less
PROBES = 16


class Criterion(ABC):
    """What a growing set of observations is worth."""

    submodular = False  # whether what an observation adds never grows as others are added

    @abstractmethod
    def gains(self, which: IntArray) -> FloatArray:
        """Return what each of some candidates (w,), by number, would add (w,)."""

    @abstractmethod
    def take(self, one: int) -> None:
        """Add a candidate to the set."""

    def along(self, order: Sequence[int]) -> Iterator[float]:
        """Go through what the first, the first two, … of candidates in an order are worth, and take them."""
        worth = 0.0
        for one in order:
            worth += float(self.gains(np.array([one]))[0])
            self.take(one)
            yield worth


def grouped(rows: FloatArray, which: IntArray, count: int) -> FloatArray:
    """Return rows (m, r) as candidates (count, k, r), given the number (m,) of the candidate of each; -1 of none.

    Of a candidate with more than r rows, as many are kept as tell the same, a triangular factor of them.
    """
    parts = [rows[which == number] for number in range(count)]
    r = rows.shape[1]
    parts = [np.linalg.qr(part, mode="r") if len(part) > r else part for part in parts]
    found = np.zeros((count, max(map(len, parts), default=0), r))
    for number, part in enumerate(parts):
        found[number, : len(part)] = part
    return found


def told(rows: FloatArray) -> FloatArray:
    """Return what observations tell, ½ ln det(I + RRᵀ) (...), of rows (..., k, r) in whitened unknowns."""
    k = rows.shape[-2]
    return np.asarray(np.linalg.slogdet(np.eye(k) + rows @ np.swapaxes(rows, -1, -2))[1] / 2)


def told_along(rows: FloatArray, beside: int = 0) -> FloatArray:
    """Return what the first, the first two, … of observations (n, k, r) tell together (n,): by one Cholesky factor.

    The last unknowns, as many as are `beside`, do not count.
    Where the same is told again and again, rounding is 1e-16 of the largest eigenvalue of RRᵀ, in nat.
    """
    n, k, r = rows.shape
    flat = rows.reshape(n * k, r)
    diagonal = np.diag(np.linalg.cholesky(np.eye(n * k) + flat @ flat.T))
    found = np.log(diagonal).cumsum()[k - 1 :: k]
    return np.asarray(found - told_along(rows[..., r - beside :]) if beside else found)


def conditioned(root: FloatArray, rows: FloatArray) -> FloatArray:
    """Return a root T (r, r) of the covariance that is left, C = TTᵀ, once rows (k, r) were observed.

    With R = rows · T = U s Vᵀ, it is T(I + RᵀR)^(−1/2) = T − TRᵀU a²/(1 + a) UᵀR, a = (1 + s²)^(−1/2): no difference of
    large numbers, however much is told.
    """
    seen = rows @ root
    squares, U = np.linalg.eigh(seen @ seen.T)
    a = (1 + np.maximum(squares, 0.0)) ** -0.5
    turned = U.T @ seen
    return np.asarray(root - (root @ turned.T * (a**2 / (1 + a))) @ turned)


class _Conditioned(Criterion):
    """Candidates (c, k, r) of each draw, and roots of the covariances that the taken ones leave."""

    def __init__(self, candidates: Sequence[FloatArray]) -> None:
        self._candidates = candidates
        self.roots = [np.eye(one.shape[-1]) for one in candidates]

    def take(self, one: int) -> None:
        pairs = zip(self.roots, self._candidates, strict=True)
        self.roots = [conditioned(root, rows[one]) for root, rows in pairs]


class Information(_Conditioned):
    """D-optimality: the mean over draws of what observations tell (nat), of candidates (c, k, r) of each draw.

    Parameters
    ----------
    candidates
        Of each draw (c, k, r).
    beside
        How many unknowns, the last ones, do not count.
    """

    submodular = True

    def __init__(self, candidates: Sequence[FloatArray], beside: int = 0) -> None:
        super().__init__(candidates)
        self._beside = Information([one[..., one.shape[-1] - beside :] for one in candidates]) if beside else None
        self.submodular = self.submodular and not beside

    def of_draws(self, which: IntArray) -> FloatArray:
        """Return what each of some candidates (w,) would add at each draw (draws, w)."""
        pairs = zip(self._candidates, self.roots, strict=True)
        found = np.array([told(rows[which] @ root) for rows, root in pairs])
        return found if self._beside is None else found - self._beside.of_draws(which)

    def gains(self, which: IntArray) -> FloatArray:
        return np.asarray(self.of_draws(which).mean(axis=0))

    def take(self, one: int) -> None:
        super().take(one)
        if self._beside is not None:
            self._beside.take(one)


class Variance(_Conditioned):
    """A-optimality: the mean over draws of the share of the variance of goals that observations take away.

    Parameters
    ----------
    candidates
        Of each draw (c, k, r).
    goals
        GᵀG (r, r) of each draw, with the goals G in units in which their prior variances add up to one.
    """

    def __init__(self, candidates: Sequence[FloatArray], goals: Sequence[FloatArray]) -> None:
        super().__init__(candidates)
        self._goals = goals

    @property
    def left(self) -> FloatArray:
        """What is left of the variance (draws,), among unknowns that observations can tell."""
        pairs = zip(self._goals, self.roots, strict=True)
        return np.array([np.trace(root.T @ goal @ root) for goal, root in pairs])

    def gains(self, which: IntArray) -> FloatArray:
        found = np.zeros(len(which))
        for rows, goal, root in zip(self._candidates, self._goals, self.roots, strict=True):
            seen = rows[which] @ root
            across = np.swapaxes(seen, -1, -2)
            within = np.eye(seen.shape[1]) + seen @ across
            taken = np.linalg.solve(within, seen @ (root.T @ goal @ root) @ across)
            found += np.trace(taken, axis1=-2, axis2=-1)
        return found / len(self._goals)


def scaled(goals: FloatArray) -> list[FloatArray]:
    """Return GᵀG of goals (draws, q, d), each over its prior standard deviation and √q; constants count nothing."""
    size = np.linalg.norm(goals, axis=2, keepdims=True)
    scaled = np.divide(goals, size, out=np.zeros_like(goals), where=size > 0) / np.sqrt(goals.shape[1])
    return [one.T @ one for one in scaled]


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


class Discrimination(Criterion):
    """The expected ln Bayes factor of the true model against another, by their probabilities before (nat).

    Model k predicts values, over the standard deviations of their errors, by a normal distribution with mean μ_k and
    covariance Σ_k = I + A_kA_kᵀ, the second part from its unknowns. If k is true, the expected ln Bayes factor against
    l is the divergence of their predictions,

        ½ [tr(Σ_l⁻¹Σ_k) − n + (μ_k − μ_l)ᵀΣ_l⁻¹(μ_k − μ_l) + ln det Σ_l − ln det Σ_k]

    (G. E. P. Box, W. J. Hill, Technometrics 9 (1967) 57–71). With P_l = I + A_lᵀA_l and Σ_l⁻¹ = I − A_lP_l⁻¹A_lᵀ all of
    it follows from products of columns of A and μ summed over the observations: each candidate is the matrix of these
    products of its own values.

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
        for k, l in permutations(range(len(self._means)), 2):
            found[..., k, l] = self._divergence(G, k, l)
        return found

    def _divergence(self, G: FloatArray, k: int, l: int) -> FloatArray:
        """Expected ln Bayes factor (...) of k, if it is true, against l, by sums (..., R, R) of products of columns."""
        of_k, of_l, at_k, at_l = self._places[k], self._places[l], self._means[k], self._means[l]
        kk, ll, lk = G[..., of_k, of_k], G[..., of_l, of_l], G[..., of_l, of_k]  # A_kᵀA_k, A_lᵀA_l, A_lᵀA_k
        toward = G[..., of_l, at_k] - G[..., of_l, at_l]  # A_lᵀ(μ_k − μ_l)
        apart = G[..., at_k, at_k] - 2 * G[..., at_k, at_l] + G[..., at_l, at_l]  # |μ_k − μ_l|²
        P_k, P_l = np.eye(kk.shape[-1]) + kk, np.eye(ll.shape[-1]) + ll
        sides = np.concatenate([ll + lk @ np.swapaxes(lk, -1, -2), toward[..., None]], axis=-1)
        solved = np.linalg.solve(P_l, sides)
        spread = np.trace(kk, axis1=-2, axis2=-1) - np.trace(solved[..., :-1], axis1=-2, axis2=-1)
        distance = apart - (toward * solved[..., -1]).sum(axis=-1)
        volumes = np.linalg.slogdet(P_l)[1] - np.linalg.slogdet(P_k)[1]
        return np.asarray((spread + distance + volumes) / 2)

    def _value(self, sums: FloatArray) -> FloatArray:
        others = self._p / (1 - self._p[:, None])
        return np.asarray((self._p[:, None] * others * self.pairs(sums)).sum(axis=(-2, -1)))

    def gains(self, which: IntArray) -> FloatArray:
        parts = [which[i : i + TOGETHER] for i in range(0, len(which), TOGETHER)]
        return (
            np.concatenate(
                [self._value(self._sum + np.array([self._products(int(one)) for one in part])) for part in parts]
            )
            - self._worth
        )

    def take(self, one: int) -> None:
        self._sum = self._sum + self._products(one)
        self._worth = float(self._value(self._sum))


def left_out(rows: FloatArray, beyond: FloatArray) -> float:
    """Return what observations tell at most (nat) beyond their rows (n, r), given A⊥z (probes, n) of random z."""
    inside = np.eye(len(rows)) + rows @ rows.T
    return float((beyond.T * np.linalg.solve(inside, beyond.T)).sum(axis=0).mean() / 2)


def of_field(
    model: ForwardModel,
    solution: Solution,
    whitened: FloatArray,
    prior: Prior,
    mass: FloatArray,
    sigma: FloatArray,
    goals: NDArray[np.bool_],
    errors: FloatArray,
    rank: int,
    seed: int,
) -> xr.Dataset:
    """Linearise a model, whose parameters are the N values of a field, at one draw; candidates are its rows of A.

    All candidates together tell AᵀA ≈ UΛUᵀ (`inverse.fields.low_rank`); the row of one in the coordinates U is a column
    of AU, which the search for the pairs has formed anyway. Of rows that are left out, A⊥, a set S of candidates tells
    at most ½ tr((I + AAᵀ)⁻¹A⊥A⊥ᵀ) more, which a few random probes z estimate by A⊥z (M. F. Hutchinson, Comm. Statist.
    Simulation Comput. 19 (1990) 433–450).

    Parameters
    ----------
    solution, whitened
        At the draw ξ (N,).
    mass
        Volume (N,) of each vertex.
    sigma, goals
        Standard deviations (m,) of the errors of the outputs, and which of these (m,) are not measured but predicted.
    errors
        What is uncertain beside the field (g, m), a row for a standard deviation of each: the last directions.
    rank, seed
        Largest number of directions, and seed of the search for them.

    Returns
    -------
    xarray.Dataset
        `output` (m,), `sigma`, `row` (m, r + g), zero for goals; `field_goal` (r + g, r + g), what the directions add
        to the mean variance of the field, over that of the prior; `goal_row` (q, r + g) of goals over their prior
        standard deviation; and `beyond` (`PROBES`, m), what is left out of the rows along random directions.
    """
    import xarray as xr

    data = np.where(goals, np.nan, 0.0)
    posterior = FieldPosterior(model, data, Noise(sigma), prior)
    point = Point(posterior, whitened, posterior.values(whitened), solution)
    spectrum = leading_pairs(point.jvp, point.vjp, posterior.size, rank=rank, seed=seed)
    directions = prior.root(spectrum.vectors)
    units = np.eye(len(sigma))[goals]
    slopes = prior.root_transposed(solution.adjoint(units)) if len(units) else np.zeros((0, posterior.size))
    slopes = np.hstack([slopes, errors[:, goals].T])
    sizes = np.linalg.norm(slopes, axis=1, keepdims=True)
    slopes = np.divide(slopes, sizes, out=np.zeros_like(slopes), where=sizes > 0)
    rows = np.hstack([slopes[:, : posterior.size] @ spectrum.vectors.T, slopes[:, posterior.size :]])
    of_field = (directions * mass) @ directions.T / (mass @ prior.variance)
    probes = np.random.default_rng([seed, 3]).standard_normal((PROBES, posterior.size))
    probes -= probes @ spectrum.vectors.T @ spectrum.vectors
    return xr.Dataset(
        {
            "output": ("value", np.array(solution.outputs)),
            "sigma": ("value", sigma),
            "row": (("value", "direction"), np.hstack([spectrum.images.T, (errors * ~goals / sigma).T])),
            "field_goal": (("direction", "other"), np.pad(of_field, (0, len(errors)))),
            "goal_row": (("goal", "direction"), rows),
            "beyond": (("probe", "value"), point.jvp(probes)),
        }
    )
