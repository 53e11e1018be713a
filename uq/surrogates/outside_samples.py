"""What few samples do not show of an expansion: tails beyond them, ends of ranges, gradients not of its values.

What it has where no samples are is exact, since its functions are products of polynomials. Of ∫ f² over a box of
coordinates, with f = Σ c_a ψ_a and the constant left out, the integrals of products of functions are products of those
of one coordinate each. All of f has the variance Σ c_a², so the difference is what lies beyond, however far out: an
order of 20 in a normal coordinate has its largest part at 6 standard deviations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.estimators.indices import shares
from uq.inputs.coordinates import Coordinates
from uq.inputs.distributions import Distribution
from uq.inputs.quadrature import panels
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.surrogates.basis import Basis, IntArray
from uq.surrogates.least_squares import Data, left_out

COMMON = 2  # parameters of which what is missed in their tails adds up
FAR = 9.0  # standard deviations beyond which a normal density is negligible
PANELS = 6  # between these
POINTS = 4096  # that stand for a distribution
Box = tuple[FloatArray, FloatArray]  # lower and upper ends (d,) in coordinates, some of them infinite
CLOSEST = 1e-12  # of the distance to an end, in coordinates: roots have no slope there
DETERMINED = 1e-10  # least over largest size of a column beside those before it
POINCARE = 4.0  # of an exponential quantity, the largest of the usual ones: of a normal 1, of a uniform one 1.2


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
    """A factor of all functions, that of a parameter or of those given by draws: integrals (P, P) of its products."""

    everywhere: FloatArray
    inside: FloatArray  # within the box
    outside: float  # probability of being beyond it
    alone: list[tuple[float, FloatArray]]  # that, and the integrals within, for the ends of one parameter each


def _factors(inputs: Inputs, basis: Basis, box: Box, held: Box | None) -> Iterator[_Factor]:
    """Go through the factors of a basis, within a box, whose functions may be held beyond another."""
    lower, upper = box
    for i, marginal in enumerate(inputs.own.values()):
        everywhere = (basis.indices[:, i, None] == basis.indices[:, i]).astype(float)
        ends = sorted({float(side[i]) for side in (*box, *(held or ())) if np.isfinite(side[i])})
        if not ends:
            yield _Factor(everywhere, everywhere, 0.0, [])
            continue
        t, weights = normal_rule(marginal, ends)
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


def towards_ends(
    bounded: NDArray[np.bool_], linear: IntArray, coefficients: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return directions (K, d) to ends of bounded parameters (d,), and of which outputs they are asked (K, m).

    That is of all outputs along each parameter, and of each along its slope, by the linear functions (L, d) of an
    expansion and their coefficients (L, m).
    """
    unit, own = np.eye(bounded.size)[bounded], np.eye(coefficients.shape[1])
    along = coefficients.T @ (linear * bounded)
    along = shares(along, np.linalg.norm(along, axis=1)[:, None])
    directions = np.concatenate([unit, -unit, along, -along])
    asked = np.concatenate([np.ones((2 * len(unit), len(own))), own, own])
    return directions, asked * directions.any(axis=1)[:, None]


def roots(
    inputs: Inputs, coordinates: Coordinates, points: FloatArray, directions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return √(b·(e − t)) (n, K) and its slopes (n, d, K) at points (n, d), for directions b (K, d).

    These are of bounded parameters, and e is the corner of their ranges in that direction. Next to a limit point an
    output has the root of the distance to it, and beyond the outermost sample an expansion has something smooth: the
    others, left out in turn, show 3e-3 of the standard deviation where 1.5e-2 is missing. But what a root *would* leave
    at these samples is known, and so is what an expansion makes of it (`Regression.edges`).
    """
    supports = zip(inputs.marginals.values(), inputs.mean.tolist(), strict=True)
    box = coordinates.of(np.array([marginal.support or (mean, mean) for marginal, mean in supports], dtype=float).T)
    ends = np.where(directions > 0, box[1], box[0])
    distance = (ends * directions).sum(axis=1) - coordinates.of(points) @ directions.T
    values = np.sqrt(np.maximum(distance, CLOSEST))
    return values, -directions.T / (2 * values[:, None])


def beside(indices: IntArray, bounded: NDArray[np.bool_]) -> IntArray:
    """Return powers (K, d) next to those of a basis (P, d), in bounded parameters (d,).

    It lacks them, and has one or two powers less of each parameter in them: even functions lack no odd ones.
    """
    steps = np.concatenate([k * np.eye(bounded.size, dtype=np.int64)[bounded] for k in (1, 2)])
    inside = indices[(indices[:, ~bounded] == 0).all(axis=1)]
    known = set(map(tuple, inside.tolist()))
    found = np.unique((inside + steps[:, None]).reshape(-1, bounded.size), axis=0)
    less = [[tuple(row) in known for row in (found - step).tolist()] for step in steps]
    has = np.array(less).reshape(2, -1, len(found)).any(axis=0) | (found[:, bounded].T == 0)
    return np.asarray(found[has.all(axis=0) & [tuple(row) not in known for row in found.tolist()]])


def contradicted(basis: Basis, data: Data) -> FloatArray:
    """Compare values with what an expansion of the gradients alone says of them.

    By Poincaré's inequality no function e varies by more than its gradient does: Var e ≤ C E|∇e|². That of the values
    minus such an expansion is known at the samples, with its gradients from those that are left out in turn. It is far
    smaller than the bound for whatever is smooth, or rough in its gradients too; steps have gradients of nothing.

    Returned are standard deviations (m,) of e over those of the values, where they exceed √(C E|∇e|²); otherwise zero.
    """
    slopes, which = data.slopes, np.flatnonzero((basis.indices != 0).any(axis=1))
    nothing = np.zeros(data.values.shape[1])
    if slopes is None or not 0 < which.size < slopes[:, :, 0].size:
        return nothing
    left = basis.subset(which).rows(data.points, gradients=True)
    n, rows, terms = left[:, 1:].shape
    q, triangle = np.linalg.qr(left[:, 1:].reshape(n * rows, terms))
    size = np.abs(np.diag(triangle))
    if size.min() < DETERMINED * size.max():
        return nothing
    blocks = q.reshape(n, rows, terms)
    rotated = np.einsum("zrp,zrm->pm", blocks, slopes)
    errors = left_out(blocks, slopes - blocks @ rotated, np.arange(n))
    off = (data.values - left[:, 0] @ np.linalg.solve(triangle, rotated)).std(axis=0)
    steepest = np.sqrt(POINCARE * (errors**2).sum(axis=1).mean(axis=0))
    return np.where(off > steepest, shares(off, data.values.std(axis=0)), 0.0)
