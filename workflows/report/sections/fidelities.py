"""The models of a multifidelity study: what was taken of each, and what it was worth."""

from __future__ import annotations

from collections.abc import Iterator

from forward.words import duration, number, with_error
from workflows.report.blocks import Block, Heading, Table, Text
from workflows.report.section import Results, Section

EVENLY = (
    "Models of a group get the same random parameters. Weights make the estimates those of the first model, whatever "
    "the others are; numbers of samples make the largest relative error of a mean least for the cost."
)
CHOSEN = (
    "All cheap models are asked at all points. Those at which the model of the study is solved as well are drawn with "
    "probabilities that grow with the difference of two cheap models, and count with the inverse of these: the "
    "estimates are those of the first model, whatever the others are. Numbers make the "
    "largest relative error of a mean least."
)


class Fidelities(Section):
    """The models, the groups that shared samples, and the gain over plain Monte Carlo."""

    def applies(self, results: Results) -> bool:
        """Whether there are several models."""
        return "fidelity_cost" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """A table of models, one of groups, and one of gains."""
        yield Heading("Models")
        yield models(results)
        yield Text(
            "A correlation is that with the outputs of the model of the study, in the pilot; in brackets, that of what "
            "the tangents leave. It is what a cheap model can explain."
        )
        yield groups(results)
        yield Text(CHOSEN if results.dataset["group_chosen"].values.any() else EVENLY)
        yield worth(results)


def models(results: Results) -> Table:
    """The models with their costs, samples and correlations."""
    dataset = results.dataset
    measured = {one["name"]: one for one in results.summary.get("fidelities", [])}
    rows = []
    for label in dataset["fidelity"].values:
        here = dataset.sel(fidelity=label)
        found = measured.get(str(label))
        taken = "" if found is None or not found["solves"] else duration(found["cpu_seconds"] / found["solves"])
        related = [
            f"{number(float(here['fidelity_correlation'].sel(output=o)), 5)} "
            f"({number(float(here['fidelity_remainder_correlation'].sel(output=o)), 5)})"
            for o in results.outputs
        ]
        rows.append(
            (str(label), number(float(here["fidelity_cost"]), 3), taken, f"{int(here['fidelity_samples']):,}", *related)
        )
    head = ("model", "a solve, predicted (1: the study's model)", "measured", "samples")
    return Table((*head, *(f"correlation, {output}" for output in results.outputs)), rows)


def groups(results: Results) -> Table:
    """The groups of models that shared samples."""
    dataset, rows = results.dataset, []
    labels = [str(label) for label in dataset["fidelity"].values]
    for g in dataset["group"].values:
        here = dataset.sel(group=g)
        members = [label for label, inside in zip(labels, here["group_models"].values, strict=True) if inside]
        pilot = " (pilot, which does not count)" if bool(here["group_pilot"]) else ""
        if bool(here["group_chosen"]):
            pilot = " (chosen where two cheap models differ)" if len(members) == len(labels) else " (the other points)"
        count, cost = int(here["group_samples"]), float(here["group_cost"])
        rows.append(
            (", ".join(members) + pilot, f"{count:,}", f"{int(here['group_failed']):,}", number(count * cost, 3))
        )
    return Table(("groups of models", "samples", "failed", "cost in solves of the study's model"), rows)


def worth(results: Results) -> Table:
    """What each unit of cost was worth in plain samples, and what other methods are predicted to need."""
    dataset, rows = results.dataset, []
    others = [str(name) for name in dataset["alternative"].values]
    for output in results.outputs:
        here = dataset.sel(output=output)
        needed = [f"{float(here['alternative_solves'].sel(alternative=name)):,.0f}" for name in others]
        gain = with_error(float(here["gain"]), float(here["gain_error"]))
        rows.append((output, gain, number(float(dataset["spent"]), 4), *needed))
    words = {"monte-carlo": "plain Monte Carlo", "sensitivity-monte-carlo": "the tangent", "expansion": "an expansion"}
    head = ("output", "gain over plain Monte Carlo", "spent (solves)")
    return Table((*head, *(f"{words[name]}, predicted" for name in others)), rows)
