"""What a reduced model says of its making, wherever it is used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from forward.model import Finding


def without_answer(told: Mapping[str, Any]) -> Iterator[Finding]:
    """Find that the body had no answer at some points: a reduced model knows none of these, and may answer there."""
    lost = told.get("without an answer", 0) + told.get("unseen without an answer", 0)
    if lost:
        unseen, answered = told.get("unseen without an answer", 0), told.get("of these answered all the same", 0)
        how = f" (at {answered} of {unseen} such unseen samples it does)" if unseen else ""
        yield Finding(
            "warning",
            f"The body had no answer at {lost} of the points at which it was solved for its reduced model, which may "
            f"find an equilibrium there all the same{how}: how many samples fail, and whether a state is stable, can "
            "only be told by the body (model.tolerance asks it). Reduce it over a range in which it has answers.",
        )
    own = told.get("unseen that only the body answers", 0)
    if own:
        yield Finding(
            "warning",
            f"The reduced model finds no equilibrium at {own} unseen samples at which the body has one; its errors are "
            "those at the others. More snapshots or modes help.",
        )
