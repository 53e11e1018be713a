"""Solves that failed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from forward.readable import size
from forward.words import NONE
from workflows.report.blocks import Block, Heading, Table, Text
from workflows.report.section import Results, Section
from workflows.report.words import counted, joined, stability


class Failures(Section):
    """Which solves failed, and why."""

    def applies(self, results: Results) -> bool:
        """Return whether it does: always."""
        return True

    def content(self, results: Results) -> Iterator[Block]:
        """How many failed, at which parameters, and why."""
        failed, listed = results.summary["failed"], len(results.summary["failures"])
        yield Heading("Failed solves")
        if "stability" in results.summary:
            yield Text(f"{stability(results.summary['stability']).capitalize()}.")
        if "joined" in results.summary:
            said = joined(results.summary["joined"], results.summary["work"])
            yield Text(f"{said[0].upper()}{said[1:]}.")
        if not listed:
            yield Text("None failed.")
            return
        line = f"{failed:,} of {counted(results.solves)} failed."
        yield Text(line if listed == failed else f"{line} These are the first {listed}; evaluations.h5 holds all.")
        yield failures(results)


def failures(results: Results) -> Table:
    """The solves that failed: the model if there are several, parameters and reason.

    The coefficients of random fields are omitted.
    """
    found = results.summary["failures"]
    every = dict.fromkeys(name for failure in found for name in failure["parameters"])
    names = [name for name in every if not name.startswith("fields.")]
    models = any("model" in failure for failure in found)

    def row(failure: Mapping[str, Any]) -> tuple[str, ...]:
        model, at = str(failure.get("model", "/")), failure["parameters"]
        shown = (NONE if name not in at else size(at[name], results.parameter_unit(name, model), 6) for name in names)
        return (*([model] if models else []), *shown, failure["reason"])

    head = (*(["model"] if models else []), *names, "reason")
    last = len(head) - 1
    return Table(
        head,
        [row(failure) for failure in found],
        text=frozenset({last, *([0] if models else [])}),
        long=frozenset({last}),
    )
