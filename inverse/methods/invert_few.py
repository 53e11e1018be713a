"""Inversion for few parameters: the mode from several starts, Laplace's Gaussian, weighted points that correct it.

The posterior is that of `inverse.low_dimensional.posterior`. With one function a rank group works by itself, with the
other all groups solve at different points of one posterior.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, assert_never

import numpy as np

from forward.model import FloatArray, ForwardModel, Guess, ReferenceSolution, SolveError
from inverse.criticism.answer import Answer, answer, by_gaussian, gaussian_points
from inverse.criticism.chains import Chains, chains_of_few, ensemble
from inverse.criticism.finer import NOT_LOOKED, Finer
from inverse.criticism.gradient_chains import gradient_chains
from inverse.criticism.predictive import examine, spectrum_of
from inverse.criticism.verdict import verdict_on_few
from inverse.criticism.weights import FEWEST, resampled
from inverse.data.errors import NORMAL, NormalErrors, StudentErrors
from inverse.data.shared_motion import Shared
from inverse.fields.low_rank import Spectrum
from inverse.low_dimensional.evidence import LEAST, Evidence, evidence
from inverse.low_dimensional.laplace import Laplace, laplace
from inverse.low_dimensional.posterior import Density, Posterior
from inverse.methods.invert import Invert
from inverse.methods.mesh_correction import before_few, corrected_few
from inverse.methods.record import (
    ENDS,
    SOURCES,
    TRUST,
    Data,
    Record,
    as_dataset,
    of_chains,
    of_data,
    of_mesh,
    of_motions,
    of_prior,
    of_test,
)
from uq.evaluation.evaluate import Recorder, SerialEvaluate
from uq.evaluation.request import Evaluate, Request, Start
from uq.inputs.random_parameters import Inputs
from uq.surrogates.linearisation import linearise

if TYPE_CHECKING:
    import xarray as xr

Look = Callable[[FloatArray], FloatArray]  # parameters (n, d) → ln of the stiffness factor (n, N) at the vertices


@dataclass(frozen=True, eq=False)
class Nearby:
    """A linear prediction of the state from a solution of this rank group; a `Start`.

    Attributes
    ----------
    point
        Its parameters (d,).
    state, slopes
        State (U_local,) there, and its derivatives (d, U_local).
    spread
        Standard deviations (d,) of the prior.
    joined
        Whether the state is joined to rest.
    """

    point: FloatArray
    state: FloatArray
    slopes: FloatArray
    spread: FloatArray
    joined: bool

    @classmethod
    def at(cls, model: ForwardModel, point: FloatArray, spread: FloatArray) -> Nearby:
        """Solve at parameters (d,); collective."""
        solution = model.solve(point)
        slopes = solution.state_tangent(np.eye(len(point)))
        return cls(point, np.array(solution.state), slopes, spread, solution.work.snaps == 0)

    def on(self, model: ForwardModel) -> Callable[[FloatArray], Guess]:
        """Return the function parameters (d,) → predicted state (U_local,) with its reference."""
        reference = ReferenceSolution(self.point, self.state, self.spread, self.joined)
        return lambda point: Guess(self.state + (point - self.point) @ self.slopes, reference)


@dataclass(frozen=True, eq=False)
class Inverted:
    """What was found of a data set: results, the posterior as it was corrected, and its weighted points."""

    dataset: xr.Dataset
    posterior: Posterior
    evidence: Evidence


def invert_by_group(
    inputs: Inputs,
    model: ForwardModel,
    data: Data,
    method: Invert,
    look: Look | None,
    errors: NormalErrors | StudentErrors = NORMAL,
    finer: Finer | None = NOT_LOOKED,
    evaluate: Evaluate | None = None,
    say: Callable[[str], None] = lambda line: None,
    shared: Shared | None = None,
) -> xr.Dataset:
    """Invert a data set on the model of one rank group, or by an evaluation of it; collective over the group.

    Parameters
    ----------
    inputs, model, data, method, errors
        The unknowns, the model, the data, the method, and the distribution of the errors.
    look
        The stiffness of the interior as a function of the parameters; None if there is none.
    finer
        The model on finer meshes; None where it has no mesh.
    evaluate
        Of the model.
    say
        Shows the user a line before the search.
    shared
        What errors the data share; None if they are independent.

    Raises
    ------
    SolveError
        If the model has no answer where the search needs one.
    """
    solve = evaluate or SerialEvaluate(model)
    near = partial(Nearby.at, model, spread=inputs.std)
    return inverted(inputs, solve, data, method, look, errors, finer, near, say, shared, model).dataset


def invert_by_all(
    inputs: Inputs,
    evaluate: Evaluate,
    data: Data,
    method: Invert,
    look: Look | None,
    errors: NormalErrors | StudentErrors = NORMAL,
    finer: Finer | None = NOT_LOOKED,
    say: Callable[[str], None] = lambda line: None,
    shared: Shared | None = None,
    model: ForwardModel | None = None,
) -> xr.Dataset:
    """Invert a data set with all rank groups, each of which solves at other points; raises as `invert_by_group`."""
    return inverted(
        inputs,
        evaluate,
        data,
        method,
        look,
        errors,
        finer,
        lambda point: linearise(inputs, evaluate, point).prediction,
        say,
        shared,
        model,
    ).dataset


def inverted(
    inputs: Inputs,
    evaluate: Evaluate,
    data: Data,
    method: Invert,
    look: Look | None,
    errors: NormalErrors | StudentErrors,
    finer: Finer | None,
    start: Callable[[FloatArray], Start | None],
    say: Callable[[str], None],
    shared: Shared | None,
    model: ForwardModel | None = None,
) -> Inverted:
    """Invert a data set, as `invert_by_group`; `start` predicts states from a solution at parameters (d,)."""
    counted = Recorder(evaluate)
    posterior = Posterior(inputs, counted, data.values, data.sigma, method.noise, data.which, errors=errors)
    if shared is not None:
        posterior = replace(posterior, shared=shared(inputs.mean))
    d = len(inputs.names)
    with suppress(SolveError):  # or else every solve begins at zero
        posterior = replace(posterior, start=start(inputs.mean))
    before = before_few(posterior, finer, say) if finer is not None and method.treatment is not None else None
    searched = laplace(posterior, starts=method.starts, seed=method.seed)
    gaussian, mesh = searched, None
    if shared is not None:  # which depends on the displacements
        posterior = replace(posterior, shared=shared(posterior.physical(gaussian.mode[None])[0, :d]))
        gaussian = laplace(posterior, starts=1, first=gaussian.mode)
    posterior = replace(posterior, start=start(posterior.physical(gaussian.mode[None])[0, :d]))
    if finer is not None:
        treatment = method.treatment or "report"
        posterior, gaussian, mesh = corrected_few(posterior, gaussian, finer, data.spread, treatment)
    best = posterior.physical(gaussian.mode[None])[0]
    found = evidence(posterior, gaussian, method.solves(len(best), field=False) or LEAST, seed=method.seed)
    at = posterior.at(gaussian.mode[None], derivatives=True)
    spectrum = spectrum_of(posterior, at)
    scale = posterior.scale(at.x)[0]
    raw = posterior.residuals(at.outputs, at.x)[0]
    residual, root = errors.normal_scores(raw), np.sqrt(errors.information(raw))
    test = examine(residual, spectrum, np.ones_like(residual), data.neighbours())
    chains = _chains(posterior, gaussian, found, method, model)
    verdict = verdict_on_few(gaussian, found, test, chains)
    known = answer(posterior, gaussian, found, chains)
    log_evidence, error = found.log_evidence, found.error
    if known.source == "chains" and chains is not None and chains.evidence is not None and not found.trusted:
        log_evidence, error = chains.evidence
    drawn = _drawn(posterior, gaussian, found, known, chains, at, method)
    moments = _moments(posterior, gaussian, known, drawn, look)
    record: Record = {
        **of_data(data, at.outputs[0], residual, scale / root, spectrum),
        **of_test(test),
        **of_prior(gaussian.mode[:d], spectrum),
        **({} if mesh is None else of_mesh(mesh, before, len(best) - d)),
        **of_motions(spectrum, posterior.whitening, posterior.shared, root),
        **moments,
        **_alone(posterior, gaussian, spectrum, data),
        **_draws(posterior, drawn.draws, drawn.outputs),
        "point": drawn.points,
        "point_weight": drawn.weights,
        "source": np.array(SOURCES.index(known.source)),
        **of_chains(chains, used=known.source == "chains"),
        "mode": best,
        "log_evidence": np.array(log_evidence),
        "log_evidence_error": np.array(error),
        "laplace_log_evidence": np.array(gaussian.log_evidence),
        "effective": np.array(found.ess),
        "tail": np.array(found.pareto_k),
        "converged": np.array(gaussian.converged),
        "trust": np.array(TRUST.index(verdict.trust)),
        "why": str(verdict),
        "solves": np.array(counted.solves + (0 if chains is None else chains.apart)),
        "zero_likelihood": np.array(sum(one.inadmissible for part in counted.log for one in part.failures)),
        "step": np.array([[s.start, s.log_posterior, s.decrement, s.damping] for s in searched.steps]).reshape(-1, 4),
        "start_mode": posterior.physical(searched.modes),
        "start_log_posterior": searched.ends,
        "direction_parameter": np.pad(spectrum.vectors, ((0, 0), (0, len(posterior.names) - d))),
    }
    return Inverted(as_dataset(record), posterior, found)


def _chains(
    posterior: Posterior, gaussian: Laplace, found: Evidence, method: Invert, model: ForwardModel | None
) -> Chains | None:
    match method.chains:
        case None:
            return None
        case "hmc":
            if model is None:
                message = "chains = 'hmc' follow the gradients of a model itself, which is not given"
                raise ValueError(message)
            return gradient_chains(posterior, gaussian, model, seed=method.seed)
        case "emcee":
            return ensemble(posterior, gaussian, seed=method.seed)
        case "pcn":
            # Fewer points say little about a covariance.
            enough = found.ess >= max(FEWEST, 4 * len(gaussian.mode))
            return chains_of_few(posterior, found if enough else gaussian, seed=method.seed)
        case _:
            assert_never(method.chains)


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Draws (n, c) of a posterior with their outputs (n, m), and points (N, c) with weights (N,) that stand for it."""

    draws: FloatArray
    outputs: FloatArray
    points: FloatArray
    weights: FloatArray
    spread: FloatArray  # points that the stiffness is looked at, with weights
    shares: FloatArray


