"""Quantiles of the outputs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from forward.readable import and_error
from workflows.report.blocks import Block, Heading, Table
from workflows.report.section import Results, Section


class Quantiles(Section):
    """Quantiles of the outputs."""

    def applies(self, results: Results) -> bool:
        """Whether there are some."""
        return "quantiles" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("Quantiles", level=3)
        yield quantiles(results)


def quantiles(results: Results) -> Table:
    """Quantiles of the outputs."""
    rows = []
    for output in results.outputs:
        of_output = results.of(output)
        pairs = zip(of_output["quantiles"].to_numpy(), of_output["quantiles_error"].to_numpy(), strict=True)
        rows.append((output, *(and_error(float(q), float(e), results.unit(output)) for q, e in pairs)))
        if "quantiles_corrected" in results.dataset and np.isfinite(of_output["quantiles_corrected"]).all():
            ends = (of_output[f"quantiles_corrected{end}"].to_numpy() for end in ("", "_error"))
            corrected = [and_error(float(q), float(e), results.unit(output)) for q, e in zip(*ends, strict=True)]
            rows.append((f"{output}, corrected for the mesh", *corrected))
    return Table(("output", *(f"{100 * p:g} %" for p in results.dataset["quantile"].to_numpy())), rows)
