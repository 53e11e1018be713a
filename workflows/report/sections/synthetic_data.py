"""Synthetic data that were made."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from workflows.report.blocks import Block, Text
from workflows.report.section import Results, Section


class SyntheticData(Section):
    """How many data were made, and where they are."""

    def applies(self, results: Results) -> bool:
        """Whether data were made."""
        return "clean" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """One sentence."""
        counts = np.isfinite(results.dataset["values"].to_numpy()).sum(axis=1)
        sets = f"{len(counts)} data sets" if len(counts) > 1 else "1 data set"
        yield Text(f"{sets} of {', '.join(map(str, counts))} components, in the folder data.")
