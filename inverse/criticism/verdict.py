"""Tests of a posterior by its residuals, and the verdict: whether Laplace's Gaussian can be trusted, or what else; why.

If model, prior and noise are right and the model is linear, the normalised residuals r at the mode are normal with the
covariance I − S, S = A(I + AᵀA)⁻¹Aᵀ (`inverse.fields.low_rank`): |r|² is a sum of squares weighted by 1/(1+λ), of the
mean n − tr S. Its distribution is taken to be that of g χ²(ν) with the same mean and variance (F. E. Satterthwaite,
Biom. Bull. 2 (1946) 110–114). Residuals of neighbours must not agree more than those of such a normal vector: this
test works even if the size of the noise was inferred.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from forward.model import FloatArray
from inverse.criticism.assessment import counts
from inverse.criticism.chains import Chains
from inverse.criticism.field_samples import FieldWeights
from inverse.criticism.weights import enough, fewest, usual, worth
from inverse.data.neighbours import DRAWS, Neighbours, agreement
from inverse.fields.low_rank import LowRankPosterior, Spectrum
from inverse.fields.newton_cg import Mode
from inverse.low_dimensional.evidence import Evidence
from inverse.low_dimensional.laplace import NEAR, Laplace
from inverse.low_dimensional.posterior import Density, Posterior

UNEXPLAINED = 0.01  # probability below which a model does not explain its residuals, or how they agree
SHIFT = 0.25  # distance of the mean from the mode, in standard deviations, tolerated for Laplace's Gaussian
SOME = 3.0  # what weights must be worth for their share to say how many points would be enough
WIDTH = 0.2  # relative difference of standard deviations tolerated


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


@dataclass(frozen=True)
class Verdict:
    """Which posterior can be trusted, and why.

    Attributes
    ----------
    trust
        "laplace", "corrected" (weighted points, or chains), or "neither".
    why
        In words.
    """

    trust: Literal["laplace", "corrected", "neither"]
    why: str

    def __str__(self) -> str:
        """Say it in one line."""
        heads = {
            "laplace": "Laplace's Gaussian can be trusted",
            "corrected": "Laplace's Gaussian is not to be trusted, the corrected posterior is",
            "neither": "not to be trusted",
        }
        return f"{heads[self.trust]}: {self.why}"


def verdict_on_few(gaussian: Laplace, found: Evidence, test: ResidualTest, chains: Chains | None = None) -> Verdict:
    """Judge the Gaussian of few parameters by weighted points, the residuals, and chains if there are any."""
    objection = _objection(gaussian.converged, test, gaussian.left)
    return verdict_on_points(gaussian, found, chains) if objection is None else objection


def verdict_on_points(gaussian: Laplace, found: Evidence, chains: Chains | None = None) -> Verdict:
    """Judge the Gaussian of few parameters by weighted points, and chains if there are any."""
    if found.route == "closed form":
        return Verdict("laplace", found.why)
    n, c = found.density.x.shape
    said = worth(found.pareto_k, found.ess, n)
    if not counts(found):
        needed = fewest(c)
        if found.trusted:
            said = f"{said}, fewer than the {needed:.0f} that stand in place of a Gaussian of {c} unknowns"
        # A few points do not tell that more would not do.
        more = enough(found.ess, n, needed) if found.ess >= SOME else 0
        return _by_chains(said, chains, max(more, usual(c)) if n < usual(c) else more)
    if found.agreed:
        said += "; a polynomial agrees with all"
    x, w = found.points
    mean, width = w @ x, np.sqrt(np.diag(gaussian.covariance))
    shift = float(np.abs((mean - gaussian.mode) / width).max())
    ratio = np.log(np.sqrt(w @ (x - mean) ** 2) / width)
    chance = 2 / np.sqrt(found.ess if found.many is None else 1 / (w @ w))
    worst = float(np.exp(ratio[np.abs(ratio).argmax()]))
    far = f"means are {shift:.2f} standard deviations from the mode, widths {worst:.2f} of the Gaussian's; {said}"
    if shift <= SHIFT + chance and np.abs(ratio).max() <= WIDTH + chance / np.sqrt(2):
        return Verdict("laplace", far)
    return Verdict("corrected", far)


def verdict_on_field(
    mode: Mode,
    gaussian: LowRankPosterior,
    found: FieldWeights | None,
    test: ResidualTest,
    chains: Chains | None = None,
    values: FloatArray | None = None,
) -> Verdict:
    """Judge means and standard deviations of the values of a field by other solves, if any, and the residuals.

    Other solves are weighted samples, and chains with the values of the field (n, N) that they drew.
    """
    objection = _objection(mode.converged, test)
    if objection is not None:
        return objection
    if found is None:
        if chains is None:
            why = (
                f"the residuals agree with it (probability {test.probability:.2g}); what it says of the directions "
                "with the largest λ was not checked by other solves (method.samples does)"
            )
            return Verdict("laplace", why)
        if not chains.mixed or values is None:
            return _by_chains("no weighted samples", chains, 0)
        return _compared(gaussian, values.mean(axis=0), values.std(axis=0), chains.ess, _said(chains))
    said = worth(found.pareto_k, found.ess, len(found.log_weights))
    if not found.trusted:
        return _by_chains(said, chains, enough(found.ess, len(found.log_weights)))
    return _compared(gaussian, found.mean, found.std, found.ess, said)


def _compared(gaussian: LowRankPosterior, mean: FloatArray, std: FloatArray, ess: float, worth: str) -> Verdict:
    """Compare the Gaussian with means and standard deviations (N,) by so many effective samples."""
    # Root mean squares over the vertices, minus what so few samples would give by chance.
    chance = 1 / ess
    shift = np.sqrt(max(float((((mean - gaussian.mean) / gaussian.std) ** 2).mean()) - chance, 0.0))
    width = float(np.sqrt((std**2).mean() / (gaussian.std**2).mean()))
    far = f"means are {shift:.2f} standard deviations from the mode, widths {width:.2f} of the Gaussian's; {worth}"
    agrees = shift <= SHIFT and abs(np.log(width)) <= WIDTH + np.sqrt(chance)
    return Verdict("laplace" if agrees else "corrected", far)


def _objection(converged: bool, test: ResidualTest, left: float = 0.0) -> Verdict | None:
    if not converged:
        why = "the search for the mode did not converge"
        far = f"{why}: its next step would move an unknown by up to {left:.2g} standard deviations"
        return Verdict("neither", far if left > np.sqrt(NEAR) else why)
    if test.probability < UNEXPLAINED:
        why = f"the model does not explain the data: |r|² = {test.square:.4g} where {test.degrees:.4g} is expected"
        return Verdict("neither", f"{why} (probability {test.probability:.1g})")
    if test.agreement_probability < UNEXPLAINED:
        why = f"residuals of neighbours agree too much (probability {test.agreement_probability:.1g})"
        return Verdict("neither", f"{why}: the model, or the independence of the noise, is wrong")
    return None


def _by_chains(worth: str, chains: Chains | None, samples: int) -> Verdict:
    if chains is None:
        more = f"take method.samples = {samples}, or run chains" if samples else "more of them will not do: run chains"
        return Verdict("neither", f"{worth}; {more} (method.chains)")
    said = _said(chains)
    if chains.mixed:
        return Verdict("corrected", f"{worth}, but chains agree: {said}")
    return Verdict("neither", f"{worth}, and chains have not mixed: {said}")


def _said(chains: Chains) -> str:
    return f"R̂ up to {chains.rhat.max():.3f}, effective draws from {chains.ess:.0f}"
