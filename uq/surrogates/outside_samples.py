"""What an expansion has where no samples are: exact, since its functions are products of polynomials.

Of ∫ f² over a box of coordinates, with f = Σ c_a ψ_a and the constant left out, the integrals of products of functions
are products of those of one coordinate each. All of f has the variance Σ c_a², so the difference is what lies beyond,
however far out: an order of 20 in a normal coordinate has its largest part at 6 standard deviations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.estimators.indices import shares
from uq.inputs.distributions import Distribution
from uq.inputs.quadrature import panels
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.surrogates.basis import Basis

COMMON = 2  # parameters of which what is missed in their tails adds up
FAR = 9.0  # standard deviations beyond which a normal density is negligible
PANELS = 6  # between these
POINTS = 4096  # that stand for a distribution


class Beyond(NamedTuple):
    """What an expansion has where no samples are.

    Attributes
    ----------
    share
        Of its variance (m,).
    mean
        √(b p) (m,), with the share b of the variance and the probability p of these places: a bound of the mean over
        them, over the norms. It adds up what is missed of all parameters as if it had one sign; where these are many,
        of `COMMON` of them, and no sign is common to the others.
    """

    share: FloatArray
    mean: FloatArray


Box = tuple[FloatArray, FloatArray]  # lower and upper ends (d,) in coordinates, some of them infinite


def beyond(
    inputs: Inputs, basis: Basis, coefficients: FloatArray, points: FloatArray, held: Box | None = None
) -> Beyond:
    """Return what an expansion (P, m) has in tails beyond the box of points (n, d).

    It may be `held` at the values that it has at the sides of another box.
    """
    m, which = coefficients.shape[1], inputs.tails
    if not which.any():
        return Beyond(np.zeros(m), np.zeros(m))
    t = basis.coordinates.of(points)
    lower, upper = np.where(which, t.min(axis=0), -np.inf), np.where(which, t.max(axis=0), np.inf)
    varying = np.flatnonzero((basis.indices != 0).any(axis=1))
    some, c = basis.subset(varying), coefficients[varying]
    factors = list(_factors(inputs, some, (lower, upper), held))
    total = np.einsum("pm,pm->m", c, reduce(np.multiply, [one.everywhere for one in factors]) @ c)

    def share(grams: Sequence[FloatArray]) -> FloatArray:
        inside = np.einsum("pm,pm->m", c, reduce(np.multiply, grams) @ c)
        return np.clip(shares(total - inside, total), 0.0, 1.0)

    every = share([one.inside for one in factors])
    probability = 1 - float(np.prod([1 - one.outside for one in factors]))
    apart = np.zeros(m)
    for k, one in enumerate(factors):
        others = [other.everywhere for other in factors[:k] + factors[k + 1 :]]
        for outside, gram in one.alone:
            apart += COMMON * outside * share([gram, *others])
    return Beyond(every, np.sqrt(np.minimum(every * probability, apart)))


def drawn_beyond(
    inputs: Inputs, functions: Callable[[FloatArray], FloatArray], coefficients: FloatArray, points: FloatArray
) -> Beyond:
    """Return the same of any functions, by draws: enough for those of a low order, which have little far out."""
    m, which = coefficients.shape[1], inputs.tails
    if not which.any():
        return Beyond(np.zeros(m), np.zeros(m))
    drawn = inputs.points(sobol_points(0, 0, 0, POINTS, len(which)))
    each = ((drawn < points.min(axis=0)) | (drawn > points.max(axis=0))) & which
    outside = each.any(axis=1)
    values = functions(drawn) @ coefficients
    squares = (values - values.mean(axis=0)) ** 2
    total = squares.sum(axis=0)
    share = shares(squares[outside].sum(axis=0), total)
    apart = COMMON * each.mean(axis=0) @ shares(each.T.astype(float) @ squares, total)
    return Beyond(share, np.sqrt(np.minimum(share * outside.mean(), apart)))


class _Factor(NamedTuple):
    """A factor of all functions, that of a parameter or of those given by draws: integrals (P, P) of its products.

    Attributes
    ----------
    everywhere
        Over everything.
    inside, outside
        Within the box, and the probability of being beyond it.
    alone
        The same, probability and integrals, for the ends of one parameter each.
    """

    everywhere: FloatArray
    inside: FloatArray
    outside: float
    alone: list[tuple[float, FloatArray]]


def _factors(inputs: Inputs, basis: Basis, box: Box, held: Box | None) -> Iterator[_Factor]:
    """Go through the factors of a basis, within a box, whose functions may be held beyond another."""
    lower, upper = box
    for i in range(inputs.joint.start):
        everywhere = (basis.indices[:, i, None] == basis.indices[:, i]).astype(float)
        ends = sorted({float(side[i]) for side in (*box, *(held or ())) if np.isfinite(side[i])})
        if not ends:
            yield _Factor(everywhere, everywhere, 0.0, [])
            continue
        t, weights = normal_rule(list(inputs.marginals.values())[i], ends)
        if held is not None:
            everywhere = _gram(basis.of_one(i, np.clip(t, held[0][i], held[1][i])), weights)
        within = (t >= lower[i]) & (t <= upper[i])
        near = t[within] if held is None else np.clip(t[within], held[0][i], held[1][i])
        inside, outside = _gram(basis.of_one(i, near), weights[within]), float(weights[~within].sum())
        yield _Factor(everywhere, inside, outside, [(outside, inside)])
    if inputs.draws is None or basis.joint is None:
        return
    start, draws, number = inputs.joint.start, inputs.draws, basis.joint.number(basis.indices)
    table = basis.joint.values(draws.coordinates)[:, number]
    kept = (draws.coordinates >= lower[start:]) & (draws.coordinates <= upper[start:])

    def of(which: NDArray[np.bool_]) -> tuple[float, FloatArray]:
        return float(draws.weights[~which].sum()), _gram(table[which], draws.weights[which])

    outside, inside = of(kept.all(axis=1))
    everywhere = (number[:, None] == number).astype(float)
    yield _Factor(everywhere, inside, outside, [of(column) for column in kept.T])


def _gram(table: FloatArray, weights: FloatArray) -> FloatArray:
    return np.asarray(table.T @ (weights[:, None] * table))


def normal_rule(marginal: Distribution, ends: Sequence[float]) -> tuple[FloatArray, FloatArray]:
    """Coordinates t and weights of a rule for functions with kinks at some coordinates."""
    from scipy.special import ndtri

    alone = Inputs({"": marginal}).coordinates
    p = marginal.cumulative(alone.points(np.array(ends)[:, None])[:, 0])
    kinks = np.clip(ndtri(p), -FAR, FAR).tolist()
    z, weights = panels(sorted({*np.linspace(-FAR, FAR, PANELS + 1).tolist(), *kinks}))
    weights = weights * np.exp(-(z**2) / 2)
    return alone.of(marginal.from_normal(z)[0][:, None])[:, 0], weights / weights.sum()
