"""Estimates of the error of the mesh at a few parameters, and what follows from them everywhere else.

The error e(ω) of an output ψ is smooth in the parameters, so that few estimates say what it is. Either e itself or its
ratio to ψ, which varies less where an error follows its output, is a Gaussian process: Σ_k c_k p_k(ω) + noise with the
orthonormal polynomials p_k of order 0 to 2 and independent coefficients c_k of zero mean, of any size for the constant
and of variances that fall with the order for the others (C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for
Machine Learning (2006), section 2.7). Given the estimates, c has a mean and a covariance: with few estimates in many
parameters, or where they disagree, it is the covariance that says so. Of both ways the one is taken that predicts
estimates best that it has not seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from forward.model import FloatArray, ForwardModel, Solution
from uq.estimators.indices import shares
from uq.evaluation.block import merge
from uq.evaluation.request import Evaluate, Evaluations, FieldSum, Request
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import latin_points, sobol_points
from uq.surrogates.basis import Basis, hyperbolic, orthonormal
from uq.surrogates.linearisation import Linearisation

DESIGNS, FAR = 256, 1.8  # of which the best is taken, with points so far (standard deviations) from the mean
FEW = 4  # points, the mean among them
STREAM = 1 << 20  # of the designs, beyond those of the methods
PRODUCTS, LINES = 8, 100  # parameters up to which errors may have terms of second order, and of first
FALL = 0.05  # variance of coefficients of one order more, over those before
CONSTANT = 1e6  # variance of the constant, over those of first order: any
EXPECTED, BELIEF = 0.3, 2.0  # how far an error is expected to vary, over itself, and the estimates this is worth
FAR_OFF = 10.0  # times the output at the mean: beyond, what is added to errors does not follow the output
SMALL = 0.05  # of the largest output at the points: where it is smaller somewhere, no ratio to it is taken


def design(inputs: Inputs, slopes: FloatArray, count: int, seed: int) -> FloatArray:
    """Return points (count, d): the mean, and points that are spread well.

    Of some Latin hypercubes, or scrambles of Sobol' points where there are more, that one is taken from which lines are
    known best, over the distribution: lines along all coordinates where points are more than these, or else along the
    directions in which the outputs vary most. Points farther out than `FAR` count against it: there terms that are
    left out are largest.

    Parameters
    ----------
    slopes
        Derivatives (m, d) of the outputs along the coordinates.
    seed
        Of the study.
    """
    d = len(inputs.names)
    if count > d:
        ways = np.eye(d)
    else:
        scaled = slopes / np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), np.finfo(float).tiny)
        ways = np.linalg.svd(np.nan_to_num(scaled), full_matrices=False)[2][: count - 1]
    few = count <= FEW
    numbers = range(STREAM, STREAM + (DESIGNS if few else DESIGNS // 4))
    drawn = [
        latin_points((seed, number), count - 1, d) if few else sobol_points(seed, number, 0, count - 1, d)
        for number in numbers
    ]
    others = inputs.points(np.concatenate(drawn))  # all at once: inverse distributions take a while
    along = inputs.coordinates.of(np.vstack([inputs.mean, others])) @ ways.T
    of_mean = np.broadcast_to(along[0], (len(drawn), 1, along.shape[1]))
    designs = np.concatenate([of_mean, along[1:].reshape(len(drawn), count - 1, -1)], axis=1)
    designs = np.concatenate([np.ones((*designs.shape[:2], 1)), designs], axis=2)
    known = np.linalg.inv(designs.swapaxes(1, 2) @ designs + FALL * np.eye(designs.shape[2]))
    far = np.maximum(np.abs(designs) - FAR, 0.0).max(axis=(1, 2))
    best = int(np.argmin(np.trace(known, axis1=1, axis2=2) + count * far))
    return np.vstack([inputs.mean, others[best * (count - 1) : (best + 1) * (count - 1)]])


@dataclass(frozen=True)
class _StateErrors(FieldSum):
    """Errors of the states at some points (n, d): the sum has a row for each of them, zero where there is none."""

    compact = True
    points: FloatArray

    def on(self, model: ForwardModel) -> Callable[[Solution, FloatArray], FloatArray]:
        def row(solution: Solution, parameters: FloatArray) -> FloatArray:
            found = solution.mesh_error()
            return np.zeros((1, 0)) if found is None else found.state[None, :]

        return row

    def total(self, points: FloatArray, rows: FloatArray) -> FloatArray:
        found = np.zeros((len(self.points), rows.shape[2]))
        for point, row in zip(points, rows, strict=True):
            found[(self.points == point).all(axis=1)] = row[0]
        return found


@dataclass(frozen=True)
class MeshErrors:
    """Errors of the mesh at some points, calibrated at the first of them where that is possible.

    Attributes
    ----------
    evaluations
        Solutions at all points, the first of which is the mean, with `Evaluations.mesh_errors`.
    fields
        Errors (n, U) of the displacements at the points that have an answer; None where they were not asked for.
    saturation
        Factors (m,) that calibrate errors of outputs, which are multiplied by them; NaN where there are none.
    measured
        Whether these were found at the mean; else they are typical ones.
    shifts
        What is added to the errors (m,) then, at the mean; elsewhere in proportion to the outputs.
    doubts
        How far the errors (m,) may be wrong at the mean; NaN where that is not known.
    hidden
        What flat facets hide of a curved surface at the mean (m,), which no estimate sees; NaN where it is not known.
    unstable
        Whether the equilibrium at the mean is unstable on a finer mesh.
    """

    evaluations: Evaluations
    fields: FloatArray | None
    saturation: FloatArray
    measured: bool
    shifts: FloatArray
    doubts: FloatArray
    hidden: FloatArray
    unstable: bool = False

    @property
    def points(self) -> FloatArray:
        """Points (n, d) that have an answer."""
        return self.evaluations.points[self.evaluations.ok]

    @property
    def outputs(self) -> FloatArray:
        """Outputs (n, m) there."""
        return self.evaluations.outputs[self.evaluations.ok]

    @property
    def seen(self) -> FloatArray:
        """Errors (n, m) of the outputs there as elements of one degree more see them."""
        assert self.evaluations.mesh_errors is not None
        return self.evaluations.mesh_errors[self.evaluations.ok]

    @property
    def errors(self) -> FloatArray:
        """Errors (n, m) of the outputs there; NaN in columns of what is not estimated."""
        seen, outputs = self.seen, self.outputs
        first = outputs[:1] if len(outputs) and self.evaluations.ok[0] else np.ones((1, outputs.shape[1]))
        ratios = np.divide(outputs, first, out=np.ones(outputs.shape), where=first != 0)
        near = (ratios > 1 / FAR_OFF) & (ratios < FAR_OFF)
        return np.asarray(seen * _factors(self.saturation) + np.nan_to_num(self.shifts) * np.where(near, ratios, 1.0))


def estimate(
    inputs: Inputs,
    evaluate: Evaluate,
    centre: Linearisation,
    count: int,
    seed: int,
    *,
    fields: bool,
    spare: float = math.inf,
) -> MeshErrors:
    """Estimate the error of the mesh at so many points, and calibrate it at the mean, which may cost so many solves."""
    points = design(inputs, centre.output_slopes, count, seed)
    parts, states, some = [], [], fields and centre.state.size > 0
    for these, calibrated in ((points[:1], spare), (points[1:], None)):
        wanted = _StateErrors(these) if some else None
        request = Request(these, fields=wanted, start=centre.prediction, mesh_errors=True, saturations=calibrated)
        found = evaluate(request)
        if found.fields.size:
            states.append(found.fields[found.ok][:, : evaluate.displacements])
        parts.append(replace(found, fields=found.fields[:0], saturations=None))
        if calibrated is not None:
            assert found.saturations is not None
            known = found.saturations[0]
    displaced = float(_factors(known["state"])) * np.vstack(states) if states else None
    measured = bool(known["measured"] == 1)
    factors, shifts, doubts, hidden = (known[name] for name in ("factors", "shifts", "doubts", "hidden"))
    return MeshErrors(merge(parts), displaced, factors, measured, shifts, doubts, hidden, bool(known["unstable"] == 1))


def _factors(saturation: FloatArray) -> FloatArray:
    """Return factors, 1 where there is no calibration."""
    return np.where(np.isfinite(saturation), saturation, 1.0)


# --- between estimates -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Between:
    """An error of an output as a function of the parameters: a + … in polynomials, or such a multiple of the output.

    Attributes
    ----------
    basis
        The functions p_k.
    follows
        Number of the output whose multiple it is; None where it is a function by itself.
    weights
        Coefficients (q, n) by the errors at the n points: c = weights @ errors.
    covariance
        Of the coefficients (q, q), for errors of a size that `scale` tells.
    unseen
        (n, n): times the errors, what is missed at each point by the estimates at the others.
    precision
        (n, n) of the errors at the points, without the constant.
    """

    basis: Basis
    follows: int | None
    weights: FloatArray
    covariance: FloatArray
    unseen: FloatArray
    precision: FloatArray

    def functions(self, points: FloatArray, outputs: FloatArray) -> FloatArray:
        """Return what the coefficients (q,) multiply (n, q), at points (n, d) with outputs (n, m)."""
        values = self.basis.values(points)
        return values if self.follows is None else np.asarray(values * outputs[:, [self.follows]])

    def slopes(self, point: FloatArray, outputs: FloatArray, tangents: FloatArray) -> FloatArray:
        """Return the derivatives (d, q) of these along the parameters at a point (d,), from outputs and tangents."""
        found = self.basis.coordinates.tangents(self.basis.derivatives(point[None, :])[0].T, point).T
        if self.follows is None:
            return np.asarray(found)
        values = self.basis.values(point[None, :])[0]
        return np.asarray(outputs[self.follows] * found + np.outer(tangents[self.follows], values))

    def scale(self, errors: FloatArray) -> float:
        """Variance of the coefficients, over that of their prior: as errors (n,) scatter, and as is expected."""
        expected = EXPECTED**2 * float((self.weights[0] @ errors) ** 2)
        return float((errors @ self.precision @ errors + BELIEF * expected) / (len(errors) - 1 + BELIEF))


def between(
    inputs: Inputs, slopes: FloatArray, points: FloatArray, outputs: FloatArray, follows: int | None
) -> Between | None:
    """Return how an error depends on the parameters, given points (n, d) with outputs (n, m); None where it cannot.

    Parameters
    ----------
    slopes
        Derivatives (m', d) along the coordinates of the outputs in question: errors vary along them rather.
    follows
        As of `Between`.
    """
    n, d = points.shape
    sizes = np.ones(n) if follows is None else outputs[:, follows]
    if not np.abs(sizes).min() > SMALL * np.abs(sizes).max():
        return None
    order = 2 if d <= PRODUCTS else int(d <= LINES)
    basis = orthonormal(inputs, hyperbolic(d, order, 1.0))
    squares = np.nan_to_num(slopes) ** 2
    along = shares(squares, squares.sum(axis=1, keepdims=True)).mean(axis=0)
    weight = (along + 1 / d) / (along.sum() + 1)
    degrees = basis.indices.sum(axis=1)
    falling = FALL ** np.maximum(degrees - 1, 0)
    variances = np.prod(np.where(basis.indices > 0, weight**basis.indices, 1.0), axis=1) * falling
    variances[degrees == 0] = CONSTANT
    noise = FALL**order
    values = basis.values(points)
    inverse = np.linalg.inv((values * variances) @ values.T + noise * np.eye(n))
    gain = variances[:, None] * values.T @ inverse
    ones = np.ones(n)
    rest = inverse - np.outer(inverse @ ones, inverse @ ones) / (ones @ inverse @ ones)
    covariance = np.diag(variances) - gain @ (values * variances)
    unseen = sizes[:, None] * inverse / np.diag(inverse)[:, None] / sizes
    return Between(basis, follows, gain / sizes, covariance, unseen, rest / np.outer(sizes, sizes))


def best(ways: Sequence[Between | None], errors: FloatArray) -> Between:
    """Return the way that predicts errors (n, k) best which it has not seen."""
    able = [way for way in ways if way is not None]
    return min(able, key=lambda way: float(((way.unseen @ errors) ** 2).sum()))


def covariances(values: FloatArray, others: FloatArray) -> FloatArray:
    """Return the covariances (p, q) of functions (n, p) and others (n, q) over the same points."""
    return np.asarray((values - values.mean(axis=0)).T @ (others - others.mean(axis=0)) / len(values))
