"""Findings, which should be read before any number."""

from __future__ import annotations

from collections.abc import Iterator

from uq.findings import findings
from workflows.report.blocks import Block, Folded, Text
from workflows.report.section import Results, Section

NOTES = 2  # that are read at once
FIRST = 2  # errors that stand before the answers


class Findings(Section):
    """Findings, the most severe first."""

    def applies(self, results: Results) -> bool:
        """Whether there are some that the answer does not begin with."""
        return "note" in results.summary or len(findings(results.dataset)) > len(gravest(results))

    def content(self, results: Results) -> Iterator[Block]:
        """A paragraph for each; many notes are folded."""
        if "note" in results.summary:
            yield Text(results.summary["note"], "warning")
        found = findings(results.dataset)
        said = gravest(results)
        for one in found:
            if one.severity != "note" and one.text not in said:
                yield Text(one.text, one.severity)
        notes = [Text(one.text) for one in found if one.severity == "note"]
        yield from notes[:NOTES]
        if len(notes) > NOTES:
            more = len(notes) - NOTES
            yield Folded(f"{more} more note{'s' * (more > 1)}", notes[NOTES:])


def gravest(results: Results) -> list[str]:
    """Return the first of what makes numbers not to be trusted, which is to be read before them."""
    return [one.text for one in findings(results.dataset) if one.severity == "error"][:FIRST]
