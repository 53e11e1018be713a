"""The dependence of evidences on errors, data and priors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from forward.readable import percent
from forward.words import with_error
from workflows.report.blocks import Block, Folded, Heading, Table, Text
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
            "Probability of each model with other errors, other data, and priors of half and twice the width (in "
            "standard normal coordinates)."
        )
        dataset = results.dataset
        models = [str(model) for model in dataset.model.values]
        chances = dataset["variant_probability"].transpose("variant", "model").to_numpy()
        names = [str(variant) for variant in dataset.variant.values]
        yield Table(
            ("", *models), [(n, *(percent(float(p)) for p in row)) for n, row in zip(names, chances, strict=True)]
        )
        yield Folded("Their evidences, ln Z", [variants(dataset)])


def variants(dataset: xr.Dataset) -> Table:
    """Evidence of each model, a column for each variant: models have longer names than there are of them."""
    names = [str(variant) for variant in dataset.variant.values]
    rows = []
    for model in dataset.model.values:
        one = dataset.sel(model=model)
        ends = (one[f"variant_log_evidence{end}"].to_numpy() for end in ("", "_error"))
        rows.append((str(model), *(with_error(float(z), float(e)) for z, e in zip(*ends, strict=True))))
    return Table(("ln Z", *names), rows)
