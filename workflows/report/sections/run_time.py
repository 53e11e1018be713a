"""What the study took."""

from __future__ import annotations

from collections.abc import Iterator

from forward.words import duration
from workflows.report.blocks import Block, Heading, Pairs
from workflows.report.section import Results, Section


class RunTime(Section):
    """What the study took."""

    def applies(self, results: Results) -> bool:
        """Return whether it does: always."""
        return True

    def content(self, results: Results) -> Iterator[Block]:
        """Times and work."""
        yield Heading("Run time")
        yield Pairs([(word, [text]) for word, text in times(results)])


def times(results: Results) -> Iterator[tuple[str, str]]:
    """What the study took."""
    summary, count = results.summary, max(results.solves, 1)
    yield "wall time", f"{duration(summary['wall_seconds'])} (of the run that finished the study)"
    cpu = summary["cpu_seconds"]
    yield "processor time of the solves", f"{duration(cpu)}; {duration(cpu / count)} a solve"
    if any(summary["work"].values()):  # unknown for inversions in parallel
        for name, amount in summary["work"].items():
            yield name.replace("_", " "), f"{amount:,}; {amount / count:.1f} a solve"
