"""When, from which study and on which machine the results were made."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime

from forward.words import NONE
from workflows.report.blocks import Block, Code, Folded, Heading, Pairs
from workflows.report.section import Results, Section


class Provenance(Section):
    """When, from which study and on which machine the results were made."""

    def applies(self, results: Results) -> bool:
        """Return whether it does: always."""
        return True

    def content(self, results: Results) -> Iterator[Block]:
        """Pairs, and the whole study."""
        yield Heading("Provenance")
        yield Pairs([(word, [text]) for word, text in provenance(results)])
        yield Folded("The study, complete with defaults", [Code(results.dataset.attrs["config"])], printed=False)


def provenance(results: Results) -> Iterator[tuple[str, str]]:
    """When, from which study and on which machine the results were made."""
    found = results.summary["provenance"]
    date = datetime.fromisoformat(found["date"]).astimezone(UTC)
    yield "date", f"{date:%Y-%m-%d %H:%M:%S} UTC"
    yield "commit", found["commit"] or "not from a git checkout"
    yield "seed", NONE if found["seed"] is None else str(found["seed"])
    ranks, groups = found["ranks"], found["groups"]
    yield "ranks", f"{ranks} in {groups} group{'s' if groups > 1 else ''}, {found['processor']}"
    yield "versions", ", ".join(f"{name} {version}" for name, version in found["versions"].items())