def _drawn(
    posterior: Posterior,
    gaussian: Laplace,
    found: Evidence,
    known: Answer,
    chains: Chains | None,
    at: Density,
    method: Invert,
) -> _Drawn:
    """Draw from what is printed; solves at draws of chains, whose outputs were not kept."""
    if known.source == "points":
        weights, points = found.weights, posterior.physical(found.density.x)
        chosen, used = resampled(weights, method.draws, method.seed), weights > 0
        return _Drawn(points[chosen], found.density.outputs[chosen], points, weights, points[used], weights[used])
    d = len(posterior.inputs.names)
    if known.source == "chains":
        assert chains is not None
        draws = _thinned(chains, method.draws)
        which = slice(None) if posterior.which is None else list(posterior.which)
        outputs = posterior.evaluate(Request(draws[:, :d], start=posterior.start)).outputs[:, which]
        if posterior.mesh is not None:
            outputs = outputs + posterior.mesh.at(draws[:, :d])
        return _Drawn(draws, outputs, draws, _even(draws), chains.flat, _even(chains.flat))
    x = gaussian_points(gaussian, max(method.draws, len(found.log_weights)))
    points, moved = posterior.physical(x), (x - gaussian.mode)[: method.draws, :d]
    # By the model linearised at the mode: exact where the posterior is Gaussian.
    outputs = at.outputs + moved @ posterior.output_slopes(at)[0].T
    return _Drawn(points[: method.draws], outputs, points, _even(points), points, _even(points))


