"""Findings from solves: how far locking changes the outputs, and how many parameters had no model."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from forward.external.derivatives import mistrusted
from forward.findings import Entry, Finding
from forward.model import SolveError
from forward.words import number, with_unit
from uq.estimators.branch import of_jumps
from uq.evaluation.block import merge
from workflows.config.priors import ranges

if TYPE_CHECKING:
    from forward.fem.model import HyperelasticModel
    from forward.model import ForwardModel
    from uq.evaluation.request import Evaluations
    from uq.inputs.random_parameters import Inputs
    from workflows.studies.sampling import Study

AFFORDABLE = 30_000  # unknowns of a solve beside those of the study
SHARE, QUICK = 0.05, 1.0  # of all solves, and s: what asking a model again may take, the larger of both
TINY = 1e-9  # s, that a solve takes at least
EACH = 3  # solves where derivatives are compared
AWAY = (0.35, -0.35)  # of the probability of each parameter, from its median: one standard deviation to both sides


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
        solutions = model.solve(mean), better.build(model.equations.comm, model.parameters).solve(mean)
    except SolveError:
        return []
    if any(solution.work.snaps for solution in solutions):  # not the same branch, so nothing about the form
        return []
    found, right = (solution.outputs for solution in solutions)
    units = {output.name: output.unit for output in spec.returned}
    said = [
        Entry(
            name,
            f" = {with_unit(number(float(value)), units[name])}, there {with_unit(number(float(other)), units[name])}",
            float(value),
        )
        for name, value, other in zip(model.outputs, found, right, strict=True)
    ]
    form = "quadratic cells and pressures" if better.mixed else "quadratic cells"
    return [Finding("locking-measured", "warning", {"form": form}, about=tuple(said))]


def of_answers(model: ForwardModel, inputs: Inputs, solved: Sequence[Evaluations] = ()) -> tuple[Finding, ...]:
    """Ask a model from outside again at the mean, and compare its derivatives there and elsewhere; on rank 0.

    That is nearly free: methods begin with a solve at the mean. Of slow models, only as many solves are added as are a
    small share of those of the study.

    Parameters
    ----------
    solved
        What was solved before, where that is known: first at the mean.
    """
    spare, known, spread = math.inf, None, None
    if solved:
        first, every = solved[0], merge(solved)
        spare = max(SHARE * len(every.points), QUICK / max(float(every.seconds.mean()), TINY))
        known = first.outputs[0] if np.array_equal(first.points[0], inputs.mean) and first.ok[0] else None
        spread = every.outputs[every.ok].std(axis=0) if every.ok.sum() > 1 else None
    if spare < 1:
        return ()
    each = EACH if model.differentiable else math.inf
    away = AWAY[: int(min(len(AWAY), max(spare - each, 0) // each))]
    signs = np.random.default_rng(0).choice([-1.0, 1.0], len(inputs.mean))
    others = [inputs.points(0.5 + share * signs[None])[0] for share in away]
    return mistrusted(model, np.array([inputs.mean, *others]), inputs.std, known, spread)


def findings_of_solves(evaluations: Iterable[Evaluations]) -> list[Finding]:
    """Say how many solves had parameters without a model, and at how many a body has several states.

    The likelihood of parameters without a model is zero, but they did not fail.
    """
    every = list(evaluations)
    jumps = list(of_jumps(every))
    lost = [failure for found in every for failure in found.failures if failure.inadmissible]
    if not lost:
        return jumps
    solves = sum(len(found.points) for found in every)
    return [
        Finding("solves-inadmissible", "note", {"lost": len(lost), "solves": solves, "reason": lost[0].reason}),
        *jumps,
    ]
