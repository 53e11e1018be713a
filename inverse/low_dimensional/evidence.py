"""The evidence Z = ∫ p(y | x) N(x; 0, I) dx of a model by weighted points, with its error, by an adaptive route.

Points are drawn from a mixture of Laplace's Gaussian, widened, and the prior, at independent scrambles of Sobol'
points. Each point is weighted by the whole mixture, whichever component it was drawn from,

    w = p(y | x) N(x; 0, I) / (α N(x; x̂, τ² H⁻¹) + (1 − α) N(x; 0, I)) ≤ p(y | x)/(1 − α),

so that no weight is large because the Gaussian is narrow (T. Hesterberg, Technometrics 37 (1995) 185–194). The mean
weight of a scramble is an unbiased estimate of Z; their scatter gives the error. The quality of the weights is also
measured by the effective sample size (Σw)²/Σw² and the shape k̂ of their tail (A. Vehtari et al., J. Mach. Learn. Res.
25 (2024) 72): above 0.7 they cannot be trusted.

The first quarter of the points decides. If the posterior is a Gaussian up to rounding, Laplace's formula is the answer.
If the weights are even, the other points are drawn from the same mixture. Otherwise a polynomial is fitted to the
points (`inverse.low_dimensional.surrogate`), the next quarter is drawn from the posterior of the polynomial, and so on.
Then all points are weighted by the mixture of all the densities they were drawn from (adaptive multiple importance
sampling: J.-M. Cornuet et al., Scand. J. Stat. 39 (2012) 798–812): weights are even where the polynomials are right,
and none is large where they are wrong and the first mixture was not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from forward.model import FloatArray, SolveError
from inverse.criticism.weights import TRUSTED, normalised, pareto_shape, trustworthy
from inverse.low_dimensional.laplace import Laplace
from inverse.low_dimensional.posterior import Density, Posterior
from inverse.low_dimensional.surrogate import SCRAMBLES, Mixture, fit, sample
from uq.inputs.sampling import sobol_points

EVEN = 0.6  # effective share of the first points from which the Gaussian is good enough for the others
QUARTERS = 4
LEAST = QUARTERS * SCRAMBLES  # solves of an estimate
ROUNDED = 1e-9  # relative difference from a Gaussian that counts as rounding error

Route = Literal["closed form", "importance", "surrogate"]


@dataclass(frozen=True)
class Evidence:
    """An estimate of ln Z by weighted points.

    Attributes
    ----------
    log_evidence, error
        ln Z, and its standard error: from the scatter of eight independent replicates.
    route
        How it was found, and `why`.
    ess
        Effective sample size of the points.
    pareto_k
        k̂ of the largest weights; infinite if there are too few points.
    density
        The posterior at the points.
    log_weights
        ln w (n,).
    """

    log_evidence: float
    error: float
    route: Route
    why: str
    ess: float
    pareto_k: float
    density: Density
    log_weights: FloatArray

    @property
    def trusted(self) -> bool:
        """Whether the estimate can be trusted."""
        return self.route == "closed form" or trustworthy(self.pareto_k, self.ess, len(self.log_weights))

    @property
    def weights(self) -> FloatArray:
        """Weights (n,) of the points in the posterior, of sum 1."""
        return normalised(self.log_weights)

    def reweighted(self, change: FloatArray) -> tuple[float, float]:
        """Return ln Z and its error with ln of the prior density changed by `change` (n,) at the points."""
        top = change.max()
        changed, plain = (
            w.reshape(SCRAMBLES, -1).sum(axis=1) for w in (self.weights * np.exp(change - top), self.weights)
        )
        ratio = changed.sum()
        scatter = (changed - ratio * plain).std(ddof=1) * np.sqrt(SCRAMBLES) / ratio
        return float(self.log_evidence + top + np.log(ratio)), float(np.hypot(self.error, scatter))


def evidence(posterior: Posterior, gaussian: Laplace, samples: int, *, seed: int = 0) -> Evidence:
    """Estimate the evidence by `samples` solves around a Gaussian, by the route that the first of them suggest.

    Parameters
    ----------
    posterior, gaussian
        The density that is integrated, and its approximation.
    samples
        Number of solves, at least 32, rounded down to a multiple of 32.
    seed
        Of all draws.

    Raises
    ------
    SolveError
        If the model has no answer at any of the points.
    """
    if samples < LEAST:
        message = f"{samples} samples, expected at least {LEAST}"
        raise ValueError(message)
    quarter = samples // LEAST * SCRAMBLES
    mixture = Mixture.of(gaussian)
    first = _drawn(posterior, mixture, seed, 0, quarter, derivatives=True)
    pilot = weighed(*first, "importance", "")
    misfit = np.abs(_from_gaussian(gaussian, pilot.density))
    even = pilot.ess / quarter
    share = f"the first {quarter} points are worth {pilot.ess:.0f}"
    # Where the model is not defined the likelihood is zero, and the posterior not Gaussian; ∞ − ∞ must not pass.
    everywhere = np.isfinite(pilot.density.log_posterior).all()
    if everywhere and (misfit <= ROUNDED * (1 + np.abs(pilot.density.log_posterior))).all():
        near = misfit[pilot.weights > 1e-6 / quarter]
        whole = _continued(posterior, mixture, first, seed, quarter)
        why = "the posterior is Gaussian at every point that was tried"
        return replace(whole, log_evidence=gaussian.log_evidence, error=float(near.max()), route="closed form", why=why)
    if even >= EVEN and pilot.pareto_k <= TRUSTED:
        whole = _continued(posterior, mixture, first, seed, quarter)
        return weighed(whole.density, whole.log_weights, "importance", f"{share}: even weights")
    try:
        return _by_surrogate(posterior, mixture, first[0], gaussian, seed, quarter, f"{share}: uneven weights")
    except SolveError as error:
        whole = _continued(posterior, mixture, first, seed, quarter)
        return weighed(whole.density, whole.log_weights, "importance", f"{share}; {error}")


def weighed(density: Density, log_weights: FloatArray, route: Route, why: str) -> Evidence:
    """Estimate from weights (n,) whose eight parts, in order, are independent replicates."""
    shift = log_weights.max()
    if not np.isfinite(shift):
        message = "the model has no answer at any of the points drawn for the evidence"
        raise SolveError(message)
    w = np.exp(log_weights - shift)
    means = w.reshape(SCRAMBLES, -1).mean(axis=1)
    total = float(means.mean())
    error = float(means.std(ddof=1) / np.sqrt(SCRAMBLES) / total)
    ess = float(w.sum() ** 2 / (w**2).sum())
    log_evidence = float(shift + np.log(total))
    return Evidence(log_evidence, error, route, why, ess, pareto_shape(w), density, log_weights)


def _drawn(
    posterior: Posterior, mixture: Mixture, seed: int, start: int, stop: int, *, derivatives: bool
) -> tuple[Density, FloatArray]:
    """Solve at points number `start` to `stop` of a mixture, for all scrambles together; return ln w too."""
    c = mixture.centres.shape[1]
    ends = (start // SCRAMBLES, stop // SCRAMBLES)
    x = mixture.draw(np.concatenate([sobol_points(seed, r, *ends, c + 1) for r in range(SCRAMBLES)]))
    density = posterior.at(x, derivatives=derivatives)
    return density, density.log_likelihood - mixture.log_over_prior(x)


def _continued(
    posterior: Posterior, mixture: Mixture, first: tuple[Density, FloatArray], seed: int, quarter: int
) -> Evidence:
    """Draw the other three quarters."""
    rest = _drawn(posterior, mixture, seed, quarter, 4 * quarter, derivatives=False)
    replicate = np.concatenate([np.arange(n) // (n // SCRAMBLES) for n in (quarter, 3 * quarter)])
    order = np.argsort(replicate, kind="stable")
    density = Density.joined([first[0], rest[0]], order)
    return weighed(density, np.concatenate([first[1], rest[1]])[order], "importance", "")


def _from_gaussian(gaussian: Laplace, density: Density) -> FloatArray:
    """Difference (n,) of the log posterior from that of the Gaussian."""
    deviation = density.x - gaussian.mode
    quadratic = gaussian.log_posterior - np.einsum("zi,ij,zj->z", deviation, gaussian.hessian, deviation) / 2
    return np.asarray(density.log_posterior - quadratic)


def _by_surrogate(
    posterior: Posterior, mixture: Mixture, first: Density, gaussian: Laplace, seed: int, quarter: int, why: str
) -> Evidence:
    """Draw each of the other quarters from the posterior of a polynomial fitted to the previous ones."""
    parts = [first]
    over: list[Callable[[FloatArray], FloatArray]] = [mixture.log_over_prior]
    errors = []
    for k in range(1, QUARTERS):
        cloud = sample(fit(posterior, Density.joined(parts)), gaussian, seed + 100 * k)
        parts.append(posterior.at(cloud.pick(seed + k, quarter), derivatives=k < QUARTERS - 1))
        over.append(cloud.log_over_prior)
        errors.append(cloud.error)
    replicate = np.concatenate([np.arange(quarter) // (quarter // SCRAMBLES)] * QUARTERS)
    density = Density.joined(parts, np.argsort(replicate, kind="stable"))
    densities = np.array([log_over_prior(density.x) for log_over_prior in over])
    top = densities.max(axis=0)
    log_over = top + np.log(np.exp(densities - top).mean(axis=0))
    found = weighed(density, density.log_likelihood - log_over, "surrogate", why)
    # The sweeps share their polynomials: a scatter smaller than that of the weights is chance. And a density with a
    # wrong factor makes its share of the mixture wrong by that factor.
    scatter = max(found.error, np.sqrt(1 / found.ess - 1 / len(density.x)))
    return replace(found, error=float(np.hypot(scatter, np.linalg.norm(errors) / QUARTERS)))
