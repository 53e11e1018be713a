"""Comparison of several models by their evidences, posteriors and residuals.

The most probable model need not be a good one. So the residuals r of each model are compared with those that it would
have if it were true: their squares Σr² ~ χ², and their correlation between neighbours of a test, Σ
r_i r_j/Σ r² over pairs of them (`inverse.data.neighbours`), whose distribution for independent errors is drawn once.
Both are posterior predictive probabilities (A. Gelman, X.-L. Meng, H. Stern, Stat. Sinica 6 (1996) 733–807); the second
one is informative even if the size of the noise was inferred.

Predictive scores leave out one datum at a time, by the weights w_i/p(y_j | x_i) (A. Vehtari, A. Gelman, J. Gabry, Stat.
Comput. 27 (2017) 1413–1432), or whole tests t, by ln p(y_t | other tests) = ln Z − ln Z without t: data of one test
follow one another, so that a single one left out is no surprise. Averaged predictions have the variance Σ P_k V_k
within models and Σ P_k (μ_k − μ)² between them (J. A. Hoeting et al., Stat. Sci. 14 (1999) 382–417).

Probabilities, averages and residual tests share this file because all come from the same weighted draws.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from inverse.criticism.assessment import Assessment, Points, answer, quantiles
from inverse.criticism.stacking import stacking
from inverse.criticism.verdict import Verdict
from inverse.criticism.weights import effective_sample_size, normalised, pareto_shape, trustworthy
from inverse.data.measurements import Measurements
from inverse.data.neighbours import DRAWS, agreement, neighbours
from inverse.low_dimensional.posterior import Posterior
from uq.inputs.random_parameters import Inputs

if TYPE_CHECKING:
    import xarray as xr

    from inverse.criticism.finer import MeshFound

QUANTILES = (0.05, 0.95)
Pair = tuple[str, str]  # candidate and group


@dataclass(frozen=True)
class Candidate:
    """A candidate model.

    Attributes
    ----------
    inputs
        Its parameters.
    weight
        π, its prior probability, up to a common factor.
    """

    inputs: Inputs
    weight: float = 1.0


@dataclass(frozen=True)
class Criticism:
    """What the data say about one model.

    Attributes
    ----------
    scores
        ln p(y_j | other data) (m,), with k̂ (m,) of the weights (`pareto_k`), and whether they can be trusted (m,).
    pointwise
        ln p(y_j | x_i) (n, m) at the points.
    misfit
        Posterior predictive probability of residuals as large as these, or larger.
    correlation
        The same for neighbours that agree as much.
    """

    scores: FloatArray
    pareto_k: FloatArray
    trusted: NDArray[np.bool_]
    pointwise: FloatArray
    misfit: float
    correlation: float


def criticise(found: Points, posterior: Posterior, data: Measurements) -> Criticism:
    """Compare the residuals of a model with its predictions of them."""
    from scipy.stats import chi2

    used = found.weights > 0
    w, x = found.weights[used], found.x[used]
    scale, r = posterior.scale(x), posterior.residuals(found.outputs[used], x)
    pointwise = -(r**2) / 2 - np.log(scale) - np.log(2 * np.pi) / 2
    log_ratio = np.log(w)[:, None] - pointwise
    top = log_ratio.max(axis=0)
    scores = -(top + np.log(np.exp(log_ratio - top).sum(axis=0)))
    left_out = [normalised(column) for column in log_ratio.T]
    pareto_k = [pareto_shape(column) for column in left_out]
    trusted = [
        trustworthy(k, effective_sample_size(column), found.weights.size)
        for k, column in zip(pareto_k, left_out, strict=True)
    ]
    whole = np.full((found.weights.size, posterior.data.size), -np.inf)
    whole[used] = pointwise
    m = posterior.data.size
    seen = data.seen()
    places = np.nan_to_num(seen.places)
    order = np.lexsort((*places.T, seen.kinds))  # independent of the rows
    beside = neighbours(places[order], seen.kinds[order])
    misfit = float(w @ chi2.sf((r**2).sum(axis=1), m))
    errors = np.random.default_rng(0).standard_normal((DRAWS, m))
    drawn = np.sort(agreement(errors, beside))
    larger = 1 - np.searchsorted(drawn, agreement(r[:, order], beside)) / DRAWS
    return Criticism(scores, np.array(pareto_k), np.array(trusted), whole, misfit, float(w @ larger))


# --- all together --------------------------------------------------------------------------------------------------


def comparison(
    candidates: Mapping[str, Candidate],
    data_groups: Mapping[str, Measurements],
    posteriors: Mapping[Pair, Posterior],
    stated: Mapping[Pair, Assessment],
    points: Mapping[Pair, Points],
    verdicts: Mapping[Pair, Verdict],
    variants: Mapping[str, Mapping[Pair, tuple[float, float]]],
    checks: Mapping[Pair, tuple[float, float]],
    left_out: Mapping[str, Mapping[Pair, tuple[float, float]]],
    meshes: Mapping[Pair, MeshFound],
) -> xr.Dataset:
    """Collect everything that is known about the candidates in a dataset.

    Parameters
    ----------
    candidates, data_groups
        By name.
    posteriors, stated, points, verdicts
        What was found, by candidate and group: around the mode, what stands for the posterior, and how far it is
        trusted.
    variants
        ln Z and error by the name of the variant, beginning with the study as it is.
    checks
        ln Z and error by nested sampling, if requested.
    left_out
        ln Z and error without each test, if requested.
    meshes
        Effect of a finer mesh, if checked.
    """
    import xarray as xr

    names = list(candidates)
    found = {pair: assessment.evidence for pair, assessment in stated.items()}
    whole = {pair: assessment.log_evidence for pair, assessment in stated.items()}
    critics = {pair: criticise(points[pair], posteriors[pair], data_groups[pair[1]]) for pair in stated}
    weights = np.array([candidate.weight for candidate in candidates.values()])

    def table(value: Mapping[Pair, Any]) -> Any:
        return (("model", "group"), np.array([[value[name, group] for group in data_groups] for name in names]))

    def totals(values: Mapping[Pair, tuple[float, float]]) -> tuple[FloatArray, FloatArray]:
        parts = [[values[name, group] for group in data_groups if (name, group) in values] for name in names]
        sums = np.array([sum(value for value, _ in part) for part in parts])
        return sums, np.array([np.sqrt(sum(error**2 for _, error in part)) for part in parts])

    sums, errors = zip(*(totals(values) for values in variants.values()), strict=True)
    chances = np.array([probabilities(total, weights) for total in sums])
    P = chances[0]
    scores = np.array([np.concatenate([critics[name, group].scores for group in data_groups]) for name in names])
    behind = scores - scores[scores.sum(axis=1).argmax()]
    count = scores.shape[1]
    stacked, stacked_errors = stacking(scores)
    variables: dict[str, Any] = {
        "log_evidence": ("model", sums[0]),
        "log_evidence_error": ("model", errors[0]),
        "probability": ("model", P),
        "probability_error": ("model", _chance_errors(P, errors[0])),
        "prior_probability": ("model", weights / weights.sum()),
        "stacking": ("model", stacked),
        "stacking_error": ("model", stacked_errors),
        "variant_log_evidence": (("variant", "model"), np.array(sums)),
        "variant_log_evidence_error": (("variant", "model"), np.array(errors)),
        "variant_probability": (("variant", "model"), chances),
        "group_log_evidence": table({pair: value for pair, (value, _) in whole.items()}),
        "group_log_evidence_error": table({pair: error for pair, (_, error) in whole.items()}),
        "laplace_log_evidence": table({pair: a.gaussian.log_evidence for pair, a in stated.items()}),
        "converged": table({pair: a.gaussian.converged for pair, a in stated.items()}),
        "route": table({pair: e.route for pair, e in found.items()}),
        "why": table({pair: e.why for pair, e in found.items()}),
        "effective": table({pair: e.ess for pair, e in found.items()}),
        "tail": table({pair: e.pareto_k for pair, e in found.items()}),
        "trusted": table({pair: a.known for pair, a in stated.items()}),
        "trust": table({pair: verdict.trust for pair, verdict in verdicts.items()}),
        "verdict": table({pair: verdict.why for pair, verdict in verdicts.items()}),
        "misfit_probability": table({pair: c.misfit for pair, c in critics.items()}),
        "correlation_probability": table({pair: c.correlation for pair, c in critics.items()}),
        "score": ("model", scores.sum(axis=1)),
        "score_error": ("model", np.sqrt(count) * scores.std(axis=1)),
        "score_behind": ("model", behind.sum(axis=1)),
        "score_behind_error": ("model", np.sqrt(count) * behind.std(axis=1)),
        "score_tail": ("model", [max(critics[name, group].pareto_k.max() for group in data_groups) for name in names]),
        "score_trusted": (
            "model",
            [
                all(
                    verdicts[name, group].trust != "neither" and critics[name, group].trusted.all()
                    for group in data_groups
                )
                for name in names
            ],
        ),
    }
    if checks:
        variables["nested_log_evidence"] = table({pair: value for pair, (value, _) in checks.items()})
        variables["nested_log_evidence_error"] = table({pair: error for pair, (_, error) in checks.items()})
    if left_out:
        ours, theirs = zip(
            *((totals({pair: whole[pair] for pair in rest}), totals(rest)) for rest in left_out.values()), strict=True
        )
        dims = ("left_out", "model")
        variables["held_out_score"] = (dims, np.array([a[0] - b[0] for a, b in zip(ours, theirs, strict=True)]))
        variables["held_out_score_error"] = (
            dims,
            np.array([np.hypot(a[1], b[1]) for a, b in zip(ours, theirs, strict=True)]),
        )
    columns = [_predictions(names, group, data, posteriors, points, P) for group, data in data_groups.items()]
    for name, (dims, _) in columns[0].items():
        variables[name] = (dims, np.concatenate([column[name][1] for column in columns], axis=-1))
    parameters = list(dict.fromkeys(p for posterior in posteriors.values() for p in posterior.names))
    variables["point_log_likelihood"] = _pointwise(names, data_groups, critics)
    variables |= _constants(names, list(data_groups), parameters, posteriors, stated, points)
    chains = {pair: a.chains for pair, a in stated.items() if a.chains is not None}
    if chains:
        variables["chains"] = table({pair: len(one.draws) * one.mixed for pair, one in chains.items()})
        variables["chain_rhat"] = table({pair: one.rhat.max() for pair, one in chains.items()})
        variables["chain_effective"] = table({pair: one.ess for pair, one in chains.items()})
    if meshes:
        variables |= _meshes(names, data_groups, parameters, posteriors, meshes, variables["constant_std"][1])
    coordinates = {"model": names, "group": list(data_groups), "variant": list(variants), "parameter": parameters}
    coordinates |= {"left_out": list(left_out)} if left_out else {}
    return xr.Dataset(variables, {**coordinates, "quantile": list(QUANTILES)})


def probabilities(log_evidence: FloatArray, weights: FloatArray) -> FloatArray:
    """Return P_k ∝ π_k Z_k, of sum 1."""
    P = weights * np.exp(log_evidence - log_evidence.max())
    return np.asarray(P / P.sum())


def _chance_errors(P: FloatArray, errors: FloatArray) -> FloatArray:
    """To first order: ∂P_k/∂ln Z_j = P_k (δ_kj − P_j)."""
    slopes = P[:, None] * (np.eye(len(P)) - P)
    return np.sqrt((slopes**2) @ errors**2)


def _predictions(
    names: list[str],
    group: str,
    data: Measurements,
    posteriors: Mapping[Pair, Posterior],
    points: Mapping[Pair, Points],
    P: FloatArray,
) -> dict[str, tuple[Any, Any]]:
    """Outputs of one group without noise, by each model and by all, beside the data."""
    m, M = len(data.seen()), len(data)
    mean, std = np.empty((2, len(names), M))
    bands = np.empty((len(QUANTILES), len(names), M))
    for k, name in enumerate(names):
        found = points[name, group]
        used = found.weights > 0
        w, outputs = found.weights[used], found.everything[used].copy()
        outputs[:, :m] = found.outputs[used]  # corrected for the mesh, where that was done
        mean[k] = w @ outputs
        std[k] = np.sqrt(w @ (outputs - mean[k]) ** 2)
        bands[:, k] = np.array([quantiles(column, w, QUANTILES) for column in outputs.T]).T
    average = P @ mean
    missing = np.full(M - m, np.nan)
    sigma = next(posteriors[name, group].noise.sigma for name in names)
    return {
        "output_group": ("output", np.full(M, group)),
        "output_test": ("output", data.tests),
        "output_at": ("output", data.positions),
        "measured": ("output", data.values),
        "sigma": ("output", np.concatenate([sigma, missing])),
        "prediction_mean": (("model", "output"), mean),
        "prediction_std": (("model", "output"), std),
        "prediction_quantiles": (("quantile", "model", "output"), bands),
        "average_mean": ("output", average),
        "average_within": ("output", P @ std**2),
        "average_between": ("output", P @ (mean - average) ** 2),
    }


def _constants(
    names: list[str],
    data_groups: list[str],
    parameters: list[str],
    posteriors: Mapping[Pair, Posterior],
    stated: Mapping[Pair, Assessment],
    points: Mapping[Pair, Points],
) -> dict[str, tuple[Any, Any]]:
    """Mode, mean, standard deviation and quantiles of every constant; NaN where a model does not have it."""
    shape = (len(names), len(data_groups), len(parameters))
    mode, mean, std = np.full((3, *shape), np.nan)
    bands = np.full((len(QUANTILES), *shape), np.nan)
    for k, name in enumerate(names):
        for g, group in enumerate(data_groups):
            posterior, assessment = posteriors[name, group], stated[name, group]
            columns = [parameters.index(p) for p in posterior.names]
            known = answer(posterior, assessment)
            mode[k, g, columns] = posterior.physical(assessment.gaussian.mode[None, :])[0]
            mean[k, g, columns], std[k, g, columns] = known.mean, known.std
            bands[:, k, g, columns] = known.quantiles(QUANTILES).T
    count = max(found.weights.size for found in points.values())
    places, shares = np.full((*shape[:2], count, shape[2]), np.nan), np.zeros((*shape[:2], count))
    for k, name in enumerate(names):
        for g, group in enumerate(data_groups):
            found = points[name, group]
            columns = [parameters.index(p) for p in posteriors[name, group].names]
            places[k, g, : found.weights.size, columns] = found.values.T
            shares[k, g, : found.weights.size] = found.weights
    dims = ("model", "group", "parameter")
    return {
        "point": (("model", "group", "point", "parameter"), places),
        "point_weight": (("model", "group", "point"), shares),
        "constant_mode": (dims, mode),
        "constant_mean": (dims, mean),
        "constant_std": (dims, std),
        "constant_quantiles": (("quantile", *dims), bands),
    }


def _pointwise(
    names: list[str], data_groups: Mapping[str, Measurements], critics: Mapping[Pair, Criticism]
) -> tuple[Any, Any]:
    """Ln of the density of every datum at every point of its group; NaN where nothing was measured."""
    count = max(critic.pointwise.shape[0] for critic in critics.values())
    parts = []
    for group, data in data_groups.items():
        part = np.full((len(names), count, len(data)), np.nan)
        for k, name in enumerate(names):
            found = critics[name, group].pointwise
            part[k, : found.shape[0], : found.shape[1]] = found
        parts.append(part)
    return ("model", "point", "output"), np.concatenate(parts, axis=2)


def _meshes(
    names: list[str],
    data_groups: Mapping[str, Measurements],
    parameters: list[str],
    posteriors: Mapping[Pair, Posterior],
    meshes: Mapping[Pair, MeshFound],
    std: FloatArray,
) -> dict[str, tuple[Any, Any]]:
    """What a finer mesh adds to the data, over the noise, to ln Z, and to unknowns, over their deviations."""
    shape = (len(names), len(data_groups))
    whys, added, fixed = np.full(shape, "", dtype=object), np.full(shape, np.nan), np.zeros(shape, dtype=bool)
    shift, left, errors = np.full(std.shape, np.nan), np.full(std.shape, np.nan), []
    for g, (group, data) in enumerate(data_groups.items()):
        error = np.full((len(names), len(data)), np.nan)
        for k, name in enumerate(names):
            found = meshes[name, group]
            whys[k, g], added[k, g] = found.why, found.log_evidence
            error[k, : len(found.error)] = found.error
            columns = [parameters.index(p) for p in posteriors[name, group].inputs.names]
            shift[k, g, columns], left[k, g, columns] = found.shift, found.left
            fixed[k, g] = found.corrected and found.settled
        errors.append(error)
    dims = ("model", "group")
    return {
        "mesh_checked": (dims, whys == ""),
        "mesh_why": (dims, whys.astype(str)),
        "mesh_corrected": (dims, fixed),
        "mesh_log_evidence": (dims, added),
        "mesh_error": (("model", "output"), np.concatenate(errors, axis=1)),
        "mesh_shift": ((*dims, "parameter"), shift),
        "mesh_left": ((*dims, "parameter"), left),
    }