def _even(points: FloatArray) -> FloatArray:
    return np.full(len(points), 1 / len(points))


def _moments(posterior: Posterior, gaussian: Laplace, known: Answer, drawn: _Drawn, look: Look | None) -> Record:
    """Moments and quantiles of the parameters, of the stiffness by weighted points; widths of the Gaussian."""
    ends = known.quantiles(ENDS)
    record: Record = {
        "mean": known.mean,
        "std": known.std,
        "lower": ends[:, 0],
        "upper": ends[:, 1],
        "covariance": known.covariance,
        "laplace_std": known.std if known.source == "laplace" else by_gaussian(posterior, gaussian).std,
    }
    if look is None:
        return record
    d = len(posterior.inputs.names)
    stiffness = look(drawn.spread[:, :d])
    average = drawn.shares @ stiffness
    return record | {
        "stiffness_mode": look(posterior.physical(gaussian.mode[None])[:, :d])[0],
        "stiffness_mean": average,
        "stiffness_std": np.sqrt(np.maximum(drawn.shares @ (stiffness - average) ** 2, 0)),
    }


def _thinned(chains: Chains, count: int) -> FloatArray:
    """At most `count` draws (n, k), chain after chain, equally many from each."""
    each = max(count // len(chains.draws), 1)
    steps = np.linspace(0, chains.draws.shape[1] - 1, each).round().astype(int)
    return chains.draws[:, steps].reshape(-1, chains.draws.shape[2])[:count]


def _alone(posterior: Posterior, gaussian: Laplace, spectrum: Spectrum, data: Data) -> Record:
    """Standard deviations (c,) by the model linearised at the mode, from all load cases and from each alone."""
    d, c = len(posterior.inputs.names), len(posterior.names)
    slopes = posterior.inputs.from_normals(gaussian.mode[None, :d])[1][0]
    A = spectrum.images.T @ spectrum.vectors

    def widths(rows: FloatArray) -> FloatArray:
        covariance = slopes @ np.linalg.inv(np.eye(d) + rows.T @ rows) @ slopes.T
        return np.concatenate([np.sqrt(np.diag(covariance)), np.full(c - d, np.nan)])

    cases = range(int(data.cases.max()) + 1)
    return {"together_std": widths(A), "alone_std": np.array([widths(A[data.cases == k]) for k in cases])}


def _draws(posterior: Posterior, draws: FloatArray, outputs: FloatArray) -> Record:
    """Draws of equal weight with what the data say of each."""
    s = np.ones(len(draws)) if posterior.noise is None else draws[:, -1]
    scale = s[:, None] * posterior.whitening.sigma
    gaps = posterior.whitening((outputs - posterior.data) / scale)
    return {"draw": draws, "draw_log_likelihood": -posterior.errors.minus_log(gaps) - np.log(scale)}
