"""What a study says of one tolerance for all errors before anything is solved."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from forward.findings import Finding, entries
from forward.model import ModelError
from forward.scalars import Mistake
from uq.accuracy.goal import LEAST, OF_SOLVER
from uq.inputs.sampling import power_of_two
from uq.methods.stopping import UNASKED

if TYPE_CHECKING:
    from uq.accuracy.goal import Goal
    from workflows.studies.sampling import Study

AUTOMATIC = "automatic"
SCRAMBLES = 16  # of quasi-Monte Carlo, by default
AMOUNTS = ("samples", "tolerance", "budget_seconds")
SOLVES = 10_000  # most, by default
COUNTS = 3, 4, 6, 9  # estimates of the error of a mesh
# Methods that stop at a goal, and so need no number of samples.
AIMING = ("monte-carlo", "sensitivity-monte-carlo", "quasi-monte-carlo", "chaos")


def completed(blocks: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the blocks of a study, with what its tolerance decides: a method, or the most samples of the given one."""
    accuracy = blocks.get("accuracy")
    if not isinstance(accuracy, Mapping) or accuracy.get("tolerance") is None:
        return blocks
    method = blocks.get("method")
    if method is None:
        return {**blocks, "method": {"kind": AUTOMATIC}}
    if not isinstance(method, Mapping) or method.get("kind") not in AIMING or method.get("fit") == "projection":
        return blocks
    most = accuracy.get("solves", SOLVES)
    if not isinstance(most, int) or any(method.get(name) is not None for name in AMOUNTS):
        return blocks
    if method["kind"] == "quasi-monte-carlo":
        scrambles = method.get("scrambles", SCRAMBLES)
        if not isinstance(scrambles, int) or scrambles < 1:
            return blocks
        most = scrambles * power_of_two(most // scrambles)
    return {**blocks, "method": {**method, "samples": most}}


def most(study: Study) -> int:
    """Return how many solves there may be, by accuracy.solves or by the method's own number of samples."""
    samples = getattr(study.method, "samples", None)
    return min(study.accuracy.solves, samples or study.accuracy.solves)


def goal(study: Study) -> Goal:
    """Return what the tolerance asks of estimates, before anything is known of the mesh."""
    from uq.accuracy.goal import Goal

    assert study.accuracy.tolerance is not None
    units = [output.unit for output in study.spec.returned]
    return Goal.of(study.accuracy.tolerance, units, study.accuracy.solves, study.spec.solver_tolerance or 0.0)


def mistakes(study: Study) -> Iterator[Mistake]:
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
    if getattr(method, "tolerance", None) is not None:
        message = "another tolerance than accuracy.tolerance, which counts all errors; expected one of the two"
        yield ("method", "tolerance"), message, getattr(method, "tolerance")  # noqa: B009
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


def refinement(study: Study) -> tuple[str, str]:
    """Return how the mesh of a study could be refined, "cells", "adapt" or "", and the same in words."""
    model = study.model
    if model.adaptive:
        return "", "is refined as model.adapt says, and no further"
    body = getattr(model, "body", None)
    objection = None
    try:
        model.finer(2.0)
    except ModelError as error:
        objection = str(error)
    except ValueError:
        objection = "it would be too large"
    assert body is not None
    if objection is None and body.cell != "tetrahedron":
        return "cells", "gets more cells along all edges, if its error is too large"
    if body.cell == "tetrahedron" and not any(field.basis != "modes" for field in getattr(model, "fields", ())):
        return "adapt", "is refined where its error arises, if that is too large"
    return "", f"is not refined: {objection}"


def findings(study: Study) -> Iterator[Finding]:
    """Say what of the errors the tolerance cannot hold."""
    if not study.spec.meshed and not study.spec.hidden:
        return
    if not study.estimates:
        why = "accuracy.mesh_error = false"
        if study.accuracy.mesh_error:
            why = "it is not estimated, so that the tolerance will not be said to be kept"
        yield Finding("tolerance-without-mesh", "warning", {"why": why})
        return
    unknown = [output.name for output in study.spec.returned if not getattr(output, "estimable", True)]
    if unknown:
        yield Finding("tolerance-without-mesh-of", "warning", about=entries(unknown))
    how, words = refinement(study)
    if not how and not study.model.adaptive:
        yield Finding("tolerance-mesh-fixed", "note", {"words": words})


def plan(study: Study) -> Iterator[str]:
    """Say what is held, and what is decided by it."""
    accuracy = study.accuracy
    parts = [
        *(["the method"] if study.method.kind == AUTOMATIC else []),
        f"the number of solves (up to {most(study):,})",
    ]
    parts += ["the mesh"] if study.estimates else []
    yield f"tolerance   {accuracy.tolerance:g} of every mean and standard deviation, all errors together, at 95 %"
    listed = " and ".join(filter(None, [", ".join(parts[:-1]), parts[-1]]))
    yield f"            {listed} follow{'s' if len(parts) == 1 else ''} from it"
    if study.estimates:
        limit = f"accuracy.memory = {accuracy.memory:,.0f} MiB for each group of ranks"
        yield f"            the mesh {refinement(study)[1]}, up to {limit}"
        yield "            times and memory are those of the given one"
