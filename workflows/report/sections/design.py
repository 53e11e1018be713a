"""Observations that were chosen before they are made."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from forward.readable import place, size
from forward.words import NONE, number
from workflows.report.blocks import Answer, Block, Card, Heading, Picture, Pictures, Table, Text
from workflows.report.plots import design as plots
from workflows.report.section import Results, Section
from workflows.results.summary import against_random

WORTH = {
    "information": "What they tell (nat)",
    "parameters": "Share of the parameters' variances that they take away",
    "predictions": "Share of the predictions' variances that they take away",
    "models": "Expected ln Bayes factor of the true model (nat)",
}
FIRST = 5  # observations on the card


class ChosenObservations(Section):
    """Pictures and a table of the chosen observations, and what they leave of the unknowns."""

    def applies(self, results: Results) -> bool:
        """Whether observations were chosen."""
        return "chosen" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """How many random ones they are worth, where they are, and each of them."""
        found, design = results.dataset, results.summary["design"]
        against = against_random(design)
        yield Heading("Which observations tell most")
        method, known = results.study.method, number(float(found["information"][-1]))
        tell = (
            f"If one of the models is true, its expected ln Bayes factor against another is {known} nat"
            if method.criterion == "models"
            else f"Together they tell {known} nat on average over the draws of what is not known"
        )
        yield Text(
            f"{against[0].upper()}{against[1:]}. {tell}. They are in design.csv in their order.",
            "lead",
        )
        ax = plots.against_number(found, WORTH[method.criterion])
        drawn = [Picture.drawn(ax, "Chosen observations, and the band of 90 % of random ones.")]
        if np.isfinite(found["candidate_place"].to_numpy()[found["chosen"].to_numpy()]).all(axis=1).any():
            bounds = results.study.specs[0].body.bounds
            drawn.append(Picture.drawn(plots.on_body(found, bounds), "Candidates and chosen points, in their order."))
        yield Pictures(drawn)
        yield _table(results)
        if "log_bayes_factor" in found:
            names = [str(name) for name in found["model"].values]
            cells = found["log_bayes_factor"].to_numpy()
            rows = [(name, *(number(float(x)) for x in row)) for name, row in zip(names, cells, strict=True)]
            yield Text("Expected ln Bayes factor (nat) of a model that is true against each other one:")
            yield Table(("true", *names), rows)
        if "field_variance_told" in found:
            share = number(100 * float(found["field_variance_told"][-1]), 3)
            yield Text(f"Share of the variance of the field over the body that they take away: {share} %.")
        if "posterior_std" in found:
            rows = [
                (
                    name,
                    *(
                        size(float(one[f"{which}_std"]), unit, 3, like=float(one["prior_std"]))
                        for which in ("prior", "posterior")
                    ),
                )
                for name in results.leading(found["posterior_std"] / found["prior_std"])
                for one, unit in [(found.sel(parameter=name), results.parameter_unit(name))]
            ]
            yield Text("Standard deviations before and after all chosen observations, by the linearised models:")
            yield Table(("parameter", "before", "after"), rows)


def card(results: Results) -> Card:
    """The first of the chosen observations, and what all are worth."""
    found, design = results.dataset, results.summary["design"]
    together = f"{number(float(found['information'][-1]), 3)} nat"
    lines = [against_random(design)]
    if "log_bayes_factor" not in found:
        lines.append("with 1 nat one unknown, or a combination of them, is known e = 2.7 times better")
    if found.sizes["choice"] > FIRST:
        lines.append(f"the first {FIRST} are shown here, all in the table below")
    answers = [Answer(f"{found.sizes['choice']} observations", together, lines)]
    for k, one in enumerate(design["chosen"][:FIRST], start=1):
        where = [] if None in one["place"] else [f"at ({place(one['place'])})"]
        case = [f"load case {one['case']}"] if one["case"] else []
        answers.append(Answer(f"{k}. {one['name']}", f"+{number(one['gain'], 2)} nat", [*case, *where]))
    return Card("Which observations tell most of what is not known?", answers)


def _table(results: Results) -> Table:
    rows = []
    for k, one in enumerate(results.summary["design"]["chosen"], start=1):
        where = NONE if None in one["place"] else place(one["place"])
        cells = (str(k), one["name"], one["case"] or NONE, where, one["measured"])
        rows.append((*cells, *(number(one[what]) for what in ("gain", "information", "cost"))))
    head = ("", "observation", "load case", "place", "measured", "adds (nat)", "together (nat)", "cost together")
    return Table(head, rows, text=frozenset({1, 2, 3, 4}))
