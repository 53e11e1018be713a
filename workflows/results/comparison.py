"""What a comparison of models leaves: what it says in sentences, and groups for ArviZ."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.findings import Finding
from forward.readable import number, percent, power_of_ten, with_error

if TYPE_CHECKING:
    import xarray as xr

    from inverse.criticism.comparison import Candidate
    from uq.inputs.distributions import Distribution
    from uq.inputs.random_parameters import Inputs

SEVERAL = 2  # specimens and candidates, from which on they may disagree
LISTED = 8  # specimens that are named
DRAWS = 1000  # of the constants of a candidate, before and after the data
SUSPICIOUS = 0.01  # posterior predictive probability below which a model is in conflict with the data
MIXED = 0.1  # weight of the others in the best mixture that is said
AGAINST = "against it: what was believed before the data decides"
GRADES = ((1.0, "not worth more than a bare mention"), (3.0, "positive"), (5.0, "strong"))


def grade(log_bayes_factor: float) -> str:
    """Return the word for ln B ≥ 0 (R. E. Kass, A. E. Raftery, J. Am. Stat. Assoc. 90 (1995) 773–795)."""
    return next((word for limit, word in GRADES if log_bayes_factor < limit), "very strong")


def odds(log_bayes_factor: float) -> str:
    """Write a Bayes factor by its logarithm: 12 to 1, 10⁷ to 1."""
    if log_bayes_factor > 13:
        return f"{power_of_ten(int(log_bayes_factor / np.log(10)))} to 1"
    return f"{number(float(np.exp(log_bayes_factor)), 2)} to 1"


def ranking(values: xr.DataArray) -> list[str]:
    """Names of the models, the one with the largest value first."""
    return [str(name) for name in values.model.values[np.argsort(-values.to_numpy(), kind="stable")]]


def by_probability(dataset: xr.Dataset, values: xr.DataArray) -> list[str]:
    """Names of the models by ln Z `values` and prior probabilities, the most probable first."""
    return ranking(values + np.log(dataset["prior_probability"]))


def conflicts(dataset: xr.Dataset, model: str) -> list[str]:
    """Say how the residuals of a model contradict it; empty if they do not."""
    of_model = dataset.sel(model=model)
    asked = 2 * dataset.sizes["group"]
    said = []
    for name, words in (
        ("misfit_probability", "are larger than the errors"),
        ("correlation_probability", "follow one another along the tests, as errors would not"),
    ):
        chances = of_model[name]
        bad = dataset.group.values[(chances * asked < SUSPICIOUS).to_numpy()]
        if len(bad):
            where = f" in {', '.join(map(str, bad))}" if dataset.sizes["group"] > 1 else ""
            told = chance(float(chances.min()))
            said.append(f"{words}{where} (p {told if told.startswith('<') else f'= {told}'})")
    return said


def findings(dataset: xr.Dataset) -> list[Finding]:
    """Say which model the data support, by how much, how certain that is and what it depends on."""
    order = by_probability(dataset, dataset["log_evidence"])
    best = order[0]
    P = float(dataset["probability"].sel(model=best))
    said = [Finding("only-candidate", "note", {"best": best})]
    if len(order) > 1:
        ln_B, error = bayes_factor(dataset, best, order[1])
        by = f"a probability of {percent(P)}".replace("\u00a0", " ").replace("of above", "above")
        values = {"best": best, "probability": by, "second": order[1], "factor": with_error(ln_B, error)}
        values["grade"] = grade(ln_B) if ln_B >= 0 else AGAINST
        said = [Finding("most-probable", "note", values)]
    wrong = conflicts(dataset, best)
    if wrong:
        said.append(Finding("best-of-bad", "warning", {"best": best, "wrong": "; and ".join(wrong)}))
    said += _disagreement(dataset)
    said += _depends(dataset, order)
    predicts = ranking(dataset["score"])[0]
    if predicts != best:
        said.append(Finding("left-out-predicted", "warning", {"other": predicts}))
    # Left-out data may be predicted better by a mixture of candidates than by the most probable one.
    weights = dataset["stacking"].sel(model=order)
    if 1 - float(weights[0]) >= MIXED + 2 * float(dataset["stacking_error"].sel(model=best)):
        shares = {name: 100 * float(weights.sel(model=name)) for name in ranking(weights)}
        parts = ", ".join(f"{name} {share:.2g} %" for name, share in shares.items() if share)
        said.append(Finding("mixture-predicted", "note", {"parts": parts}))
    if "held_out_score" in dataset:
        predicts = ranking(dataset["held_out_score"].sum("left_out"))[0]
        if predicts != best:
            said.append(Finding("whole-tests-predicted", "warning", {"other": predicts}))
    if "assumption_shift" in dataset:
        from inverse.criticism.assumptions import findings_in

        said += [one.of(best) for one in findings_in(dataset.sel(model=best).isel(group=0))]  # of several the first
    if "motion_eigenvalue" in dataset:
        from inverse.data.shared_motion import said as determined

        said.append(determined(dataset["motion_eigenvalue"].sel(model=best).to_numpy()).of(best))
    return said


def _disagreement(dataset: xr.Dataset) -> Iterator[Finding]:
    """Say that specimens are rather of two materials than of one."""
    from inverse.criticism.mixtures import DISAGREE, mixture

    evidence = dataset["group_log_evidence"].transpose("model", "group").to_numpy()
    if min(evidence.shape) < SEVERAL or not np.isfinite(evidence).all():
        return
    found = mixture(evidence, dataset["prior_probability"].to_numpy())
    if found.log_bayes_factor <= DISAGREE:
        return
    names = [str(dataset["model"].values[k]) for k in found.pair]
    first = found.first > 1 / 2
    sides = sorted(zip(names, (first, ~first), strict=True), key=lambda side: -side[1].sum())
    (most, _), (fewer, theirs) = sides
    groups = [str(group) for group in dataset["group"].values[theirs]]
    listed = ", ".join([*groups[:LISTED], *([f"and {len(groups) - LISTED} more"] if len(groups) > LISTED else [])])
    values = {"specimens": first.size, "many": int((~theirs).sum()), "most": most, "few": int(theirs.sum())}
    values |= {"fewer": fewer, "listed": listed, "factor": number(found.log_bayes_factor, 3)}
    yield Finding("specimens-disagree", "warning", values)


def untrusted(found: xr.Dataset, judged: xr.Dataset, wrong: Collection[str]) -> Iterator[Finding]:
    """Find evidences that cannot be trusted; where no finer mesh was looked at, that is said elsewhere.

    The comparison was `found` by the weights of its points, and `judged` by derivatives and meshes too. Of candidates
    with wrong derivatives that is said.
    """
    for model in by_probability(found, found["log_evidence"]):
        for group in found.group.values:
            one = found.sel(model=model, group=group)
            where = f"{model} in {group}" if found.sizes["group"] > 1 else model
            if not bool(one["trusted"]):
                yield Finding("evidence-untrusted", "error", {"where": where, "verdict": one["verdict"].item()})
            elif one["trust"].item() == "neither":
                yield Finding("constants-of-laplace", "warning", {"where": where, "verdict": one["verdict"].item()})
    looked = found["mesh_checked"] if "mesh_checked" in found else found["trusted"]
    by_mesh = (found["trusted"] & ~judged["trusted"] & looked).any("group")
    names = [str(name) for name in found["model"].values[by_mesh.to_numpy()] if name not in wrong]
    if names:
        yield Finding("evidence-untrusted-for-meshes", "error", {"models": ", ".join(names)})


def _depends(dataset: xr.Dataset, order: list[str]) -> Iterator[Finding]:
    """Say under which other priors, errors and parts of the data the order changes, and whether another one wins."""
    best, changed = order[0], []
    for variant in dataset.variant.values[1:]:
        other = by_probability(dataset, dataset["variant_log_evidence"].sel(variant=variant))
        if other[0] != best:
            changed.append(f"{other[0]} with {variant}")
        elif other != order:
            yield Finding("order-depends", "note", {"variant": variant, "best": best, "order": ", ".join(other)})
    if changed:
        yield Finding("winner-depends", "warning", {"changed": "; ".join(changed)})


def doubts_of_selection(
    dataset: xr.Dataset,
    candidates: Mapping[str, Inputs],
    noise: Distribution | None,
    units: Mapping[str, Mapping[str, str]] = MappingProxyType({}),
) -> list[Finding]:
    """Say what is doubtful about the most probable candidate: its constants, its errors, outliers.

    Candidates and SI units of their constants are by names; `noise` is the prior of an inferred factor on the errors.
    """
    from inverse.criticism import doubts as criticism
    from inverse.criticism.weights import resampled

    best = by_probability(dataset, dataset["log_evidence"])[0]
    inputs = candidates[best]
    names = list(inputs.names)
    said: list[Finding] = []
    for group in map(str, dataset.group.values):
        of = dataset.sel(model=best, group=group)
        mode, mean = (of[f"constant_{name}"].sel(parameter=names).to_numpy() for name in ("mode", "mean"))
        weights = of["point_weight"].to_numpy()
        draws = of["point"].sel(parameter=names).transpose("point", "parameter").to_numpy()
        draws = draws[resampled(weights, DRAWS, 0)]
        found = criticism.at_an_end(inputs.marginals, mode, draws, units.get(best, {}))
        found += criticism.heavy_tails(names, of["constant_outermost"].sel(parameter=names).to_numpy())
        found += criticism.far_from_prior(inputs.marginals, mode, mean, 0.0, 0.0, units.get(best, {}))
        here = (dataset["output_group"].to_numpy() == group) & np.isfinite(dataset["measured"].to_numpy())
        rows = dataset.isel(output=here)
        values, sigma, factor = rows["measured"].to_numpy(), rows["sigma"].to_numpy(), 1.0
        if noise is not None:
            factor = float(of["constant_mode"].sel(parameter="noise"))
            found += criticism.noise_far(factor, noise.at(0.5), sigma, values)
        residual = (rows["prediction_mean"].sel(model=best).to_numpy() - values) / (factor * sigma)
        labels = [
            f"{test} at {number(float(at), 4)}"
            for test, at in zip(rows["output_test"].values, rows["output_at"].values, strict=True)
        ]
        found += criticism.strangers(residual, np.zeros(len(residual)), labels, heavy=False, remedy="")
        if "mesh_checked" in dataset:
            found += _doubts_of_mesh(dataset, best, group)
        where = f"{best} in {group}" if dataset.sizes["group"] > 1 else best
        said += [one.of(where) for one in found]
    return said + _doubts_of_meshes(dataset, best)


def _doubts_of_mesh(dataset: xr.Dataset, model: str, group: str) -> list[Finding]:
    """Say what the mesh of a candidate does in a group of data, and what of it is doubtful."""
    from inverse.criticism import doubts as criticism

    of = dataset.sel(model=model, group=group)
    here = (dataset["output_group"].to_numpy() == group) & np.isfinite(dataset["measured"].to_numpy())
    of_file = "mesh_of_file" in of and bool(of["mesh_of_file"])
    return criticism.of_mesh(of, of["mesh_error"].to_numpy()[here], settled=True, from_file=of_file)


def _doubts_of_meshes(dataset: xr.Dataset, best: str) -> list[Finding]:
    """Say what finer meshes do to the evidences, and for which candidates this is unknown."""
    from inverse.criticism import doubts as criticism

    if "mesh_checked" not in dataset:
        return []
    weights = dataset["log_evidence"] + np.log(dataset["prior_probability"])
    left = dataset["mesh_log_evidence"].where(~dataset["mesh_corrected"], 0.0)  # of what is corrected nothing
    values, added = weights.to_series().to_dict(), left.sum("group", skipna=False)
    added = added.where(~dataset["mesh_corrected"].all("group"))  # of these nothing is left to say
    of_files = _too_coarse_for_files(dataset).any("group")
    corrected, unknown, coarse = (
        [str(name) for name in dataset.model.values[which.to_numpy()]]
        for which in (dataset["mesh_corrected"].any("group"), ~dataset["mesh_checked"].all("group"), of_files)
    )
    said = [
        Finding("mesh-not-checked", "warning", {"why": one["mesh_why"].item()}, subject=model)
        for model in map(str, dataset.model.values)
        for one in [dataset.isel(group=0).sel(model=model)]
        if model != best and not bool(one["mesh_checked"])
    ]
    said += [
        doubt.of(model)
        for model in map(str, dataset.model.values)
        for group in map(str, dataset.group.values)
        if model != best and bool(dataset["mesh_corrected"].sel(model=model, group=group))
        for doubt in _doubts_of_mesh(dataset, model, group)
        if doubt.severity != "note"
    ]
    moved = abs(dataset["mesh_shift"]).where(~dataset["mesh_corrected"], 0.0)
    shifts = moved.max(("group", "parameter")).to_series().to_dict()
    said += criticism.meshes_not_alike(corrected, unknown)
    said += criticism.meshes_of_files(coarse)
    return said + criticism.meshes_too_coarse(values, added.to_series().to_dict(), shifts)


def learnt(dataset: xr.Dataset) -> Iterator[Finding]:
    """Say what the errors of candidates are that were learnt."""
    from inverse.criticism import doubts as criticism

    for name in dataset["model"].values if "model_error" in dataset else ():
        one = dataset.sel(model=name)
        if one["model_error_solves"]:
            yield criticism.learnt(one).of(f"Candidate '{name}'")


def trusted_on_meshes(dataset: xr.Dataset) -> xr.Dataset:
    """Trust no evidence whose mesh was not looked at, moves or may move ln Z and is not corrected, or decides on it."""
    from inverse.criticism import doubts as criticism

    if "mesh_checked" not in dataset:
        return dataset
    shift = abs(dataset["mesh_shift"]).max("parameter")
    mended = dataset["mesh_corrected"] & ~criticism.decides(shift, dataset["mesh_left"].max("parameter"))
    mended &= ~_too_coarse_for_files(dataset)
    known = mended | (~dataset["mesh_corrected"] & criticism.certain(dataset["mesh_log_evidence"], shift))
    return dataset.assign(trusted=dataset["trusted"] & known)


def _too_coarse_for_files(dataset: xr.Dataset) -> xr.DataArray:
    """Which candidates (model, group) on meshes of files are corrected for more than such corrections hold for."""
    from inverse.criticism import doubts as criticism

    corrected = dataset["mesh_corrected"]
    if "mesh_of_file" not in dataset:
        return corrected & False
    squares = (dataset["mesh_error"] ** 2).where(np.isfinite(dataset["measured"]))
    of_group = dataset["output_group"] == dataset["group"]
    size = np.sqrt(squares.where(of_group).mean("output"))
    found: xr.DataArray = corrected & dataset["mesh_of_file"] & criticism.beyond_files(size)
    return found.transpose(*corrected.dims)


def bayes_factor(dataset: xr.Dataset, one: str, other: str) -> tuple[float, float]:
    """Return ln of the Bayes factor of one model over another, and its standard error."""
    values, errors = (dataset[name] for name in ("log_evidence", "log_evidence_error"))
    difference = float(values.sel(model=one) - values.sel(model=other))
    return difference, float(np.hypot(errors.sel(model=one), errors.sel(model=other)))


def chance(p: float) -> str:
    """Write a probability that was found by a few thousand draws: 0.52, < 0.0003."""
    return "< 0.0003" if p < 3e-4 else number(p, 2)


def arviz_groups(
    candidates: Mapping[str, Candidate], factor: Distribution | None, seed: int, found: xr.Dataset
) -> dict[str, xr.Dataset]:
    """Return ArviZ's groups: `arviz.from_netcdf("results.nc")`.

    Draws of the constants of every model before and after the data, in each group of data; ln of the density of each
    datum at these draws, one variable for each model; the data.

    `factor` is the prior of the factor on the errors, if it was inferred, and `seed` that of draws before the data.
    """
    import xarray as xr

    from inverse.criticism.weights import resampled
    from inverse.low_dimensional.posterior import NOISE

    drawn, dense, before = dict[str, Any](), dict[str, Any](), dict[str, Any]()
    measured = np.isfinite(found["measured"].to_numpy())
    of_group = found["output_group"].to_numpy()[measured]
    dims = ("chain", "draw", "group")
    for model in map(str, found.model.values):
        one = found.sel(model=model)
        chosen = {
            str(group): resampled(one["point_weight"].sel(group=group).to_numpy(), DRAWS, 0)
            for group in found.group.values
        }
        for parameter in found.parameter.values:
            points = one["point"].sel(parameter=parameter)
            values = np.array([points.sel(group=group).to_numpy()[which] for group, which in chosen.items()])
            if np.isfinite(values).all():
                drawn[f"{model}.{parameter}"] = (dims, values.T[None])
        dense_at = one["point_log_likelihood"].to_numpy()[:, measured]
        columns = [dense_at[chosen[group], j] for j, group in enumerate(of_group)]
        dense[model] = (("chain", "draw", "output"), np.array(columns).T[None])
        rng, inputs = np.random.default_rng(seed), candidates[model].inputs
        prior = dict(zip(inputs.names, inputs.drawn(rng, DRAWS).T, strict=True))
        if factor is not None:
            prior[NOISE] = factor.from_normal(rng.standard_normal(DRAWS))[0]
        for name, values in prior.items():
            before[f"{model}.{name}"] = (dims, np.broadcast_to(values[None, :, None], (1, DRAWS, len(chosen))))
    where = {"group": found.group.values}
    return {
        "posterior": xr.Dataset(drawn, where),
        "prior": xr.Dataset(before, where),
        "log_likelihood": xr.Dataset(dense),
        "observed_data": xr.Dataset({found.attrs["quantity"]: found["measured"].isel(output=measured)}),
    }
