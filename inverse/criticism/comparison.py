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

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from inverse.criticism.assessment import Assessment, Points, answer, of_chains, of_gaussian, quantiles, weighted
from inverse.criticism.assumptions import Assumptions, Moves
from inverse.criticism.finer import MeshFound
from inverse.criticism.stacking import stacking
from inverse.criticism.verdict import Verdict, verdict_on_points
from inverse.criticism.weights import effective_sample_size, fewest, normalised, pareto_shape, trustworthy
from inverse.data.measurements import Measurements
from inverse.data.neighbours import DRAWS, agreement, neighbours
from inverse.low_dimensional.posterior import Posterior
from uq.inputs.random_parameters import Inputs

if TYPE_CHECKING:
    import xarray as xr

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


@dataclass(frozen=True, eq=False)
class Compared:
    """What was found of a candidate for a group of data.

    Attributes
    ----------
    posterior, data, assessment
        The posterior, its data, and what was found around the mode.
    mesh
        What finer meshes have said; None where they were not asked.
    assumed
        What is taken for granted, and how far it moves the posterior; None where it is not looked at.
    """

    posterior: Posterior
    data: Measurements
    assessment: Assessment
    mesh: MeshFound | None
    assumed: tuple[Assumptions, Moves] | None = None

    @cached_property
    def points(self) -> Points:
        """What stands for the posterior: chains, else points that were solved, which know what is predicted too.

        Of solved points it is enough that many count: what is predicted from a tail that is not to be trusted is nearer
        than what a linearised model predicts.
        """
        posterior, one = self.posterior, self.assessment
        count = len(one.evidence.log_weights)
        if one.source == "chains":
            assert one.chains is not None
            return of_chains(posterior, one.chains, count)
        if one.evidence.ess >= fewest(len(one.gaussian.mode)):
            return weighted(posterior, one.evidence)
        return of_gaussian(posterior, one.gaussian, posterior.at(one.gaussian.mode[None], derivatives=True), count)

    @cached_property
    def verdict(self) -> Verdict:
        """How far it can be trusted."""
        return verdict_on_points(self.assessment.gaussian, self.assessment.evidence, self.assessment.chains)

    @cached_property
    def critic(self) -> Criticism:
        """What the data say of it."""
        return criticise(self.points, self.posterior, self.data)


