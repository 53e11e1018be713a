"""Constants of the models: posteriors and priors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from forward.readable import size
from forward.words import settings
from workflows.report.blocks import Block, Heading, Picture, Pictures, Table, Text
from workflows.report.plots import selection as plots
from workflows.report.section import Results, Section
from workflows.studies.findings_selection import by_probability

if TYPE_CHECKING:
    from workflows.studies.selection import Comparison


class Constants(Section):
    """Constants of the models: posteriors and priors."""

    def applies(self, results: Results) -> bool:
        """Whether models were compared."""
        return "probability" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """Pictures and tables, the candidates, and where the data are from."""
        dataset, study = results.dataset, results.study
        yield Heading("Constants")
        yield constants(results)
        several, best = dataset.sizes["group"] > 1, by_probability(dataset, dataset["log_evidence"])[0]
        yield Heading("Posteriors of the constants" + (f" of {best}" if several else ""), level=3)
        pairs = [(str(m), str(g)) for m in dataset.model.values for g in dataset.group.values]
        yield Pictures(
            [
                Picture.drawn(
                    plots.corner(dataset, model, group, study.units_of(model)),
                    f"{model}{f' ({group})' if several else ''}",
                )
                for model, group in pairs
                if not several or model == best
            ]
        )
        yield Heading("Candidates and priors", level=3)
        yield priors(results)
        if study.source:
            yield Heading("Data", level=3)
            yield Text("\n".join(study.source))


def constants(results: Results) -> Table:
    """Posterior of every constant."""
    dataset = results.dataset
    rows = []
    for model in dataset.model.values:
        for group in dataset.group.values:
            one = dataset.sel(model=model, group=group)
            for name in dataset.parameter.values:
                of_name = one.sel(parameter=name)
                if np.isnan(float(of_name["constant_mode"])):
                    continue
                unit = results.parameter_unit(str(name), str(model))
                low, high = of_name["constant_quantiles"].values
                values = (of_name["constant_mode"], of_name["constant_mean"], of_name["constant_std"], low, high)
                rows.append(
                    (
                        str(model),
                        str(group),
                        str(name),
                        *(size(float(v), unit, 4, like=float(of_name["constant_mean"])) for v in values),
                    )
                )
    head = ("model", "group", "constant", "mode", "mean", "standard deviation", "5 %", "95 %")
    return Table(head, rows, text=frozenset({0, 1, 2}))


def priors(results: Results) -> Table:
    """The candidates with the priors of their constants."""
    study: Comparison = results.study
    rows = []
    for name, candidate in study.candidates.items():
        for constant, distribution in candidate.parameters.items():
            block = distribution.model_dump()
            unit = results.parameter_unit(constant, name)
            rows.append((name, study.described(name), constant, f"{block['kind']}: {settings(block, 'kind')}", unit))
    return Table(("candidate", "model", "constant", "prior", "unit"), rows, text=frozenset(range(5)))
