"""Errors against cost: methods compared, cheap models, levels, reduced models."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from forward.readable import NONE, duration, number, percent, size, with_unit
from uq.estimators.scores import gains, plain_samples
from workflows.report import plots
from workflows.report.blocks import Answer, Block, Card, Heading, Pairs, Pictures, Table, Text
from workflows.report.plots import accuracy
from workflows.report.plots.accuracy import Cost
from workflows.report.plots.outputs import WORDS
from workflows.report.section import Results, section, written

if TYPE_CHECKING:
    import xarray as xr

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


@section("row_method", heading="Error against cost")
def error_against_cost(results: Results) -> Iterator[Block]:
    """Errors of several methods against their cost."""
    yield Text(
        "The reference, with its own standard errors; the error due to the tolerance of the solver (against the "
        "textbook solver, on some draws); the error of the mesh, by estimate or (method.mesh_error) by a "
        "mesh of twice the cells in each direction at the mean parameters."
    )
    rows = []
    for output in results.outputs:
        of, unit = results.of(output), results.unit(output)
        floors = (size(abs(float(of[f"{name}_error"])), unit) for name in ("solver", "mesh"))
        rows.append((output, *(results.estimate(output, name) for name in WORDS), *floors))
    yield Table(("output", *WORDS.values(), "error of the solver", "error of the mesh"), rows)
    yield Text(
        "RMSE is the root mean square error of the repeats against the reference, “claimed” the standard error "
        "that the method itself gives, coverage the share of its 95\u00a0% intervals that contain the reference. "
        "Errors below twice that of the reference are not resolved. A gain is the cost of plain Monte Carlo at "
        "equal error (by its exact rate) over the cost of the method, with its set-up: in solves, in processor "
        "time, and in processor time if plain Monte Carlo uses the textbook solver. The rate is the slope of "
        "ln RMSE over ln solves. Rows with the textbook solver are derived from the solves of plain Monte Carlo."
    )
    costs: dict[Cost, str] = {"solves": "the number of solves", "cpu_seconds": "processor time"}
    for output in results.outputs:
        for estimated, word in WORDS.items():
            yield Heading(f"{output}: {word}", level=3)
            drawn = ((plots.errors(results.dataset, output, estimated, cost), of) for cost, of in costs.items())
            yield Pictures.of(*((ax, f"Error of the {word} of {output} against {of}.") for ax, of in drawn))
            yield errors(results, output, estimated)


def errors(results: Results, output: str, estimated: str) -> Table:
    """Error and cost of each method at each budget, for one estimate of an output."""
    dataset = results.of(output)
    scale, methods = abs(float(dataset[estimated])), dataset["row_method"].to_numpy().tolist()
    last = {name: i for i, name in enumerate(methods)}
    of = [dataset.isel(row=i) for i in range(len(methods))]
    rmse, resolved = (dataset[f"{estimated}_{which}"].to_numpy() for which in ("rmse", "resolved"))
    ratios = [plain_samples(dataset, estimated), *gains(dataset, estimated).values()]
    words = ("plain samples for this error", "gain in solves", "gain in CPU time", "gain over the textbook")

    def coverage(i: int) -> str:
        understated = " (understated)" if bool(of[i][f"{estimated}_understated"]) else ""
        return f"{100 * float(of[i][f'{estimated}_coverage']):.0f} %{understated}" if resolved[i] else NONE

    def ratio(i: int, found: xr.DataArray) -> str:
        return NONE if np.isnan(found[i]) else ("" if resolved[i] else "≥ ") + number(float(found[i]), 2)

    return Table.of(
        range(len(methods)),
        {
            "method": lambda i: methods[i],
            "samples": lambda i: f"{int(of[i]['budget']):,}",
            "solves": lambda i: f"{int(of[i]['solves']):,}",
            "CPU time": lambda i: duration(float(of[i]["cpu_seconds"])),
            with_unit("RMSE", f"({results.unit(output)})"): lambda i: (
                number(float(rmse[i]), 2) + ("" if resolved[i] else " (not resolved)")
            ),
            "relative": lambda i: number(float(rmse[i] / scale if scale else np.nan), 2),
            "claimed": lambda i: number(float(of[i][f"{estimated}_claimed"]), 2),
            "coverage": coverage,
            **{word: partial(ratio, found=found) for word, found in zip(words, ratios, strict=True)},
            "rate": lambda i: (
                written(dataset.sel(estimator=methods[i]), f"{estimated}_rate") if last[methods[i]] == i else ""
            ),
        },
    )


@section("fidelity_cost", heading="Models")
def fidelities(results: Results) -> Iterator[Block]:
    """The models, the groups that shared samples, and the gain over plain Monte Carlo."""
    dataset, rows = results.dataset, []
    measured = {one["name"]: one for one in results.summary.get("fidelities", []) if one["solves"]}
    labels = [str(label) for label in dataset["fidelity"].values]
    for label in labels:
        here = dataset.sel(fidelity=label)
        taken = duration(measured[label]["cpu_seconds"] / measured[label]["solves"]) if label in measured else ""
        both = (here[f"fidelity_{which}correlation"].sel(output=results.outputs) for which in ("", "remainder_"))
        related = (f"{number(float(whole), 5)} ({number(float(left), 5)})" for whole, left in zip(*both, strict=True))
        cost, samples = number(float(here["fidelity_cost"]), 3), f"{int(here['fidelity_samples']):,}"
        rows.append((label, cost, taken, samples, *related))
    head = ("model", "a solve, predicted (1: the study's model)", "measured", "samples")
    yield Table((*head, *(f"correlation, {output}" for output in results.outputs)), rows)
    yield Text(
        "A correlation is that with the outputs of the model of the study, in the pilot; in brackets, that of what "
        "the tangents leave. It is what a cheap model can explain."
    )
    rows = []
    for g in dataset["group"].values:
        here = dataset.sel(group=g)
        members = [label for label, inside in zip(labels, here["group_models"].values, strict=True) if inside]
        pilot = " (pilot, which does not count)" if bool(here["group_pilot"]) else ""
        if bool(here["group_chosen"]):
            pilot = " (chosen where two cheap models differ)" if len(members) == len(labels) else " (the other points)"
        count, failed = int(here["group_samples"]), f"{int(here['group_failed']):,}"
        cost = number(count * float(here["group_cost"]), 3)
        rows.append((", ".join(members) + pilot, f"{count:,}", failed, cost))
    yield Table(("groups of models", "samples", "failed", "cost in solves of the study's model"), rows)
    yield Text(CHOSEN if dataset["group_chosen"].values.any() else EVENLY)
    others, rows = [str(name) for name in dataset["alternative"].values], []
    for output in results.outputs:
        here = dataset.sel(output=output)
        needed = [f"{float(here['alternative_solves'].sel(alternative=name)):,.0f}" for name in others]
        rows.append((output, written(here, "gain"), number(float(dataset["spent"]), 4), *needed))
    words = {"monte-carlo": "plain Monte Carlo", "sensitivity-monte-carlo": "the tangent", "expansion": "an expansion"}
    first = ("output", "gain over plain Monte Carlo", "spent (solves)")
    yield Table((*first, *(f"{words[name]}, predicted" for name in others)), rows)


@section("level_change", heading="Levels")
def levels(results: Results) -> Iterator[Block]:
    """Costs and accuracy of the levels of multilevel chaos."""
    yield Text(
        "Every level starts its samples from the expansion of the previous level. Residuals are relative to the loads."
    )
    dataset = results.dataset

    def work(one: xr.Dataset, name: str) -> str:
        return f"{int(one['level_work'].sel(operation=name)):,}"

    yield Table.of(
        [dataset.sel(level=k) for k in dataset["level"].to_numpy()],
        {
            "level": lambda one: f"{one['level'].item()}",
            "iterations": lambda one: f"{int(one['level_iterations']) or 'to the tolerance'}",
            "samples": lambda one: f"{int(one['level_solves'])}",
            "at equilibrium": lambda one: f"{int(one['level_converged'])}",
            "largest residual": lambda one: number(float(one["level_residual"]), 2),
            "median residual": lambda one: number(float(one["level_residual_median"]), 2),
            "change of the moments": lambda one: number(float(one["level_change"]), 2),
            "residuals": partial(work, name="residuals"),
            "back-substitutions": partial(work, name="back_substitutions"),
            "factorisations": partial(work, name="factorisations"),
        },
    )
    yield Text(
        "Moments from the samples of the last level, with the expansion of the previous level, which does not "
        "depend on them, as control variate; the distance between these and the moments of the expansion is part "
        "of the errors of the latter."
    )
    yield results.estimates({f"control_{name}": word for name, word in WORDS.items()})


@section(when=lambda results: "reduced" in results.summary)
def reduced_model_of_body(results: Results) -> Iterator[Block]:
    """Errors on unseen samples, and how the model is made."""
    told, found = results.summary["reduced"], results.dataset
    drawn = []
    if told.get("errors"):
        yield Heading("How well it follows the body")
        yield Text(
            f"Errors on {told['unseen']} samples that the model has not seen: their root mean square over the spread "
            "of each output, and what the correction by the residual leaves of them. The effectivity is the estimated "
            "over the true error; where it is 1, estimates can be taken for the errors."
        )
        left = {name: percent(error) for name, error in told.get("errors after correction", {}).items()}
        shares = {name: f"{share:.2f}" for name, share in told.get("effectivity", {}).items()}
        rows = [(o, percent(error), left.get(o, "–"), shares.get(o, "–")) for o, error in told["errors"].items()]
        yield Table(("output", "error", "after the correction", "effectivity"), rows)
        if told["unseen"] > 1:
            caption = "Estimated against true errors at the unseen samples, over the root mean square of each output."
            drawn.append((accuracy.estimates(found), caption))
    else:
        yield Text("Nobody has measured how well it follows the body, with no unseen samples (method.unseen).")
    drawn.append((accuracy.energies(found, told["modes"]), "The part of the snapshots that so many modes leave out."))
    yield Pictures.of(*drawn)
    yield Heading("What it is made of")
    file, seconds = told["file"], told["seconds"]
    use = f"model = {{ kind = 'reduced', file = '{file}' }} in any study"
    yield Pairs.of(
        ("snapshots", f"{told['snapshots']:,} solves of the body, {told['unknowns']:,} unknowns"),
        ("modes", f"{told['modes']}; {told['modes of the larger model']} of the model that tells the errors"),
        ("points of the material", f"{told['points']:,}"),
        ("made in", duration(seconds["snapshots"] + seconds["reduction"]) + " of processor time"),
        ("use it", f"tissuq live {file}: a page with sliders", use),
    )


def reduced_card(results: Results) -> Card:
    """How small the model is, and how large its errors are."""
    told = results.summary["reduced"]
    lines = [f"instead of {told['unknowns']:,} unknowns", f"from {told['snapshots']} solves", f"in {told['file']}"]
    own, full = (1e3 * told["seconds"].get(f"{which} solve", math.nan) for which in ("reduced", "full"))
    if math.isfinite(own):
        lines.insert(1, f"a solve takes {number(own, 2)} ms, one of the body {number(full, 2)} ms")
    answers = [Answer("reduced model", f"{told['modes']} modes", lines)]
    for name, error in told.get("errors", {}).items():
        left, lines = error, ["of its spread; nothing estimates or corrects it"]
        if name in told.get("effectivity", {}):
            left = told["errors after correction"][name]
            true, estimated = (results.dataset[f"reduced_{w}"].sel(output=name) for w in ("error", "estimate"))
            rms = float(((true - estimated) ** 2).mean() ** 0.5)
            lines = [
                f"of its spread, or {size(rms, results.unit(name))}, once corrected by the residual",
                f"{percent(error)} without the correction",
                f"estimated over true error: {told['effectivity'][name]:.2f}",
            ]
        answers.append(Answer(f"error of {name}", percent(left), lines))
    return Card("How well does a reduced model follow the body?", answers)
