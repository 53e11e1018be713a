"""How well candidates fit: constants, curves, residuals, tests held out."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from forward.readable import size
from forward.words import NONE, named, number, settings, with_error
from workflows.report.blocks import Block, Heading, Pictures, Table, Text
from workflows.report.plots import selection as plots
from workflows.report.plots.figure import text_of
from workflows.report.section import Results, section, written
from workflows.studies.selection_results import by_probability, chance, conflicts, ranking

if TYPE_CHECKING:
    from workflows.studies.selection import Comparison


@section("probability")
def constants(results: Results) -> Iterator[Block]:
    """Constants of the models: posteriors and priors."""
    dataset, study = results.dataset, results.study
    yield Heading("Constants")
    yield posteriors(results)
    several, best = dataset.sizes["group"] > 1, by_probability(dataset, dataset["log_evidence"])[0]
    yield Heading("Posteriors of the constants" + (f" of {best}" if several else ""), level=3)
    pairs = [(str(m), str(g)) for m in dataset.model.values for g in dataset.group.values]
    yield Pictures.of(
        *(
            (plots.corner(dataset, model, group, study.units_of(model)), f"{model}{f' ({group})' if several else ''}")
            for model, group in pairs
            if not several or model == best
        )
    )
    yield Heading("Candidates and priors", level=3)
    yield priors(results)
    if study.data.source:
        yield Heading("Data", level=3)
        yield Text("\n".join(study.data.source))


def posteriors(results: Results) -> Table:
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
                like = float(of_name["constant_mean"])
                rows.append((str(model), str(group), str(name), *(size(float(v), unit, 4, like=like) for v in values)))
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


@section("probability")
def criticism(results: Results) -> Iterator[Block]:
    """Predictions of left-out data, and residuals."""
    yield Heading("Is the best one good?")
    yield Text(
        "Each datum is left out and predicted from the others, by weights that are judged in the same way; "
        "residuals are compared with those of a true model."
    )
    dataset = results.dataset
    yield Table.of(
        [dataset.sel(model=model) for model in ranking(dataset["score"])],
        {
            "model": lambda one: str(one["model"].item()),
            "Σ ln p(left-out datum)": lambda one: written(one, "score"),
            "behind the best": lambda one: written(one, "score_behind") if float(one["score_behind"]) else NONE,
            "largest k̂": lambda one: number(float(one["score_tail"]), 2),
            "to be trusted": lambda one: "yes" if bool(one["score_trusted"]) else "no",
            "p of larger residuals": lambda one: chance(float(one["misfit_probability"].min())),
            "p of neighbours that agree more": lambda one: chance(float(one["correlation_probability"].min())),
            "conflict": lambda one: "; ".join(conflicts(dataset, str(one["model"].item()))) or "none",
        },
        text={0, 4, 7},
        long={7},
    )


@section("held_out_score")
def held_out(results: Results) -> Iterator[Block]:
    """Whole tests, predicted from the others."""
    yield Text("Whole tests, predicted from the others: ln of the density of all data in the test.")
    dataset = results.dataset
    scores, errors = dataset["held_out_score"], dataset["held_out_score_error"]
    rows = []
    for model in ranking(scores.sum("left_out")):
        cells = [
            with_error(float(value), float(error))
            for value, error in zip(scores.sel(model=model).values, errors.sel(model=model).values, strict=True)
        ]
        total = with_error(float(scores.sel(model=model).sum()), float(np.sqrt((errors.sel(model=model) ** 2).sum())))
        rows.append((model, *cells, total))
    yield Table(("model", *map(str, dataset.left_out.values), "sum"), rows)


@section("probability")
def curves(results: Results) -> Iterator[Block]:
    """Curves over the data, or residuals."""
    dataset, study = results.dataset, results.study
    tests = list(dict.fromkeys(zip(dataset["output_group"].values, dataset["output_test"].values, strict=True)))
    if dataset.attrs["quantity"] == "stress":
        yield Heading("Curves over the data")
        several = dataset.sizes["group"] > 1
        captions = [f"{test}{f' of {group}' if several else ''}: mean and 90 % band." for group, test in tests]
        drawn = [plots.curves(dataset, str(group), str(test)) for group, test in tests]
        yield Pictures.of(*zip(drawn, captions, strict=True), small=True)
        return
    paths = dict(_paths(results, [str(test) for _, test in tests]))
    if paths:
        yield Heading("Curves over the data")
        captions = [f"{name} over the path: mean and 90 % band of each model." for name in paths]
        drawn = [plots.along(dataset, *of) for of in paths.values()]
        yield Pictures.of(*zip(drawn, captions, strict=True))
    on_paths = {test for places, *_ in paths.values() for test in places}
    left = [str(test) for _, test in tests if str(test) not in on_paths]
    if left:
        yield Heading("Residuals")
        captions = [f"{test}: measured minus predicted, over the errors." for test in left]
        drawn = [plots.residuals(dataset, test, of=study.measured_in(test)) for test in left]
        yield Pictures.of(*zip(drawn, captions, strict=True), small=True)


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
