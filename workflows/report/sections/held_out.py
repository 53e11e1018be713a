"""Whole tests, predicted from the others."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from forward.words import with_error
from workflows.report.blocks import Block, Table, Text
from workflows.report.section import Results, Section
from workflows.studies.findings_selection import ranking

if TYPE_CHECKING:
    import xarray as xr


class HeldOut(Section):
    """Whole tests, predicted from the others."""

    def applies(self, results: Results) -> bool:
        """Whether tests were left out."""
        return "held_out_score" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Text("Whole tests, predicted from the others: ln of the density of all data in the test.")
        yield held_out(results.dataset)


def held_out(dataset: xr.Dataset) -> Table:
    """Predictive scores of whole tests."""
    scores, errors = dataset["held_out_score"], dataset["held_out_score_error"]
    rows = []
    for model in ranking(scores.sum("left_out")):
        cells = [
            with_error(float(value), float(error))
            for value, error in zip(scores.sel(model=model).values, errors.sel(model=model).values, strict=True)
        ]
        total = with_error(float(scores.sel(model=model).sum()), float(np.sqrt((errors.sel(model=model) ** 2).sum())))
        rows.append((model, *cells, total))
    return Table(("model", *map(str, dataset.left_out.values), "sum"), rows)
