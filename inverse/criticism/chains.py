"""Markov chains that check a Gaussian where it may fail.

A chain whose proposals are reversible with respect to Laplace's Gaussian N(x̂, LLᵀ), x = x̂ + Lz with

    z' = √(1−β²) z + βw,   w ~ N(0, I),   accepted with the chance min(1, exp(ℓ(x') + ½|z'|² − ℓ(x) − ½|z|²)),

accepts everything where the posterior exp ℓ is that Gaussian, whatever the dimension (preconditioned Crank–Nicolson:
S. L. Cotter, G. O. Roberts, A. M. Stuart, D. White, Stat. Sci. 28 (2013) 424–446; with a Gaussian of the posterior: D.
Rudolf, B. Sprungk, Found. Comput. Math. 18 (2018) 309–343). Those of fields are in `inverse.criticism.field_samples`.
For few parameters there is also the affine-invariant ensemble, which uses no Gaussian (J. Goodman, J. Weare, Comm.
Appl. Math. Comp. Sci. 5 (2010) 65–80; emcee: D. Foreman-Mackey et al., Publ. Astron. Soc. Pac. 125 (2013) 306–312). R̂
and effective sample sizes are ArviZ's (A. Vehtari et al., Bayesian Anal. 16 (2021) 667–718).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from forward.model import FloatArray, SolveError
from forward.phases import phase
from inverse.low_dimensional.evidence import Evidence
from inverse.low_dimensional.laplace import Laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.optional import imported

ACCEPTED = 0.3  # acceptance rate for which β is tuned during the burn-in
FIRST_STEP = 0.5  # β at its start
SPREAD = 1.3  # of the starts of chains, in standard deviations of the Gaussian
WIDER = 1.2  # standard deviations of the Gaussian of weighted points, over those of the points
MIXED = 1.01  # R̂ up to which chains agree, however many draws there are
INDEPENDENT = 400.0  # effective sample size from which R̂ and quantiles are meaningful

Place = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
Map = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Lengths:
    """Number of chains, draws kept from each, burn-in steps, and steps per draw."""

    chains: int
    draws: int
    burn: int
    thin: int

    @property
    def evaluations(self) -> int:
        """How often ℓ is evaluated."""
        return self.chains * (1 + self.burn + self.draws * self.thin)


FEW = Lengths(4, 1000, 300, 1)
FIELD = Lengths(2, 1000, 200, 1)


def walkers(size: int) -> Lengths:
    """Lengths of an ensemble for so many unknowns: few long walks, since short chains cannot be judged."""
    return Lengths(max(8, 2 * size), 800, 400, 5)


@dataclass(frozen=True, eq=False)
class Chains:
    """Draws of k quantities.

    Attributes
    ----------
    draws
        (chains, draws, k).
    accepted
        Share (chains,) of proposals that were accepted.
    step
        β; NaN for an ensemble.
    needed
        Effective draws from which on R̂ and quantiles are meaningful.
    evidence
        ln Z and its standard error, where the chains tell.
    apart
        Of the solves, those that no evaluation has counted.
    x
        Of few parameters, the draws in standard normal coordinates (chains, draws, c).
    """

    draws: FloatArray
    accepted: FloatArray
    step: float
    needed: float = INDEPENDENT
    evidence: tuple[float, float] | None = None
    apart: int = 0
    x: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 0)))

    @cached_property
    def rhat(self) -> FloatArray:
        """Rank-normalised split R̂ (k,)."""
        return self._diagnosed(_arviz().rhat)

    @cached_property
    def ess_bulk(self) -> FloatArray:
        """Effective sample sizes (k,) for the bulk."""
        return self._diagnosed(_arviz().ess)

    @cached_property
    def ess_tail(self) -> FloatArray:
        """Effective sample sizes (k,) for the quantiles of 5 and 95 %."""
        return self._diagnosed(lambda dataset: _arviz().ess(dataset, method="tail"))

    def _diagnosed(self, diagnose: Callable[[Any], Any]) -> FloatArray:
        import xarray as xr

        values = xr.Dataset({"quantity": (("chain", "draw", "name"), self.draws)})
        return np.asarray(diagnose(values)["quantity"].to_numpy(), dtype=float)

    @property
    def mixed(self) -> bool:
        """Whether all chains agree, with enough draws."""
        return bool(self.rhat.max() <= self.agreeing and self.ess >= self.needed)

    @property
    def agreeing(self) -> float:
        """R̂ up to which chains agree.

        Means of half chains scatter, by χ² with one degree of freedom less than there are halves: the largest R̂ of
        all quantities that one run in a hundred has by chance. A bound of its own, 1.01, holds where this is less.
        """
        from scipy.special import chdtri

        halves, ess = 2 * len(self.draws), self.ess
        chance = float(chdtri(halves - 1, 0.01 / self.draws.shape[2]))
        return max(MIXED, float(np.sqrt(1 + chance / (halves - 1) * halves / ess)))

    @property
    def ess(self) -> float:
        """Smallest effective sample size over all quantities, for bulk and tails."""
        return float(min(self.ess_bulk.min(), self.ess_tail.min()))

    @property
    def flat(self) -> FloatArray:
        """All draws (n, k), chain after chain."""
        return self.draws.reshape(-1, self.draws.shape[2])


def _arviz() -> Any:
    return imported("R̂ and effective sizes of chains need", "arviz")


@phase("running chains")
def crank_nicolson(
    place: Place,
    size: int,
    *,
    keep: Map = lambda x: x,
    lengths: Lengths = FEW,
    seed: int = 0,
) -> Chains:
    """Run chains side by side: in every step, one evaluation of as many points as there are chains.

    Parameters
    ----------
    place
        Points x (n, c) of z (n, c), and ℓ (n,) there, up to a constant: −∞ where there is no answer.
    size
        c.
    keep
        Quantities (n, k) at x (n, c) that are kept.
    lengths
        Number of chains, and how long they are; β is adapted in the steps before the draws that are kept.
    seed
        Of all draws; each chain has its own numbers.

    Raises
    ------
    SolveError
        If there is no answer at the start of a chain.
    """
    burn, thin = lengths.burn, lengths.thin
    rngs = [np.random.default_rng([seed, chain]) for chain in range(lengths.chains)]

    def normals() -> FloatArray:
        return np.array([rng.standard_normal(size) for rng in rngs])

    z = SPREAD * normals()
    x, here = place(z)
    for _ in range(burn):  # starts at which the model has no answer are moved closer
        lost = ~np.isfinite(here)
        if not lost.any():
            break
        z = np.where(lost[:, None], z / 2, z)
        x, here = place(z)
    if not np.isfinite(here).all():
        raise SolveError("the model has no answer where a chain starts")
    odds = np.log(FIRST_STEP / (1 - FIRST_STEP))
    kept, accepted = [], np.zeros(lengths.chains)
    for step in range(-burn, lengths.draws * thin):
        beta = float(1 / (1 + np.exp(-odds)))
        moved = np.sqrt(1 - beta**2) * z + beta * normals()
        x_moved, there = place(moved)
        chance = np.exp(np.minimum(0.0, there - here + ((moved**2).sum(axis=1) - (z**2).sum(axis=1)) / 2))
        taken = np.array([rng.random() for rng in rngs]) < chance
        z, x = np.where(taken[:, None], moved, z), np.where(taken[:, None], x_moved, x)
        here = np.where(taken, there, here)
        if step < 0:
            # One β for all chains, with decreasing changes, and none after the burn-in.
            odds = float(np.clip(odds + 3 * (chance.mean() - ACCEPTED) / np.sqrt(step + burn + 1), -7, 7))
            continue
        accepted += taken
        if (step + 1) % thin == 0:
            kept.append(keep(x))
    return Chains(np.swapaxes(np.array(kept), 0, 1), accepted / (lengths.draws * thin), beta)


def chains_of_few(
    posterior: Posterior, gaussian: Laplace, points: Evidence | None = None, *, lengths: Lengths = FEW, seed: int = 0
) -> Chains:
    """Run chains for few parameters, kept in physical units.

    Proposals are of Laplace's Gaussian, or of that of weighted points, slightly widened: if the posterior is curved,
    Laplace's is too narrow, and chains get stuck in its tails.
    """
    centre, root = gaussian.mode, gaussian.root
    if points is not None:
        w, x = points.weights, points.density.x
        centre = w @ x
        root = WIDER * np.linalg.cholesky((x - centre).T @ ((x - centre) * w[:, None]))

    def place(z: FloatArray) -> tuple[FloatArray, FloatArray]:
        x = centre + z @ root.T
        return x, posterior.at(x).log_posterior

    return in_units(posterior, crank_nicolson(place, len(centre), lengths=lengths, seed=seed))


def in_units(posterior: Posterior, chains: Chains) -> Chains:
    """Return chains of standard normal coordinates as those of the parameters in physical units."""
    x = chains.draws
    values = posterior.physical(x.reshape(-1, x.shape[2])).reshape(x.shape)
    return replace(chains, draws=values, x=x)


@phase("running chains")
def ensemble(posterior: Posterior, gaussian: Laplace, lengths: Lengths | None = None, *, seed: int = 0) -> Chains:
    """Run emcee's ensemble for few parameters, kept in physical units; its walkers are the chains.

    They start as Laplace's Gaussian says, and are as long as those of `walkers` by default.
    """
    from emcee import EnsembleSampler, State

    c = len(gaussian.mode)
    long = walkers(c) if lengths is None else lengths
    count = long.chains
    sampler = EnsembleSampler(count, c, lambda x: posterior.at(x).log_posterior, vectorize=True)
    z = np.random.default_rng(seed).standard_normal((count, c))
    generator = np.random.RandomState(seed)
    state = State(gaussian.mode + z @ gaussian.root.T, random_state=generator.get_state())
    state = sampler.run_mcmc(state, long.burn, store=False)
    sampler.run_mcmc(state, long.draws, thin_by=long.thin)
    walked = Chains(np.swapaxes(sampler.get_chain(), 0, 1), np.asarray(sampler.acceptance_fraction), np.nan)
    return in_units(posterior, walked)
