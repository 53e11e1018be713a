"""The distribution of parameters over specimens, from the posterior of each.

Specimens i have posteriors by draws z_is with weights w_is, under a prior π_0 that was the same for all. Over the
population z is normal, N(m, C). The likelihood of m and C is Π_i ∫ p_i(z)/π_0(z) N(z|m, C) dz, up to a factor, with
the posterior p_i: no model is solved again (D. W. Hogg, A. D. Myers, J. Bovy, Astrophys. J. 725 (2010) 2166–2175).

A sum over draws alone fails where a population is narrow: few draws lie there, and as C → 0 the nearest decides. So
each draw has a normal kernel of covariance h² V_i, V_i the covariance of the posterior, and draws are moved towards
their mean by √(1 − h²), which leaves mean and covariance as they are (M. West, J. R. Stat. Soc. B 55 (1993) 409–422).
π_0 varies within a kernel: ln π_0 is a quadratic polynomial, fitted to the draws, and a rest that is taken at the draw.
Kernel over polynomial is a normal kernel again, of covariance B_i, at other places b_is with other weights v_is:

    ∫ p_i/π_0 N(z|m, C) dz ≈ Σ_s v_is N(b_is | m, C + B_i).

For normal posteriors under normal priors it is exact for normal kernels of any width. Where π_0 has ends, draws stay in
their places, kernels are cut at the ends and hold their weight inside, and of the integral counts what is inside: of
each number the share of a normal distribution, as if they were independent. The prior of m is normal, twice as wide as
π_0, around its mean; standard deviations of the population have half-t priors with 3 degrees of freedom
and those of π_0 as scale; correlations have density ∝ det R (Lewandowski, Kurowicka and Joe's with η = 2). m, the
logarithms of standard deviations and the angles of R are sampled by emcee's ensemble of walkers (J. Goodman, J. Weare,
Commun. Appl. Math. Comput. Sci. 5 (2010) 65–80).

With covariates x_i of the specimens (grade, region), less their means, the mean of specimen i is m + B x_i. The prior
of each number of B is normal, of mean 0 and as wide as that of m for a change of x by its standard deviation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from forward.model import FloatArray
from forward.phases import phase
from uq.inputs.draws import effective

FREEDOM = 3.0  # of the prior of standard deviations
WIDER = 2.0  # prior of the mean of a population over that of a specimen
KEPT = 200  # draws of a specimen that are used
FLAT = 1e-14  # smallest eigenvalue of a covariance over the largest
TOGETHER = 16  # specimens at once: more are no faster
AGAIN = 50  # times that a draw beyond the ends of a prior is made again
MOST_BENT = 0.99  # second derivatives of ln π_0 over those of a posterior as a normal distribution


@dataclass(frozen=True)
class Specimen:
    """The posterior of a specimen.

    Attributes
    ----------
    draws
        z (S, d).
    weights
        (S,), of sum 1.
    log_prior
        Ln π_0 (S,) at the draws.
    effective
        Number of independent draws that they are worth.
    ends
        Of π_0, lower and upper (2, d), infinite where there are none; None where there are none at all.
    """

    draws: FloatArray
    weights: FloatArray
    log_prior: FloatArray
    effective: float
    ends: FloatArray | None = None

    @cached_property
    def mean(self) -> FloatArray:
        """Mean (d,)."""
        return np.asarray(self.weights @ self.draws)

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance V (d, d)."""
        deviations = self.draws - self.mean
        return np.asarray(deviations.T @ (self.weights[:, None] * deviations))

    @property
    def width(self) -> float:
        """Width h of the kernels, by B. W. Silverman's rule, at most 1."""
        d = self.draws.shape[1]
        return float(min(1.0, (4 / (d + 2) / max(self.effective, 1.0)) ** (1 / (d + 4))))

    @cached_property
    def kernels(self) -> Kernels:
        """The draws as kernels over π_0."""
        S, d = self.draws.shape
        values, vectors = np.linalg.eigh(self.covariance)
        root = vectors * np.sqrt(np.maximum(values, FLAT * values[-1]) + 1e-300)
        u = np.linalg.solve(root, (self.draws - self.mean).T).T
        # ln π_0 ≈ c + g·u + u·H u/2, by draws as far as they count
        pairs = [(i, j) for i in range(d) for j in range(i + 1)]
        squares = np.column_stack([u[:, i] * u[:, j] * (0.5 if i == j else 1.0) for i, j in pairs])
        columns = np.column_stack([np.ones(S), u, squares])
        columns = columns if 3 * columns.shape[1] <= S else columns[:, : 1 + d]
        rows = np.sqrt(self.weights)
        found = np.linalg.lstsq(columns * rows[:, None], self.log_prior * rows, rcond=1e-8)[0]
        rest = self.log_prior - columns @ found
        H = np.zeros((d, d))
        for (i, j), value in zip(pairs, found[1 + d :], strict=False):
            H[i, j] = H[j, i] = value
        bent, axes = np.linalg.eigh(H)
        H = (axes * bent.clip(-MOST_BENT, MOST_BENT)) @ axes.T  # no prior is narrower than a posterior
        near, h = (np.sqrt(1 - self.width**2) if self.ends is None else 1.0) * u, self.width
        B = np.linalg.inv(np.eye(d) / h**2 + H)
        at = (near / h**2 - found[1 : 1 + d]) @ B
        with np.errstate(divide="ignore"):
            logs = np.log(self.weights) - rest - found[0]
        logs += (np.einsum("si,ij,sj->s", at, np.eye(d) / h**2 + H, at) - (near**2).sum(axis=1) / h**2) / 2
        if self.ends is not None:
            logs -= _log_inside(self.mean + near @ root.T, h**2 * np.diag(self.covariance), self.ends)
        return Kernels(self.mean + at @ root.T, root @ B @ root.T, logs)


