"""The evidence Z = ∫ p(y | x) N(x; 0, I) dx of a model by weighted points, with its error, by an adaptive route.

Points are drawn from a mixture of Laplace's Gaussian, widened, and the prior, at independent scrambles of Sobol'
points. Each point is weighted by the whole mixture, whichever component it was drawn from,

    w = p(y | x) N(x; 0, I) / (α N(x; x̂, τ² H⁻¹) + (1 − α) N(x; 0, I)) ≤ p(y | x)/(1 − α),

so that no weight is large because the Gaussian is narrow (T. Hesterberg, Technometrics 37 (1995) 185–194). The mean
weight of a scramble is an unbiased estimate of Z; their scatter gives the error. The quality of the weights is also
measured by the effective sample size (Σw)²/Σw² and the shape k̂ of their tail (A. Vehtari et al., J. Mach. Learn. Res.
25 (2024) 72): above 0.7 they cannot be trusted.

The first quarter of the points decides. In so many unknowns that few points of the mixture would count it is drawn from
Student's t about the mode instead (`inverse.low_dimensional.laplace`). If the posterior is a Gaussian up to rounding,
Laplace's formula is the answer, and half of the points are draws of it. If the weights are even, the other points are
drawn from the same density, or, in many unknowns, from Laplace's Gaussian if the weights of the first points tell that
its points are worth more. Otherwise a polynomial is fitted to the points (`inverse.low_dimensional.surrogate`), the
next quarter is drawn from the posterior of the polynomial, and so on, unless that quarter turns out to be worth less
than the better one. All points are weighted by the mixture of all the densities they were drawn from (adaptive multiple
importance sampling: J.-M. Cornuet et al., Scand. J. Stat. 39 (2012) 798–812): weights are even where the proposals are
right, and none is large where they are wrong and the first one was not. Points that were drawn several times count
once, with the weights of all (`inverse.criticism.weights.quality`).

Moments and quantiles need more points than that: of 250, six lie beyond an end of an interval. They are those of many
points in the posterior of a polynomial, E_s[h], plus what solved points say of the difference, Σ (w_i − v_i) h_i with
their weights w in the posterior and v in that of the polynomial: a control variate (B. Peherstorfer, K. Willcox, M.
Gunzburger, SIAM Rev. 60 (2018) 550–591, section 3), where these weights have the smaller sum of squares.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np

from forward.model import FloatArray, SolveError
from forward.phases import phase
from inverse.criticism.weights import FEWEST, TRUSTED, normalised, quality, trustworthy
from inverse.low_dimensional.laplace import Laplace, Proposal, about, first, joint
from inverse.low_dimensional.posterior import Density, Posterior
from inverse.low_dimensional.surrogate import SCRAMBLES, Cloud, affordable, fit, sample, terms
from inverse.optional import imported
from uq.inputs.sampling import sobol_points

EVEN = 0.6  # effective share of the first points from which the Gaussian is good enough for the others
QUARTERS = 4
LEAST = QUARTERS * SCRAMBLES  # solves of an estimate
LIVE = 400  # points of nested sampling
NOTHING = -1e300  # ln p(y | x) there where the model has no answer
AGREED = 0.01  # of the posterior, root mean square over all its parts: what a polynomial may miss
SAME = 4.0  # standard errors between two estimates of ln Z
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
        Effective sample size of the distinct points.
    pareto_k
        k̂ of their largest weights; infinite if there are too few points.
    density
        The posterior at the points.
    log_weights
        ln w (n,).
    many
        More points (N, c) with weights (N,) of sum 1, some of which are negative, that give moments and quantiles
        better; None where there are none.
    cut
        Share of the posterior that these may miss, since the range of their polynomial cuts tails off.
    """

    log_evidence: float
    error: float
    route: Route
    why: str
    ess: float
    pareto_k: float
    density: Density
    log_weights: FloatArray
    many: tuple[FloatArray, FloatArray] | None = None
    cut: float = 0.0

    @property
    def points(self) -> tuple[FloatArray, FloatArray]:
        """Points (N, c), and weights (N,) of sum 1, for moments and quantiles."""
        return (self.density.x, self.weights) if self.many is None else self.many

    @property
    def trusted(self) -> bool:
        """Whether the estimate can be trusted."""
        different = len(np.unique(self.density.x, axis=0))
        weights = trustworthy(self.pareto_k, self.ess, different)
        return self.route == "closed form" or weights or self.agreed

    @property
    def agreed(self) -> bool:
        """Whether a polynomial tells the weights of all points that were solved: no share of the posterior is missed.

        That counts for more than k̂, which takes a few larger weights of points of the prior for a tail.
        """
        if self.many is None:
            return False
        left = self.many[1][-len(self.log_weights) :]
        return bool(left @ left <= AGREED**2)

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


