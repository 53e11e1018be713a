"""What few samples do not show of an expansion: roots at the ends of ranges, and gradients that are not of its values.

Next to a limit point an output has the root of the distance to it, and beyond the outermost sample an expansion has
something smooth instead: the others, left out in turn, show 3e-3 of the standard deviation where 1.5e-2 is missing. But
what a root *would* leave at these samples is known, and so is what an expansion makes of it (`Regression.edges`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.estimators.indices import shares
from uq.inputs.coordinates import Coordinates
from uq.inputs.random_parameters import Inputs
from uq.surrogates.basis import Basis, IntArray
from uq.surrogates.least_squares import Data, left_out

CLOSEST = 1e-12  # of the distance to an end, in coordinates: roots have no slope there
DETERMINED = 1e-10  # least over largest size of a column beside those before it
POINCARE = 4.0  # of an exponential quantity, the largest of the usual ones: of a normal 1, of a uniform one 1.2


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

    These are of bounded parameters, and e is the corner of their ranges in that direction.
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

    Returns
    -------
    FloatArray
        Standard deviations (m,) of e over those of the values, where they exceed √(C E|∇e|²); otherwise zero.
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
