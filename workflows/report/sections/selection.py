"""Evidences, what they depend on, and what averages over candidates."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from forward.readable import percent, size
from forward.words import number, with_error
from uq.estimators.estimate import estimate_of, single
from workflows.report import plots
from workflows.report.blocks import Block, Folded, Heading, Picture, Pictures, Table, Text
from workflows.report.plots import selection as selection_plots
from workflows.report.plots.averaged import within_and_between
from workflows.report.section import Results, Section, written
from workflows.studies.selection_results import bayes_factor, grade, ranking

if TYPE_CHECKING:
    import xarray as xr


class Evidences(Section):
    """Evidence and probability of each model, and how each was found."""

    needs = ("probability",)

    def content(self, results: Results) -> Iterator[Block]:
        """Tables, pictures, routes and meshes."""
        from inverse.criticism.weights import RULE

        dataset = results.dataset
        yield Heading("Evidences and probabilities")
        yield Text(
            "± is one standard error. Laplace's formula is shown beside the corrected evidence; the words for Bayes "
            "factors are those of Kass and Raftery. Probabilities say which candidate is true, if one is; the weights "
            "of stacking are those with which their mixture predicts left-out data best, whether or not one is true."
        )
        yield evidences(dataset)
        captions = (
            "ln Z minus that of the most probable model, with three standard errors.",
            "Probability of each model, and with other errors, data and priors.",
        )
        drawn = selection_plots.evidence_bars(dataset), selection_plots.probability_bars(dataset)
        yield Pictures([Picture.drawn(ax, caption) for ax, caption in zip(drawn, captions, strict=True)], small=True)
        yield Heading("How each was found", level=3)
        yield Text(RULE)
        yield routes(dataset)


def evidences(dataset: xr.Dataset) -> Table:
    """Evidence, Bayes factor and probability of each model, nested sampling beside it."""
    order = ranking(dataset["log_evidence"])
    nested, stacked = "nested_log_evidence" in dataset, "stacking" in dataset
    rows = []
    for model in order:
        of_model = dataset.sel(model=model)
        ln_B, error = bayes_factor(dataset, order[0], model)
        row = [
            model,
            written(of_model, "log_evidence"),
            number(float(of_model["laplace_log_evidence"].sum()), 6),
            "" if model == order[0] else with_error(ln_B, error),
            "" if model == order[0] else grade(ln_B),
            f"{number(100 * float(of_model['prior_probability']), 3)} %",
            f"{number(100 * float(of_model['probability']), 4)} %",
        ]
        if stacked:
            share = single(of_model, "stacking")
            row.append(f"{with_error(100 * share.value, 100 * share.error)} %")
        if nested:
            found = estimate_of(of_model, "nested_log_evidence")
            row.append(with_error(float(np.nansum(found.value)), float(np.sqrt(np.nansum(found.error**2)))))
        rows.append(row)
    head = [
        "model",
        "ln Z",
        "by Laplace alone",
        "ln of the first's Bayes factor",
        "which is",
        "before",
        "P(model | data)",
        *(["stacking"] if stacked else []),
    ]
    return Table([*head, *(["ln Z by nested sampling"] if nested else [])], rows, text=frozenset({0, 4}), strong=0)


def routes(dataset: xr.Dataset) -> Table:
    """How each evidence was found, and the quality of its weights."""
    rows = []
    for model in dataset.model.values:
        for group in dataset.group.values:
            one = dataset.sel(model=model, group=group)
            rows.append(
                (
                    str(model),
                    str(group),
                    written(one, "group_log_evidence"),
                    str(one["route"].item()),
                    str(one["why"].item()),
                    number(float(one["effective"]), 3),
                    number(float(one["tail"]), 2),
                    "yes" if bool(one["trusted"]) else "no",
                )
            )
    head = ("model", "group", "ln Z", "route", "because", "effective points", "k̂", "to be trusted")
    return Table(head, rows, text=frozenset({0, 1, 3, 4, 7}), long=frozenset({4}))


class Dependence(Section):
    """Evidences with other errors, other data and other priors."""

    needs = ("probability",)

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("What the evidences depend on")
        yield Text(
            "Probability of each model with other errors, other data, and priors of half and twice the width (in "
            "standard normal coordinates)."
        )
        dataset = results.dataset
        models = [str(model) for model in dataset.model.values]
        chances = dataset["variant_probability"].transpose("variant", "model").to_numpy()
        names = [str(variant) for variant in dataset.variant.values]
        yield Table(
            ("", *models), [(n, *(percent(float(p)) for p in row)) for n, row in zip(names, chances, strict=True)]
        )
        yield Folded("Their evidences, ln Z", [variants(dataset)])


def variants(dataset: xr.Dataset) -> Table:
    """Evidence of each model, a column for each variant: models have longer names than there are of them."""
    names = [str(variant) for variant in dataset.variant.values]
    rows = []
    for model in dataset.model.values:
        one = dataset.sel(model=model)
        rows.append((str(model), *(written(one.sel(variant=name), "variant_log_evidence") for name in names)))
    return Table(("ln Z", *names), rows)


UNITS = {"stress": "Pa", "displacement": "m"}  # outputs have their own


class Averages(Section):
    """Predictions averaged over the models."""

    needs = ("probability",)

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("Averaged predictions")
        yield Text(
            "At the end of each test, or where the largest displacement was measured, without measurement errors."
        )
        yield averages(results)
        caption = "Parts of the variance: within the models, and between them: what it matters which of them is right."
        yield Pictures([Picture.drawn(within_and_between(last_of_tests(results.dataset)), caption)])


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


def averages(results: Results) -> Table:
    """Predictions averaged over the models at the end of each test, with both parts of their variance."""
    rows, dataset = [], results.dataset
    quantity = str(dataset.attrs["quantity"])
    specs = getattr(results.study, "of_candidates", {})
    units = {output.name: output.unit for spec in [*specs.values()][:1] for output in spec.returned}
    for one in last_of_tests(dataset).values():
        unit = UNITS.get(quantity) or units.get(str(one["output_test"].item()), "1")
        stds = (np.sqrt(float(one[name])) for name in ("average_within", "average_between"))
        rows.append(
            (
                str(one["output_group"].item()),
                str(one["output_test"].item()),
                number(float(one["output_at"])),
                size(float(one["measured"]), unit, 4),
                size(float(one["average_mean"]), unit, 4),
                *(size(std, unit, 3) for std in stds),
            )
        )
    place = "at" if quantity == "stress" else "datum"
    head = ("group", "test", place, "measured", "averaged prediction", "spread within models", "spread between models")
    return Table(head, rows, text=frozenset({0, 1}))


class AveragedCandidates(Section):
    """A table for each output, and a bar of the parts of its variance."""

    needs = ("candidate_mean",)

    def content(self, results: Results) -> Iterator[Block]:
        """The tables, then the bars."""
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
                rows.append((name, share, *(written(one, f"candidate_{m}", unit) for m in MOMENTS)))
            rows.append(("all", "100 %", *(results.estimate(output, m) for m in MOMENTS)))
            yield Heading(output, level=3)
            yield Table(("candidate", "weight" if stacked else "probability", "mean", "standard deviation"), rows)
        caption = "Parts of the variance: within each candidate, by what it counts, and between candidates."
        yield Pictures([Picture.drawn(plots.parts_of_variance(of), caption)])


MOMENTS = ("mean", "std")
