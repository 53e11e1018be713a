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
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from inverse.criticism.assessment import (
    Assessment,
    Points,
    answer,
    of_chains,
    of_gaussian,
    quantiles,
    weighted,
    with_nans,
)
from inverse.criticism.assumptions import Assumption, Assumptions, Moves
from inverse.criticism.finer import MeshFound
from inverse.criticism.mixtures import stacking
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
    asked
        Places, among the unknowns, of those that are asked for.
    mesh
        What finer meshes have said; None where they were not asked.
    assumed
        What is taken for granted, and how far it moves the posterior; None where it is not looked at.
    sampled
        Which of that are unknowns too.
    """

    posterior: Posterior
    data: Measurements
    assessment: Assessment
    asked: list[int]
    mesh: MeshFound | None
    assumed: tuple[Assumptions, Moves] | None = None
    sampled: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        """Names of the unknowns that are asked for."""
        return [self.posterior.names[k] for k in self.asked]

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
            nested = [[checks[name, group][k] for group in groups] for name in names]
            variables[f"nested_log_evidence{end}"] = (("model", "group"), nested)
        if left_out:
            pairs = [(totals({pair: whole[pair] for pair in rest})[k], totals(rest)[k]) for rest in left_out.values()]
            rows = [np.hypot(ours, without) if k else ours - without for ours, without in pairs]
            variables[f"held_out_score{end}"] = (("left_out", "model"), np.array(rows))
    parameters = list(dict.fromkeys(p for one in found.values() for p in one.names))
    taken = [one.assumed[0] for one in found.values() if one.assumed]
    held = {one.name: one.unit for several in taken for one in several.shown[0]}
    bends = list(dict.fromkeys(name for one in taken for name in one.groups))
    of_groups = _joined(found, candidates, data_groups, _of_group, "group").reindex(
        parameter=parameters, assumption=list(held), uncertain=bends
    )
    of_groups = of_groups.assign(point_weight=of_groups["point_weight"].fillna(0.0))
    if held:
        # A candidate takes the same for granted in all groups.
        alike = {f"assumption_{name}": of_groups[f"assumption_{name}"].max("group") for name in ("size", "part")}
        of_groups = of_groups.assign(alike | {"assumption_unit": ("assumption", list(held.values()))})
    else:
        of_groups = of_groups.drop_dims(["assumption", "uncertain"])
    if not any(one.assessment.chains for one in found.values()):
        of_groups = of_groups.drop_vars(["chains", "chain_rhat", "chain_effective"])
    of_outputs = _joined(found, candidates, data_groups, _of_outputs, "output")
    mean, std = (of_outputs[f"prediction_{name}"].to_numpy() for name in ("mean", "std"))
    average = P @ mean
    first = of_model[names[0]]
    variables |= {
        "output_group": ("output", np.repeat(groups, [len(one.data) for one in first])),
        "output_test": ("output", np.concatenate([one.data.tests for one in first])),
        "output_at": ("output", np.concatenate([one.data.positions for one in first])),
        "measured": ("output", np.concatenate([one.data.values for one in first])),
        "sigma": ("output", np.concatenate([with_nans(one.posterior.noise.sigma, len(one.data)) for one in first])),
        "average_mean": ("output", average),
        "average_within": ("output", P @ std**2),
        "average_between": ("output", P @ (mean - average) ** 2),
    }
    for part in (of_groups, of_outputs):
        variables |= {str(name): (one.dims, one.to_numpy()) for name, one in part.data_vars.items()}
    variables["point"] = variables.pop("point_values")  # xarray renames nothing to the name of a dimension
    coordinates = {"model": names, "group": groups, "variant": list(variants), "parameter": parameters}
    coordinates |= {"left_out": list(left_out)} if left_out else {}
    coordinates |= {"assumption": list(held), "uncertain": bends} if held else {}
    return xr.Dataset(variables, {**coordinates, "quantile": list(QUANTILES)})


def _joined(
    found: Mapping[Pair, Compared], names: Iterable[str], groups: Iterable[str], of: Callable[[Compared], Any], dim: str
) -> xr.Dataset:
    """Put together what is known of each candidate for each group; NaN of what one of them does not have."""
    import xarray as xr

    how: Any = {"join": "outer", "data_vars": "all"}  # newer versions of xarray warn where it is not said
    several = [xr.concat([of(found[name, group]) for group in groups], dim, **how) for name in names]
    whole: xr.Dataset = xr.concat(several, "model", **how)
    return whole.transpose("quantile", "model", "group", ..., missing_dims="ignore").drop_vars("point")


def probabilities(log_evidence: FloatArray, weights: FloatArray) -> FloatArray:
    """Return P_k ∝ π_k Z_k, of sum 1."""
    P = weights * np.exp(log_evidence - log_evidence.max())
    return np.asarray(P / P.sum())


def _chance_errors(P: FloatArray, errors: FloatArray) -> FloatArray:
    """To first order: ∂P_k/∂ln Z_j = P_k (δ_kj − P_j)."""
    slopes = P[:, None] * (np.eye(len(P)) - P)
    return np.sqrt((slopes**2) @ errors**2)


def _of_outputs(one: Compared) -> xr.Dataset:
    """Outputs of a candidate for a group without noise, ln of the density of each datum, and the error of the mesh."""
    import xarray as xr

    found, m, M = one.points, len(one.data.seen()), len(one.data)
    used = found.weights > 0
    w, outputs = found.weights[used], found.everything[used].copy()
    outputs[:, :m] = found.outputs[used]  # corrected for the mesh, where that was done
    mean = w @ outputs
    known: dict[str, Any] = {
        "prediction_mean": ("output", mean),
        "prediction_std": ("output", np.sqrt(w @ (outputs - mean) ** 2)),
        "prediction_quantiles": (
            ("quantile", "output"),
            np.array([quantiles(column, w, QUANTILES) for column in outputs.T]).T,
        ),
        "point_log_likelihood": (("point", "output"), with_nans(one.critic.pointwise, M)),
    }
    if one.mesh is not None:
        known["mesh_error"] = ("output", with_nans(one.mesh.error, M))
    return xr.Dataset(known, {"point": np.arange(len(found.weights))})


def _of_group(one: Compared) -> xr.Dataset:
    """Return what is known of a candidate for a group of data.

    That is its evidence, its constants, its points, what a finer mesh adds to ln Z and to unknowns, and how far what is
    taken for granted moves both; unknowns are moved in their deviations.
    """
    import xarray as xr

    posterior, assessment, mesh, by = one.posterior, one.assessment, one.mesh, "parameter"
    gaussian, evidence, chains = assessment.gaussian, assessment.evidence, assessment.chains
    known, which, c = answer(posterior, assessment), one.asked, len(one.asked)
    found: dict[str, Any] = {
        "group_log_evidence": assessment.log_evidence[0],
        "group_log_evidence_error": assessment.log_evidence[1],
        "laplace_log_evidence": gaussian.log_evidence,
        "converged": gaussian.converged,
        "route": evidence.route,
        "why": evidence.why,
        "effective": evidence.ess,
        "tail": evidence.pareto_k,
        "trusted": assessment.known,
        "trust": one.verdict.trust,
        "verdict": one.verdict.why,
        "misfit_probability": one.critic.misfit,
        "correlation_probability": one.critic.correlation,
        "constant_mode": (by, posterior.physical(gaussian.mode[None, :])[0, which]),
        "constant_mean": (by, known.mean[which]),
        "constant_std": (by, known.std[which]),
        "constant_outermost": (by, known.outermost[which]),
        "constant_quantiles": (("quantile", by), known.quantiles(QUANTILES)[which].T),
        "point_values": (("point", by), one.points.values[:, which]),
        "point_weight": ("point", one.points.weights),
        "chains": 0 if chains is None else len(chains.draws) * chains.mixed,
        "chain_rhat": np.nan if chains is None else chains.rhat.max(),
        "chain_effective": np.nan if chains is None else chains.ess,
    }
    if mesh is not None:
        found |= {
            "mesh_checked": not mesh.why,
            "mesh_why": mesh.why,
            "mesh_corrected": mesh.corrected and mesh.settled,
            "mesh_log_evidence": mesh.log_evidence,
            "mesh_shift": (by, with_nans(mesh.shift, c)),
            "mesh_left": (by, with_nans(mesh.left, c)),
        }
    shown, groups, moves = list[Assumption](), list[str](), Moves(np.zeros((0, 0)), np.zeros(0), np.zeros((0, 0)))
    if one.assumed is not None:
        taken, moves = one.assumed
        shown, groups = taken.shown[0], list(taken.groups)
    over = known.std[which][: moves.parameters.shape[1]]
    found |= {
        "assumption_shift": (("assumption", by), with_nans(moves.parameters / over, c)),
        "assumption_bend": (("uncertain", by), with_nans(moves.bends / over, c)),
        "assumption_log_evidence": ("assumption", moves.log_evidence),
        "assumption_size": ("assumption", [each.size for each in shown]),
        "assumption_part": ("assumption", [each.part for each in shown]),
        "uncertain_sampled": ("uncertain", [float(name in one.sampled) for name in groups]),
    }
    names = {by: one.names, "assumption": [each.name for each in shown], "uncertain": groups}
    return xr.Dataset(found, {**names, "point": np.arange(len(one.points.weights))})
