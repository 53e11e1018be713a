"""Inversion for few parameters: the mode from several starts, Laplace's Gaussian, weighted points that correct it.

The posterior is that of `inverse.low_dimensional.posterior`. A rank group works by itself, with states that it has at
hand (`Nearby`), or all groups solve at different points of one posterior.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from forward.model import FloatArray, ForwardModel, Guess, ReferenceSolution
from inverse.criticism.assessment import (
    Answer,
    Assessment,
    Points,
    answer,
    by_gaussian,
    even,
    of_chains,
    of_gaussian,
    weighted,
    with_nans,
)
from inverse.criticism.assumptions import Moves
from inverse.criticism.questions import Questions, asked
from inverse.criticism.verdict import examine, spectrum_of, verdict_on_few
from inverse.criticism.weights import resampled
from inverse.data.measurements import Measurements
from inverse.fields.low_rank import Spectrum
from inverse.low_dimensional.evidence import Evidence
from inverse.low_dimensional.laplace import Laplace
from inverse.low_dimensional.posterior import Density, Posterior
from inverse.methods.infer import Inferred, Problem, infer
from inverse.methods.invert import Invert
from inverse.methods.record import (
    ENDS,
    SOURCES,
    Record,
    as_dataset,
    diagnosed,
    noise_of,
    of_data,
    of_learnt,
    of_mesh,
    of_motions,
    of_prior,
    of_process,
    of_some,
    of_verdict,
)
from uq.evaluation.evaluate import Recorder, Steps
from uq.evaluation.request import Evaluate
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
    reference
        That solution, with this rank's part of the state.
    slopes
        Derivatives (d, U_local) of the state there.
    """

    reference: ReferenceSolution
    slopes: FloatArray

    @classmethod
    def at(cls, model: ForwardModel, point: FloatArray, spread: FloatArray) -> Nearby:
        """Solve at parameters (d,); collective."""
        solution = model.solve(point)
        slopes = solution.state_tangent(np.eye(len(point)))
        return cls(ReferenceSolution(point, np.array(solution.state), spread, solution.work.snaps == 0), slopes)

    def on(self, model: ForwardModel) -> Callable[[FloatArray], Guess]:
        """Return the function parameters (d,) → predicted state (U_local,) with its reference."""
        here = self.reference
        return lambda point: Guess(here.state + (point - here.parameters) @ self.slopes, here)


@dataclass(frozen=True, eq=False)
class Inverted:
    """What was found of a data set: results, the posterior as it was corrected, and its weighted points."""

    dataset: xr.Dataset
    posterior: Posterior
    evidence: Evidence