class Kernels(NamedTuple):
    """Normal kernels: their places b (S, d), their covariance B (d, d), and ln of their weights v (S,)."""

    places: FloatArray
    covariance: FloatArray
    log_weights: FloatArray


def _log_inside(means: FloatArray, variances: FloatArray, ends: FloatArray) -> FloatArray:
    """Ln of the probability (…,) that independent normal numbers (…, d) lie between ends (2, …, d)."""
    from scipy.special import ndtr

    found = np.zeros(np.broadcast_shapes(means.shape, variances.shape)[:-1])
    for k in np.flatnonzero(np.isfinite(ends).reshape(-1, ends.shape[-1]).any(axis=0)):
        lower, upper = ((end[..., k] - means[..., k]) / np.sqrt(variances[..., k]) for end in ends)
        turned = np.where(lower + upper > 0, -1.0, 1.0)  # to the tail where differences are exact
        found += np.log(np.maximum(np.abs(ndtr(turned * upper) - ndtr(turned * lower)), 1e-300))
    return found


def thinned(one: Specimen, seed: int) -> Specimen:
    """Return a specimen with at most `KEPT` draws of equal weight, by systematic resampling."""
    if len(one.draws) <= KEPT:
        return one
    places = (np.arange(KEPT) + np.random.default_rng(seed).uniform()) / KEPT
    which = np.searchsorted(np.cumsum(one.weights), places).clip(max=len(one.weights) - 1)
    weights = np.full(KEPT, 1 / KEPT)
    return Specimen(one.draws[which], weights, one.log_prior[which], min(one.effective, KEPT), one.ends)


@dataclass(frozen=True)
class Hyperprior:
    """Mean (d,) and standard deviation (d,) of a specimen's prior π_0."""

    mean: FloatArray
    std: FloatArray


