"""Sobol' indices of outputs and of the displacement field."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from forward.words import with_error
from workflows.report import plots
from workflows.report.blocks import Block, Heading, Picture, Pictures, Table, Text
from workflows.report.section import Results, Section
from workflows.report.sections.local_sensitivities import largest_of


class SobolIndices(Section):
    """Sobol' indices: tables and pictures by output, shares of all outputs side by side, and those of the field."""

    def applies(self, results: Results) -> bool:
        """Whether there are some."""
        return "sobol_first" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """Tables and pictures of each output, then of all and of the field."""
        dataset = results.dataset
        yield Heading("Sobol' indices")
        yield Text("The share of the variance due to a parameter alone, and with all its interactions.")
        for output in results.drawn:
            yield Heading(output, level=3)
            yield sobol(results, output)
            if "sobol_second" in dataset:
                yield second_order(results, output)
            caption = f"Indices of {output} with 95 % confidence intervals{largest_of(dataset)}."
            pictures = [Picture.drawn(plots.index_bars(dataset, output), caption)]
            if dataset.sizes.get("index_round", 0) > 1:
                caption = f"Indices of {output} against the number of samples, with 95 % confidence bands."
                pictures.append(Picture.drawn(plots.index_convergence(dataset, output), caption))
            yield Pictures(pictures)
        caption = "Shares of the variance: parameters alone, and the rest."
        yield Pictures([Picture.drawn(plots.index_shares(dataset, results.drawn), caption)])


def sobol(results: Results, output: str) -> Table:
    """Sobol' indices of an output, and what they are without the error of the mesh."""
    leading = results.leading(results.of(output)["sobol_total"])
    groups = map(str, results.dataset["group"].values if "group" in results.dataset.coords else ())
    single, grouped = (("sobol_first", "sobol_total"), ("sobol_group_first", "sobol_group_total"))
    rows = [(name, *_cells(results, single, {"output": output, "parameter": name})) for name in leading]
    rows += [(f"group {name}", *_cells(results, grouped, {"output": output, "group": name})) for name in groups]
    head = _head(results, "sobol_first", ("first order", "total"))
    return Table(("parameter", *head), rows)


def second_order(results: Results, output: str) -> Table:
    """Shares of the variance of an output due to interactions of two parameters."""
    names = results.parameters
    rows = []
    for i, name in enumerate(names):
        for partner in names[i + 1 :]:
            at = {"output": output, "parameter": name, "partner": partner}
            rows.append((name, partner, *_cells(results, ("sobol_second",), at)))
    head = _head(results, "sobol_second", ("second order",))
    return Table(("parameter", "with", *head), rows, text=frozenset({0, 1}))


def _cells(results: Results, names: Sequence[str], at: Mapping[str, str]) -> Iterator[str]:
    """Indices with their errors, each followed by its corrected value where there is one."""
    for name in names:
        value, error = (float(results.dataset[f"{name}{end}"].sel(at)) for end in ("", "_error"))
        yield with_error(value, error)
        yield from results.corrected(name, at)


def _head(results: Results, name: str, words: Sequence[str]) -> Iterator[str]:
    for word in words:
        yield word
        if f"{name}_corrected" in results.dataset:
            yield f"{word}, corrected"
