"""The title: which study it is, and how it went."""

from __future__ import annotations

from collections.abc import Iterator

from workflows.report.blocks import Block, Heading, Text
from workflows.report.section import Results, Section
from workflows.report.words import counted


class Header(Section):
    """Which study it is, and how it went."""

    def applies(self, results: Results) -> bool:
        """Return whether it does: always."""
        return True

    def content(self, results: Results) -> Iterator[Block]:
        """Title, method and number of solves."""
        summary = results.summary
        yield Heading(f"Study {summary['study']}", level=1)
        yield Text(str(type(results.study.method).__doc__).partition("\n")[0].replace("`", ""), "lead")
        sets, failed = len(summary.get("data_sets", ())), f"{summary['failed']:,} failed"
        if sets > 1:
            yield Text(f"{sets} data sets, {failed}; {counted(results.solves)}")
        else:
            yield Text(f"{summary['stopped']}; {counted(results.solves)}, {failed}")