def comparison(
    candidates: Mapping[str, Candidate],
    data_groups: Mapping[str, Measurements],
    found: Mapping[Pair, Compared],
    variants: Mapping[str, Mapping[Pair, tuple[float, float]]],
    checks: Mapping[Pair, tuple[float, float]],
    left_out: Mapping[str, Mapping[Pair, tuple[float, float]]],
) -> xr.Dataset:
    """Collect everything that is known about the candidates in a dataset.

    Estimates of ln Z are given with their errors by candidate and group: of each variant, by name, of which the first
    is the study as it is; by nested sampling (`checks`), and without each test (`left_out`), where these were asked
    for.
    """
    import xarray as xr

    names, groups = list(candidates), list(data_groups)
    whole = {pair: one.assessment.log_evidence for pair, one in found.items()}
    weights = np.array([candidate.weight for candidate in candidates.values()])

    def table(values: Mapping[Pair, Any]) -> Any:
        return (("model", "group"), np.array([[values[name, group] for group in groups] for name in names]))

    def each(value: Callable[[Compared], Any]) -> Any:
        return table({pair: value(one) for pair, one in found.items()})

    def totals(values: Mapping[Pair, tuple[float, float]]) -> tuple[FloatArray, FloatArray]:
        parts = [[values[name, group] for group in groups if (name, group) in values] for name in names]
        sums = np.array([sum(value for value, _ in part) for part in parts])
        return sums, np.array([np.sqrt(sum(error**2 for _, error in part)) for part in parts])

    sums, errors = zip(*(totals(values) for values in variants.values()), strict=True)
    chances = np.array([probabilities(total, weights) for total in sums])
    P = chances[0]
    of_model = {name: [found[name, group] for group in groups] for name in names}
    scores = np.array([np.concatenate([one.critic.scores for one in several]) for several in of_model.values()])
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
        "group_log_evidence": each(lambda one: one.assessment.log_evidence[0]),
        "group_log_evidence_error": each(lambda one: one.assessment.log_evidence[1]),
        "laplace_log_evidence": each(lambda one: one.assessment.gaussian.log_evidence),
        "converged": each(lambda one: one.assessment.gaussian.converged),
        "route": each(lambda one: one.assessment.evidence.route),
        "why": each(lambda one: one.assessment.evidence.why),
        "effective": each(lambda one: one.assessment.evidence.ess),
        "tail": each(lambda one: one.assessment.evidence.pareto_k),
        "trusted": each(lambda one: one.assessment.known),
        "trust": each(lambda one: one.verdict.trust),
        "verdict": each(lambda one: one.verdict.why),
        "misfit_probability": each(lambda one: one.critic.misfit),
        "correlation_probability": each(lambda one: one.critic.correlation),
        "score": ("model", scores.sum(axis=1)),
        "score_error": ("model", np.sqrt(count) * scores.std(axis=1)),
        "score_behind": ("model", behind.sum(axis=1)),
        "score_behind_error": ("model", np.sqrt(count) * behind.std(axis=1)),
        "score_tail": ("model", [max(one.critic.pareto_k.max() for one in several) for several in of_model.values()]),
        "score_trusted": (
            "model",
            [
                all(one.verdict.trust != "neither" and one.critic.trusted.all() for one in several)
                for several in of_model.values()
            ],
        ),
    }
    for k, end in enumerate(("", "_error")):
        if checks:
            variables[f"nested_log_evidence{end}"] = table({pair: pairs[k] for pair, pairs in checks.items()})
        if left_out:
            pairs = [(totals({pair: whole[pair] for pair in rest})[k], totals(rest)[k]) for rest in left_out.values()]
            rows = [np.hypot(ours, without) if k else ours - without for ours, without in pairs]
            variables[f"held_out_score{end}"] = (("left_out", "model"), np.array(rows))
    columns = [_predictions(group, [found[name, group] for name in names], P) for group in groups]
    for name, (dims, _) in columns[0].items():
        variables[name] = (dims, np.concatenate([column[name][1] for column in columns], axis=-1))
    parameters = list(dict.fromkeys(p for one in found.values() for p in one.posterior.names))
    variables |= _by_point(names, groups, parameters, found)
    variables |= _constants(names, groups, parameters, found)
    chains = {pair: one.assessment.chains for pair, one in found.items()}
    if any(one is not None for one in chains.values()):
        variables["chains"] = table({k: 0 if one is None else len(one.draws) * one.mixed for k, one in chains.items()})
        variables["chain_rhat"] = table({k: np.nan if one is None else one.rhat.max() for k, one in chains.items()})
        variables["chain_effective"] = table({k: np.nan if one is None else one.ess for k, one in chains.items()})
    if all(one.mesh is not None for one in found.values()):
        variables |= _meshes(names, data_groups, parameters, found)
    held = list(dict.fromkeys(taken.name for one in found.values() if one.assumed for taken in one.assumed[0].shown[0]))
    bends = list(dict.fromkeys(name for one in found.values() if one.assumed for name in one.assumed[0].groups))
    if held:
        variables |= _assumptions(names, groups, parameters, held, bends, found)
    coordinates = {"model": names, "group": groups, "variant": list(variants), "parameter": parameters}
    coordinates |= {"left_out": list(left_out)} if left_out else {}
    coordinates |= {"assumption": held, "uncertain": bends} if held else {}
    return xr.Dataset(variables, {**coordinates, "quantile": list(QUANTILES)})


def probabilities(log_evidence: FloatArray, weights: FloatArray) -> FloatArray:
    """Return P_k ∝ π_k Z_k, of sum 1."""
    P = weights * np.exp(log_evidence - log_evidence.max())
    return np.asarray(P / P.sum())


