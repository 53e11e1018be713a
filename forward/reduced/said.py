"""What a reduced model says of its making, wherever it is used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from forward.findings import Finding


def without_answer(told: Mapping[str, Any]) -> Iterator[Finding]:
    """Find that the body had no answer at some points: a reduced model knows none of these, and may answer there."""
    lost = told.get("without an answer", 0) + told.get("unseen without an answer", 0)
    if lost:
        unseen, answered = told.get("unseen without an answer", 0), told.get("of these answered all the same", 0)
        how = f" (at {answered} of {unseen} such unseen samples it does)" if unseen else ""
        yield Finding("reduced-body-fails", "warning", {"lost": lost, "how": how})
    own = told.get("unseen that only the body answers", 0)
    if own:
        yield Finding("reduced-finds-none", "warning", {"lost": own})
