"""Evidence and probability of each model, and how each was found."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from forward.words import number, with_error
from workflows.report.blocks import Block, Heading, Picture, Pictures, Table, Text
from workflows.report.plots import selection as plots
from workflows.report.section import Results, Section
from workflows.studies.findings_selection import bayes_factor, grade, ranking

if TYPE_CHECKING:
    import xarray as xr


class Evidences(Section):
    """Evidence and probability of each model, and how each was found."""

    def applies(self, results: Results) -> bool:
        """Whether models were compared."""
        return "probability" in results.dataset

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
        drawn = plots.evidence_bars(dataset), plots.probability_bars(dataset)
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
            with_error(float(of_model["log_evidence"]), float(of_model["log_evidence_error"])),
            number(float(of_model["laplace_log_evidence"].sum()), 6),
            "" if model == order[0] else with_error(ln_B, error),
            "" if model == order[0] else grade(ln_B),
            f"{number(100 * float(of_model['prior_probability']), 3)} %",
            f"{number(100 * float(of_model['probability']), 4)} %",
        ]
        if stacked:
            share, error = (100 * float(of_model[name]) for name in ("stacking", "stacking_error"))
            row.append(f"{with_error(share, error)} %")
        if nested:
            value = float(of_model["nested_log_evidence"].sum())
            row.append(with_error(value, float(np.sqrt((of_model["nested_log_evidence_error"] ** 2).sum()))))
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
                    with_error(float(one["group_log_evidence"]), float(one["group_log_evidence_error"])),
                    str(one["route"].item()),
                    str(one["why"].item()),
                    number(float(one["effective"]), 3),
                    number(float(one["tail"]), 2),
                    "yes" if bool(one["trusted"]) else "no",
                )
            )
    head = ("model", "group", "ln Z", "route", "because", "effective points", "k̂", "to be trusted")
    return Table(head, rows, text=frozenset({0, 1, 3, 4, 7}), long=frozenset({4}))
