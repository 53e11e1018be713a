"""Polynomials that stand for a model and whose moments are known exactly: control variates.

A control is C(ω) = Σ_k φ_k(ω) c_k, of features φ whose moments are known. E[C] = Σ E[φ_k] c_k is exact whatever the
coefficients are, as long as they do not depend on the samples that are controlled: an error of theirs costs efficiency
and never bias. So is E[C²] = Σ c_k E[φ_kφ_l] c_l. For the Taylor polynomials around the mean parameters, with the
deviation δ = ω − ω̄, φ = (δ_i; ½δ_i², δ_iδ_j for i < j) and c = (∂ψ/∂ω_i; ∂²ψ/∂ω_i∂ω_j).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from forward.model import FloatArray, ForwardModel, Solution, SolveError
from uq.evaluate import Evaluate, Request
from uq.inputs import Inputs
from uq.linearisation import Linearisation

STEP = 0.5  # of the difference quotients, in standard deviations: wide, to see the curvature where the samples lie
EDGE = 1e-9  # probability of the quantile that takes the place of the end of an unbounded range


class Features(Protocol):
    """Functions φ of the parameters."""

    def values(self, points: FloatArray) -> FloatArray:
        """Return φ (n, k) at points (n, d)."""


@dataclass(frozen=True)
class Monomials:
    """The features of a Taylor polynomial: the deviations from `point` (d,), and products of `pairs` (i, j), i ≤ j."""

    point: FloatArray
    pairs: tuple[tuple[int, int], ...] = ()

    def values(self, points: FloatArray) -> FloatArray:
        """Return φ (n, k) at points (n, d)."""
        deviation = points - self.point
        second = [(0.5 if i == j else 1.0) * deviation[:, i] * deviation[:, j] for i, j in self.pairs]
        return np.column_stack([deviation, *second])


@dataclass(frozen=True)
class Control:
    """A polynomial that stands for the deviations of the outputs and of the state from those at the mean parameters.

    Attributes
    ----------
    polynomials
        The k features.
    outputs, state
        Coefficients (k, m) and (k, U); no state (0, U) where the slopes of the state are not known.
    features_mean
        E[φ] (k,).
    features_second
        E[φφᵀ] (s, s) of the first s features, s = k, or d where the fourth moments of the inputs are not known: the
        square of what these predict is the control of the second moment.
    """

    polynomials: Features
    outputs: FloatArray
    state: FloatArray
    features_mean: FloatArray
    features_second: FloatArray

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


def tangent(inputs: Inputs, centre: Linearisation) -> Control:
    """Return the Taylor polynomial of first degree: E[φ] = 0 and E[φφᵀ] is the covariance of the inputs."""
    zero = np.zeros(len(centre.point))
    return Control(Monomials(centre.point), centre.tangents.T, centre.slopes, zero, inputs.covariance)


def quadratic(inputs: Inputs, evaluate: Evaluate, centre: Linearisation, *, fields: bool) -> Control:
    """Return the Taylor polynomial of second degree, by central differences of tangents: two solves for each parameter.

    E[φ] follows from the covariance of the inputs. E[φφᵀ] needs their moments up to the fourth, which are known where
    the inputs are independent; with a copula the second moment is controlled by the square of the tangent alone.

    Parameters
    ----------
    inputs, evaluate
        Where, and of what.
    centre
        The linearisation at the mean parameters.
    fields
        Whether the coefficients of the state are wanted: d(d + 1)/2 fields.

    Raises
    ------
    SolveError
        If the model has no answer at one of the displaced points.
    """
    d = len(centre.point)
    pairs = tuple((i, j) for i in range(d) for j in range(i, d))
    steps = _steps(inputs)
    displaced = centre.point + np.concatenate([np.diag(steps), -np.diag(steps)])
    wanted = _SecondDerivatives(centre.point, pairs) if fields and centre.slopes.size else None
    found = evaluate(Request(displaced, tangents=True, fields=wanted, start=centre.prediction))
    for failure in found.failures:
        message = (
            f"the model has no answer near the mean parameters, which control = 'quadratic' needs: {failure.reason}"
        )
        raise SolveError(message, failure.history)
    assert found.tangents is not None
    # (d, m, d): ∂/∂ω_i of ∂ψ/∂ω_j
    differences = (found.tangents[:d] - found.tangents[d:]) / (2 * steps[:, None, None])
    hessian = np.array([(differences[i, :, j] + differences[j, :, i]) / 2 for i, j in pairs])
    state = np.concatenate([centre.slopes, found.fields]) if wanted is not None else centre.slopes[:0]
    exponents = np.concatenate([np.eye(d, dtype=int), [np.eye(d, dtype=int)[[i, j]].sum(axis=0) for i, j in pairs]])
    factors = np.array([1.0] * d + [0.5 if i == j else 1.0 for i, j in pairs])
    covariance = inputs.covariance
    mean = factors * np.array([0.0] * d + [covariance[i, j] for i, j in pairs])
    second = covariance if inputs.correlations else _second_moments(inputs, exponents, factors)
    outputs = np.concatenate([centre.tangents.T, hessian])
    return Control(Monomials(centre.point, pairs), outputs, state, mean, second)


def _second_moments(inputs: Inputs, exponents: FloatArray, factors: FloatArray) -> FloatArray:
    """E[φφᵀ] (k, k) of independent inputs, for φ_k = f_k Π_i δ_i^e_ki."""
    d = len(inputs.std)
    higher = np.array([marginal.higher_moments for marginal in inputs.marginals.values()])
    central = np.stack([np.ones(d), np.zeros(d), inputs.std**2, higher[:, 0], higher[:, 1]], axis=1)
    total = exponents[:, None, :] + exponents[None, :, :]
    products = np.prod(central[np.arange(d), total], axis=-1)
    return np.asarray(factors[:, None] * factors[None, :] * products)


def _steps(inputs: Inputs) -> FloatArray:
    """Steps (d,) of the differences: no further than half the way to an end of the range."""
    steps = []
    for marginal, mean, std in zip(inputs.marginals.values(), inputs.mean, inputs.std, strict=True):
        lower, upper = marginal.support or (marginal.at(EDGE), marginal.at(1 - EDGE))
        steps.append(min(STEP * std, (mean - lower) / 2, (upper - mean) / 2))
    return np.array(steps)


@dataclass(frozen=True)
class _SecondDerivatives:
    """Sums up to ∂²u/∂ω_i∂ω_j over points that are displaced from ω̄ by ± h_i along one parameter each."""

    point: FloatArray
    pairs: tuple[tuple[int, int], ...]

    def on(self, model: ForwardModel) -> Callable[[Solution, FloatArray], FloatArray]:
        directions = np.eye(len(self.point))

        def rows(solution: Solution, parameters: FloatArray) -> FloatArray:
            step = parameters - self.point
            moved = int(np.abs(step).argmax())
            slopes = solution.state_tangent(directions) / (2 * step[moved])
            total = np.zeros((len(self.pairs), slopes.shape[1]))
            for k, (i, j) in enumerate(self.pairs):
                if moved == i:
                    total[k] += slopes[j] / 2
                if moved == j:
                    total[k] += slopes[i] / 2
            return total

        return rows