def invert_few(inputs: Inputs, evaluate: Evaluate, problem: Problem[Invert], look: Look | None = None) -> Inverted:
    """Invert a data set for few parameters.

    The stiffness of the interior is looked at as a function of the parameters, if there is one. Raises `SolveError` if
    the model has no answer where the search needs one.
    """
    data, method = problem.data, problem.method
    counted = Recorder(evaluate)
    of_data_set = Posterior(inputs, counted, data.values, noise_of(problem), data.which)
    steps, d = replace(problem.steps, recorder=counted), len(inputs.names)
    start = problem.start or (lambda point: linearise(inputs, evaluate, point).prediction)
    inferred = infer(of_data_set, replace(problem, start=start, steps=steps))
    posterior, one, mesh, first = inferred.posterior, inferred.assessment, inferred.mesh, inferred.first
    gaussian, found, chains, at = one.gaussian, one.evidence, one.chains, inferred.found.at
    kept = inferred.asked
    own = kept[:d]
    spectrum = spectrum_of(posterior, at)
    scale = posterior.scale(at.x)[0]
    raw = posterior.residuals(at.outputs, at.x)[0]
    residual, root = posterior.noise.normal_scores(raw), np.sqrt(posterior.noise.information(raw))
    test = examine(residual, spectrum, data.neighbours())
    verdict = verdict_on_few(gaussian, found, test, chains)
    known = answer(posterior, one)
    log_evidence, error = one.log_evidence
    more, ends = 0.0 if inferred.process is None else inferred.process.log_evidence, known.quantiles(ENDS)
    points, *drawn = _drawn(posterior, one, at, method)
    asking, std = (first.posterior, first.gaussian, first.at), known.std[own]
    of_all: Record = {
        "mean": known.mean,
        "std": known.std,
        "lower": ends[:, 0],
        "upper": ends[:, 1],
        "covariance": known.covariance,
        "outermost": known.outermost,
        "laplace_std": known.std if known.source == "laplace" else by_gaussian(posterior, gaussian).std,
        **_alone(posterior, gaussian, spectrum, data),
        **_draws(posterior, *drawn),
        "point": points.values,
        "mode": posterior.physical(gaussian.mode[None])[0],
        "direction_parameter": np.pad(spectrum.vectors, ((0, 0), (0, len(kept) - d))),
    }
    record: Record = {
        **of_data(data, at.outputs[0], residual, scale / root, spectrum),
        **of_verdict(verdict, test),
        **of_prior(gaussian.mode[: len(posterior.inputs.names)], spectrum),
        **({} if mesh is None else of_mesh(mesh, inferred.before, len(kept))),
        **({} if problem.truth is None else of_learnt(posterior.noise, problem.truth)),
        **of_motions(spectrum, posterior.noise, root),
        **({} if inferred.process is None else of_process(inferred.process)),
        **of_some(of_all, kept),
        **({} if look is None else _stiffness(posterior, one, known, points, lambda values: look(values[:, own]))),
        **({} if inferred.moves is None else _of_assumed(inferred.moves, std, len(kept))),
        **({} if problem.questions is None else _asked(*asking, problem.questions, len(kept), method.seed, steps)),
        **_of_uncertain(posterior, points, gaussian.mode, problem, inferred),
        "point_weight": points.weights,
        "source": np.array(SOURCES.index(known.source)),
        "cut": np.array(found.cut if known.source == "points" else 0.0),
        **diagnosed(chains, used=known.source == "chains"),
        "log_evidence": np.array(log_evidence + more),
        "log_evidence_error": np.array(error),
        "laplace_log_evidence": np.array(gaussian.log_evidence + more),
        "effective": np.array(found.ess),
        "tail": np.array(found.pareto_k),
        "converged": np.array(gaussian.converged),
        "solves": np.array(counted.solves + inferred.solves + (0 if chains is None else chains.apart)),
        "zero_likelihood": np.array(sum(one.inadmissible for part in counted.log for one in part.failures)),
        "step": np.array(inferred.searched.steps).reshape(-1, 4),
        "start_mode": of_data_set.physical(inferred.searched.modes),
        "start_log_posterior": inferred.searched.ends,
    }
    return Inverted(as_dataset(record), posterior, found)


def _drawn(posterior: Posterior, one: Assessment, at: Density, method: Invert) -> tuple[Points, FloatArray, FloatArray]:
    """Return points that stand for what is printed, and draws (n, c) of it with their outputs (n, m).

    Draws of chains are solved, since their outputs were not kept.
    """
    match one.source:
        case "points":
            found = weighted(posterior, one.evidence)
            chosen = resampled(found.weights, method.draws, method.seed)
            return found, found.values[chosen], found.outputs[chosen]
        case "chains":
            assert one.chains is not None
            found = of_chains(posterior, one.chains, method.draws)
        case "laplace":
            found = of_gaussian(posterior, one.gaussian, at, max(method.draws, len(one.evidence.log_weights)))
    return found, found.values[: method.draws], found.outputs[: method.draws]


def _stiffness(posterior: Posterior, one: Assessment, known: Answer, points: Points, look: Look) -> Record:
    """Moments of the stiffness by weighted points or chains, and at the mode."""
    values, weights = points.values[points.weights > 0], points.weights[points.weights > 0]
    if known.source == "chains" and one.chains is not None:
        values, weights = one.chains.flat, even(len(one.chains.flat))
    stiffness = look(values)
    average = weights @ stiffness
    return {
        "stiffness_mode": look(posterior.physical(one.gaussian.mode[None]))[0],
        "stiffness_mean": average,
        "stiffness_std": np.sqrt(np.maximum(weights @ (stiffness - average) ** 2, 0)),
    }


