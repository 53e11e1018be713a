"""Predictions of the models and the data."""

from __future__ import annotations

from collections.abc import Iterator

from forward.words import named
from workflows.report.blocks import Block, Heading, Picture, Pictures
from workflows.report.plots import selection as plots
from workflows.report.plots.figure import text_of
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
        if dataset.attrs["quantity"] == "stress":
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
            return
        paths = dict(_paths(results, [str(test) for _, test in tests]))
        if paths:
            yield Heading("Curves over the data")
            drawn = [
                Picture.drawn(
                    plots.along(dataset, places, over, of),
                    f"{name} over the path: mean and 90 % band of each model.",
                )
                for name, (places, over, of) in paths.items()
            ]
            yield Pictures(drawn)
        on_paths = {test for places, *_ in paths.values() for test in places}
        left = [str(test) for _, test in tests if str(test) not in on_paths]
        if left:
            yield Heading("Residuals")
            drawn = [
                Picture.drawn(
                    plots.residuals(dataset, test, of=study.measured_in(test)),
                    f"{test}: measured minus predicted, over the errors.",
                )
                for test in left
            ]
            yield Pictures(drawn, small=True)


def _paths(results: Results, tests: list[str]) -> Iterator[tuple[str, tuple[dict[str, float], str, str]]]:
    """Go through outputs that were measured along a path: by name, where each of their tests is, and both axes."""
    from inverse.data.curves import steps_of

    specs = getattr(results.study, "of_candidates", None)
    steps = steps_of(next(iter(specs.values()))) if specs else None
    if steps is None:
        return
    path, (unit, values) = next(iter(steps.numbers.items()))
    for name in steps.units:
        places = {test: value for k, value in enumerate(values, 1) if (test := f"{name}.{k}") in tests}
        if len(places) > 1:
            yield name, (places, named(text_of(path), unit), named(text_of(name), steps.units[name]))
