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

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray

IntArray = NDArray[np.int64]


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
