"""How well candidates fit: constants, curves, residuals, tests held out."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from forward.readable import size
from forward.words import NONE, named, number, settings, with_error
from workflows.report.blocks import Block, Heading, Picture, Pictures, Table, Text
from workflows.report.plots import selection as plots
from workflows.report.plots.figure import text_of
from workflows.report.section import Results, Section, written
from workflows.studies.selection_results import by_probability, chance, conflicts, ranking

if TYPE_CHECKING:
    import xarray as xr

    from workflows.studies.selection import Comparison


class Constants(Section):
    """Constants of the models: posteriors and priors."""

    needs = ("probability",)

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
        if study.data.source:
            yield Heading("Data", level=3)
            yield Text("\n".join(study.data.source))


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


class Criticism(Section):
    """Predictions of left-out data, and residuals."""

    needs = ("probability",)

    def content(self, results: Results) -> Iterator[Block]:
        """Tables of scores."""
        yield Heading("Is the best one good?")
        yield Text(
            "Each datum is left out and predicted from the others, by weights that are judged in the same way; "
            "residuals are compared with those of a true model."
        )
        yield criticism(results.dataset)


def criticism(dataset: xr.Dataset) -> Table:
    """Predictive scores and checks."""
    rows = []
    for model in ranking(dataset["score"]):
        one = dataset.sel(model=model)
        behind = float(one["score_behind"])
        rows.append(
            (
                model,
                written(one, "score"),
                written(one, "score_behind") if behind else NONE,
                number(float(one["score_tail"]), 2),
                "yes" if bool(one["score_trusted"]) else "no",
                *(chance(float(one[f"{what}_probability"].min())) for what in ("misfit", "correlation")),
                "; ".join(conflicts(dataset, model)) or "none",
            )
        )
    head = (
        "model",
        "Σ ln p(left-out datum)",
        "behind the best",
        "largest k̂",
        "to be trusted",
        "p of larger residuals",
        "p of neighbours that agree more",
        "conflict",
    )
    return Table(head, rows, text=frozenset({0, 4, 7}), long=frozenset({7}))


class HeldOut(Section):
    """Whole tests, predicted from the others."""

    needs = ("held_out_score",)

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Text("Whole tests, predicted from the others: ln of the density of all data in the test.")
        yield held_out(results.dataset)


def held_out(dataset: xr.Dataset) -> Table:
    """Predictive scores of whole tests."""
    scores, errors = dataset["held_out_score"], dataset["held_out_score_error"]
    rows = []
    for model in ranking(scores.sum("left_out")):
        cells = [
            with_error(float(value), float(error))
            for value, error in zip(scores.sel(model=model).values, errors.sel(model=model).values, strict=True)
        ]
        total = with_error(float(scores.sel(model=model).sum()), float(np.sqrt((errors.sel(model=model) ** 2).sum())))
        rows.append((model, *cells, total))
    return Table(("model", *map(str, dataset.left_out.values), "sum"), rows)


class Curves(Section):
    """Curves over the data, or residuals."""

    needs = ("probability",)

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
