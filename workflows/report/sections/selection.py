"""Evidences, what they depend on, and what averages over candidates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from forward.readable import percent, size
from forward.words import number, with_error
from uq.estimators.estimate import estimate_of, single
from workflows.report.blocks import Block, Folded, Heading, Pictures, Table, Text
from workflows.report.plots import selection as plots
from workflows.report.plots.moments import WORDS
from workflows.report.section import Results, section, written
from workflows.studies.selection_results import bayes_factor, grade, ranking

if TYPE_CHECKING:
    import xarray as xr


@section("probability")
def evidences(results: Results) -> Iterator[Block]:
    """Evidence and probability of each model, and how each was found."""
    from inverse.criticism.weights import RULE

    dataset = results.dataset
    yield Heading("Evidences and probabilities")
    yield Text(
        "± is one standard error. Laplace's formula is shown beside the corrected evidence; the words for Bayes "
        "factors are those of Kass and Raftery. Probabilities say which candidate is true, if one is; the weights "
        "of stacking are those with which their mixture predicts left-out data best, whether or not one is true."
    )
    yield _evidences(dataset)
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


def _evidences(dataset: xr.Dataset) -> Table:
    """Evidence, Bayes factor and probability of each model, nested sampling beside it."""
    order = ranking(dataset["log_evidence"])
    nested, stacked = "nested_log_evidence" in dataset, "stacking" in dataset
    of = {model: dataset.sel(model=model) for model in order}

    def stacking(model: str) -> str:
        share = single(of[model], "stacking")
        return f"{with_error(100 * share.value, 100 * share.error)} %"

    def sampled(model: str) -> str:
        found = estimate_of(of[model], "nested_log_evidence")
        return with_error(float(np.nansum(found.value)), float(np.sqrt(np.nansum(found.error**2))))

    return replace(
        Table.of(
            order,
            {
                "model": str,
                "ln Z": lambda model: written(of[model], "log_evidence"),
                "by Laplace alone": lambda model: number(float(of[model]["laplace_log_evidence"].sum()), 6),
                "ln of the first's Bayes factor": lambda model: (
                    "" if model == order[0] else with_error(*bayes_factor(dataset, order[0], model))
                ),
                "which is": lambda model: "" if model == order[0] else grade(bayes_factor(dataset, order[0], model)[0]),
                "before": lambda model: f"{number(100 * float(of[model]['prior_probability']), 3)} %",
                "P(model | data)": lambda model: f"{number(100 * float(of[model]['probability']), 4)} %",
                **({"stacking": stacking} if stacked else {}),
                **({"ln Z by nested sampling": sampled} if nested else {}),
            },
            text={0, 4},
        ),
        strong=0,
    )


@section("probability")
def dependence(results: Results) -> Iterator[Block]:
    """Evidences with other errors, other data and other priors."""
    yield Heading("What the evidences depend on")
    yield Text(
        "Probability of each model with other errors, other data, and priors of half and twice the width (in "
        "standard normal coordinates)."
    )
    dataset = results.dataset
    models = [str(model) for model in dataset.model.values]
    chances = dataset["variant_probability"].transpose("variant", "model").to_numpy()
    names = [str(variant) for variant in dataset.variant.values]
    yield Table(("", *models), [(n, *(percent(float(p)) for p in row)) for n, row in zip(names, chances, strict=True)])
    of = [[dataset.sel(model=model, variant=name) for name in names] for model in models]  # models have longer names
    rows = [(model, *(written(o, "variant_log_evidence") for o in row)) for model, row in zip(models, of, strict=True)]
    yield Folded("Their evidences, ln Z", [Table(("ln Z", *names), rows)])


UNITS = {"stress": "Pa", "displacement": "m"}  # outputs have their own


@section("probability")
def averages(results: Results) -> Iterator[Block]:
    """Predictions averaged over the models."""
    yield Heading("Averaged predictions")
    yield Text("At the end of each test, or where the largest displacement was measured, without measurement errors.")
    dataset = results.dataset
    quantity, last = str(dataset.attrs["quantity"]), last_of_tests(dataset)
    specs = getattr(results.study, "of_candidates", {})
    units = {output.name: output.unit for spec in [*specs.values()][:1] for output in spec.returned}
    rows = []
    for one in last.values():
        unit = UNITS.get(quantity) or units.get(str(one["output_test"].item()), "1")
        means = (size(float(one[name]), unit, 4) for name in ("measured", "average_mean"))
        stds = (size(np.sqrt(float(one[f"average_{part}"])), unit, 3) for part in plots.PARTS)
        at = number(float(one["output_at"]))
        rows.append((str(one["output_group"].item()), str(one["output_test"].item()), at, *means, *stds))
    place = "at" if quantity == "stress" else "datum"
    head = ("group", "test", place, "measured", "averaged prediction", "spread within models", "spread between models")
    yield Table(head, rows, text=frozenset({0, 1}))
    caption = "Parts of the variance: within the models, and between them: what it matters which of them is right."
    yield Pictures.of((plots.within_and_between(last), caption))


def last_of_tests(dataset: xr.Dataset) -> dict[str, xr.Dataset]:
    """Return the last datum of each test, or the largest displacement, by group and test."""
    found = {}
    tests = list(zip(dataset["output_group"].values, dataset["output_test"].values, strict=True))
    for group, test in dict.fromkeys(tests):
        members = [i for i, pair in enumerate(tests) if pair == (group, test)]
        at = dataset["output_at"].values[members]
        # Displacement data have only numbers: take the largest displacement.
        stress = dataset.attrs["quantity"] == "stress"
        far = np.abs(at - at[0]) if stress else np.abs(dataset["measured"].values[members])
        found[f"{group}, {test}"] = dataset.isel(output=members[int(np.argmax(far))])
    return found


@section("candidate_mean")
def averaged_candidates(results: Results) -> Iterator[Block]:
    """A table for each output, and a bar of the parts of its variance."""
    of = results.dataset
    yield Heading("Averaged over candidates")
    stacked = of.attrs.get("weights") == "stacked"
    what = "weight in the mixture that predicts left-out data best" if stacked else "probability"
    yield Text(
        f"Each candidate predicts with its own posterior, and counts by its {what}. The variance is that "
        "within the candidates, and that between their means: what it matters which of them is right."
    )
    for output in results.drawn:
        unit, rows = results.unit(output), []
        for name in map(str, of["candidate"].values):
            one = of.sel(candidate=name, output=output)
            share = f"{100 * float(one['candidate_probability']):.3g} %"
            rows.append((name, share, *(written(one, f"candidate_{moment}", unit) for moment in WORDS)))
        rows.append(("all", "100 %", *(results.estimate(output, moment) for moment in WORDS)))
        yield Heading(output, level=3)
        yield Table(("candidate", "weight" if stacked else "probability", *WORDS.values()), rows)
    caption = "Parts of the variance: within each candidate, by what it counts, and between candidates."
    yield Pictures.of((plots.parts_of_variance(of), caption))