@dataclass(frozen=True)
class Fit:
    """Draws of the distribution of a population.

    Attributes
    ----------
    mean
        m (A, d).
    covariance
        C (A, d, d).
    effective
        Number of independent draws that they are worth.
    specimens
        What it was fitted to.
    slopes
        B (A, d, q), by covariates; None where there are none.
    covariates
        x (n, q) of the specimens, less their means; None where there are none.
    """

    mean: FloatArray
    covariance: FloatArray
    effective: float
    specimens: tuple[Specimen, ...]
    slopes: FloatArray | None = None
    covariates: FloatArray | None = None

    @cached_property
    def std(self) -> FloatArray:
        """Standard deviations (A, d)."""
        return np.asarray(np.sqrt(np.einsum("aii->ai", self.covariance)))

    def at(self, x: FloatArray | None) -> FloatArray:
        """Return the mean m + B x (A, d) of specimens with covariates x (q,), less the means; m for None."""
        return self.mean if x is None or self.slopes is None else self.mean + self.slopes @ x

    def predictive(self, seed: int, x: FloatArray | None = None) -> FloatArray:
        """Return a draw (A, d) of a new specimen, with covariates x (q,), for each draw of the population."""
        normals = np.random.default_rng([seed, 1]).standard_normal(self.mean.shape)
        return np.asarray(self.at(x) + np.einsum("aij,aj->ai", np.linalg.cholesky(self.covariance), normals))

    def estimates(self, number: int, seed: int) -> tuple[FloatArray, float]:
        """Return draws (A, d) of a specimen under the population, and the effective size of its weights.

        The size is that of the draws of the posterior with the weights that they have over the population.
        """
        one, rng = self.specimens[number], np.random.default_rng([seed, 2, number])
        kernel = one.kernels.covariance
        mean = self.at(None if self.covariates is None else self.covariates[number])
        logs = _log_kernels(one, mean, self.covariance)
        weights = np.exp(logs - logs.max(axis=1, keepdims=True))
        weights /= weights.sum(axis=1, keepdims=True)
        chosen = (weights.cumsum(axis=1) < rng.random((len(weights), 1))).sum(axis=1).clip(max=weights.shape[1] - 1)
        kernels = np.broadcast_to(kernel, self.covariance.shape)
        gain = np.swapaxes(np.linalg.solve(self.covariance + kernel, kernels), 1, 2)
        at = one.kernels.places[chosen]
        middle = at + np.einsum("aij,aj->ai", gain, mean - at)
        left = kernel - gain @ kernel
        values, vectors = np.linalg.eigh((left + np.swapaxes(left, 1, 2)) / 2)
        together = weights.mean(axis=0)

        def drawn() -> FloatArray:
            normals = np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(values.shape)
            return np.asarray(middle + np.einsum("aij,aj->ai", vectors, normals))

        found = drawn()
        if one.ends is not None:
            for _ in range(AGAIN):
                found = np.where(((found < one.ends[0]) | (found > one.ends[1])).any(axis=1)[:, None], drawn(), found)
            found = found.clip(*one.ends)
        return found, float(1 / (together**2).sum())


def _log_kernels(one: Specimen, means: FloatArray, covariances: FloatArray) -> FloatArray:
    """Ln of v N(b | m, C + B) (A, S) of all draws."""
    return np.asarray(_Alike.of([one]).log_kernels(means[None], covariances)[0])


