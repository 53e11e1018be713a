"""What is said of one tolerance for all errors: before anything is solved, as meshes are looked at, and at the end."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.findings import Finding, entries
from forward.readable import number
from forward.scalars import Mistake
from uq.accuracy.budget import LEAST, OF_SOLVER
from uq.estimators.doubts import unmet
from uq.methods.method import UNASKED
from workflows.accuracy.levers import AIMING, AUTOMATIC, COUNTS, Assessed, MeshLever, Reach, Step, most
from workflows.studies.study import never_estimable

if TYPE_CHECKING:
    from workflows.studies.sampling_blocks import SamplingBlocks

LARGEST_ASKED = 0.5  # tolerance that is worth asking for
FAR_OFF = 2.0  # times what is not known: then estimates on two meshes contradict each other
SOURCES = ("mesh", "sampling", "solver", "total")
ESTIMATES = f"{COUNTS[0]} to {COUNTS[-1]} estimates on each mesh"


def _either(parts: Sequence[str], word: str) -> str:
    """Join parts, the last one with a word."""
    return f" {word} ".join(filter(None, [", ".join(parts[:-1]), parts[-1]]))


def _memory(study: SamplingBlocks) -> str:
    return f"accuracy.memory = {study.accuracy.memory:,.0f} MiB"


# --- before anything is solved ---------------------------------------------------------------------------------------


def mistakes(study: SamplingBlocks) -> Iterator[Mistake]:
    """Find what cannot be asked together with a tolerance, or by it."""
    asked, method = study.accuracy.tolerance, study.method
    if asked is None:
        if method.kind == AUTOMATIC:
            yield ("method", "kind"), UNASKED, method.kind
        return
    if not method.aims:
        message = (
            "does not stop at accuracy.tolerance, expected no block [method], or one of the kinds "
            f"{', '.join(AIMING)}{' by regression' if method.kind == 'chaos' else ''}"
        )
        yield ("method", "kind"), message, method.kind
    another = getattr(method, "tolerance", None)
    if another is not None:
        message = "another tolerance than accuracy.tolerance, which counts all errors; expected one of the two"
        yield ("method", "tolerance"), message, another
    if asked < LEAST:
        yield ("accuracy", "tolerance"), f"below what rounding leaves of results, expected at least {LEAST:g}", asked
    solver = study.model.solver_tolerance
    normal = type(study.model).model_fields.get("solver")
    if solver is not None and normal is not None and solver > max(OF_SOLVER * asked, normal.default.tolerance):
        message = (
            f"below what the solver reaches (model.solver.tolerance = {solver:g}), expected at least "
            f"{solver / OF_SOLVER:g}, or a smaller model.solver.tolerance"
        )
        yield ("accuracy", "tolerance"), message, asked


def findings(study: SamplingBlocks) -> Iterator[Finding]:
    """Say what of the errors the tolerance cannot hold."""
    if not study.spec.meshed and not study.spec.hidden:
        return
    if not study.estimates:
        why = "accuracy.mesh_error = false"
        if study.accuracy.mesh_error:
            why = "it is not estimated, so that the tolerance will not be said to be kept"
        yield Finding("tolerance-without-mesh", "warning", {"why": why})
        return
    unknown = never_estimable(study.spec)
    if unknown:
        yield Finding("tolerance-without-mesh-of", "warning", about=entries(unknown))
    lever = MeshLever.of(study)
    if not lever.moves and not study.model.adaptive:
        yield Finding("tolerance-mesh-fixed", "note", {"words": lever.words})


def plan(study: SamplingBlocks) -> Iterator[str]:
    """Say what is held, and what is decided by it."""
    parts = [
        *(["the method"] if study.method.kind == AUTOMATIC else []),
        f"the number of solves (up to {most(study):,})",
        *(["the mesh"] if study.estimates else []),
    ]
    yield f"tolerance   {study.accuracy.tolerance:g} of every mean and standard deviation, all errors together, at 95 %"
    yield f"            {_either(parts, 'and')} follow{'s' if len(parts) == 1 else ''} from it"
    if study.estimates:
        yield f"            the mesh {MeshLever.of(study).words}, up to {_memory(study)} for each group of ranks"
        yield "            times and memory are those of the given one"


# --- while meshes are looked at --------------------------------------------------------------------------------------


def line(one: Assessed) -> str:
    """Say what a mesh takes of the tolerance."""
    if one.share == np.inf:
        return f"mesh of {one.unknowns:,} unknowns: too coarse for an estimate of its error"
    return f"mesh of {one.unknowns:,} unknowns: takes {one.share:.2g} of the tolerance ({one.of} of {one.output})"


def taken(study: SamplingBlocks, lever: MeshLever, meshes: Sequence[Assessed], step: Step) -> str:
    """Say why the last mesh is taken."""
    limits = {
        "": "",
        "meshes": f", and {len(meshes)} meshes are enough",
        "memory": f"; finer ones would take more than {_memory(study)}",
        "fixed": f"; it {lever.words}",
    }
    now = meshes[-1]
    share = f"takes {100 * now.share:.0f} % of the tolerance once corrected"
    return f"the mesh of {now.unknowns:,} unknowns {share}{limits[step.limit]}"


def out_of_reach(study: SamplingBlocks, now: Assessed, reach: Reach) -> str:
    """Say that no mesh in memory is fine enough, what is reachable and what to do."""
    tolerance = study.accuracy.tolerance
    assert tolerance is not None
    here = f"the mesh of {now.unknowns:,} unknowns takes {number(now.share, 2)} times the tolerance once corrected"
    falls = "as errors have fallen so far" if reach.seen else "even where errors fall as fast as they can"
    remedies = [] if int(study.solid.body.degree) > 1 else ["elements of degree 2 (model.body.degree)"]
    remedies += ["more accuracy.memory"]
    reachable = tolerance * reach.share
    remedies += [f"a tolerance of {number(reachable, 2)} or more"] if reachable < LARGEST_ASKED else []
    return (
        f"accuracy.tolerance = {tolerance:g} is out of reach: {here}; {falls}, about {number(reach.needed, 2)} "
        f"unknowns are needed, and {_memory(study)} is enough for {reach.most:,}; expected {_either(remedies, 'or')}"
    )


# --- at the end ------------------------------------------------------------------------------------------------------


def of_mesh(found: Mapping[str, Any]) -> str:
    """Say how the mesh was found, by what was written down of it."""
    meshes, why = found["meshes"], found["why"]
    shares = " → ".join("?" if one["share"] is None else f"{100 * one['share']:.0f} %" for one in meshes)
    unknowns = " → ".join(f"{n:,}" for n in dict.fromkeys(one["unknowns"] for one in meshes))
    if "→" not in unknowns:
        return f"The mesh is the given one: {why}."
    _, semicolon, rest = why.partition("; ")
    return (
        f"The mesh was refined, {unknowns} unknowns: once corrected it takes {shares} of the tolerance, with "
        f"{found['estimates']} estimates at last{semicolon}{rest}."
    )


def missed(study: SamplingBlocks, told: Mapping[str, Any]) -> Iterator[Finding]:
    """Say that the tolerance is not kept, and what keeps it from being so; or how much may be unseen where it is."""
    worst, shares, mesh = told["worst"], told["shares"], told["mesh"]
    asked = {"tolerance": told["tolerance"]}
    if told["kept"]:
        if (share := unmet(told["seen"])) > told["tolerance"]:
            yield Finding("tolerance-unseen", "note", {"n": told["seen"], "share": share})
        return
    if told["unmet"]:
        values = asked | {"share": max(told["unmet"].values())}
        yield Finding("tolerance-constants", "error", values, about=entries(told["unmet"]))
        if shares["total"] <= 1 and (mesh is None or mesh["estimated"]):
            return
    taken = ", ".join(f"{source} {100 * shares[source]:.2g} %" for source in SOURCES[:-1] if shares[source] > 0)
    values = asked | {"of": worst["of"], "reached": told["reached"], "taken": taken}
    if shares["mesh"] > 1 - shares["solver"] or shares["total"] <= 1:  # which is then not known
        tried = mesh is not None and mesh["tried"]
        code = "tolerance-mesh-tried" if tried else "tolerance-mesh-unknown"
        values |= {"why": told["reasons"][0]} if tried else {}
    else:
        limits = f"accuracy.solves = {study.accuracy.solves:,}"
        if most(study) < study.accuracy.solves:
            limits += f" and method.samples = {most(study):,}"
        code, values = "tolerance-solves", values | {"limits": limits}
    # A script that asked for it would go on with less.
    yield Finding(code, "error", values, about=entries([worst["output"]]))


def contradictions(meshes: Sequence[Mapping[str, Any]], outputs: Mapping[str, Any]) -> Iterator[Finding]:
    """Find means that moved otherwise, from one mesh to the next, than the estimates of their errors say.

    Meshes are as they are written down; less than the error (95 %) of each mean of `outputs` does not matter.
    """
    if not meshes:
        return
    fine = meshes[-1]
    coarse = next((one for one in reversed(meshes) if one["unknowns"] != fine["unknowns"] and one["means"]), None)
    before = {} if coarse is None else {name: row for name, *row in coarse["means"]}
    for name, value, error, doubt in fine["means"]:
        if coarse is None or name not in before:
            continue
        its_value, its_error, its_doubt = before[name]
        seen, foreseen = value - its_value, its_error - error
        off = abs(seen - foreseen)
        if off > FAR_OFF * np.hypot(doubt, its_doubt) and off > outputs[name]["mean"]["error"]:
            values = {"coarse": coarse["unknowns"], "fine": fine["unknowns"], "seen": seen, "foreseen": foreseen}
            yield Finding("mesh-estimates-contradict", "warning", values, about=entries([name]))