@phase("weighting points around the mode")
def evidence(posterior: Posterior, gaussian: Laplace, samples: int, *, seed: int = 0) -> Evidence:
    """Estimate the evidence by `samples` solves around a Gaussian, by the route that the first of them suggest.

    They are at least 32, rounded down to a multiple of 32. Raises `SolveError` if the model has no answer at any of the
    points.
    """
    if samples < LEAST:
        raise ValueError(f"{samples} samples, expected at least {LEAST}")
    quarter = samples // LEAST * SCRAMBLES
    wide, student, normal = about(gaussian)
    opening = first(wide, student, normal)
    derivatives = affordable(len(posterior.inputs.names))  # which only polynomials need
    pilot = [_drawn(posterior, opening, seed, 0, quarter, derivatives=derivatives)]

    @cache
    def fitted() -> Cloud:
        """Many points by a polynomial, or raise `SolveError`."""
        if not derivatives:
            d = len(posterior.inputs.names)
            count = f"{terms(d, 2):,} terms, too many to be fitted"
            raise SolveError(f"a polynomial of degree 2 in {d} unknowns has {count}")
        return sample(fit(posterior, pilot[0].density), gaussian, seed + 100)

    def polynomial() -> Cloud | None:
        """Many points that may stand for few, by a polynomial; None where there is none."""
        with suppress(SolveError):
            return fitted()
        return None

    def continued(proposal: Proposal, why: str, cloud: Cloud | None = None) -> Evidence:
        """Draw all quarters that are left from a proposal; many points may stand for them."""
        done = sum(len(part.density.x) for part in pilot)
        rest = _drawn(posterior, proposal, seed, done, QUARTERS * quarter, derivatives=False)
        return _weighted(posterior, [*pilot, rest], "importance", why, cloud)

    drawn = _weighted(posterior, pilot, "importance", "")
    share = f"the first {quarter} points are worth {drawn.ess:.0f}"
    # Of the first points all must have an answer: where many have none, the Gaussian is not what the prior allows.
    if np.isfinite(drawn.density.log_posterior).all() and _is_gaussian(gaussian, drawn.density):
        pilot.append(_drawn(posterior, opening, seed, quarter, 2 * quarter, derivatives=False))
        whole = continued(normal, "")
        if _is_gaussian(gaussian, whole.density):
            misfit = np.abs(_from_gaussian(gaussian, whole.density))  # of points that count
            near = float(misfit[whole.weights > 1e-6 / len(misfit)].max())
            why = "the posterior is Gaussian at every point that was tried"
            return replace(whole, log_evidence=gaussian.log_evidence, error=near, route="closed form", why=why)
        return replace(whole, why=f"{share}: nearly Gaussian")
    expected = {one: _expected(drawn, opening, one) for one in (opening, student, normal)}
    best = max(expected, key=lambda one: expected[one])
    if opening is wide:
        # The others would see no more of what is far from the mode; polynomials do, and are right in few unknowns.
        if drawn.ess >= EVEN * quarter and drawn.pareto_k <= TRUSTED:
            cloud = polynomial()
            # Even weights say nothing of a mode that no point has met: both must have the same Z.
            if cloud is None or abs(cloud.log_evidence - drawn.log_evidence) <= SAME * np.hypot(
                drawn.error, cloud.error
            ):
                return continued(opening, f"{share}: even weights", cloud)
    elif expected[best] >= EVEN:
        name = "Laplace's Gaussian" if best is normal else "Student's t about the mode"
        share += f", and all, with others from {name}, would be worth {100 * expected[best]:.0f} % of their number"
        return continued(best, share, polynomial())
    try:
        return _by_surrogate(posterior, pilot[0], fitted(), gaussian, seed, f"{share}: uneven weights", expected[best])
    except SolveError as error:
        return continued(best, f"{share}; {error}", polynomial())


