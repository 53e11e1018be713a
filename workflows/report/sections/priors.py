"""The priors of the unknowns."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator

from forward.words import NONE, settings
from workflows.report.blocks import Block, Heading, Table
from workflows.report.section import Results, Section


class Priors(Section):
    """The priors of the unknowns."""

    def applies(self, results: Results) -> bool:
        """Whether data were inverted."""
        return "alone_eigenvalue" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("Priors")
        yield priors(results)


def priors(results: Results) -> Table:
    """The priors of the unknowns."""
    config = tomllib.loads(results.dataset.attrs["config"])
    rows = [
        (path, f"{block['kind']}: {settings(block, 'kind')}", results.parameter_unit(path))
        for path, block in config.get("parameters", {}).items()
    ]
    rows += [
        (f"fields.{block.get('name') or block['of']}", f"log-normal field: {settings(block, 'of', 'name')}", "1")
        for block in config["model"].get("fields", ())
    ]
    noise = config["method"].get("noise")
    if noise is not None:
        rows.append(("factor on all sigma", f"{noise['kind']}: {settings(noise, 'kind')}", "1"))
    rows = [(unknown, prior, NONE if unit == "1" else unit) for unknown, prior, unit in rows]
    return Table(("unknown", "prior", "unit"), rows, text=frozenset(range(3)))
