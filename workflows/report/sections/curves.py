"""Predictions of the models and the data."""

from __future__ import annotations

from collections.abc import Iterator

from workflows.report.blocks import Block, Heading, Picture, Pictures
from workflows.report.plots import selection as plots
from workflows.report.section import Results, Section


class Curves(Section):
    """Curves over the data, or residuals."""

    def applies(self, results: Results) -> bool:
        """Whether models were compared."""
        return "probability" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """A picture for each test."""
        dataset, study = results.dataset, results.study
        tests = list(dict.fromkeys(zip(dataset["output_group"].values, dataset["output_test"].values, strict=True)))
        if dataset.attrs["quantity"] != "stress":
            yield Heading("Residuals")
            drawn = [
                Picture.drawn(
                    plots.residuals(dataset, str(test), of=study.measured_in(str(test))),
                    f"{test}: measured minus predicted, over the errors.",
                )
                for _, test in tests
            ]
        else:
            yield Heading("Curves over the data")
            several = dataset.sizes["group"] > 1
            drawn = [
                Picture.drawn(
                    plots.curves(dataset, str(group), str(test)),
                    f"{test}{f' of {group}' if several else ''}: mean and 90 % band.",
                )
                for group, test in tests
            ]
        yield Pictures(drawn, small=True)
