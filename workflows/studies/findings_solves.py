"""Findings from solves: how far locking changes the outputs, and how many parameters had no model."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from forward.model import Finding, SolveError
from forward.words import number, with_unit
from workflows.config.priors import ranges

if TYPE_CHECKING:
    from forward.fem.model import HyperelasticModel
    from uq.evaluation.request import Evaluations
    from workflows.studies.sampling import Study

AFFORDABLE = 30_000  # unknowns of a solve beside those of the study


def measured(study: Study, model: HyperelasticModel) -> list[Finding]:
    """Compare outputs at the mean of the inputs with a form that locks less; collective over the model's ranks.

    Empty if the body does not lock by the tables, or if the solve would be too large or fails.
    """
    spec, better = model.spec, model.spec.unlocked()
    tables = spec.locking(ranges(study.given))
    if better.unknowns > AFFORDABLE or not any(finding.severity == "warning" for finding in tables):
        return []
    mean = study.inputs.mean
    try:
        found = model.solve(mean).outputs
        right = better.build(model.equations.comm, model.parameters).solve(mean).outputs
    except SolveError:
        return []
    units = {output.name: output.unit for output in spec.returned}
    said = [
        f"{name} = {with_unit(number(float(value)), units[name])}, there {with_unit(number(float(other)), units[name])}"
        for name, value, other in zip(model.outputs, found, right, strict=True)
    ]
    form = "quadratic cells and pressures" if better.mixed else "quadratic cells"
    text = f"At the mean of the inputs, against {form} on the same mesh, which lock less: {'; '.join(said)}."
    return [Finding("warning", text)]


def findings_of_solves(evaluations: Iterable[Evaluations]) -> list[Finding]:
    """Say how many solves had parameters without a model: their likelihood is zero, but they did not fail."""
    every = list(evaluations)
    lost = [failure for found in every for failure in found.failures if failure.inadmissible]
    if not lost:
        return []
    solves = sum(len(found.points) for found in every)
    text = (
        f"{len(lost):,} of {solves:,} solves were of parameters for which there is no model, as for the first of them "
        f"({lost[0].reason}): their likelihood is zero, and they count as answered."
    )
    return [Finding("note", text)]