def _alone(posterior: Posterior, gaussian: Laplace, spectrum: Spectrum, data: Measurements) -> Record:
    """Standard deviations (c,) by the model linearised at the mode, from all load cases and from each alone."""
    d, c = len(posterior.inputs.names), len(posterior.names)
    slopes = posterior.inputs.from_normals(gaussian.mode[None, :d])[1][0]
    A = spectrum.images.T @ spectrum.vectors

    def widths(rows: FloatArray) -> FloatArray:
        covariance = slopes @ np.linalg.inv(np.eye(d) + rows.T @ rows) @ slopes.T
        return np.concatenate([np.sqrt(np.diag(covariance)), np.full(c - d, np.nan)])

    cases = range(int(data.cases.max()) + 1)
    return {"together_std": widths(A), "alone_std": np.array([widths(A[data.cases == k]) for k in cases])}


def _of_assumed(moves: Moves, std: FloatArray, count: int) -> Record:
    """How far (…, c) what is taken for granted moves the parameters, in their deviations; of the noise NaN."""
    shift, bend = (with_nans(of / std, count) for of in (moves.parameters, moves.bends))
    return {"assumption_shift": shift, "assumption_bend": bend}


def _asked(
    posterior: Posterior, gaussian: Laplace, at: Density, questions: Questions, count: int, seed: int, steps: Steps
) -> Record:
    """Answers to questions to the shape; how far (q, c) they move the parameters is NaN of the noise."""
    found = asked(posterior, gaussian, at, questions, seed, steps)
    return {
        "question_forms": "; ".join(str(one.form) for one in found),
        "question_probability": np.array([one.probability for one in found]),
        "question_log_evidence": np.array([one.log_evidence for one in found]),
        "question_move": with_nans([one.move for one in found], count),
        "question_left": with_nans([one.left for one in found], count),
    }


def _draws(posterior: Posterior, draws: FloatArray, outputs: FloatArray) -> Record:
    """Draws of equal weight with what the data say of each."""
    noise = posterior.noise
    scale = (np.ones(len(draws)) if noise.factor is None else draws[:, -1])[:, None] * noise.scale
    gaps = noise.whitened((outputs - posterior.data) / scale)
    return {"draw": draws, "draw_log_likelihood": -noise.minus_log(gaps) - np.log(scale)}


def _of_uncertain(
    posterior: Posterior, points: Points, mode: FloatArray, problem: Problem[Invert], inferred: Inferred
) -> Record:
    """Moments of what is uncertain beside the parameters, in its deviations, at each point and over all.

    And of what no parameters explain of displacements that are predicted.

    With the most probable size of the errors, for which it was made; what was sampled is known at each point.
    """
    pull, seen, names = posterior.noise.pull, points.weights[:, None] > 0, inferred.sampled
    count = len(pull) + len(names)
    process = None if problem.elsewhere is None else inferred.process
    residuals = posterior.residuals(np.where(seen, points.outputs, posterior.data), mode[None])
    found: Record = {}
    if process is not None:
        means, covariance, beside = process.given(posterior.noise, residuals)
        found = {"unexplained_point": means, "unexplained_covariance": covariance}
    if not count:
        return found
    groups = [] if problem.assumed is None else list(problem.assumed.groups)
    new = [posterior.names.index(name) for name in names]
    sampled = np.array([groups.index(name) for name in names], dtype=int)
    others = np.delete(np.arange(count), sampled)
    there, covariance = np.zeros((len(points.values), count)), np.zeros((count, count))
    there[:, others] = -residuals @ pull.T
    there[:, sampled] = np.where(seen, points.values[:, new], 0.0)
    covariance[np.ix_(others, others)] = np.eye(len(pull)) - pull @ pull.T
    mean = points.weights @ there
    squares = np.diag(covariance) + points.weights @ (there - mean) ** 2
    if found:
        both = np.zeros((len(beside), count))
        both[:, others] = beside
        found["unexplained_uncertain"] = both
    return {
        **found,
        "uncertain_point": there,
        "uncertain_covariance": covariance,
        "uncertain_mean": mean,
        "uncertain_std": np.sqrt(np.maximum(squares, 0)),
        "uncertain_sampled": np.isin(np.arange(count), sampled),
    }
