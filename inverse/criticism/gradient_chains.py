"""Chains that follow gradients: Hamiltonian dynamics in coordinates in which Laplace's Gaussian is standard normal.

A point of a posterior is moved along a path on which −ln of the density plus a kinetic energy stays the same, as far as
it does not turn back (M. D. Hoffman, A. Gelman, J. Mach. Learn. Res. 15 (2014) 1593–1623; dynamic multinomial version:
M. Betancourt, arXiv:1701.02434; by mici, M. Graham, which needs NumPy only). Each step of a path takes one solve and
one adjoint, whatever the number of unknowns. Paths have at most 64 steps, so that what chains cost is bounded.

The evidence follows from the ratio of the posterior to a Gaussian that is fitted to half of the draws, by bridge
sampling with the other half (X.-L. Meng, W. H. Wong, Stat. Sinica 6 (1996) 831–860), with the error of S.
Frühwirth-Schnatter, Econom. J. 7 (2004) 143–167, and then with the halves exchanged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from forward.model import FloatArray, ForwardModel, SolveError
from forward.phases import phase
from inverse.criticism.chains import SPREAD, Chains, Lengths, in_units
from inverse.low_dimensional.laplace import Laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.optional import imported

# A point x (c,) and what solves there for −ln of the density and its gradient → these.
Kept = Callable[[FloatArray, Callable[[], tuple[float, FloatArray]]], tuple[float, FloatArray]]
DEPTH = 6  # doublings of a path
GRADIENTS = Lengths(2, 300, 100, 1)
STEERED = 0.8  # mean probability of acceptance for which the step is chosen
EACH = 100.0  # effective draws of a chain from which on R̂ and quantiles are meaningful
BUDGET = 60_000  # gradients
BRIDGED = 100  # most iterations of a bridge


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
    """Run chains for few parameters, kept in physical units, with the evidence that follows from them.

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
    log_density: Callable[[FloatArray], FloatArray],
    z: FloatArray,
    levels: FloatArray,
    ess: float,
    rng: np.random.Generator,
) -> tuple[float, float]:
    """Return ln of the integral of a density and its standard error by bridge sampling from chains.

    The density is given by ln of it (n,) at points (n, c), and (chains, draws) at draws (chains, draws, c) that are
    worth `ess` independent ones.
    """
    half = z.shape[1] // 2
    parts = (slice(half), slice(half, 2 * half))
    found = [
        _half(log_density, z[:, fitted].reshape(-1, z.shape[2]), z[:, used], levels[:, used], ess / 2, rng)
        for fitted, used in (parts, parts[::-1])
    ]
    (one, first_error), (other, other_error) = found
    # Both halves stand for both tasks, so their errors are not independent.
    return (one + other) / 2, float(np.hypot((first_error + other_error) / 2, (one - other) / 2))


def _half(
    log_density: Callable[[FloatArray], FloatArray],
    fitted: FloatArray,
    used: FloatArray,
    levels: FloatArray,
    ess: float,
    rng: np.random.Generator,
) -> tuple[float, float]:
    """A bridge between some draws and a Gaussian that is fitted to others, as `bridge`."""
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
