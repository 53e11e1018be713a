"""Synthetic data that were made."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from forward.readable import size
from forward.specimen import Specimen
from workflows.report.blocks import Block, Heading, Table
from workflows.report.section import Results, Section


class SyntheticData(Section):
    """How many data were made, how large they are, and their errors."""

    def applies(self, results: Results) -> bool:
        """Whether data were made."""
        return "clean" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """A table: what was measured in each load case, or of each output over a path."""
        of = results.dataset
        parts = np.array([str(name).partition(".")[0] for name in of["output"].values])
        units = units_of(results.study.model)
        values, sigma = (of[name].to_numpy() for name in ("values", "sigma"))
        rows = []
        for part in dict.fromkeys(parts.tolist()):
            for unit in dict.fromkeys(units.get(name, "m") for name in np.array(results.outputs)[parts == part]):
                here = (parts == part) & np.array([units.get(name, "m") == unit for name in results.outputs])
                made = np.isfinite(values[:, here])
                if made.any():
                    largest, error = (float(np.abs(x[:, here][made]).max()) for x in (values, sigma))
                    rows.append((part, f"{int(made.sum()):,}", size(largest, unit, 3), size(error, unit)))
        yield Heading("The data")
        yield Table(("of", "data", "largest", "largest standard error"), rows)


def units_of(model: Any) -> dict[str, str]:
    """Units of what is measured of a model beside displacements (m), by name."""
    if isinstance(model, Specimen):
        return {f"{case}.{name}": unit for case, of in model.measurable.items() for name, unit in of.items()}
    return {output.name: output.unit for output in model.returned}
