"""The posterior density of a field of N values given many measured outputs, in coordinates whitened by its prior.

With m = m_0 + Lξ and ξ ~ N(0, I) a priori, so that Γ_pr = LLᵀ, and data y = G(m) + e with independent e_i ~ N(0, σ_i²),

    −ln p(ξ | y) = ½ r·r + ½ ξ·ξ + const,   r_i = (G_i(m) − y_i)/σ_i.

The gradient ξ + Aᵀr and the Gauss–Newton product (I + AᵀA)ξ, A = Γ_n^{−1/2} G'(m) L, are those of the density of m with
the prior covariance as preconditioner: H v = λ Γ_pr⁻¹ v has the solutions v = Lu with AᵀA u = λu (T. Bui-Thanh, O.
Ghattas, J. Martin, G. Stadler, SIAM J. Sci. Comput. 35 (2013) A2494–A2523). Neither the precision nor any other N × N
matrix is needed.

Vectors are rows: k of them are (k, N) in the field and (k, n) in the data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np

from forward.model import FloatArray, ForwardModel, Guess, Solution, SolveError
from inverse.data.noise import HALF_LOG, Noise

BLOCK = 32  # vectors whose products are computed together


class Prior(Protocol):
    """A normal distribution N(0, LLᵀ) of N values, given by products with a root L of its covariance."""

    @property
    def variance(self) -> FloatArray:
        """Diagonal (N,) of LLᵀ."""

    def root(self, whitened: FloatArray) -> FloatArray:
        """Return Lξ (N,) for ξ (N,), or (k, N)."""

    def root_transposed(self, g: FloatArray) -> FloatArray:
        """Return Lᵀg (N,) for g (N,), or (k, N)."""


@dataclass
class Counts:
    """Number of solutions."""

    solves: int = 0


@dataclass(frozen=True, eq=False)
class FieldPosterior:
    """Measured outputs of a model, and the prior of its parameters.

    Parameters
    ----------
    model
        The model; all of its parameters are values of the field.
    data
        y (n,), in the units of the outputs; NaN where nothing was measured.
    noise
        The errors, of known size; a model misses the same for all fields.
    prior
        Prior of the differences from `mean`.
    mean
        m_0 (N,); by default zero.
    progress
        Told of each solve, and whether it failed.
    """

    model: ForwardModel
    data: FloatArray
    noise: Noise
    prior: Prior
    mean: FloatArray | None = None
    counts: Counts = field(default_factory=Counts)
    progress: Callable[[int, int], None] = lambda done, failed: None

    def __post_init__(self) -> None:
        n = len(self.model.outputs)
        sigma = self.noise.sigma
        if self.data.shape != (n,) or sigma.shape != (n,):
            raise ValueError(f"{self.data.size} data and {sigma.size} standard deviations, expected {n} of each")
        if not self.measured.any():
            raise ValueError("all data are NaN, expected at least one number")

    @property
    def size(self) -> int:
        """Number N of values."""
        return len(self.model.parameters)

    @cached_property
    def measured(self) -> FloatArray:
        """One for measured outputs (n,), zero for others."""
        return np.isfinite(self.data).astype(float)

    @cached_property
    def seen(self) -> Noise:
        """The errors of what was measured."""
        return self.noise.seen(self.measured)

    @cached_property
    def weights(self) -> FloatArray:
        """1/σ (n,) of what was measured."""
        return self.measured / self.seen.scale

    @cached_property
    def constant(self) -> float:
        """What −ln p(y | ξ) has besides the misfit: Σ ln σ + ½ ln det(I + ŨŨᵀ) + (n/2) ln 2π of what was measured."""
        weights = self.weights[self.weights > 0]
        return self.seen.log_determinant - float(np.log(weights).sum()) + len(weights) * HALF_LOG

    def values(self, whitened: FloatArray) -> FloatArray:
        """Return the field m_0 + Lξ (N,), or (k, N)."""
        return self.prior.root(whitened) + (0.0 if self.mean is None else self.mean)

    def at(self, whitened: FloatArray, guess: Guess | None = None) -> Point:
        """Solve at ξ (N,), starting from a guess; raises `SolveError` if the model has no answer."""
        self.counts.solves += 1
        values = self.values(whitened)
        try:
            solution = self.model.solve(values, guess)
        except SolveError:
            self.progress(1, 1)
            raise
        self.progress(1, 0)
        return Point(self, np.array(whitened), values, solution)


@dataclass(frozen=True, eq=False)
class Point:
    """The posterior at one ξ, with its linearisation there.

    Attributes
    ----------
    posterior
        The posterior.
    whitened
        ξ (N,).
    values
        m (N,).
    solution
        The solution of the model.
    """

    posterior: FieldPosterior
    whitened: FloatArray
    values: FloatArray
    solution: Solution

    @cached_property
    def gaps(self) -> FloatArray:
        """Predicted minus measured outputs, over σ (n,); zero where nothing was measured."""
        posterior = self.posterior
        gap = np.where(posterior.measured > 0, self.predicted_outputs - posterior.data, 0.0)
        return posterior.seen.whitened(posterior.weights * gap)

    @property
    def predicted_outputs(self) -> FloatArray:
        """What is predicted (n,), corrected where the error of the mesh is known."""
        missed = self.posterior.noise.model
        return np.asarray(self.solution.outputs if missed is None else self.solution.outputs + missed.error)

    @cached_property
    def root(self) -> FloatArray:
        """√ (n,) of the weights of the data for Gauss–Newton: 1 for normal errors, see `inverse.data.noise`."""
        return np.asarray(np.sqrt(self.posterior.noise.information(self.gaps)))

    @cached_property
    def residual(self) -> FloatArray:
        """Residuals r (n,); for errors that are not normal, with the same gradient under Gauss–Newton weights."""
        return np.asarray(self.posterior.noise.score(self.gaps) / self.root)

    @cached_property
    def misfit(self) -> float:
        """−ln p(y | ξ) without Σ ln σ + (n/2) ln 2π: ½ r·r for normal errors."""
        minus_log = self.posterior.noise.minus_log(self.gaps) - HALF_LOG
        return float(self.posterior.measured @ minus_log)

    @property
    def log_likelihood(self) -> float:
        """Ln p(y | ξ)."""
        return -self.misfit - self.posterior.constant

    @property
    def penalty(self) -> float:
        """½ ξ·ξ."""
        return float(self.whitened @ self.whitened) / 2

    @property
    def cost(self) -> float:
        """−ln p(ξ | y) up to a constant."""
        return self.misfit + self.penalty

    @cached_property
    def gradient(self) -> FloatArray:
        """ξ + Aᵀr (N,), by one adjoint of the model."""
        return np.asarray(self.whitened + self.vjp(self.residual))

    def jvp(self, whitened: FloatArray) -> FloatArray:
        """Return the Jacobian-vector product Aξ (n,), or (k, n) for k of them."""
        posterior = self.posterior
        moved = posterior.weights * self.solution.tangent(posterior.prior.root(whitened))
        return self.root * posterior.seen.whitened(moved)

    def vjp(self, data: FloatArray) -> FloatArray:
        """Return the vector-Jacobian product Aᵀr (N,), or (k, N) for k of them."""
        posterior = self.posterior
        weights = posterior.weights * posterior.seen.whitened(self.root * data)
        return posterior.prior.root_transposed(self.solution.adjoint(weights))

    def product(self, whitened: FloatArray) -> FloatArray:
        """Return AᵀAξ (N,), or (k, N) for k of them."""
        return self.vjp(self.jvp(whitened))

    def predicted(self, step: FloatArray) -> FloatArray:
        """Return the change (U_local,) of the state along a step (N,) of ξ."""
        return self.solution.state_tangent(self.posterior.prior.root(step))
