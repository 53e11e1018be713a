"""The sampling of a study with one tolerance for all errors, on a mesh that is fine enough if any may be."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.findings import Finding, entries
from forward.model import FloatArray, SolveError
from uq.accuracy.consequences import has
from uq.accuracy.doubts import failed
from uq.accuracy.effects import with_mesh_errors
from uq.accuracy.goal import Goal
from uq.estimators.doubts import equal, unmet
from uq.estimators.estimate import ESTIMATED, estimate_of
from uq.estimators.moments import half_width
from uq.evaluation.evaluate import Recorder
from uq.evaluation.request import Evaluate, Evaluations
from uq.findings import add
from uq.surrogates.linearisation import linearise
from workflows.studies.tolerance import Found, doubts, history
from workflows.studies.tolerance_asked import goal as asked
from workflows.studies.tolerance_asked import most

if TYPE_CHECKING:
    import xarray as xr

    from uq.inputs.random_parameters import Inputs
    from uq.methods.method import Method
    from workflows.studies.sampling_blocks import SamplingBlocks

FAR_OFF = 2.0  # times what is not known: then estimates on two meshes contradict each other
ATTEMPTS = 3  # at sampling, as what is known of the mesh changes by it
SOURCES = ("mesh", "sampling", "solver", "total")
TRIED = ("unknowns", "cells", "estimates", "share")  # of a mesh
IN_WORDS = {"mean": "mean", "std": "standard deviation"}


def within(
    study: SamplingBlocks,
    method: Method,
    inputs: Inputs,
    evaluate: Evaluate,
    recorders: dict[str, Recorder],
    estimates: list[Evaluations],
    directory: Path,
) -> xr.Dataset:
    """Sample until mean and standard deviation of every output are within the tolerance, with their mesh errors.

    What is not known of the error of the mesh is known first by tangents, and better once outputs are sampled: then
    sampling goes on if it needs to. It finds its solves where they are stored.

    Parameters
    ----------
    recorders, estimates
        Of the job, where evaluations are kept.
    directory
        Of the results: how the mesh was found stands there.
    """
    goal, mesh, before = asked(study), None, history(directory)
    unknown: tuple[Finding, ...] = ()
    if study.estimates and before is not None:
        try:
            mesh = Found(study, inputs, evaluate, linearise(inputs, evaluate), before["estimates"])
        except SolveError as error:
            unknown = (failed(f"{error}"),)
        else:
            estimates.append(mesh.errors.evaluations)
            goal = replace(goal, mesh=mesh.doubts)
    for _ in range(ATTEMPTS):
        recorders["/"] = Recorder(evaluate)
        found = method.until(inputs, recorders["/"], goal)
        if mesh is None:
            break
        found = with_mesh_errors(found, inputs, mesh.centre, mesh.errors, study.told)
        now = replace(goal, mesh=doubts(found))
        settled = now.reached(_moments(found), half_width(found)) <= 1
        goal = now
        if settled:
            break
    add(found, *unknown, first=True)
    parts = goal.parts(_moments(found), half_width(found))
    told = _told(study, found, goal, parts, before)
    found.attrs["accuracy"] = json.dumps(told, ensure_ascii=False)
    add(found, *_findings(study, told), *contradictions([] if before is None else before["meshes"], told["outputs"]))
    return found


def _moments(dataset: xr.Dataset) -> dict[str, FloatArray]:
    return {name: dataset[name].to_numpy() for name in ("mean", "mean_error", "std", "std_error")}


def _told(
    study: SamplingBlocks, found: xr.Dataset, goal: Goal, parts: dict[str, FloatArray], before: dict[str, Any] | None
) -> dict[str, Any]:
    """Say what was asked for and reached, by what, and why; nothing that depends on the machine."""
    names = [str(name) for name in found["output"].values]
    chosen = json.loads(found.attrs.pop("chosen", "{}")) or {"method": study.method.kind, "reasons": []}
    sizes = goal.sizes(found["mean"].to_numpy(), found["std"].to_numpy())
    row, column = np.unravel_index(int(np.argmax(np.nan_to_num(parts["total"]))), parts["total"].shape)
    meshes = [] if before is None else before["meshes"]
    never = study.told.never
    estimates = {name: estimate_of(found, name) for name in ESTIMATED}
    corrected = np.isfinite(estimates["mean"].corrected)  # the outputs of which the error of the mesh was estimated
    if before is None:  # nothing to be known, or not asked for; else it was too much
        known = not (study.spec.meshed or study.spec.hidden) or not study.accuracy.mesh_error
    else:
        known = all(corrected[i] for i, name in enumerate(names) if name not in never)
    missed = _unmet(found)
    return {
        "tolerance": goal.tolerance,
        "reached": float(goal.tolerance * parts["total"][row, column]),
        "kept": known and not missed and bool((parts["total"] <= 1).all()),
        "unmet": missed,
        "worst": {"output": names[column], "of": IN_WORDS[ESTIMATED[row]]},
        "shares": {source: float(parts[source][row, column]) for source in SOURCES},
        "method": chosen["method"],
        "reasons": [*([_of_mesh(before)] if before is not None else []), *chosen["reasons"]],
        "mesh": {
            "unknowns": study.spec.unknowns,
            "estimated": known and before is not None,
            "tried": [{name: one[name] for name in TRIED} for one in meshes],
        }
        if study.spec.meshed
        else None,
        "outputs": {
            name: {
                estimate: {
                    "value": float(one.corrected[i] if corrected[i] else one.value[i]),
                    "error": float(goal.tolerance * parts["total"][k, i] * sizes[k, i]),
                    "relative_to": float(sizes[k, i]),
                    **{source: float(parts[source][k, i]) for source in SOURCES},
                }
                for k, (estimate, one) in enumerate(estimates.items())
            }
            for i, name in enumerate(names)
        },
    }


def _unmet(found: xr.Dataset) -> dict[str, float]:
    """Return what share of all cases samples may have missed, by output of which all of them are the same."""
    if not has(found, "values", "sample", "output"):
        return {}
    values = found["values"].to_numpy()[found["ok"].to_numpy()]
    names = np.array([str(name) for name in found["output"].values])
    return dict.fromkeys(names[equal(values)].tolist(), unmet(len(values))) if len(values) else {}


def _of_mesh(before: dict[str, Any]) -> str:
    """Say how the mesh was found."""
    meshes = before["meshes"]
    shares = " → ".join("?" if one["share"] is None else f"{100 * one['share']:.0f} %" for one in meshes)
    unknowns = " → ".join(f"{n:,}" for n in dict.fromkeys(one["unknowns"] for one in meshes))
    if "→" not in unknowns:
        return f"The mesh is the given one: {before['why']}."
    return (
        f"The mesh was refined, {unknowns} unknowns: once corrected it takes {shares} of the tolerance, with "
        f"{before['estimates']} estimates at last{_after(before['why'])}."
    )


def _after(why: str) -> str:
    """What stands behind the first part of a reason."""
    _, semicolon, rest = why.partition("; ")
    return f"{semicolon}{rest}"


def contradictions(meshes: Sequence[Mapping[str, Any]], outputs: Mapping[str, Any]) -> Iterator[Finding]:
    """Find means that moved otherwise, from one mesh to the next, than the estimates of their errors say.

    Parameters
    ----------
    meshes
        Those that were looked at, as they are written down.
    outputs
        Of the results, with the error (95 %) of each mean: less does not matter.
    """
    if not meshes:
        return
    fine = meshes[-1]
    coarse = next((one for one in reversed(meshes) if one["unknowns"] != fine["unknowns"] and one["means"]), None)
    if coarse is None:
        return
    before = {name: row for name, *row in coarse["means"]}
    for name, value, error, doubt in fine["means"]:
        if name not in before:
            continue
        its_value, its_error, its_doubt = before[name]
        seen, foreseen = value - its_value, its_error - error
        off = abs(seen - foreseen)
        if off > FAR_OFF * np.hypot(doubt, its_doubt) and off > outputs[name]["mean"]["error"]:
            yield Finding(
                "mesh-estimates-contradict",
                "warning",
                {"coarse": coarse["unknowns"], "fine": fine["unknowns"], "seen": seen, "foreseen": foreseen},
                about=entries([name]),
            )


def _findings(study: SamplingBlocks, told: dict[str, Any]) -> Iterator[Finding]:
    """Say that the tolerance is not kept, and what keeps it from being so."""
    worst, shares = told["worst"], told["shares"]
    if told["kept"]:
        return
    asked = {"tolerance": told["tolerance"]}
    if told["unmet"]:
        values = asked | {"share": max(told["unmet"].values())}
        yield Finding("tolerance-constants", "error", values, about=entries(told["unmet"]))
        if shares["total"] <= 1 and (told["mesh"] is None or told["mesh"]["estimated"]):
            return
    taken = ", ".join(f"{source} {100 * shares[source]:.2g} %" for source in SOURCES[:-1] if shares[source] > 0)
    values = asked | {"of": worst["of"], "reached": told["reached"], "taken": taken}
    if shares["mesh"] > 1 - shares["solver"] or shares["total"] <= 1:  # which is then not known
        tried = told["mesh"] is not None and told["mesh"]["tried"]
        code = "tolerance-mesh-tried" if tried else "tolerance-mesh-unknown"
        values |= {"why": told["reasons"][0]} if tried else {}
    else:
        limits = f"accuracy.solves = {study.accuracy.solves:,}"
        if most(study) < study.accuracy.solves:
            limits += f" and method.samples = {most(study):,}"
        code, values = "tolerance-solves", values | {"limits": limits}
    # A script that asked for it would go on with less.
    yield Finding(code, "error", values, about=entries([worst["output"]]))
