"""What an inversion says in sentences: verdicts on each posterior, and what makes it doubtful."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from forward.fem.finer import counted as counted_on
from forward.findings import Finding, Severity
from forward.readable import told
from inverse.data.shared_motion import said
from uq.findings import add
from workflows.studies.predictions import of_file

if TYPE_CHECKING:
    import xarray as xr

    from uq.inputs.distributions import Distribution
    from workflows.studies.inversion_blocks import InversionBlocks

NEITHER, DOUBTFUL = 2, 3  # values of `trust`, see docs/results.md
SEVERITY: dict[int, Severity] = {NEITHER: "error", DOUBTFUL: "warning"}


def judged(dataset: xr.Dataset, study: InversionBlocks) -> xr.Dataset:
    """Look for everything that makes the posteriors of an inversion doubtful; return the results with verdicts."""
    words, trust = [str(why) for why in dataset["why"].values], dataset["trust"].to_numpy().copy()
    said: list[Finding] = []
    if study.predict is not None:
        from workflows.studies import predicted

        predicted.keep_unknown_meshes(study, dataset)
    for k, name in enumerate(dataset.data_set.values):
        if not bool(dataset["ok"][k]):
            said.append(Finding("not-inverted", "warning", {"name": name, "why": words[k]}))
            continue
        doubts = doubts_of(dataset.isel(data_set=k), study, k)
        words[k], trust[k] = _verdict(words[k], int(trust[k]), doubts)
        said.append(Finding("verdict", SEVERITY.get(int(trust[k]), "note"), {"verdict": words[k]}, subject=str(name)))
        said += [one.of(str(name)) for one in doubts]
        if study.predict is not None:
            said += predicted.findings(dataset.isel(data_set=k), name)
    found = dataset.assign(why=("data_set", words), trust=("data_set", trust))
    add(found, *said)
    return found


def _verdict(words: str, trust: int, doubts: list[Finding]) -> tuple[str, int]:
    """Return the sentence and the number of a verdict, given those before any doubts."""
    errors = [doubt.short for doubt in doubts if doubt.severity == "error"]
    warnings = [doubt.short for doubt in doubts if doubt.severity == "warning"]
    if trust == NEITHER:
        return "; ".join([words, *errors, *warnings]), NEITHER
    if errors:
        return f"not to be trusted: {'; '.join([*errors, *warnings])}", NEITHER
    if warnings:
        return f"doubtful: {'; '.join(warnings)}; but for that: {words}", DOUBTFUL
    return words, trust


def doubts_of(one: xr.Dataset, study: InversionBlocks, number: int) -> list[Finding]:
    """Say what is doubtful about one data set, given by its number."""
    from inverse.criticism import doubts as criticism
    from uq.inputs.distributions import Normal

    found: list[Finding] = []
    names = [str(name) for name in one.parameter.values]
    mode, mean = one["mode"].to_numpy(), one["mean"].to_numpy()
    square, degrees = float(one["prior_square"]), float(one["prior_degrees"])
    d, units = len(names) - (study.method.noise is not None), study.units_of("/")
    if study.field:
        centre, width = float(one["prior_mean"][0]), float(one["prior_std"][0])
        priors: dict[str, Distribution] = {names[0]: Normal(mean=centre, std=width)}
        stiffness = (one[name].to_numpy() for name in ("stiffness_std", "stiffness_prior_std", "node_position"))
        found += criticism.little_seen(*stiffness)
    else:
        priors = dict(study.inputs.marginals)
        found += criticism.at_an_end(priors, mode[:d], one["draw"].to_numpy()[:, :d], units)
    found += criticism.far_from_prior(priors, mode[:d], mean[:d], square, degrees, units)
    seen = np.isfinite(one["measured"].to_numpy())
    residual, resolution = one["residual"].to_numpy()[seen], one["resolution"].to_numpy()[seen]
    if study.method.noise is not None:
        sigma, measured = one["sigma"].to_numpy()[seen], one["measured"].to_numpy()[seen]
        found += criticism.noise_far(float(mode[-1]), study.method.noise.at(0.5), sigma, measured)
    else:
        found += criticism.too_large_errors(
            *(float(one[f"residual_{n}"]) for n in ("square", "degrees", "probability"))
        )
    labels = study.measurements[number].data_labels()
    found += criticism.strangers(residual, resolution, labels, heavy=study.data.errors.kind != "normal")
    if "points_moved" in one and int(one["points_moved"]):
        count, farthest, rms = int(one["points_moved"]), float(one["largest_move"]), float(one["rms_move"])
        points = "1 point" if count == 1 else f"{count} points"
        where = " outside the body" if not study.measurements[number].on_surface else ""
        values = {"points": points, "where": where, "farthest": told(farthest, "m"), "rms": told(rms, "m")}
        found.append(Finding("data-moved", "note", values))
    if "points_moved" in one:
        measured = study.measurements[number]
        if measured.registered is not None:
            found.append(Finding("registered", "note", {"how": measured.registered.described}))
        found += measured.findings
    if "motion_eigenvalue" in one:
        motions = one["motion_eigenvalue"].to_numpy()
        found.append(said(motions[np.isfinite(motions)]))
    if "expansion_error" in one:
        found += criticism.expansion_off(float(one["expansion_error"]), int(one["expansion_solves"]))
    if "reduced_share" in one:
        shift = dict(zip(names, one["reduced_shift"].to_numpy().tolist(), strict=True))
        found += criticism.reduced_off(float(one["reduced_share"]), shift, int(one["solves"]))
    return found + _of_mesh(one, study, number)


def _of_mesh(one: xr.Dataset, study: InversionBlocks, number: int) -> list[Finding]:
    """Say what the mesh does to one data set, given by its number, and what of it is doubtful."""
    from inverse.criticism.doubts import not_estimable, of_mesh

    if "mesh_checked" not in one:
        return []
    error = one["mesh_error"].to_numpy()[np.isfinite(one["measured"].to_numpy())]
    settled, counted = bool(one["mesh_settled"]), not study.field or counted_on(study.model)
    found = of_mesh(one, error, settled=settled, counted=counted, from_file=of_file(study.model))
    return not_estimable(study.not_estimable(number)) + found
