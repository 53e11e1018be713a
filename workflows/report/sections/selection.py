"""Candidates: evidences, what they depend on, how well each fits, and what averages over all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from forward.readable import NONE, named, number, percent, size, with_error
from uq.estimators.estimate import estimate_of, single
from workflows.report.blocks import Block, Folded, Heading, Pictures, Table, Text
from workflows.report.plots import selection as plots
from workflows.report.plots.figure import text_of
from workflows.report.plots.outputs import WORDS
from workflows.report.section import Results, section, written
from workflows.report.words import law
from workflows.results.comparison import bayes_factor, by_probability, chance, conflicts, grade, ranking

if TYPE_CHECKING:
    import xarray as xr

    from workflows.studies.selection import Selection

UNITS = {"stress": "Pa", "displacement": "m"}  # outputs have their own


@section("probability", heading="Evidences and probabilities")
def evidences(results: Results) -> Iterator[Block]:
    """Evidence and probability of each model, and how each was found."""
    from inverse.criticism.weights import RULE

    dataset = results.dataset
    yield Text(
        "± is one standard error. Laplace's formula is shown beside the corrected evidence; the words for Bayes "
        "factors are those of Kass and Raftery. Probabilities say which candidate is true, if one is; the weights "
        "of stacking are those with which their mixture predicts left-out data best, whether or not one is true."
    )
    order = ranking(dataset["log_evidence"])
    of = {model: dataset.sel(model=model) for model in order}
    factors = {model: bayes_factor(dataset, order[0], model) for model in order[1:]}

    def stacking(model: str) -> str:
        share = single(of[model], "stacking")
        return f"{with_error(100 * share.value, 100 * share.error)} %"

    def sampled(model: str) -> str:
        found = estimate_of(of[model], "nested_log_evidence")
        return with_error(float(np.nansum(found.value)), float(np.sqrt(np.nansum(found.error**2))))

    columns: dict[str, Callable[[str], str]] = {
        "model": str,
        "ln Z": lambda model: written(of[model], "log_evidence"),
        "by Laplace alone": lambda model: number(float(of[model]["laplace_log_evidence"].sum()), 6),
        "ln of the first's Bayes factor": lambda model: with_error(*factors[model]) if model in factors else "",
        "which is": lambda model: grade(factors[model][0]) if model in factors else "",
        "before": lambda model: f"{number(100 * float(of[model]['prior_probability']), 3)} %",
        "P(model | data)": lambda model: f"{number(100 * float(of[model]['probability']), 4)} %",
        **({"stacking": stacking} if "stacking" in dataset else {}),
        **({"ln Z by nested sampling": sampled} if "nested_log_evidence" in dataset else {}),
    }
    yield replace(Table.of(order, columns, text={0, 4}), strong=0)
    yield Pictures.of(
        (plots.evidence_bars(dataset), "ln Z minus that of the most probable model, with three standard errors."),
        (plots.probability_bars(dataset), "Probability of each model, and with other errors, data and priors."),
        small=True,
    )
    yield Heading("How each was found", level=3)
    yield Text(RULE)
    yield Table.of(
        [dataset.sel(model=model, group=group) for model in dataset.model.values for group in dataset.group.values],
        {
            "model": lambda one: str(one["model"].item()),
            "group": lambda one: str(one["group"].item()),
            "ln Z": lambda one: written(one, "group_log_evidence"),
            "route": lambda one: str(one["route"].item()),
            "because": lambda one: str(one["why"].item()),
            "effective points": lambda one: number(float(one["effective"]), 3),
            "k̂": lambda one: number(float(one["tail"]), 2),
            "to be trusted": lambda one: "yes" if bool(one["trusted"]) else "no",
        },
        text={0, 1, 3, 4, 7},
        long={4},
    )


@section("probability", heading="What the evidences depend on")
def dependence(results: Results) -> Iterator[Block]:
    """Evidences with other errors, other data and other priors."""
    yield Text(
        "Probability of each model with other errors, other data, and priors of half and twice the width (in "
        "standard normal coordinates)."
    )
    dataset = results.dataset
    models, names = ([str(name) for name in dataset[over].values] for over in ("model", "variant"))
    chances = dataset["variant_probability"].transpose("variant", "model").to_numpy()
    yield Table(("", *models), [(n, *(percent(float(p)) for p in row)) for n, row in zip(names, chances, strict=True)])
    of = [[dataset.sel(model=model, variant=name) for name in names] for model in models]  # models have longer names
    rows = [(model, *(written(o, "variant_log_evidence") for o in row)) for model, row in zip(models, of, strict=True)]
    yield Folded("Their evidences, ln Z", [Table(("ln Z", *names), rows)])


@section("probability", heading="Averaged predictions")
def averages(results: Results) -> Iterator[Block]:
    """Predictions averaged over the models."""
    yield Text("At the end of each test, or where the largest displacement was measured, without measurement errors.")
    dataset, rows = results.dataset, []
    stress, study = dataset.attrs["quantity"] == "stress", results.study
    units = {output.name: output.unit for spec in [*study.of_candidates.values()][:1] for output in spec.returned}
    tests = _tests(dataset)
    for group, test in dict.fromkeys(tests):
        members = [i for i, pair in enumerate(tests) if pair == (group, test)]
        at = dataset["output_at"].values[members]
        # Displacement data have only numbers: take the largest displacement.
        far = np.abs(at - at[0]) if stress else np.abs(dataset["measured"].values[members])
        one = dataset.isel(output=members[int(np.argmax(far))])
        unit = UNITS.get(str(dataset.attrs["quantity"])) or units.get(test, "1")
        means = (size(float(one[name]), unit, 4) for name in ("measured", "average_mean"))
        stds = (size(np.sqrt(float(one[f"average_{part}"])), unit, 3) for part in ("within", "between"))
        rows.append((group, test, number(float(one["output_at"])), *means, *stds))
    place = "at" if stress else "datum"
    head = ("group", "test", place, "measured", "averaged prediction", "spread within models", "spread between models")
    yield Table(head, rows, text={0, 1})


def _tests(dataset: xr.Dataset) -> list[tuple[str, str]]:
    """Name the group and the test of each datum."""
    groups, tests = (map(str, dataset[name].values) for name in ("output_group", "output_test"))
    return list(zip(groups, tests, strict=True))


@section("candidate_mean", heading="Averaged over candidates")
def averaged_candidates(results: Results) -> Iterator[Block]:
    """A table for each output, and a bar of the parts of its variance."""
    of = results.dataset
    stacked = of.attrs.get("weights") == "stacked"
    what = "weight in the mixture that predicts left-out data best" if stacked else "probability"
    yield Text(
        f"Each candidate predicts with its own posterior, and counts by its {what}. The variance is that "
        "within the candidates, and that between their means: what it matters which of them is right."
    )
    for output in results.drawn:
        rows = []
        for name in map(str, of["candidate"].values):
            one = of.sel(candidate=name, output=output)
            share = f"{100 * float(one['candidate_probability']):.3g} %"
            cells = (written(one, f"candidate_{moment}", results.unit(output)) for moment in WORDS)
            rows.append((name, share, *cells))
        rows.append(("all", "100 %", *(results.estimate(output, moment) for moment in WORDS)))
        yield Heading(output, level=3)
        yield Table(("candidate", "weight" if stacked else "probability", *WORDS.values()), rows)
    caption = "Parts of the variance: within each candidate, by what it counts, and between candidates."
    yield Pictures.of((plots.parts_of_variance(of), caption))


@section("probability", heading="Constants")
def constants(results: Results) -> Iterator[Block]:
    """Constants of the models: posteriors and priors."""
    dataset, study, rows = results.dataset, results.study, []
    models, groups = ([str(name) for name in dataset[of].values] for of in ("model", "group"))
    for model, group, name in product(models, groups, results.parameters):
        one = dataset.sel(model=model, group=group, parameter=name)
        mode, mean, std = (float(one[f"constant_{which}"]) for which in ("mode", "mean", "std"))
        if np.isfinite(mode):
            unit = results.parameter_unit(name, model)
            values = (mode, mean, std, *one["constant_quantiles"].to_numpy().tolist())
            rows.append((model, group, name, *(size(value, unit, 4, like=mean) for value in values)))
    head = ("model", "group", "constant", "mode", "mean", "standard deviation", "5 %", "95 %")
    yield Table(head, rows, text={0, 1, 2})
    several, best = len(groups) > 1, by_probability(dataset, dataset["log_evidence"])[0]
    yield Heading("Posteriors of the constants" + (f" of {best}" if several else ""), level=3)
    drawn = []
    for model, group in product([best] if several else models, groups):
        ax = plots.corner(dataset, model, group, study.units_of(model))
        drawn.append((ax, f"{model}{f' ({group})' if several else ''}"))
    yield Pictures.of(*drawn)
    yield Heading("Candidates and priors", level=3)
    rows = [
        (name, study.described(name), constant, law(prior.model_dump()), results.parameter_unit(constant, name))
        for name, one in study.candidates.items()
        for constant, prior in one.parameters.items()
    ]
    yield Table(("candidate", "model", "constant", "prior", "unit"), rows, text=range(5))
    if study.data.source:
        yield Heading("Data", level=3)
        yield Text("\n".join(study.data.source))


@section("probability", heading="Is the best one good?")
def criticism(results: Results) -> Iterator[Block]:
    """Predictions of left-out data, and residuals."""
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
    rows = []
    for model in ranking(dataset["held_out_score"].sum("left_out")):
        scores = estimate_of(dataset.sel(model=model), "held_out_score")
        cells = (with_error(*of) for of in zip(scores.value.tolist(), scores.error.tolist(), strict=True))
        total = with_error(float(scores.value.sum()), float(np.sqrt((scores.error**2).sum())))
        rows.append((model, *cells, total))
    yield Table(("model", *map(str, dataset.left_out.values), "sum"), rows)


@section("probability")
def curves(results: Results) -> Iterator[Block]:
    """Curves over the data, or residuals."""
    dataset, study = results.dataset, results.study
    tests, words = list(dict.fromkeys(_tests(dataset))), "mean and 90 % band of each model."
    if dataset.attrs["quantity"] == "stress":
        yield Heading("Curves over the data")
        names = ", ".join(dict.fromkeys(test for _, test in tests))
        yield Pictures.of((plots.fits(dataset, tests), f"{names}: {words}"))
        return
    paths = dict(_paths(results, [test for _, test in tests]))
    if paths:
        yield Heading("Curves over the data")
        drawn = ((plots.along(dataset, *of), f"{name} over the path: {words}") for name, of in paths.items())
        yield Pictures.of(*drawn)
    on_paths = {test for places, *_ in paths.values() for test in places}
    left = [test for _, test in tests if test not in on_paths]
    if left:
        yield Heading("Residuals")
        words = "measured minus predicted, over the errors."
        drawn = ((plots.residuals(dataset, test, of=study.measured_in(test)), f"{test}: {words}") for test in left)
        yield Pictures.of(*drawn, small=True)


def _paths(results: Results, tests: list[str]) -> Iterator[tuple[str, tuple[dict[str, float], str, str]]]:
    """Go through outputs that were measured along a path: by name, where each of their tests is, and both axes."""
    from inverse.data.outputs import steps_of

    study: Selection = results.study
    steps = next(map(steps_of, study.of_candidates.values()), None)
    if steps is None:
        return
    path, (unit, values) = next(iter(steps.numbers.items()))
    for name in steps.units:
        places = {test: value for k, value in enumerate(values, 1) if (test := f"{name}.{k}") in tests}
        if len(places) > 1:
            yield name, (places, named(text_of(path), unit), named(text_of(name), steps.units[name]))
