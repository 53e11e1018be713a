"""The Gaussian at the mode of a posterior of a field, from the directions that the data constrain.

With AᵀA u = λu at the mode ξ̂ (`inverse.fields.field_posterior`), and V = LU for the r pairs that are kept,

    Γ_post = Γ_pr − V diag(λ/(1+λ)) Vᵀ = L (I + UΛUᵀ)⁻¹ Lᵀ,

with an error of at most λ/(1+λ) of the first neglected pair, in units of the prior (T. Bui-Thanh, O. Ghattas, J.
Martin, G. Stadler, SIAM J. Sci. Comput. 35 (2013) A2494–A2523). For the data, S = A(I + AᵀA)⁻¹Aᵀ is the sensitivity of
the prediction of a datum to that datum (its leverage); it is also the posterior covariance of Γ_n^{−1/2} G(m).

The pairs come from the Krylov space of a block of random vectors (C. Musco, C. Musco, NIPS 28 (2015)): one product for
each of its vectors, whereas a randomised two-pass method takes two, and is less accurate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from forward.model import FloatArray
from forward.phases import phase
from inverse.fields.field_posterior import BLOCK, Point, Prior

CUTOFF = 0.1  # λ below which pairs are neglected: they change a variance by at most λ/(1+λ)
ACCURACY = 1e-2  # ‖AᵀAu − λu‖/λ of pairs that are kept: the relative error of λ is about its square
VANISHING = 1e-13  # of the largest λ: rounding errors

Map = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Spectrum:
    """The leading eigenpairs of AᵀA.

    Attributes
    ----------
    values
        λ (r,), descending.
    vectors
        u (r, N), orthonormal rows.
    images
        Au (r, n), orthogonal rows of length √λ.
    neglected
        Estimate of the first neglected λ; zero if there is none.
    products
        Number of products with AᵀA.
    """

    values: FloatArray
    vectors: FloatArray
    images: FloatArray
    neglected: float
    products: int

    @property
    def determined(self) -> float:
        """Number of directions that the data determine: the trace Σ λ/(1+λ) of S."""
        return float((self.values / (1 + self.values)).sum())

    @property
    def resolution(self) -> FloatArray:
        """Diagonal (n,) of S: from 0 (the datum adds nothing to the others) to 1 (it alone tells its prediction)."""
        return np.asarray((self.images**2 / (1 + self.values[:, None])).sum(axis=0))

    def solve(self, whitened: FloatArray) -> FloatArray:
        """Multiply (I + UΛUᵀ)⁻¹ with (N,), or (k, N)."""
        return whitened - (whitened @ self.vectors.T * (self.values / (1 + self.values))) @ self.vectors

    def root(self, whitened: FloatArray) -> FloatArray:
        """Multiply (I + UΛUᵀ)^{−1/2} with (N,), or (k, N)."""
        return whitened + (whitened @ self.vectors.T * ((1 + self.values) ** -0.5 - 1)) @ self.vectors


@phase("finding what the data determine")
def leading_pairs(
    jvp: Map,
    vjp: Map,
    size: int,
    *,
    cutoff: float = CUTOFF,
    rank: int | None = None,
    accuracy: float = ACCURACY,
    block: int = BLOCK,
    seed: int = 0,
) -> Spectrum:
    """Find the eigenpairs of AᵀA with λ above a cutoff.

    Parameters
    ----------
    jvp, vjp
        Products of A with rows (k, N), and of Aᵀ with rows (k, n).
    size
        N.
    cutoff
        λ above which pairs are kept, unless they are rounding errors.
    rank
        Largest number of pairs that are kept.
    accuracy
        Tolerance of ‖AᵀAu − λu‖/λ.
    block
        Number of vectors whose products are computed together.
    seed
        Of the first block.
    """
    rng = np.random.default_rng(seed)
    wanted = size if rank is None else min(rank, size)
    AQ = HQ = np.zeros((0, 0))
    Q = np.zeros((0, size))
    new = _orthonormal(rng.standard_normal((min(block, size), size)), Q, 0.0)
    while True:
        images = jvp(new)
        products = vjp(images)
        AQ = np.concatenate([AQ, images]) if len(Q) else images
        HQ = np.concatenate([HQ, products]) if len(Q) else products
        Q = np.concatenate([Q, new])
        values, turn = np.linalg.eigh(AQ @ AQ.T)
        values, turn = np.maximum(values[::-1], 0), turn[:, ::-1].T
        rounding = VANISHING * float(values[0])
        kept = min(int((values > max(cutoff, rounding)).sum()), wanted)
        residuals = np.linalg.norm(turn[:kept] @ HQ - values[:kept, None] * (turn[:kept] @ Q), axis=1)
        # A pair found below the cutoff shows that none above it was missed (except for a λ of multiplicity larger than
        # `block`).
        beyond = len(values) - kept
        settled = (residuals <= accuracy * values[:kept]).all() and (beyond >= min(block, size - kept))
        if settled or len(Q) == size:
            break
        room = size - len(Q)
        new = _orthonormal(products, Q, rounding)[:room]
        if len(new) == 0:  # the space is invariant: more pairs need other vectors
            new = _orthonormal(rng.standard_normal((min(block, room), size)), Q, 0.0)
    neglected = float(values[kept]) if kept < len(values) else 0.0
    return Spectrum(values[:kept], turn[:kept] @ Q, turn[:kept] @ AQ, neglected, len(Q))


def _orthonormal(rows: FloatArray, basis: FloatArray, least: float) -> FloatArray:
    """Orthonormal rows that extend an orthonormal basis to span rows (k, N), to within `least`."""
    from scipy.linalg import qr

    rest = rows - (rows @ basis.T) @ basis
    rest = rest - (rest @ basis.T) @ basis
    columns, triangle, _ = qr(rest.T, mode="economic", pivoting=True)
    found = columns.T[np.abs(np.diag(triangle)) > least]
    # If rows have very different lengths, normalisation may amplify their remaining components along the basis.
    found = found - (found @ basis.T) @ basis
    return np.asarray(qr(found.T, mode="economic")[0].T) if len(found) else found


@dataclass(frozen=True, eq=False)
class LowRankPosterior:
    """The normal distribution N(m̂, Γ_post) of the N values of a field.

    Attributes
    ----------
    mean
        m̂ (N,).
    whitened
        ξ̂ (N,).
    prior, spectrum
        The prior, and the pairs at the mode.
    log_likelihood
        ln p(y | m̂).
    """

    mean: FloatArray
    whitened: FloatArray
    prior: Prior
    spectrum: Spectrum
    log_likelihood: float

    @classmethod
    def at(cls, mode: Point, **settings: Any) -> LowRankPosterior:
        """Find the directions at a mode that the data constrain, as `leading_pairs` does with the same settings."""
        posterior = mode.posterior
        spectrum = leading_pairs(mode.jvp, mode.vjp, posterior.size, **settings)
        return cls(mode.values, mode.whitened, posterior.prior, spectrum, mode.log_likelihood)

    # --- the field ---------------------------------------------------------------------------------------------------

    @cached_property
    def directions(self) -> FloatArray:
        """V (r, N), from the most to the least constrained direction; Vᵀ Γ_pr⁻¹ V = I.

        Directions orthogonal to all of them in this sense are constrained less than the last.
        """
        return self.prior.root(self.spectrum.vectors)

    @cached_property
    def variance(self) -> FloatArray:
        """Variances (N,)."""
        share = self.spectrum.values / (1 + self.spectrum.values)
        return np.asarray(self.prior.variance - share @ self.directions**2)

    @property
    def std(self) -> FloatArray:
        """Standard deviations (N,)."""
        return np.asarray(np.sqrt(np.maximum(self.variance, 0)))

    def covariance(self, g: FloatArray) -> FloatArray:
        """Multiply Γ_post with g (N,), or (k, N)."""
        return self.prior.root(self.spectrum.solve(self.prior.root_transposed(g)))

    def samples(self, whitened: FloatArray) -> FloatArray:
        """Return samples (N,) for standard normal numbers (N,), or (k, N) for k of them."""
        return self.mean + self.prior.root(self.spectrum.root(whitened))

    def marginal(self, g: FloatArray) -> tuple[float, float]:
        """Mean and standard deviation of the linear functional g·m (N,), for example the mean over a region."""
        return float(g @ self.mean), float(np.sqrt(g @ self.covariance(g)))

    # --- numbers -----------------------------------------------------------------------------------------------------

    @property
    def log_determinant(self) -> float:
        """Ln det(Γ_post Γ_pr⁻¹) = −Σ ln(1+λ)."""
        return -float(np.log1p(self.spectrum.values).sum())

    @property
    def log_evidence(self) -> float:
        """Ln p(y) = ln L(m̂) − ½|ξ̂|² − ½ Σ ln(1+λ); exact for linear models, up to the neglected pairs."""
        return self.log_likelihood - float(self.whitened @ self.whitened) / 2 + self.log_determinant / 2

    @property
    def information(self) -> float:
        """Divergence (nat) of the posterior from the prior (S. Kullback, R. A. Leibler, 1951)."""
        values = self.spectrum.values
        spread = float((np.log1p(values) - values / (1 + values)).sum())
        return (spread + float(self.whitened @ self.whitened)) / 2


@dataclass(frozen=True, eq=False)
class Beside:
    """What is uncertain beside a field m of N values, in its deviations, given m: N(mean + slopes (m − m̂), CCᵀ).

    With a field of the covariance Γ, both have the covariance [[Γ, ΓSᵀ], [SΓ, SΓSᵀ + CCᵀ]], S the slopes.

    Attributes
    ----------
    mean
        (g,).
    slopes
        (g, N).
    root
        C (g, r).
    """

    mean: FloatArray
    slopes: FloatArray
    root: FloatArray

    @classmethod
    def before(cls, size: int, count: int) -> Beside:
        """What it is before the data: independent of the field."""
        return cls(np.zeros(count), np.zeros((count, size)), np.eye(count))

    @classmethod
    def of(cls, mode: Point) -> Beside:
        """What it is at a mode, by `inverse.data.noise.Noise.pull`."""
        posterior = mode.posterior
        pull = posterior.seen.pull
        over = posterior.weights * posterior.seen.whitened(pull)
        slopes = -mode.solution.adjoint(over) if len(pull) else np.zeros((0, posterior.size))
        return cls(-pull @ mode.gaps, slopes, symmetric_root(np.eye(len(pull)) - pull @ pull.T))

    def covariance(self, of_field: Map) -> Map:
        """Return what multiplies the covariance of both with (k, N + g), by what does so with Γ."""

        def product(rows: FloatArray) -> FloatArray:
            g, z = np.split(rows, [self.slopes.shape[1]], axis=1)
            seen = of_field(g + z @ self.slopes)
            return np.hstack([seen, seen @ self.slopes.T + z @ self.root @ self.root.T])

        return product

    def deviations(self, of_field: FloatArray, normals: FloatArray) -> FloatArray:
        """Return draws (k, N + g) of both less their means, by those (k, N) of the field and normal numbers (k, r)."""
        return np.hstack([of_field, of_field @ self.slopes.T + normals @ self.root.T])

    def weighted(self, mean: FloatArray, values: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return points of both (n, N + g) with weights, by those of the field: sums of squares are those of all.

        They are 2r + 1 for each, as of an unscented transform (S. Julier, J. Uhlmann, Proc. IEEE 92 (2004) 401–422).
        """
        r = self.root.shape[1]
        normals = np.sqrt(r + 1) * np.vstack([np.zeros((1, r)), np.eye(r), -np.eye(r)])
        shares = np.append(1.0, np.full(2 * r, 0.5)) / (r + 1)
        rows = self.deviations(np.repeat(values - mean, 2 * r + 1, axis=0), np.tile(normals, (len(values), 1)))
        return rows + np.append(mean, self.mean), np.outer(weights, shares).ravel()


def symmetric_root(covariance: FloatArray) -> FloatArray:
    """Return the symmetric root of a covariance (g, g), of which rounding may leave negative variances."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T)