@dataclass(frozen=True)
class _Alike:
    """Specimens n with equally many draws and ends of the same numbers: arrays as of one, stacked.

    What many small arrays cost is the calls: all walkers of all of these are one.
    """

    means: FloatArray
    places: FloatArray
    covariances: FloatArray
    log_weights: FloatArray
    ends: FloatArray | None

    @classmethod
    def of(cls, specimens: Sequence[Specimen]) -> _Alike:
        """Return those of some specimens."""
        places, covariances, log_weights = map(np.array, zip(*(one.kernels for one in specimens), strict=True))
        ends = None if specimens[0].ends is None else np.array([one.ends for one in specimens])
        return cls(np.array([one.mean for one in specimens]), places, covariances, log_weights, ends)

    def log_kernels(self, means: FloatArray, covariances: FloatArray) -> FloatArray:
        """Ln of v N(b | m, C + B) (n, A, S) of all draws, for means (n, A, d) and covariances (A, d, d)."""
        n, A, d = means.shape
        inverses = np.linalg.inv(np.linalg.cholesky(covariances + self.covariances[:, None]))
        places = np.swapaxes(self.places - self.means[:, None], 1, 2)
        whitened = (inverses.reshape(n, -1, d) @ places).reshape(n, A, d, -1)  # one product for all
        whitened -= inverses @ (means - self.means[:, None])[..., None]
        logs = np.log(np.einsum("naii->nai", inverses)).sum(axis=2)
        found = self.log_weights[:, None] - np.einsum("nads,nads->nas", whitened, whitened) / 2 + logs[..., None]
        if self.ends is not None:
            half = inverses @ self.covariances[:, None]  # of a kernel under the population is left B − halfᵀ half
            left = np.einsum("nii->ni", self.covariances)[:, None] - (half**2).sum(axis=2)
            middle = self.places[:, None] - np.einsum("naki,naks->nasi", half, whitened)
            ends = np.swapaxes(self.ends, 0, 1)[:, :, None, None]
            found += _log_inside(middle, np.maximum(left, 1e-300)[:, :, None], ends)
        return np.asarray(found)


def _parted(specimens: Sequence[Specimen]) -> list[tuple[list[int], _Alike]]:
    """Numbers of specimens that are taken at once, and what they are."""
    groups: dict[object, list[int]] = {}
    for number, one in enumerate(specimens):
        bounded = None if one.ends is None else np.isfinite(one.ends).any(axis=0).tobytes()
        groups.setdefault((len(one.draws), bounded), []).append(number)
    parts = [members[k : k + TOGETHER] for members in groups.values() for k in range(0, len(members), TOGETHER)]
    return [(part, _Alike.of([specimens[i] for i in part])) for part in parts]


