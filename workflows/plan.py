"""What a study will cost, before anything is imported or computed."""

from __future__ import annotations

from workflows.config import Study


def seconds_per_solve(unknowns: int) -> float:
    """Predict the time of one solve from a tangent prediction on one core, to a factor of two or so.

    Fitted to 0.049, 0.222 and 1.277 s at 1 071, 3 375 and 13 209 unknowns (quadratic hexahedra, a 2.8 GHz core;
    `python -m benchmarks newton`).
    """
    return float(6.24e-6 * unknowns**1.29)


def bytes_per_model(unknowns: int) -> float:
    """Predict the memory of one model with its factorised stiffness, to a factor of two or so."""
    return float(1.5e8 + 8 * (200 * unknowns + 30 * unknowns ** (4 / 3)))


def plan(study: Study, groups: int = 1) -> list[str]:
    """Describe a study in lines: unknowns, solves, memory and predicted time."""
    unknowns = study.model.unknowns
    solves = study.planned
    seconds = solves * seconds_per_solve(unknowns) / groups
    body = study.model.body
    cells = body.cells[0] * body.cells[1] * body.cells[2] * (6 if body.cell == "tetrahedron" else 1)
    form = "mixed form: displacements and pressures" if study.model.mixed else "displacement form"
    up_to = "up to " if getattr(study.method, "tolerance", None) is not None else ""
    return [
        f"method      {study.method.kind}",
        f"unknowns    {unknowns:,} ({cells:,} cells: {body.cell}, degree {body.degree}; {form})",
        f"parameters  {', '.join(study.parameters)}",
        f"outputs     {', '.join(output.name for output in study.model.outputs)}",
        f"solves      {up_to}{solves:,}",
        f"memory      about {bytes_per_model(unknowns) / 2**20:,.0f} MiB for each group of ranks",
        f"time        {up_to}about {_duration(seconds)} on {groups} core{'s' if groups > 1 else ''}"
        f" (rough; {seconds_per_solve(unknowns):.2g} s a solve)",
    ]


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
