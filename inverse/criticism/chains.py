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

from forward.model import FloatArray, ForwardModel, SolveError
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
# A point x (c,) and what solves there for −ln of the density and its gradient → these.
Kept = Callable[[FloatArray, Callable[[], tuple[float, FloatArray]]], tuple[float, FloatArray]]
DEPTH = 6  # doublings of a path
STEERED = 0.8  # mean probability of acceptance for which the step is chosen
EACH = 100.0  # effective draws of a chain from which on R̂ and quantiles are meaningful
BUDGET = 60_000  # gradients
BRIDGED = 100  # most iterations of a bridge


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
    place: Place, size: int, *, keep: Map = lambda x: x, lengths: Lengths = FEW, seed: int = 0
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


GRADIENTS = Lengths(2, 300, 100, 1)


def most(lengths: Lengths = GRADIENTS, burn: int | None = None) -> int:
    """Return the most gradients that chains of some lengths take, also with another burn-in."""
    steps: int = lengths.chains * ((lengths.burn if burn is None else burn) + lengths.draws) << DEPTH
    return steps


class _Potential:
    """−ln of the posterior and its gradient by whitened coordinates z (c,), which remembers the last point."""

    def __init__(self, posterior: Posterior, gaussian: Laplace, model: ForwardModel, kept: Kept) -> None:
        self._posterior, self._model, self._kept = posterior, model, kept
        self._mode, self._root = gaussian.mode, gaussian.root
        self._last: tuple[bytes, float, FloatArray] = (b"", 0.0, np.zeros(0))
        self.count = 0

    def both(self, z: FloatArray) -> tuple[float, FloatArray]:
        key = z.tobytes()
        if key != self._last[0]:
            self.count += 1
            x = self._mode + self._root @ z
            value, gradient = self._kept(x, lambda: self._posterior.potential(x, self._model))
            self._last = key, value, self._root.T @ gradient
        return self._last[1:]


@phase("running chains")
def gradient_chains(
    posterior: Posterior,
    gaussian: Laplace,
    model: ForwardModel,
    *,
    lengths: Lengths = GRADIENTS,
    budget: int = BUDGET,
    seed: int = 0,
    kept: Kept = lambda x, solve: solve(),
) -> Chains:
    """Run Hamiltonian chains for few parameters, kept in physical units, with the evidence that follows from them.

    In coordinates in which Laplace's Gaussian is standard normal, a point is moved along a path on which −ln of the
    density plus a kinetic energy stays the same, as far as it does not turn back (M. D. Hoffman, A. Gelman, J. Mach.
    Learn. Res. 15 (2014) 1593–1623; dynamic multinomial version: M. Betancourt, arXiv:1701.02434; by mici, M. Graham,
    which needs NumPy only). Each step of a path takes one solve and one adjoint, whatever the number of unknowns; paths
    have at most 64 steps, so that what chains cost is bounded.

    The model is solved for values and adjoints, one point after another; collective over its ranks. As many draws again
    follow until the chains have mixed, as long as the budget of gradients allows for them: only the first may exceed
    it. What was `kept` of an interrupted run is not solved again. Raises `ImportError` if mici is not installed, and
    `SolveError` if there is no answer at the start of a chain.
    """
    mici = imported("chains that follow gradients need", "mici")
    potential = _Potential(posterior, gaussian, model, kept)
    rng = np.random.default_rng(seed)

    def value(z: FloatArray) -> float:  # a function: a method would be copied, with what it counts
        return potential.both(z)[0]

    def gradient(z: FloatArray) -> tuple[FloatArray, float]:
        return potential.both(z)[::-1]

    system = mici.systems.EuclideanMetricSystem(value, grad_neg_log_dens=gradient)
    # All chains share it: copies are told apart by their addresses in what states remember, which differ between runs.
    system.__deepcopy__ = lambda memo: system
    integrator = mici.integrators.LeapfrogIntegrator(system)
    sampler = mici.samplers.DynamicMultinomialHMC(system, integrator, rng, max_tree_depth=DEPTH)
    states: Any = [_start(potential, SPREAD * rng.standard_normal(len(gaussian.mode))) for _ in range(lengths.chains)]
    burn, adapters = lengths.burn, [mici.adapters.DualAveragingStepSizeAdapter(STEERED)]
    chains: Chains | None = None
    parts: tuple[Any, ...] = ()
    while chains is None or not (chains.mixed or potential.count + most(lengths, 0) > budget):
        found = sampler.sample_chains(
            burn,
            lengths.draws,
            states,
            adapters=adapters,
            trace_funcs=[lambda state: {"z": state.pos, "potential": system.neg_log_dens(state)}],
            display_progress=False,
        )
        states, burn, adapters = found.final_states, 0, []  # more of the same, with the step that was found
        more = (np.array(found.traces["z"]), -np.array(found.traces["potential"]), found.statistics["accept_stat"])
        parts = (*parts, more)
        z, log_density, accepts = (np.concatenate([part[k] for part in parts], axis=1) for k in range(3))
        walked = Chains(gaussian.mode + z @ gaussian.root.T, accepts.mean(axis=1), np.nan, EACH * len(z))
        chains = in_units(posterior, walked)

    def at(there: FloatArray) -> FloatArray:
        return posterior.at(gaussian.mode + there @ gaussian.root.T).log_posterior

    ratio, error = bridge(at, z, log_density, chains.ess, rng)
    c = len(gaussian.mode)
    log_evidence = ratio + float(np.linalg.slogdet(gaussian.root)[1]) - c / 2 * float(np.log(2 * np.pi))
    return replace(chains, evidence=(log_evidence, error), apart=potential.count)


