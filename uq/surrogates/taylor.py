"""Control variates: polynomial surrogates of a model whose moments are known exactly.

A control is C(ω) = Σ_k φ_k(ω) c_k, with features φ whose moments are known. E[C] = Σ E[φ_k] c_k is exact whatever the
coefficients, as long as they do not depend on the samples that are controlled: errors in them cost efficiency but never
cause bias. So is E[C²] = Σ c_k E[φ_kφ_l] c_l. For the Taylor polynomials around the mean parameters, with the
deviation δ = t − t̄ of the coordinates (`uq.inputs.coordinates`), φ = (δ_i; ½δ_i², δ_iδ_j for i < j) and c = (∂ψ/∂t_i;
∂²ψ/∂t_i∂t_j).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from forward.model import FloatArray, ForwardModel, Solution, SolveError
from uq.evaluation.request import Evaluate, FieldSum, Request
from uq.inputs.coordinates import Coordinates
from uq.inputs.random_parameters import Inputs
from uq.surrogates.basis import Basis, gauss_rule
from uq.surrogates.field_regression import Deviations
from uq.surrogates.linearisation import Linearisation
from uq.surrogates.outside_samples import normal_rule

STEP = 0.5  # of the difference quotients, in standard deviations: wide, to capture the curvature where the samples lie
MARGIN = 0.25  # of the range of its samples, by which an expansion is used beyond them on either side
EDGE = 1e-9  # probability of the quantile that replaces the end of an unbounded range


@dataclass(frozen=True)
class Monomials:
    """The features of a Taylor polynomial: deviations δ from `point` (d,), and products of `pairs` (i, j), i ≤ j."""

    coordinates: Coordinates
    point: FloatArray
    pairs: tuple[tuple[int, int], ...] = ()

    def values(self, points: FloatArray) -> FloatArray:
        """Return φ (n, k) at points (n, d)."""
        deviation = self.coordinates.of(points) - self.coordinates.of(self.point)
        second = [(0.5 if i == j else 1.0) * deviation[:, i] * deviation[:, j] for i, j in self.pairs]
        return np.column_stack([deviation, *second])


@dataclass(frozen=True)
class Control:
    """A polynomial surrogate of the deviations of the outputs and the state from those at the mean parameters.

    Attributes
    ----------
    polynomials
        The k features.
    outputs, state
        Coefficients (k, m) and (k, U); empty (0, U) if the slopes of the state are unknown.
    features_mean
        E[φ] (k,).
    features_second
        E[φφᵀ] (s, s) of the first s features, s = k, or d if the fourth moments of the inputs are unknown: the square
        of the prediction by these is the control of the second moment.
    """

    polynomials: Basis | Monomials | Held
    outputs: FloatArray
    state: FloatArray
    features_mean: FloatArray
    features_second: FloatArray

    @property
    def linear(self) -> bool:
        """Whether it is a tangent."""
        return isinstance(self.polynomials, Monomials) and not self.polynomials.pairs

    def features(self, points: FloatArray) -> FloatArray:
        """Return φ (…, k) at points (…, d)."""
        return self.polynomials.values(points.reshape(-1, points.shape[-1])).reshape(*points.shape[:-1], -1)

    def predict(self, features: FloatArray, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the controls C and D (…, q) of the deviation and of its square, from φ (…, k) and c (k, q)."""
        s = len(self.features_second)
        whole = features @ coefficients
        leading = whole if s == len(coefficients) else features[..., :s] @ coefficients[:s]
        return whole, np.square(leading)

    def expected(self, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return E[C] and E[D] (q,)."""
        leading = coefficients[: len(self.features_second)]
        return self.features_mean @ coefficients, (leading * (self.features_second @ leading)).sum(axis=0)


def expansion(fitted: Deviations) -> Control:
    """Return an expansion in orthonormal polynomials as a control: E[φφᵀ] = 1, E[φ] is 1 for the constant, else 0."""
    constant = (fitted.basis.indices == 0).all(axis=1)
    return Control(fitted.basis, fitted.outputs, fitted.state, constant.astype(float), np.eye(constant.size))


def held_expansion(inputs: Inputs, fitted: Deviations) -> Control | None:
    """Return the expansion as a control of outputs within the range of its samples and `MARGIN`, constant beyond.

    Beyond, the expansion is a guess that no sample supports, while E[φφᵀ] counts it in full. None if all parameters
    are bounded: samples then reach the ends.
    """
    tails = inputs.unbounded
    if not tails.any():
        return None
    t = inputs.coordinates.of(fitted.trial.points)
    lower, upper = t.min(axis=0), t.max(axis=0)
    more = MARGIN * (upper - lower)
    held = Held(fitted.basis, np.where(tails, lower - more, -np.inf), np.where(tails, upper + more, np.inf))
    mean, second = np.ones(len(fitted.outputs)), np.ones((len(fitted.outputs), len(fitted.outputs)))
    for i, marginal in enumerate(inputs.own.values()):
        if tails[i]:
            t, weights = normal_rule(marginal, [held.lower[i], held.upper[i]])
        else:
            t, weights = gauss_rule(marginal, int(fitted.basis.indices[:, i].max()) + 1)
        table = fitted.basis.of_one(i, np.clip(t, held.lower[i], held.upper[i]))
        mean *= weights @ table
        second *= table.T @ (weights[:, None] * table)
    if fitted.basis.joint is not None:  # orthonormal as they are
        number = fitted.basis.joint.number(fitted.basis.indices)
        mean *= number == 0
        second *= number[:, None] == number
    return Control(held, fitted.outputs, fitted.state[:0], mean, second)


@dataclass(frozen=True)
class Held:
    """Functions of the parameters that keep, beyond a range (d,) of the coordinates, their values at its edge."""

    basis: Basis
    lower: FloatArray
    upper: FloatArray

    def values(self, points: FloatArray) -> FloatArray:
        """Return φ (n, k) at points (n, d)."""
        coordinates = self.basis.coordinates
        return self.basis.values(coordinates.points(np.clip(coordinates.of(points), self.lower, self.upper)))


def tangent(inputs: Inputs, centre: Linearisation) -> Control:
    """Return the Taylor polynomial of first degree: E[φ] = −t̄, and E[φφᵀ] the correlation of t, and t̄t̄ᵀ."""
    middle = -inputs.coordinates.of(centre.point)
    second = inputs.correlation + np.outer(middle, middle)
    features = Monomials(inputs.coordinates, centre.point)
    return Control(features, centre.output_slopes.T, centre.state_slopes, middle, second)


def quadratic(inputs: Inputs, evaluate: Evaluate, centre: Linearisation, *, fields: bool) -> Control:
    """Return the Taylor polynomial of second degree, by central differences of tangents: two solves for each parameter.

    E[φ] follows from the correlation of the coordinates. E[φφᵀ] needs their moments up to the fourth, which are known
    if the inputs are independent; with a copula only the square of the tangent controls the second moment.
    With `fields` the coefficients of the state are computed too: d(d + 1)/2 fields. Raises `SolveError` if the model
    has no answer at one of the displaced points.
    """
    d, coordinates = len(centre.point), inputs.coordinates
    pairs = tuple((i, j) for i in range(d) for j in range(i, d))
    middle, steps = coordinates.of(centre.point), _steps(inputs)
    displaced = coordinates.points(middle + np.concatenate([np.diag(steps), -np.diag(steps)]))
    wanted = _SecondDerivatives(coordinates, centre.point, pairs) if fields and centre.slopes.size else None
    found = evaluate(Request(displaced, tangents=True, fields=wanted, start=centre.prediction))
    for failure in found.failures:
        message = "the model has no answer near the mean parameters, which control = 'quadratic' needs"
        raise SolveError(f"{message}: {failure.reason}", failure.history)
    assert found.tangents is not None
    # (2d, m, d): ∂ψ/∂t_j; (d, m, d): ∂/∂t_i of it
    slopes = coordinates.along(found.tangents, displaced)
    differences = (slopes[:d] - slopes[d:]) / (2 * steps[:, None, None])
    hessian = np.array([(differences[i, :, j] + differences[j, :, i]) / 2 for i, j in pairs])
    state = np.concatenate([centre.state_slopes, found.fields]) if wanted is not None else centre.slopes[:0]
    exponents = np.concatenate([np.eye(d, dtype=int), [np.eye(d, dtype=int)[[i, j]].sum(axis=0) for i, j in pairs]])
    factors = np.array([1.0] * d + [0.5 if i == j else 1.0 for i, j in pairs])
    linear = tangent(inputs, centre)
    first = linear.features_mean
    mean = factors * np.append(first, [linear.features_second[i, j] for i, j in pairs])
    second = linear.features_second if inputs.correlations else _second_moments(inputs, middle, exponents, factors)
    outputs = np.concatenate([centre.output_slopes.T, hessian])
    return Control(Monomials(coordinates, centre.point, pairs), outputs, state, mean, second)


def _second_moments(inputs: Inputs, middle: FloatArray, exponents: FloatArray, factors: FloatArray) -> FloatArray:
    """E[φφᵀ] (k, k) for φ_k = f_k Π_i (t_i − t̄_i)^e_ki, by exact Gauss rules and sums over draws."""
    moments = []
    own = inputs.joint.start
    for marginal, at in zip(inputs.own.values(), middle[:own], strict=True):
        t, weights = gauss_rule(marginal, 3)
        moments.append([weights @ (t - at) ** k for k in range(5)])
    total = exponents[:, None, :] + exponents[None, :, :]
    products = np.prod(np.reshape(moments, (own, 5))[np.arange(own), total[..., :own]], axis=-1)
    if inputs.draws is not None:
        powers = np.prod((inputs.draws.coordinates - middle[own:])[:, None, :] ** exponents[:, own:], axis=-1)
        products = products * (powers.T @ (inputs.draws.weights[:, None] * powers))
    return np.asarray(factors[:, None] * factors[None, :] * products)


def _steps(inputs: Inputs) -> FloatArray:
    """Steps (d,) of the differences along the coordinates: at most half the distance to an end of the range."""
    marginals = inputs.marginals.values()
    supports = [marginal.support or (marginal.at(EDGE), marginal.at(1 - EDGE)) for marginal in marginals]
    lower, upper = inputs.coordinates.of(np.array(supports).T)
    if inputs.draws is not None:
        own, t = inputs.joint.start, inputs.draws.coordinates
        lower[own:], upper[own:] = t.min(axis=0), t.max(axis=0)
    middle = inputs.coordinates.of(inputs.mean)
    return np.asarray(np.minimum(STEP, np.minimum(middle - lower, upper - middle) / 2))


@dataclass(frozen=True)
class _SecondDerivatives(FieldSum):
    """Sums up to ∂²u/∂t_i∂t_j over points that are displaced from t̄ by ± h_i along one coordinate each."""

    coordinates: Coordinates
    point: FloatArray
    pairs: tuple[tuple[int, int], ...]

    def on(self, model: ForwardModel) -> Callable[[Solution, FloatArray], FloatArray]:
        here = self.coordinates.of(self.point)

        def rows(solution: Solution, parameters: FloatArray) -> FloatArray:
            step = self.coordinates.of(parameters) - here
            moved = int(np.abs(step).argmax())
            directions = self.coordinates.directions(parameters)
            slopes = solution.state_tangent(directions) / (2 * step[moved])
            total = np.zeros((len(self.pairs), slopes.shape[1]))
            for k, (i, j) in enumerate(self.pairs):
                if moved == i:
                    total[k] += slopes[j] / 2
                if moved == j:
                    total[k] += slopes[i] / 2
            return total

        return rows