def _chance_errors(P: FloatArray, errors: FloatArray) -> FloatArray:
    """To first order: ∂P_k/∂ln Z_j = P_k (δ_kj − P_j)."""
    slopes = P[:, None] * (np.eye(len(P)) - P)
    return np.sqrt((slopes**2) @ errors**2)


def _predictions(group: str, models: Sequence[Compared], P: FloatArray) -> dict[str, Any]:
    """Outputs of one group without noise, by each model and by all, beside the data."""
    data = models[0].data
    m, M = len(data.seen()), len(data)
    mean, std = np.empty((2, len(models), M))
    bands = np.empty((len(QUANTILES), len(models), M))
    for k, found in enumerate(one.points for one in models):
        used = found.weights > 0
        w, outputs = found.weights[used], found.everything[used].copy()
        outputs[:, :m] = found.outputs[used]  # corrected for the mesh, where that was done
        mean[k] = w @ outputs
        std[k] = np.sqrt(w @ (outputs - mean[k]) ** 2)
        bands[:, k] = np.array([quantiles(column, w, QUANTILES) for column in outputs.T]).T
    average = P @ mean
    return {
        "output_group": ("output", np.full(M, group)),
        "output_test": ("output", data.tests),
        "output_at": ("output", data.positions),
        "measured": ("output", data.values),
        "sigma": ("output", np.concatenate([models[0].posterior.noise.sigma, np.full(M - m, np.nan)])),
        "prediction_mean": (("model", "output"), mean),
        "prediction_std": (("model", "output"), std),
        "prediction_quantiles": (("quantile", "model", "output"), bands),
        "average_mean": ("output", average),
        "average_within": ("output", P @ std**2),
        "average_between": ("output", P @ (mean - average) ** 2),
    }


Cells = Iterator[tuple[tuple[int, int], Compared, list[int]]]


def _cells(names: list[str], groups: list[str], parameters: list[str], found: Mapping[Pair, Compared]) -> Cells:
    """Go through models and groups: their numbers, what was found, and the columns of its parameters."""
    for (k, name), (g, group) in product(enumerate(names), enumerate(groups)):
        one = found[name, group]
        yield (k, g), one, [parameters.index(p) for p in one.posterior.names]


def _constants(
    names: list[str], groups: list[str], parameters: list[str], found: Mapping[Pair, Compared]
) -> dict[str, Any]:
    """Mode, mean, standard deviation and quantiles of every constant; NaN where a model does not have it."""
    shape, dims = (len(names), len(groups), len(parameters)), ("model", "group", "parameter")
    mode, mean, std, far = np.full((4, *shape), np.nan)
    bands = np.full((len(QUANTILES), *shape), np.nan)
    for (k, g), one, columns in _cells(names, groups, parameters, found):
        known = answer(one.posterior, one.assessment)
        mode[k, g, columns] = one.posterior.physical(one.assessment.gaussian.mode[None, :])[0]
        mean[k, g, columns], std[k, g, columns], far[k, g, columns] = known.mean, known.std, known.outermost
        bands[:, k, g, columns] = known.quantiles(QUANTILES).T
    return {
        "constant_mode": (dims, mode),
        "constant_mean": (dims, mean),
        "constant_std": (dims, std),
        "constant_outermost": (dims, far),
        "constant_quantiles": (("quantile", *dims), bands),
    }