def bridge(
    log_density: Map, z: FloatArray, levels: FloatArray, ess: float, rng: np.random.Generator
) -> tuple[float, float]:
    """Return ln of the integral of a density and its standard error by bridge sampling from chains.

    From its ratio to a Gaussian that is fitted to half of the draws, with the other half (X.-L. Meng, W. H. Wong, Stat.
    Sinica 6 (1996) 831–860), with the error of S. Frühwirth-Schnatter, Econom. J. 7 (2004) 143–167; then with the
    halves exchanged.

    The density is given by ln of it (n,) at points (n, c), and (chains, draws) at draws (chains, draws, c) that are
    worth `ess` independent ones.
    """
    half = z.shape[1] // 2
    first, second = slice(half), slice(half, 2 * half)
    one, first_error = _half(log_density, z[:, first], z[:, second], levels[:, second], ess / 2, rng)
    other, other_error = _half(log_density, z[:, second], z[:, first], levels[:, first], ess / 2, rng)
    # Both halves stand for both tasks, so their errors are not independent.
    return (one + other) / 2, float(np.hypot((first_error + other_error) / 2, (one - other) / 2))


def _half(
    log_density: Map, fitted: FloatArray, used: FloatArray, levels: FloatArray, ess: float, rng: np.random.Generator
) -> tuple[float, float]:
    """A bridge between some draws and a Gaussian that is fitted to others, as `bridge`."""
    fitted = fitted.reshape(-1, fitted.shape[2])
    n, c = fitted.shape
    mean = fitted.mean(axis=0)
    # So few draws say little of a covariance: it is drawn towards that of Laplace, which is I here.
    share = n / (n + c)
    root = np.linalg.cholesky(share * np.cov(fitted.T, bias=True).reshape(c, c) + (1 - share) * np.eye(c))

    def log_gaussian(points: FloatArray) -> FloatArray:
        square = (np.linalg.solve(root, (points - mean).T) ** 2).sum(axis=0)
        return np.asarray(-square / 2 - np.linalg.slogdet(root)[1] - c / 2 * np.log(2 * np.pi))

    drawn = mean + rng.standard_normal((levels.size, c)) @ root.T
    of_chains = levels.ravel() - log_gaussian(used.reshape(-1, c))  # ln of the ratios of the densities
    of_gaussian = log_density(drawn) - log_gaussian(drawn)
    top = float(np.median(of_chains))
    p, g = np.exp(np.clip(of_chains - top, -700, 700)), np.exp(np.clip(of_gaussian - top, -700, 700))
    many = ess / (ess + len(g))
    r = 1.0
    for _ in range(BRIDGED):
        above, below = g / (many * g + (1 - many) * r), 1 / (many * p + (1 - many) * r)
        r, before = float(above.mean() / below.mean()), r
        if abs(np.log(r / before)) < 1e-10:
            break
    above, below = g / (many * g + (1 - many) * r), 1 / (many * p + (1 - many) * r)
    error = np.sqrt(above.var() / above.mean() ** 2 / len(g) + below.var() / below.mean() ** 2 / ess)
    return top + float(np.log(r)), float(error)


def _start(potential: _Potential, z: FloatArray) -> FloatArray:
    """Move a start at which the model has no answer closer to the mode."""
    for _ in range(20):
        if np.isfinite(potential.both(z)[0]):
            return z
        z = z / 2
    raise SolveError("the model has no answer where a chain starts")
