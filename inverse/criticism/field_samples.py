"""Samples of the posterior of a field: its low-rank Gaussian, bent, as weighted samples or as proposals of chains.

The Gaussian has x = ξ̂ + Lz with L = (I + UΛUᵀ)^{−1/2} of the low-rank pairs, in the whitened coordinates of the prior.
It alone misses second-order effects of the many directions that the data hardly see: together they change
well-determined quantities by more than the noise (a field that varies is softer in the mean than a constant one). So L
is bent: with the part w of Lz in the directions U of λ ≤ 30, and the residual r of a solve at ξ̂+w,

    x = ξ̂ + w + U_s (a(w) + (I+Λ_s)^{−1/2} z_s),   a(w) = −(I+Λ_s)⁻¹ (A_sᵀ r + ξ̂_s),

the strong directions s follow by a step of Gauss–Newton. As a depends on w alone, the determinant of this map is that
of L, and all formulas stay as they are; for linear models a = 0. Samples x of independent z have the weights w ∝
exp(ℓ(x) + ½|z|²), and the mean of these is the evidence. Chains (`inverse.criticism.chains`) take the same map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from forward.model import FloatArray, Guess, ReferenceSolution, SolveError
from forward.phases import phase
from inverse.criticism.chains import FIELD, Chains, Lengths, Map, Place, crank_nicolson
from inverse.criticism.weights import OfWeights, pareto_shape, trustworthy
from inverse.fields.field_posterior import Point
from inverse.fields.low_rank import LowRankPosterior

STRONG = 30.0  # λ of the directions of a field that follow the others
DRAWS = 6  # of the Gaussian of a field, for the screen of stability


def bent(mode: Point, found: LowRankPosterior) -> Place:
    """Return the map of z (n, N) to ξ (n, N) and −cost (n,) there: two solves for each, by the factor of the mode."""
    pairs = found.spectrum
    slopes = mode.solution.state_tangent(found.directions)
    state = np.array(mode.solution.state)
    # The screen of stability must know where the samples go.
    draws = pairs.root(np.random.default_rng(0).standard_normal((DRAWS, len(mode.whitened))))
    reference = ReferenceSolution(mode.values, state, mode.posterior.prior.root(draws), mode.solution.work.snaps == 0)
    strong = pairs.values > STRONG
    vectors, images, stiffness = pairs.vectors[strong], pairs.images[strong], 1 + pairs.values[strong]
    centre = vectors @ mode.whitened

    def solved(whitened: FloatArray) -> Point:
        start = state + ((whitened - mode.whitened) @ pairs.vectors.T) @ slopes
        return mode.posterior.at(whitened, Guess(start, reference))

    def place(z: FloatArray) -> tuple[FloatArray, FloatArray]:
        along = z @ vectors.T
        whitened = mode.whitened + pairs.root(z - along @ vectors)
        values = np.full(len(z), -np.inf)
        for i in range(len(z)):
            try:
                follows = -(images @ solved(whitened[i]).residual + centre) / stiffness if strong.any() else 0.0
                whitened[i] += (follows + along[i] / np.sqrt(stiffness)) @ vectors
                values[i] = -solved(whitened[i]).cost
            except SolveError:
                continue
        return whitened, values

    return place


@dataclass(frozen=True, eq=False)
class FieldWeights(OfWeights):
    """Samples of the low-rank Gaussian, bent, with their weights in the posterior.

    Attributes
    ----------
    values
        m (n, N).
    log_weights
        ln w (n,), of which the mean of w is p(y); −∞ where the model has no answer.
    """

    values: FloatArray
    log_weights: FloatArray

    @property
    def mean(self) -> FloatArray:
        """Means (N,) of the values."""
        return np.asarray(self.weights @ self.values)

    @property
    def std(self) -> FloatArray:
        """Standard deviations (N,)."""
        return np.asarray(np.sqrt(self.weights @ (self.values - self.mean) ** 2))

    @property
    def pareto_k(self) -> float:
        """Shape k̂ of the largest weights; infinite if there are too few."""
        return pareto_shape(self.weights)

    @property
    def trusted(self) -> bool:
        """Whether the weights can be trusted."""
        return trustworthy(self.pareto_k, self.ess, len(self.log_weights))

    @property
    def log_evidence(self) -> float:
        """Ln p(y)."""
        top = self.log_weights.max()
        return float(top + np.log(np.exp(self.log_weights - top).mean()))

    @property
    def error(self) -> float:
        """Standard error of that."""
        w = self.weights * len(self.log_weights)
        return float(w.std(ddof=1) / np.sqrt(len(w)))


@phase("weighting points around the mode")
def weigh_field(mode: Point, found: LowRankPosterior, samples: int = 64, *, seed: int = 0) -> FieldWeights:
    """Draw samples of the low-rank Gaussian, bent, and weigh them by the posterior: two solves for each.

    Raises `SolveError` if the model has no answer at any of them.
    """
    z = np.random.default_rng(seed).standard_normal((samples, len(mode.whitened)))
    whitened, log_density = bent(mode, found)(z)
    log_weights = log_density + (z**2).sum(axis=1) / 2 + (found.log_determinant / 2 - mode.posterior.constant)
    if not np.isfinite(log_weights.max()):
        raise SolveError("the model has no answer at any of the samples of the Gaussian")
    return FieldWeights(mode.posterior.values(whitened), log_weights)


def chains_of_field(
    mode: Point, found: LowRankPosterior, *, keep: Map = lambda m: m, lengths: Lengths = FIELD, seed: int = 0
) -> Chains:
    """Run chains for a field; kept are its values (N,), or quantities (n, k) of values (n, N)."""
    values = mode.posterior.values
    return crank_nicolson(
        bent(mode, found),
        len(mode.whitened),
        keep=lambda x: keep(values(x)),
        lengths=lengths,
        seed=seed,
    )