def _by_point(
    names: list[str], groups: list[str], parameters: list[str], found: Mapping[Pair, Compared]
) -> dict[str, Any]:
    """Points with their weights, and ln of the density of every datum at each; NaN where nothing was measured."""
    count = max(one.points.weights.size for one in found.values())
    ends = np.cumsum([0, *(len(found[names[0], group].data) for group in groups)])
    logs = np.full((len(names), count, ends[-1]), np.nan)
    places = np.full((len(names), len(groups), count, len(parameters)), np.nan)
    shares = np.zeros(places.shape[:3])
    for (k, g), one, columns in _cells(names, groups, parameters, found):
        n, m = one.critic.pointwise.shape
        logs[k, :n, ends[g] : ends[g] + m] = one.critic.pointwise
        places[k, g, :n, columns] = one.points.values.T
        shares[k, g, :n] = one.points.weights
    return {
        "point_log_likelihood": (("model", "point", "output"), logs),
        "point": (("model", "group", "point", "parameter"), places),
        "point_weight": (("model", "group", "point"), shares),
    }


def _meshes(
    names: list[str], data_groups: Mapping[str, Measurements], parameters: list[str], found: Mapping[Pair, Compared]
) -> dict[str, Any]:
    """What a finer mesh adds to the data, over the noise, to ln Z, and to unknowns, over their deviations."""
    shape, dims = (len(names), len(data_groups)), ("model", "group")
    whys, added, fixed = np.full(shape, "", dtype=object), np.full(shape, np.nan), np.zeros(shape, dtype=bool)
    shift, left = np.full((2, *shape, len(parameters)), np.nan)
    errors = [np.full((len(names), len(data)), np.nan) for data in data_groups.values()]
    for (k, g), one, columns in _cells(names, list(data_groups), parameters, found):
        mesh, d = one.mesh, len(one.posterior.inputs.names)
        assert mesh is not None
        whys[k, g], added[k, g], fixed[k, g] = mesh.why, mesh.log_evidence, mesh.corrected and mesh.settled
        errors[g][k, : len(mesh.error)] = mesh.error
        shift[k, g, columns[:d]], left[k, g, columns[:d]] = mesh.shift, mesh.left
    return {
        "mesh_checked": (dims, whys == ""),
        "mesh_why": (dims, whys.astype(str)),
        "mesh_corrected": (dims, fixed),
        "mesh_log_evidence": (dims, added),
        "mesh_error": (("model", "output"), np.concatenate(errors, axis=1)),
        "mesh_shift": ((*dims, "parameter"), shift),
        "mesh_left": ((*dims, "parameter"), left),
    }


def _assumptions(
    names: list[str],
    groups: list[str],
    parameters: list[str],
    held: list[str],
    uncertain: list[str],
    found: Mapping[Pair, Compared],
) -> dict[str, Any]:
    """How far what is taken for granted moves the constants, in their deviations, and ln Z; NaN where it is not."""
    shape, dims = (len(names), len(groups), len(held)), ("model", "group", "assumption")
    shift, added = np.full((*shape, len(parameters)), np.nan), np.full(shape, np.nan)
    bend = np.full((*shape[:2], len(uncertain), len(parameters)), np.nan)
    size, part = np.full((2, len(names), len(held)), np.nan)
    unit: dict[str, str] = {}
    for (k, g), one, columns in _cells(names, groups, parameters, found):
        if one.assumed is None:
            continue
        taken, moves = one.assumed
        rows, mine = [held.index(each.name) for each in taken.shown[0]], columns[: len(one.posterior.inputs.names)]
        std = answer(one.posterior, one.assessment).std[: len(mine)]
        shift[k, g][np.ix_(rows, mine)] = moves.parameters / std
        bend[k, g][np.ix_([uncertain.index(name) for name in taken.groups], mine)] = moves.bends / std
        added[k, g, rows] = moves.log_evidence
        size[k, rows], part[k, rows] = [each.size for each in taken.shown[0]], [each.part for each in taken.shown[0]]
        unit |= {each.name: each.unit for each in taken.shown[0]}
    return {
        "assumption_shift": ((*dims, "parameter"), shift),
        "assumption_bend": (("model", "group", "uncertain", "parameter"), bend),
        "assumption_log_evidence": (dims, added),
        "assumption_size": (("model", "assumption"), size),
        "assumption_part": (("model", "assumption"), part),
        "assumption_unit": ("assumption", [unit[name] for name in held]),
    }
