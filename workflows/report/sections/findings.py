"""Findings, which should be read before any number."""

from __future__ import annotations

from collections.abc import Iterator

from uq.findings import findings
from workflows.report.blocks import Block, Text
from workflows.report.section import Results, Section


class Findings(Section):
    """Findings, the most severe first."""

    def applies(self, results: Results) -> bool:
        """Whether there are some."""
        return "note" in results.summary or bool(findings(results.dataset))

    def content(self, results: Results) -> Iterator[Block]:
        """A paragraph for each."""
        if "note" in results.summary:
            yield Text(results.summary["note"], "warning")
        for found in findings(results.dataset):
            yield Text(found.text, "" if found.severity == "note" else found.severity)
