"""What a study will cost, before anything is imported or computed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from workflows.config import Study

if TYPE_CHECKING:
    from workflows.selection import Selection


def seconds_per_solve(unknowns: int) -> float:
    """Predict the time of one solve from a tangent prediction on one core, to a factor of two or so.

    Fitted to 0.011, 0.067 and 0.98 s at 1 575, 9 963 and 70 227 unknowns (quadratic tetrahedra, a 2.8 GHz core;
    `python -m benchmarks realisation`). Inputs so wide that the prediction fails take several times as long.
    """
    return float(4e-3 + 1.2e-6 * unknowns**1.2)


TEXTBOOK = 15  # times as long is a solve by the textbook, at 10⁴ unknowns


def bytes_per_model(unknowns: int) -> float:
    """Predict the memory of one model with the factors of a solution and of a reference, to a factor of two or so."""
    return float(1.5e8 + 8 * (300 * unknowns + 45 * unknowns ** (4 / 3)))


SECONDS_PER_STRESS = 4e-4  # a material point with its derivatives
SECONDS_PER_SURROGATE = 0.8  # fits and clouds for one evidence


def plan(study: Study | Selection, groups: int = 1) -> list[str]:
    """Describe a study in lines: unknowns, solves, memory and predicted time."""
    if not isinstance(study, Study):
        return _comparison(study)
    unknowns = study.model.unknowns
    solves = study.planned
    each = seconds_per_solve(unknowns) * (TEXTBOOK if study.model.solver.kind == "newton" else 1)
    seconds = min(solves * each, getattr(study.method, "budget_seconds", None) or float("inf")) / groups
    body = study.model.body
    cells = body.cells[0] * body.cells[1] * body.cells[2] * (6 if body.cell == "tetrahedron" else 1)
    form = "mixed form: displacements and pressures" if study.model.mixed else "displacement form"
    up_to = "up to " if getattr(study.method, "open_ended", False) else ""
    return [
        f"method      {study.method.kind}",
        f"unknowns    {unknowns:,} ({cells:,} cells: {body.cell}, degree {body.degree}; {form})",
        f"parameters  {', '.join(study.parameters)}",
        f"outputs     {', '.join(output.name for output in study.model.outputs)}",
        f"solves      {up_to}{solves:,}",
        f"memory      about {bytes_per_model(unknowns) / 2**20:,.0f} MiB for each group of ranks",
        f"time        {up_to}about {_duration(seconds)} on {groups} core{'s' if groups > 1 else ''}"
        f" (rough; {each:.2g} s a solve)",
    ]


def _comparison(study: Selection) -> list[str]:
    method, tests = study.method, study.data.tests
    evidences = len(study.pairs) * method.variants
    seconds = SECONDS_PER_STRESS * study.planned + SECONDS_PER_SURROGATE * evidences
    check = " and nested sampling, which takes minutes" if method.check else ""
    groups = f" in {len(study.data.groups)} groups" if len(study.data.groups) > 1 else ""
    return [
        f"method      {method.kind}",
        f"candidates  {', '.join(f'{name} ({len(c.parameters)})' for name, c in study.candidates.items())}",
        f"data        {sum(len(test.at) for test in tests)} stresses of {len(tests)} tests{groups}",
        f"evidences   {evidences}{check}",
        f"solves      about {study.planned:,}",
        f"time        about {_duration(seconds)} on 1 core (rough)",
    ]


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
