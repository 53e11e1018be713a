"""The dependence of evidences on errors, data and priors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from forward.words import number, with_error
from workflows.report.blocks import Block, Heading, Table, Text
from workflows.report.section import Results, Section

if TYPE_CHECKING:
    import xarray as xr


class Dependence(Section):
    """Evidences with other errors, other data and other priors."""

    def applies(self, results: Results) -> bool:
        """Whether models were compared."""
        return "probability" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("What the evidences depend on")
        yield Text(
            "ln Z and probability of each model with other errors, other data, and priors of half and twice the width "
            "(in standard normal coordinates)."
        )
        yield variants(results.dataset)


def variants(dataset: xr.Dataset) -> Table:
    """Evidence and probability with other errors, data and priors."""
    rows = []
    for variant in dataset.variant.values:
        one = dataset.sel(variant=variant)
        cells = [
            f"{with_error(float(z), float(e))} ({number(100 * float(p), 3)} %)"
            for z, e, p in zip(
                one["variant_log_evidence"].values,
                one["variant_log_evidence_error"].values,
                one["variant_probability"].values,
                strict=True,
            )
        ]
        rows.append((str(variant), *cells))
    return Table(("", *map(str, dataset.model.values)), rows)
