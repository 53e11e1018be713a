"""Tests of a posterior by its residuals.

If model, prior and noise are right and the model is linear, the normalised residuals r at the mode are normal with the
covariance I − S, S = A(I + AᵀA)⁻¹Aᵀ (`inverse.fields.low_rank`): |r|² is a sum of squares weighted by 1/(1+λ), of the
mean n − tr S. Its distribution is taken to be that of g χ²(ν) with the same mean and variance (F. E. Satterthwaite,
Biom. Bull. 2 (1946) 110–114). Residuals of neighbours must not agree more than those of such a normal vector: this
test works even if the size of the noise was inferred.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from forward.model import FloatArray
from inverse.data.neighbours import DRAWS, Neighbours, agreement
from inverse.fields.low_rank import Spectrum
from inverse.low_dimensional.posterior import Density, Posterior

UNEXPLAINED = 0.01  # probability below which a model does not explain its residuals, or how they agree


@dataclass(frozen=True)
class ResidualTest:
    """What residuals at the mode say about model, prior and noise.

    Attributes
    ----------
    square
        |r|².
    degrees
        Its expectation n − tr S: the effective degrees of freedom.
    probability
        Of a larger one. Small: the model does not explain the data; near 1: σ is too large.
    agreement_probability
        Probability of neighbours that agree as much or more, by Σ r_i r_j/Σ r² over them; NaN where there are none.
    """

    square: float
    degrees: float
    probability: float
    agreement_probability: float


def examine(residual: FloatArray, spectrum: Spectrum, neighbours: Neighbours | None = None) -> ResidualTest:
    """Test residuals r (n,) at a mode, given the eigenpairs of AᵀA, of which neglected ones count as λ = 0.

    Neighbours are data that are expected to agree if the model is wrong (`inverse.data.neighbours`).
    """
    from scipy.special import chdtrc

    n, values = len(residual), spectrum.values
    weights = np.concatenate([1 / (1 + values[:n]), np.ones(max(n - len(values), 0))])
    square, total = float(residual @ residual), float(weights.sum())
    scale = float((weights**2).sum()) / total
    probability = float(chdtrc(total / scale, square / scale))
    if neighbours is None or not len(neighbours[0]):
        return ResidualTest(square, total, probability, np.nan)
    drawn = np.random.default_rng(0).standard_normal((DRAWS, n))
    # (I − S)^{1/2}: the images are the eigenvectors of S times √λ.
    share = np.divide((1 + values) ** -0.5 - 1, values, out=np.zeros_like(values), where=values > 0)
    drawn = drawn + (drawn @ spectrum.images.T * share) @ spectrum.images
    here = float(agreement(residual[None], neighbours)[0])
    larger = (1 + int((agreement(drawn, neighbours) >= here).sum())) / (DRAWS + 1)
    return ResidualTest(square, total, probability, larger)


def spectrum_of(posterior: Posterior, at: Density) -> Spectrum:
    """Return all pairs of AᵀA of few parameters at a point with derivatives; the noise is no parameter of these."""
    d = len(posterior.inputs.names)
    root = np.sqrt(posterior.noise.information(posterior.residuals(at.outputs, at.x)[0]))
    A = posterior.sensitivities(at)[0] * root[:, None]
    values, vectors = np.linalg.eigh(A.T @ A)
    values, vectors = np.maximum(values[::-1], 0), vectors[:, ::-1].T
    return Spectrum(values, vectors, vectors @ A.T, 0.0, d)
