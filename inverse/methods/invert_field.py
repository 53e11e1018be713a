"""Inversion for a field: mode by conjugate gradients, low-rank Gaussian, and its corrections.

The posterior is that of `inverse.fields.field_posterior`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from inverse.criticism.assessment import quantiles, with_nans
from inverse.criticism.assumptions import Assumptions
from inverse.criticism.chains import Chains
from inverse.criticism.field_samples import FieldWeights, chains_of_field, weigh_field
from inverse.criticism.finer import NOT_LOOKED, Finer
from inverse.criticism.verdict import Verdict, examine, verdict_on_field
from inverse.criticism.weights import resampled
from inverse.fields.field_posterior import FieldPosterior
from inverse.fields.low_rank import Beside, LowRankPosterior
from inverse.fields.newton_cg import SolvedField, find_mode, infer_noise
from inverse.methods.infer import Problem
from inverse.methods.invert import Invert
from inverse.methods.mesh_correction import corrected_field, field_moved, told
from inverse.methods.record import (
    COLUMNS,
    ENDS,
    SHOWN,
    Record,
    as_dataset,
    diagnosed,
    of_data,
    of_mesh,
    of_motions,
    of_prior,
    of_verdict,
    ritz,
)

if TYPE_CHECKING:
    import xarray as xr

Weighted = tuple[FloatArray, FloatArray]  # values (n, N) of a field with weights (n,) of sum 1


@dataclass(frozen=True)
class Vertices:
    """Quantities that turn values at the vertices into a stiffness.

    Attributes
    ----------
    offset
        ln of the factor (N,) at values of zero.
    volumes
        Volumes of the vertices (N,), in m³.
    """

    offset: FloatArray
    volumes: FloatArray


def _solve(method: Invert, posterior: FieldPosterior, start: FloatArray | None) -> SolvedField:
    if posterior.noise.factor is not None:
        return infer_noise(posterior, start=start, cutoff=method.cutoff, rank=method.rank)
    mode = find_mode(posterior, start)
    found = LowRankPosterior.at(mode.point, cutoff=method.cutoff, rank=method.rank, seed=method.seed)
    return SolvedField(mode, found, mode.converged)


def invert_field(
    posterior: FieldPosterior,
    problem: Problem[Invert],
    vertices: Vertices,
    predict: Callable[[LowRankPosterior, Weighted | None, Beside], Record] | None = None,
) -> xr.Dataset:
    """Invert a data set for a field; collective over the rank group of the model.

    A posterior, the values with weights that correct it if it cannot be trusted, and what is uncertain beside `predict`
    what else is asked for. Raises `SolveError` if the model has no answer at the centre of the prior.
    """
    data, method, shared, finer = problem.data, problem.method, problem.shared, problem.finer or NOT_LOOKED
    g = vertices.volumes / vertices.volumes.sum()
    before = _before(posterior, finer, problem.say) if method.treatment is not None else None
    first = None
    if shared is not None:  # which depends on the displacements
        noise = replace(posterior.noise, **shared(posterior.values(np.zeros(posterior.size))))
        begun = _solve(method, replace(posterior, noise=noise), None).mode.point
        noise, first = replace(noise, **shared(begun.values)), begun.whitened
        posterior = replace(posterior, noise=noise)

    def solve(asked: FieldPosterior, start: FloatArray | None) -> SolvedField:
        return _solve(method, asked, first if start is None else start)

    treatment = method.treatment or "report"
    solved, moved, mesh = corrected_field(posterior, solve, finer, data, treatment, g)
    mode, found, converged, factor = solved.mode, solved.found, solved.converged, solved.factor
    log_evidence = solved.log_evidence
    spectrum = found.spectrum
    root = mode.point.root
    residual = posterior.noise.normal_scores(mode.point.gaps)
    test = examine(residual, spectrum, data.neighbours())
    samples = method.solves(0, field=True)
    weighed = weigh_field(mode.point, found, samples, seed=method.seed) if samples else None
    chains = whole = None
    needed = weighed is None or not weighed.trusted
    if method.chains is not None and (needed or method.chains_when == "always"):
        # Chains are judged by the mean over the body: mixing at all vertices would need far more draws.
        whole = chains_of_field(mode.point, found, keep=lambda m: np.column_stack([m @ g, m]), seed=method.seed)
        chains = replace(whole, draws=whole.draws[:, :, :1])
    drawn = None if whole is None else whole.flat[:, 1:]
    verdict = verdict_on_field(replace(mode, converged=converged), found, weighed, test, chains, drawn)
    error = np.nan
    if log_evidence is None and weighed is not None and weighed.trusted:
        log_evidence, error = weighed.log_evidence, weighed.error
    scale = mode.point.posterior.seen.scale  # with the factor where that is inferred
    cases = int(data.cases.max()) + 1
    inferred_noise = (factor, solved.log_std) if method.noise is not None else None
    corrected = _corrected(verdict, weighed, chains, drawn)
    predicted = mode.point.predicted_outputs
    mean = _of_mean(found, vertices, inferred_noise, corrected)
    stiffness = _of_stiffness(found, vertices, method, corrected)
    record: Record = {
        **of_motions(spectrum, mode.point.posterior.seen, root),
        **of_data(data, predicted, residual, scale / root, spectrum),
        **of_verdict(verdict, test),
        **of_prior(mode.point.whitened, spectrum),
        **of_mesh(mesh, before, np.size(mean["mode"])),
        **mean,
        **stiffness,
        "stiffness_mesh_shift": moved / np.maximum(np.asarray(stiffness["stiffness_std"]), 1e-300),
        **_directions(found),
        **diagnosed(chains),
        "log_evidence": np.array(found.log_evidence if log_evidence is None else log_evidence),
        "log_evidence_error": np.array(error),
        "laplace_log_evidence": np.array(found.log_evidence),
        "effective": np.array(np.nan if weighed is None else weighed.ess),
        "tail": np.array(np.nan if weighed is None else weighed.pareto_k),
        "converged": np.array(converged),
        "solves": np.array(posterior.counts.solves),
        "products": np.array(mode.products + spectrum.products),
        "step": np.array(mode.iterations).reshape(-1, len(COLUMNS["field"])),
        "stiffness_mode": vertices.offset + found.mean,
        "alone_stiffness_std": np.array([_alone_std(found, data.cases == k) for k in range(cases)]),
        "neglected": np.array(spectrum.neglected),
        "information": np.array(found.information),
    }
    if problem.assumed is not None:
        record |= _of_assumed(solved, problem.assumed, g, np.asarray(stiffness["stiffness_std"]), mean["std"])
    beside = Beside.of(mode.point)
    if len(beside.mean):
        squares = np.einsum("gn,gn->g", beside.slopes, found.covariance(beside.slopes)) + (beside.root**2).sum(axis=1)
        record |= {"uncertain_mean": beside.mean, "uncertain_std": np.sqrt(squares)}
    if predict is not None:
        record |= predict(found, corrected, beside)
    return as_dataset(record)


def _of_assumed(solved: SolvedField, assumed: Assumptions, g: FloatArray, std: FloatArray, of_mean: Any) -> Record:
    """How far what is taken for granted moves the mean over the body, and the vertex that it moves most, in deviations.

    Of second order the larger of both.
    """
    point, width, count = solved.mode.point, np.ravel(of_mean)[0], np.size(of_mean)
    state = np.asarray(point.solution.state)

    def moved(changes: FloatArray) -> tuple[FloatArray, FloatArray]:
        moves = field_moved(solved, changes)
        return moves @ g / width, np.abs(moves / np.maximum(std, 1e-300)).max(axis=1, initial=0.0)

    shift, largest = moved(assumed.shown[1] @ assumed.changes(point.values[None], state)[0])
    bends = np.maximum(*map(np.abs, moved(assumed.bends(point.values, state))))
    return {
        "assumption_shift": with_nans(shift[:, None], count),
        "assumption_stiffness": largest,
        "assumption_bend": with_nans(bends[:, None], count),
    }


def _before(posterior: FieldPosterior, finer: Finer, say: Callable[[str], None]) -> float:
    """Hold the error of the mesh at the centre of the prior against the noise, before the search; its size."""
    values = posterior.values(np.zeros(posterior.size))
    look, _ = finer.look(values)
    if look is None:
        return np.nan
    return told(
        posterior.weights * (look.outputs - posterior.model.solve(values).outputs), posterior.measured.sum(), say
    )


def _corrected(
    verdict: Verdict, weighed: FieldWeights | None, chains: Chains | None, drawn: FloatArray | None
) -> Weighted | None:
    """Values of the field that correct the Gaussian if it cannot be trusted."""
    if verdict.trust != "corrected":
        return None
    if chains is not None and drawn is not None and chains.mixed:
        return drawn, np.full(len(drawn), 1 / len(drawn))
    assert weighed is not None
    return weighed.values, weighed.weights


def _of_stiffness(found: LowRankPosterior, vertices: Vertices, method: Invert, corrected: Weighted | None) -> Record:
    """Mean, standard deviation and draws of ln stiffness."""
    count = -(-method.draws // 10)
    if corrected is None:
        whitened = np.random.default_rng(method.seed).standard_normal((count, len(found.mean)))
        mean, std, draws = found.mean, found.std, found.samples(whitened)
    else:
        values, weights = corrected
        mean = weights @ values
        std = np.sqrt(weights @ (values - mean) ** 2)
        draws = values[resampled(weights, count, method.seed)]
    return {
        "stiffness_mean": vertices.offset + mean,
        "stiffness_std": std,
        "stiffness_draw": vertices.offset + draws,
    }


def _of_mean(
    found: LowRankPosterior, vertices: Vertices, noise: tuple[float, float] | None, corrected: Weighted | None
) -> Record:
    """Posterior of the mean of the logarithm over the body, and of the noise."""
    g = vertices.volumes / vertices.volumes.sum()
    offset = float(g @ vertices.offset)
    at, std = found.marginal(g)
    mode, mean = np.array([at + offset]), np.array([at + offset])
    lower, upper = mode - 1.96 * std, mode + 1.96 * std
    if corrected is not None:
        values, weights = corrected
        means = values @ g + offset
        mean = np.array([weights @ means])
        std = float(np.sqrt(weights @ (means - mean) ** 2))
        lower, upper = quantiles(means, weights, ENDS)[:, None]
    widths = np.array([std])
    if noise is not None:
        factor, log_std = noise
        mode, mean, widths = np.append(mode, factor), np.append(mean, factor), np.append(widths, factor * log_std)
        lower = np.append(lower, factor * np.exp(-1.96 * log_std))
        upper = np.append(upper, factor * np.exp(1.96 * log_std))
    covariance = np.diag(widths**2)
    return {"mode": mode, "mean": mean, "std": widths, "lower": lower, "upper": upper, "covariance": covariance}


def _directions(found: LowRankPosterior) -> Record:
    """The directions that the data constrain most, and the last ones found."""
    count = len(found.spectrum.values)
    first = np.arange(min(SHOWN, count))
    last = np.arange(max(count - SHOWN, len(first)), count)
    shown = np.concatenate([first, np.full(SHOWN - len(first), -1), last, np.full(SHOWN - len(last), -1)])
    vectors = np.full((len(shown), len(found.mean)), np.nan)
    vectors[shown >= 0] = found.directions[shown[shown >= 0]]
    return {"direction_stiffness": vectors, "shown_number": shown}


def _alone_std(found: LowRankPosterior, rows: NDArray[np.bool_]) -> FloatArray:
    """Standard deviations (N,) from one load case alone."""
    values, turn = ritz(found.spectrum, rows)
    share = values / (1 + values)
    return np.asarray(np.sqrt(np.maximum(found.prior.variance - share @ (turn @ found.directions) ** 2, 0)))
