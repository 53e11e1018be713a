"""What a study will cost, before anything is imported or computed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from forward.fem.cost import ADDRESSES_OF_PROGRAM, BYTES_OF_PROGRAM
from forward.findings import Finding
from forward.machine import MIB, Headroom, limits
from workflows.run import own_code

if TYPE_CHECKING:
    from workflows.studies.study import StudyKind


def shortage(study: StudyKind, rank_groups: int = 1) -> Finding | None:
    """Warn if the memory of this machine may not suffice for a study with so many groups of ranks."""
    need = study.memory
    if not need:
        return None
    for limit in sorted(limits(), key=lambda one: one.size):
        wanted = (need + of_program(limit)) * (1 if limit.of_each_process else rank_groups)
        if wanted > limit.size:
            return Finding("memory", "warning", {"needed": wanted / MIB, "limit": limit})
        largest, what = study.growth
        wanted = largest + of_program(limit)
        if wanted > limit.size:
            needed = f"about {wanted / MIB:,.0f} MiB are needed for {what} says"
            return Finding("memory-of-refinement", "warning", {"needed": needed, "limit": limit})
    return None


def of_program(limit: Headroom) -> float:
    """Memory (bytes) of the program itself, as counted by a limit."""
    return ADDRESSES_OF_PROGRAM if limit.of_addresses else BYTES_OF_PROGRAM


def plan(study: StudyKind, rank_groups: int = 1) -> list[str]:
    """Describe a study in lines: unknowns, solves, memory and predicted time."""
    short = shortage(study, rank_groups)
    found = [*study.findings, *([] if short is None else [short])]
    return [*study.plan(rank_groups), *own_code.listed(study), *(f"{one.severity:10}  {one.text}" for one in found)]
