"""Markov chains and weighted samples that check a Gaussian where it may fail, and the verdict on it.

A chain whose proposals are reversible with respect to Laplace's Gaussian N(x̂, LLᵀ), x = x̂ + Lz with

    z' = √(1−β²) z + βw,   w ~ N(0, I),   accepted with the chance min(1, exp(ℓ(x') + ½|z'|² − ℓ(x) − ½|z|²)),

accepts everything where the posterior exp ℓ is that Gaussian, whatever the dimension (preconditioned Crank–Nicolson:
S. L. Cotter, G. O. Roberts, A. M. Stuart, D. White, Stat. Sci. 28 (2013) 424–446; with a Gaussian of the posterior: D.
Rudolf, B. Sprungk, Found. Comput. Math. 18 (2018) 309–343). For fields L = (I + UΛUᵀ)^{−1/2} of the low-rank pairs, in
the whitened coordinates of the prior. For few parameters there is also the affine-invariant ensemble, which uses no
Gaussian (J. Goodman, J. Weare, Comm. Appl. Math. Comp. Sci. 5 (2010) 65–80; emcee: D. Foreman-Mackey et al., Publ.
Astron. Soc. Pac. 125 (2013) 306–312). R̂ and effective sample sizes are ArviZ's (A. Vehtari et al., Bayesian Anal. 16
(2021) 667–718).

For fields the Gaussian alone misses second-order effects of the many directions that the data hardly see: together
they change well-determined quantities by more than the noise (a field that varies is softer in the mean than a constant
one). So the L above is bent: with the part w of Lz in the directions U of λ ≤ 30, and the residual r of a solve at ξ̂+w,

    x = ξ̂ + w + U_s (a(w) + (I+Λ_s)^{−1/2} z_s),   a(w) = −(I+Λ_s)⁻¹ (A_sᵀ r + ξ̂_s),

the strong directions s follow by a step of Gauss–Newton. As a depends on w alone, the determinant of this map is that
of L, and all formulas stay as they are; for linear models a = 0. Samples x of independent z have the weights w ∝
exp(ℓ(x) + ½|z|²), and the mean of these is the evidence.

Chains and weighted samples share proposals, diagnostics and the verdict, hence one file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from forward.model import FloatArray, Guess, ReferenceSolution, SolveError
from inverse.criticism.predictive import ResidualTest
from inverse.criticism.weights import effective_sample_size, enough, normalised, pareto_shape, trustworthy, worth
from inverse.fields.field_posterior import Point
from inverse.fields.low_rank import LowRankPosterior
from inverse.fields.newton_cg import Mode
from inverse.low_dimensional.evidence import Evidence
from inverse.low_dimensional.laplace import Laplace
from inverse.low_dimensional.posterior import Posterior

if TYPE_CHECKING:
    import xarray as xr

ACCEPTED = 0.3  # acceptance rate for which β is tuned during the burn-in
FIRST_STEP = 0.5  # β at its start
STRONG = 30.0  # λ of the directions of a field that follow the others
DRAWS = 6  # of the Gaussian of a field, for the screen of stability
SPREAD = 1.3  # of the starts of chains, in standard deviations of the Gaussian
WIDER = 1.2  # standard deviations of the Gaussian of weighted points, over those of the points
MIXED = 1.01  # R̂ up to which chains agree
INDEPENDENT = 400.0  # effective sample size from which R̂ and quantiles are meaningful

Place = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
Map = Callable[[FloatArray], FloatArray]


# --- chains ----------------------------------------------------------------------------------------------------------


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
    names
        Of the quantities (k,).
    draws
        (chains, draws, k).
    log_density
        ℓ (chains, draws).
    accepted
        Share (chains,) of proposals that were accepted.
    step
        β; NaN for an ensemble.
    solves
        How often ℓ was evaluated.
    """

    names: tuple[str, ...]
    draws: FloatArray
    log_density: FloatArray
    accepted: FloatArray
    step: float
    solves: int

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
        return bool(self.rhat.max() <= MIXED and self.ess >= INDEPENDENT)

    @property
    def ess(self) -> float:
        """Smallest effective sample size over all quantities, for bulk and tails."""
        return float(min(self.ess_bulk.min(), self.ess_tail.min()))

    @property
    def flat(self) -> FloatArray:
        """All draws (n, k), chain after chain."""
        return self.draws.reshape(-1, self.draws.shape[2])

    def arviz_groups(self) -> dict[str, xr.Dataset]:
        """Return ArviZ's groups: `arviz.InferenceData(**chains.arviz_groups())`."""
        import xarray as xr

        posterior = {name: (("chain", "draw"), self.draws[:, :, i]) for i, name in enumerate(self.names)}
        stats = {"lp": (("chain", "draw"), self.log_density), "acceptance_rate": ("chain", self.accepted)}
        at = {"chain": np.arange(self.draws.shape[0]), "draw": np.arange(self.draws.shape[1])}
        return {"posterior": xr.Dataset(posterior, at), "sample_stats": xr.Dataset(stats, at)}


