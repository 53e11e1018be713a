"""Sobol' indices of outputs and of the displacement field."""

from __future__ import annotations

from collections.abc import Iterator

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
        yield Pictures([Picture.drawn(plots.index_shares(dataset), caption)])


def sobol(results: Results, output: str) -> Table:
    """Sobol' indices of an output."""
    of_output = results.dataset.sel(output=output)
    rows = []
    for name in results.leading(of_output["sobol_total"]):
        of_parameter = of_output.sel(parameter=name)
        pairs = [(of_parameter[f"sobol_{which}"], of_parameter[f"sobol_{which}_error"]) for which in ("first", "total")]
        rows.append((name, *(with_error(float(value), float(error)) for value, error in pairs)))
    for name in map(str, results.dataset["group"].values if "group" in results.dataset.coords else ()):
        of_group = of_output.sel(group=name)
        kinds = [f"sobol_group_{which}" for which in ("first", "total")]
        texts = [with_error(float(of_group[kind]), float(of_group[f"{kind}_error"])) for kind in kinds]
        rows.append((f"group {name}", *texts))
    return Table(("parameter", "first order", "total"), rows)


def second_order(results: Results, output: str) -> Table:
    """Shares of the variance of an output due to interactions of two parameters."""
    of_output = results.dataset.sel(output=output)
    names = results.parameters
    rows = []
    for i, name in enumerate(names):
        for partner in names[i + 1 :]:
            of_pair = of_output.sel(parameter=name, partner=partner)
            share = with_error(float(of_pair["sobol_second"]), float(of_pair["sobol_second_error"]))
            rows.append((name, partner, share))
    return Table(("parameter", "with", "second order"), rows, text=frozenset({0, 1}))