@phase("fitting the population")
def fitted(
    specimens: Sequence[Specimen],
    prior: Hyperprior,
    draws: int,
    seed: int,
    steps: int = 600,
    covariates: FloatArray | None = None,
    kept: Callable[[FloatArray, Callable[[], FloatArray]], FloatArray] = lambda at, compute: compute(),
) -> Fit:
    """Sample the distribution of a population of at least two specimens, and keep so many draws.

    Each walker makes so many steps, of which the first third is left out. Covariates x (n, q) are less their means.
    Densities that are `kept` are not computed again (`Steps.rows`).
    """
    from emcee import EnsembleSampler, State

    few = tuple(thinned(one, seed) for one in specimens)
    parts = _parted(few)
    d = len(prior.mean)
    means = np.array([one.mean for one in few])
    x = np.zeros((len(few), 0)) if covariates is None else covariates
    lines = np.linalg.lstsq(x, means - means.mean(axis=0), rcond=None)[0]
    means = means - x @ lines
    spread = np.maximum(means.std(axis=0), np.sqrt(np.mean([np.diag(one.covariance) for one in few], axis=0)) / 4)
    widths = np.concatenate([spread / 2, np.full(d * (d + 1) // 2, 0.3), np.outer(spread / 2, 1 / _sizes(x)).ravel()])
    start = np.concatenate([means.mean(axis=0), np.log(spread), np.zeros(d * (d - 1) // 2), lines.T.ravel()])
    rng = np.random.default_rng([seed, 0])
    walkers = start + widths * rng.standard_normal((max(32, 4 * start.size), start.size))

    def log_density(at: FloatArray) -> FloatArray:
        return kept(at, lambda: _log_posterior(at, parts, prior, x))

    sampler = EnsembleSampler(*walkers.shape, log_density, vectorize=True)
    sampler.run_mcmc(State(walkers, random_state=np.random.RandomState(seed).get_state()), steps)
    chain = sampler.get_chain(discard=steps // 3)
    worth = min(
        effective(chain[:, :, j].T.ravel(), np.repeat(np.arange(chain.shape[1]), len(chain))) for j in range(start.size)
    )
    flat = chain.reshape(-1, start.size)
    chosen = flat[rng.permutation(len(flat))[:draws]]
    mean, covariance, slopes = _population(chosen, d)
    known = (None, None) if covariates is None else (slopes, covariates)
    return Fit(mean, covariance, min(worth, float(len(chosen))), tuple(specimens), *known)


def _sizes(x: FloatArray) -> FloatArray:
    """Standard deviations (q,) of covariates (n, q)."""
    return np.asarray(np.sqrt((x**2).mean(axis=0)))


def _population(x: FloatArray, d: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean, covariance and slopes from the coordinates (A, d + d + d(d − 1)/2 + d q) of walkers."""
    ends = d * (d + 3) // 2
    roots = np.exp(x[:, d : 2 * d, None]) * _roots(x[:, 2 * d : ends], d)[0]
    return x[:, :d], roots @ np.swapaxes(roots, 1, 2), x[:, ends:].reshape(len(x), d, -1)


def _roots(y: FloatArray, d: int) -> tuple[FloatArray, FloatArray]:
    """Cholesky factors (A, d, d) of correlation matrices from real numbers (A, d(d − 1)/2), and ln of det R dR/dy.

    Partial correlations are tanh y (D. Lewandowski, D. Kurowicka, H. Joe, J. Multivar. Anal. 100 (2009) 1989–2001):
    that of column k has the density ∝ (1 − p²)^(1 + (d − 2 − k)/2) for η = 2, and dp/dy = 1 − p².
    """
    partial = np.tanh(y)
    root, logs, place = np.zeros((len(y), d, d)), np.zeros(len(y)), 0
    root[:, 0, 0] = 1.0
    for i in range(1, d):
        left = np.ones(len(y))
        for k in range(i):
            p = partial[:, place]
            root[:, i, k] = p * np.sqrt(left)
            rest = np.maximum(1 - p**2, 1e-300)
            left = left * rest
            logs += (2 + (d - 2 - k) / 2) * np.log(rest)
            place += 1
        root[:, i, i] = np.sqrt(left)
    return root, logs


def _log_posterior(
    x: FloatArray, parts: Sequence[tuple[list[int], _Alike]], prior: Hyperprior, covariates: FloatArray
) -> FloatArray:
    """Ln of the density (A,) at coordinates (A, …) of walkers, for covariates (n, q)."""
    d = len(prior.mean)
    mean, covariance, slopes = _population(x, d)
    logs, angles = x[:, d : 2 * d], x[:, 2 * d : d * (d + 3) // 2]
    found = -(((mean - prior.mean) / (WIDER * prior.std)) ** 2).sum(axis=1) / 2
    ratio = np.exp(np.clip(logs - np.log(prior.std), -50, 50))
    found += (logs - (FREEDOM + 1) / 2 * np.log1p(ratio**2 / FREEDOM)).sum(axis=1) + _roots(angles, d)[1]
    found -= ((slopes * _sizes(covariates) / (WIDER * prior.std[:, None])) ** 2).sum(axis=(1, 2)) / 2
    possible = np.isfinite(found) & (np.abs(logs - np.log(prior.std)) < 15).all(axis=1)
    possible &= (np.abs(angles) < 8).all(axis=1)
    found[~possible] = -np.inf
    there = np.repeat(mean[None, possible], len(covariates), axis=0)
    if covariates.size:
        there += np.array([slopes[possible] @ row for row in covariates])
    likelihoods = np.empty(there.shape[:2])
    for numbers, alike in parts:
        kernels = alike.log_kernels(there[numbers], covariance[possible])
        top = kernels.max(axis=2)
        likelihoods[numbers] = top + np.log(np.exp(kernels - top[..., None]).sum(axis=2))
    for one in likelihoods:
        found[possible] += one
    return np.asarray(found)