@dataclass(frozen=True, eq=False)
class _Part:
    """Solved points, and the density they were drawn from: ln of it over that of the prior, at points (n, c)."""

    density: Density
    log_over_prior: Callable[[FloatArray], FloatArray]


def _weighted(
    posterior: Posterior, parts: Sequence[_Part], route: Route, why: str, cloud: Cloud | None = None
) -> Evidence:
    """Weight all points by the mixture of the densities they were drawn from, eight replicates in order.

    With a cloud, it stands for the posterior with what they differ from it.
    """
    replicate = np.concatenate([np.arange(n) // (n // SCRAMBLES) for n in (len(part.density.x) for part in parts)])
    density = Density.joined([part.density for part in parts], np.argsort(replicate, kind="stable"))
    counts: dict[Callable[[FloatArray], FloatArray], int] = {}
    for part in parts:
        counts[part.log_over_prior] = counts.get(part.log_over_prior, 0) + len(part.density.x)
    log_over = joint(list(counts), [n / len(density.x) for n in counts.values()], density.x)
    found = weighed(density, density.log_likelihood - log_over, route, why)
    if cloud is None:
        return found
    many = _corrected(posterior, found, log_over, cloud)
    return replace(found, many=many, cut=0.0 if many is None else cloud.cut)


def _corrected(
    posterior: Posterior, found: Evidence, log_over: FloatArray, cloud: Cloud
) -> tuple[FloatArray, FloatArray] | None:
    """Return points of a cloud and of an estimate with their weights; None where the cloud is no help.

    Or where it is so wrong that what the points differ from it leaves a negative variance, of the parameters too.
    """
    x, weights = found.density.x, found.weights
    by_polynomial = cloud.surrogate.at(x).log_likelihood - log_over
    if not np.isfinite(by_polynomial).any():
        return None
    points, many = np.concatenate([cloud.x, x]), np.concatenate([cloud.weights, weights - normalised(by_polynomial)])
    for values in (points, posterior.physical(points)):
        apart = (values - many @ values) / values.std(axis=0)
        if np.linalg.eigvalsh((many[:, None] * apart).T @ apart)[0] <= 0:
            return None
    return (points, many) if many @ many < weights @ weights else None


def weighed(density: Density, log_weights: FloatArray, route: Route, why: str) -> Evidence:
    """Estimate from weights (n,) whose eight parts, in order, are independent replicates."""
    shift = log_weights.max()
    if not np.isfinite(shift):
        raise SolveError("the model has no answer at any of the points drawn for the evidence")
    w = np.exp(log_weights - shift)
    means = w.reshape(SCRAMBLES, -1).mean(axis=1)
    total = float(means.mean())
    error = float(means.std(ddof=1) / np.sqrt(SCRAMBLES) / total)
    log_evidence = float(shift + np.log(total))
    ess, pareto_k = quality(density.x, normalised(log_weights))
    return Evidence(log_evidence, error, route, why, ess, pareto_k, density, log_weights)


def _drawn(posterior: Posterior, proposal: Proposal, seed: int, start: int, stop: int, *, derivatives: bool) -> _Part:
    """Solve at points number `start` to `stop` of a proposal, for all scrambles together."""
    c = len(posterior.names)
    ends = (start // SCRAMBLES, stop // SCRAMBLES)
    x = proposal.draw(np.concatenate([sobol_points(seed, r, *ends, c + 1) for r in range(SCRAMBLES)]))
    return _Part(posterior.at(x, derivatives=derivatives), proposal.log_over_prior)


def _deviation(gaussian: Laplace, density: Density) -> FloatArray:
    """Squares (n,) of the distances of points from the mode, in standard deviations."""
    gap = density.x - gaussian.mode
    return np.asarray(np.einsum("zi,ij,zj->z", gap, gaussian.hessian, gap))


def _from_gaussian(gaussian: Laplace, density: Density) -> FloatArray:
    """Difference (n,) of the log posterior from that of the Gaussian."""
    return np.asarray(density.log_posterior - (gaussian.log_posterior - _deviation(gaussian, density) / 2))


def _is_gaussian(gaussian: Laplace, density: Density) -> bool:
    """Whether the posterior is the Gaussian at all points, up to rounding; it is zero where the model has no answer."""
    here, misfit = density.log_posterior, _from_gaussian(gaussian, density)
    lost = ~np.isfinite(here)
    near = np.abs(misfit[~lost]) <= ROUNDED * (1 + np.abs(here[~lost]))
    return bool(near.all() and (_deviation(gaussian, density)[lost] > -2 * np.log(ROUNDED)).all())


def _expected(drawn: Evidence, opening: Proposal, proposal: Proposal) -> float:
    """Share that all points would be worth if the other quarters were drawn from a proposal; 0 if too few tell.

    Of points of a density q with weights w = p/q, the share is (Σw)²/(n Σ w w'), w' = p/q' the weights in the mixture
    q' of a quarter of q and three of the proposal.
    """
    if drawn.ess < FEWEST:
        return 0.0
    densities = (opening.log_over_prior, proposal.log_over_prior)
    over = joint(densities, (1 / QUARTERS, 1 - 1 / QUARTERS), drawn.density.x)
    top = drawn.log_weights.max()
    plain, mixed = np.exp(drawn.log_weights - top), np.exp(drawn.density.log_likelihood - over - top)
    return float(plain.mean() ** 2 / (plain * mixed).mean())


def _by_surrogate(
    posterior: Posterior, pilot: _Part, cloud: Cloud, gaussian: Laplace, seed: int, why: str, otherwise: float
) -> Evidence:
    """Draw each of the other quarters from the posterior of a polynomial fitted to the previous ones.

    The first is the `cloud`. Raises `SolveError` if polynomials cannot be fitted, or what they say is worth less than
    the share expected otherwise, or is a few points only: picked from these, most would be copies.
    """
    if cloud.ess < FEWEST:
        raise SolveError(f"many points by a polynomial are worth {cloud.ess:.0f}")
    parts, errors = [pilot], list[float]()
    for k in range(1, QUARTERS):
        if k > 1:
            better = sample(fit(posterior, Density.joined([part.density for part in parts])), gaussian, seed + 100 * k)
            cloud = better if better.ess >= FEWEST else cloud
        picked = posterior.at(cloud.pick(seed + k, len(pilot.density.x)), derivatives=k < QUARTERS - 1)
        parts.append(_Part(picked, cloud.log_over_prior))
        errors.append(cloud.error)
        found = _weighted(posterior, parts, "surrogate", why, cloud)
        if k == 1 and found.ess < otherwise * len(found.log_weights):
            raise SolveError(f"a polynomial makes them worth {found.ess:.0f} of {len(found.log_weights)}")
    # The sweeps share their polynomials: a scatter smaller than that of the weights is chance. And a density with a
    # wrong factor makes its share of the mixture wrong by that factor.
    scatter = max(found.error, np.sqrt(max(1 / found.ess - 1 / len(found.log_weights), 0.0)))
    return replace(found, error=float(np.hypot(scatter, np.linalg.norm(errors) / QUARTERS)))


@phase("nested sampling")
def nested(
    posterior: Posterior, *, seed: int = 0, live: int = LIVE, kept: Callable[..., float] = lambda x, solve: solve()
) -> tuple[float, float]:
    """Return ln Z and its standard error by nested sampling with `live` live points; what was `kept` is not solved.

    It shares only the likelihood with the other routes (J. Skilling, Bayesian Anal. 1 (2006) 833–860; by dynesty: J. S.
    Speagle, Mon. Not. R. Astron. Soc. 493 (2020) 3132–3158), and takes ten thousand solves or more: for cheap models.
    Raises `ImportError` if dynesty is not installed.
    """
    dynesty = imported("method.check = 'dynesty' needs", "dynesty")
    from scipy.special import ndtri

    def log_likelihood(x: FloatArray) -> float:
        return max(kept(x, lambda: float(posterior.at(x[None, :]).log_likelihood[0])), NOTHING)

    sampler = dynesty.NestedSampler(
        log_likelihood,
        lambda u: ndtri(np.clip(u, 1e-15, 1 - 1e-15)),
        len(posterior.names),
        nlive=live,
        rstate=np.random.default_rng(seed),
    )
    sampler.run_nested(print_progress=False, dlogz=0.01)
    return float(sampler.results.logz[-1]), float(sampler.results.logzerr[-1])
