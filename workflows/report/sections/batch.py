"""All data sets that were inverted, one row each."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from forward.readable import scale, spoken
from forward.words import named, number, with_error
from workflows.report.blocks import Block, Heading, Table, Text
from workflows.report.section import Results, Section

TRUSTED = ("Laplace's", "corrected", "not to be trusted", "doubtful")


class Batch(Section):
    """All data sets that were inverted, one row each."""

    def applies(self, results: Results) -> bool:
        """Whether several data sets were inverted."""
        return "alone_eigenvalue" in results.dataset and results.dataset.sizes["data_set"] > 1

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("All data sets")
        yield Text(
            "± is one posterior standard deviation; batch.csv has more digits. The first data sets that could be "
            "inverted follow one by one."
        )
        yield batch(results)


def batch(results: Results) -> Table:
    """A row for each data set."""
    dataset = results.dataset
    names = [str(name) for name in dataset.parameter.values]
    sizes = {
        name: scale(float(abs(dataset["mean"].sel(parameter=name)).median()), results.parameter_unit(name))
        for name in names
    }
    rows = []
    for label in dataset.data_set.values:
        one = dataset.sel(data_set=label)
        if not bool(one["ok"]):
            rows.append((str(label), "", "failed", *[""] * (len(names) + 3)))
            continue
        values = [
            with_error(*(float(one[which].sel(parameter=name)) / sizes[name][0] for which in ("mean", "std")))
            for name in names
        ]
        rows.append(
            (
                str(label),
                f"{int(np.isfinite(one['measured']).sum()):,}",
                TRUSTED[int(one["trust"])],
                *values,
                number(float(one["determined"]), 3),
                number(float(one["residual_probability"]), 2),
                number(float(one["log_evidence"]), 6),
            )
        )
    units = [named(spoken(name), sizes[name][1]) for name in names]
    head = ("data set", "data", "posterior", *units, "directions determined", "p of larger residuals", "ln Z")
    return Table(head, rows, text=frozenset({0, 2}))
