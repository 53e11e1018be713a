"""Predictions averaged over the models."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from forward.readable import size
from forward.words import number
from workflows.report.blocks import Block, Heading, Picture, Pictures, Table, Text
from workflows.report.plots.averaged import within_and_between
from workflows.report.section import Results, Section

if TYPE_CHECKING:
    import xarray as xr

UNITS = {"stress": "Pa", "displacement": "m"}  # outputs have their own


class Averages(Section):
    """Predictions averaged over the models."""

    def applies(self, results: Results) -> bool:
        """Whether models were compared."""
        return "probability" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("Averaged predictions")
        yield Text(
            "At the end of each test, or where the largest displacement was measured, without measurement errors."
        )
        yield averages(results)
        caption = "Parts of the variance: within the models, and between them: what it matters which of them is right."
        yield Pictures([Picture.drawn(within_and_between(last_of_tests(results.dataset)), caption)])


def last_of_tests(dataset: xr.Dataset) -> dict[str, xr.Dataset]:
    """Return the last datum of each test, or the largest displacement, by group and test."""
    found = {}
    tests = list(zip(dataset["output_group"].values, dataset["output_test"].values, strict=True))
    for group, test in dict.fromkeys(tests):
        members = [i for i, pair in enumerate(tests) if pair == (group, test)]
        at = dataset["output_at"].values[members]
        # Displacement data have only numbers: take the largest displacement.
        stress = dataset.attrs["quantity"] == "stress"
        far = np.abs(at - at[0]) if stress else np.abs(dataset["measured"].values[members])
        found[f"{group}, {test}"] = dataset.isel(output=members[int(np.argmax(far))])
    return found


def averages(results: Results) -> Table:
    """Predictions averaged over the models at the end of each test, with both parts of their variance."""
    rows, dataset = [], results.dataset
    quantity = str(dataset.attrs["quantity"])
    specs = getattr(results.study, "of_candidates", {})
    units = {output.name: output.unit for spec in [*specs.values()][:1] for output in spec.returned}
    for one in last_of_tests(dataset).values():
        unit = UNITS.get(quantity) or units.get(str(one["output_test"].item()), "1")
        stds = (np.sqrt(float(one[name])) for name in ("average_within", "average_between"))
        rows.append(
            (
                str(one["output_group"].item()),
                str(one["output_test"].item()),
                number(float(one["output_at"])),
                size(float(one["measured"]), unit, 4),
                size(float(one["average_mean"]), unit, 4),
                *(size(std, unit, 3) for std in stds),
            )
        )
    place = "at" if quantity == "stress" else "datum"
    head = ("group", "test", place, "measured", "averaged prediction", "spread within models", "spread between models")
    return Table(head, rows, text=frozenset({0, 1}))
