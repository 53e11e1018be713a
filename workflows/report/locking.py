"""What locking does to the outputs of a study, by a solve that locks less."""

from __future__ import annotations

from typing import TYPE_CHECKING

from forward.model import Finding, SolveError
from workflows.config.study import ranges
from workflows.report.words import number, with_unit

if TYPE_CHECKING:
    from forward.fem.model import HyperelasticModel
    from workflows.config.study import Study

AFFORDABLE = 30_000  # unknowns of a solve beside those of the study


def measured(study: Study, model: HyperelasticModel) -> list[Finding]:
    """Say what the outputs at the mean of the inputs are in a form that locks less; collective over the model's ranks.

    Nothing where the body does not lock by the tables, or where the solve would be too large or fails.
    """
    spec, better = model.spec, model.spec.unlocked()
    tables = spec.locking(ranges(study.parameters))
    if better.unknowns > AFFORDABLE or not any(finding.severity == "warning" for finding in tables):
        return []
    mean = study.inputs.mean
    try:
        found = model.solve(mean).outputs
        right = better.build(model.body.comm, model.parameters).solve(mean).outputs
    except SolveError:
        return []
    units = {output.name: output.unit for output in spec.outputs}
    said = [
        f"{name} = {with_unit(number(float(value)), units[name])}, there {with_unit(number(float(other)), units[name])}"
        for name, value, other in zip(model.outputs, found, right, strict=True)
    ]
    form = "quadratic cells and pressures" if better.mixed else "quadratic cells"
    text = f"At the mean of the inputs, against {form} on the same mesh, which lock less: {'; '.join(said)}."
    return [Finding("warning", text)]