def _arviz() -> Any:
    try:
        import arviz
    except ImportError:
        message = "R̂ and effective sizes of chains need arviz, which is not installed: pip install arviz"
        raise ImportError(message) from None
    return arviz


def crank_nicolson(
    place: Place,
    size: int,
    *,
    keep: Map = lambda x: x,
    names: tuple[str, ...] | None = None,
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
    names
        Of these; by default their numbers.
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
    kept, levels = [], []
    accepted = np.zeros(lengths.chains)
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
            levels.append(here)
    values = np.swapaxes(np.array(kept), 0, 1)
    labels = tuple(map(str, range(values.shape[2]))) if names is None else names
    share = accepted / (lengths.draws * thin)
    return Chains(labels, values, np.array(levels).T, share, beta, lengths.evaluations)


def chains_of_few(
    posterior: Posterior,
    around: Laplace | Evidence,
    *,
    lengths: Lengths = FEW,
    seed: int = 0,
) -> Chains:
    """Run chains for few parameters, kept in physical units.

    Parameters
    ----------
    posterior
        What is sampled.
    around
        Laplace's Gaussian, or weighted points, whose mean and (slightly widened) covariance are used: if the posterior
        is curved, Laplace's is too narrow, and chains get stuck in its tails.
    lengths, seed
        As in `crank_nicolson`.
    """
    if isinstance(around, Laplace):
        centre, root = around.mode, around.root
    else:
        w, x = around.weights, around.density.x
        centre = w @ x
        root = WIDER * np.linalg.cholesky((x - centre).T @ ((x - centre) * w[:, None]))

    def place(z: FloatArray) -> tuple[FloatArray, FloatArray]:
        x = centre + z @ root.T
        return x, posterior.at(x).log_posterior

    return crank_nicolson(
        place,
        len(centre),
        keep=posterior.physical,
        names=posterior.names,
        lengths=lengths,
        seed=seed,
    )


def chains_of_field(
    mode: Point,
    found: LowRankPosterior,
    *,
    keep: Map | None = None,
    names: tuple[str, ...] | None = None,
    lengths: Lengths = FIELD,
    seed: int = 0,
) -> Chains:
    """Run chains for a field; kept are its values (N,), or quantities (n, k) of values (n, N)."""
    values = mode.posterior.values
    return crank_nicolson(
        bent(mode, found),
        len(mode.whitened),
        keep=values if keep is None else lambda x: keep(values(x)),
        names=names,
        lengths=lengths,
        seed=seed,
    )


def ensemble(posterior: Posterior, gaussian: Laplace, lengths: Lengths | None = None, *, seed: int = 0) -> Chains:
    """Run emcee's ensemble for few parameters, kept in physical units; its walkers are the chains.

    Parameters
    ----------
    posterior, gaussian
        What is sampled, and where the walkers start.
    lengths
        By default those of `walkers`.
    seed
        Of all draws.

    Raises
    ------
    ImportError
        If emcee is not installed.
    """
    try:
        import emcee
    except ImportError:
        message = "an ensemble needs emcee, which is not installed: pip install emcee"
        raise ImportError(message) from None
    c = len(gaussian.mode)
    long = walkers(c) if lengths is None else lengths
    count = long.chains
    sampler = emcee.EnsembleSampler(count, c, lambda x: posterior.at(x).log_posterior, vectorize=True)
    z = np.random.default_rng(seed).standard_normal((count, c))
    generator = np.random.RandomState(seed)
    state = emcee.State(gaussian.mode + z @ gaussian.root.T, random_state=generator.get_state())
    state = sampler.run_mcmc(state, long.burn, store=False)
    sampler.run_mcmc(state, long.draws, thin_by=long.thin)
    x = np.swapaxes(sampler.get_chain(), 0, 1)
    values = posterior.physical(x.reshape(-1, c)).reshape(count, long.draws, c)
    accepted = np.asarray(sampler.acceptance_fraction)
    return Chains(posterior.names, values, sampler.get_log_prob().T, accepted, np.nan, long.evaluations)


def bent(mode: Point, found: LowRankPosterior) -> Place:
    """Return the map of z (n, N) to ξ (n, N) and −cost (n,) there: two solves for each, by the factor of the mode."""
    pairs = found.spectrum
    slopes = mode.solution.state_tangent(found.directions)
    state = np.array(mode.solution.state)
    # The screen of stability must know where the samples go.
    draws = pairs.root(np.random.default_rng(0).standard_normal((DRAWS, len(mode.whitened))))
    reference = ReferenceSolution(mode.values, state, mode.posterior.prior.root(draws))
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


# --- weighted samples of a field -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class FieldWeights:
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
    def weights(self) -> FloatArray:
        """Weights (n,) of sum 1."""
        return normalised(self.log_weights)

    @property
    def mean(self) -> FloatArray:
        """Means (N,) of the values."""
        return np.asarray(self.weights @ self.values)

    @property
    def std(self) -> FloatArray:
        """Standard deviations (N,)."""
        return np.asarray(np.sqrt(self.weights @ (self.values - self.mean) ** 2))

    @property
    def ess(self) -> float:
        """Effective sample size."""
        return effective_sample_size(self.weights)

    @property
    def share(self) -> float:
        """Effective sample size over the number of samples."""
        return self.ess / len(self.log_weights)

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


def weigh_field(mode: Point, found: LowRankPosterior, samples: int = 64, *, seed: int = 0) -> FieldWeights:
    """Draw samples of the low-rank Gaussian, bent, and weigh them by the posterior: two solves for each.

    Raises
    ------
    SolveError
        If the model has no answer at any of them.
    """
    z = np.random.default_rng(seed).standard_normal((samples, len(mode.whitened)))
    whitened, log_density = bent(mode, found)(z)
    weights = mode.posterior.weights[mode.posterior.weights > 0]
    constant = float(np.log(weights).sum()) - len(weights) / 2 * float(np.log(2 * np.pi)) + found.log_determinant / 2
    constant -= mode.posterior.whitening.log_determinant
    log_weights = log_density + (z**2).sum(axis=1) / 2 + constant
    if not np.isfinite(log_weights.max()):
        raise SolveError("the model has no answer at any of the samples of the Gaussian")
    return FieldWeights(mode.posterior.values(whitened), log_weights)


# --- what they say ---------------------------------------------------------------------------------------------------

SHIFT = 0.25  # distance of the mean from the mode, in standard deviations, tolerated for Laplace's Gaussian
WIDTH = 0.2  # relative difference of standard deviations tolerated


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
    objection = _objection(gaussian.converged, test)
    if objection is not None:
        return objection
    if found.route == "closed form":
        return Verdict("laplace", found.why)
    said = worth(found.pareto_k, found.ess, len(found.log_weights))
    if not found.trusted:
        return _by_chains(said, chains, enough(found.ess, len(found.log_weights)))
    w, x = found.weights, found.density.x
    mean, width = w @ x, np.sqrt(np.diag(gaussian.covariance))
    shift = float(np.abs((mean - gaussian.mode) / width).max())
    ratio = np.log(np.sqrt(w @ (x - mean) ** 2) / width)
    chance = 2 / np.sqrt(found.ess)
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

    Parameters
    ----------
    mode, gaussian
        What is judged.
    found
        Weighted samples.
    test
        Of the residuals.
    chains
        Judged chains, and `values` (n, N), the values of the field that they drew.
    """
    objection = _objection(mode.converged, test)
    if objection is not None:
        return objection
    if found is None and chains is None:
        why = (
            f"the residuals agree with it (probability {test.probability:.2g}); what it says of the directions with "
            "the largest λ was not checked by other solves (method.samples does)"
        )
        return Verdict("laplace", why)
    if found is None:
        assert chains is not None
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


def _objection(converged: bool, test: ResidualTest) -> Verdict | None:
    if not converged:
        return Verdict("neither", "the search for the mode did not converge")
    if test.probability < 0.01:
        why = f"the model does not explain the data: |r|² = {test.square:.4g} where {test.degrees:.4g} is expected"
        return Verdict("neither", f"{why} (probability {test.probability:.1g})")
    if test.agreement_probability < 0.01:
        why = f"residuals of neighbours agree too much (probability {test.agreement_probability:.1g})"
        return Verdict("neither", f"{why}: the model, or the independence of the noise, is wrong")
    return None


def _by_chains(worth: str, chains: Chains | None, samples: int) -> Verdict:
    if chains is None:
        return Verdict("neither", f"{worth}; take method.samples = {samples}, or run chains (method.chains)")
    said = _said(chains)
    if chains.mixed:
        return Verdict("corrected", f"{worth}, but chains agree: {said}")
    return Verdict("neither", f"{worth}, and chains have not mixed: {said}")


def _said(chains: Chains) -> str:
    return f"R̂ up to {chains.rhat.max():.3f}, effective draws from {chains.ess:.0f}"
