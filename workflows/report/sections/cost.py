"""Errors against cost: methods compared, cheap models, levels."""

from __future__ import annotations

import math
from collections.abc import Iterator

from forward.readable import size
from forward.words import NONE, duration, number, with_unit
from uq.estimators.scores import gains, plain_samples
from workflows.report import plots
from workflows.report.blocks import Block, Heading, Picture, Pictures, Table, Text
from workflows.report.section import Results, Section, written


class ErrorAgainstCost(Section):
    """Errors of several methods against their cost."""

    needs = ("row_method",)

    def content(self, results: Results) -> Iterator[Block]:
        """The reference, and pictures and a table for each estimate of each output."""
        yield Heading("Error against cost")
        yield Text(
            "The reference, with its own standard errors; the error due to the tolerance of the solver (against the "
            "textbook solver, on some draws); the error of the mesh, by estimate or (method.mesh_error) by a "
            "mesh of twice the cells in each direction at the mean parameters."
        )
        yield references(results)
        yield Text(
            "RMSE is the root mean square error of the repeats against the reference, “claimed” the standard error "
            "that the method itself gives, coverage the share of its 95\u00a0% intervals that contain the reference. "
            "Errors below twice that of the reference are not resolved. A gain is the cost of plain Monte Carlo at "
            "equal error (by its exact rate) over the cost of the method, with its set-up: in solves, in processor "
            "time, and in processor time if plain Monte Carlo uses the textbook solver. The rate is the slope of "
            "ln RMSE over ln solves. Rows with the textbook solver are derived from the solves of plain Monte Carlo."
        )
        costs: dict[str, plots.Cost] = {"the number of solves": "solves", "processor time": "cpu_seconds"}
        words: dict[str, plots.Estimated] = {"mean": "mean", "standard deviation": "std"}
        for output in results.outputs:
            for word, estimated in words.items():
                yield Heading(f"{output}: {word}", level=3)
                yield Pictures(
                    [
                        Picture.drawn(
                            plots.errors(results.dataset, output, estimated, against),
                            f"Error of the {word} of {output} against {cost}.",
                        )
                        for cost, against in costs.items()
                    ]
                )
                yield errors(results, output, estimated)


def references(results: Results) -> Table:
    """The references, and the errors of the solver and the mesh."""
    rows = []
    for output in results.outputs:
        of_output, unit = results.of(output), results.unit(output)
        floors = (size(abs(float(of_output[f"{name}_error"])), unit) for name in ("solver", "mesh"))
        rows.append((output, *(results.estimate(output, name) for name in ("mean", "std")), *floors))
    return Table(("output", "mean", "standard deviation", "error of the solver", "error of the mesh"), rows)


def errors(results: Results, output: str, estimated: str) -> Table:
    """Error and cost of each method at each budget, for one estimate of an output."""
    dataset = results.of(output)
    scale = abs(float(dataset[estimated]))
    plain, gained = plain_samples(dataset, estimated).to_numpy(), gains(dataset, estimated)
    methods = dataset["row_method"].to_numpy().tolist()
    rates = {}
    for name in dataset["estimator"].to_numpy().tolist():
        of_method = dataset.sel(estimator=name)
        rates[name] = written(of_method, f"{estimated}_rate")
    rows = []
    for i, name in enumerate(methods):
        row = dataset.isel(row=i)
        rmse, resolved = float(row[f"{estimated}_rmse"]), bool(row[f"{estimated}_resolved"])
        coverage = NONE
        if resolved:
            coverage = f"{100 * float(row[f'{estimated}_coverage']):.0f} %"
            coverage += " (understated)" if bool(row[f"{estimated}_understated"]) else ""
        bound = "" if resolved else "≥ "
        ratios = [plain[i], *(float(gain[i]) for gain in gained.values())]
        rows.append(
            (
                name,
                f"{int(row['budget']):,}",
                f"{int(row['solves']):,}",
                duration(float(row["cpu_seconds"])),
                number(rmse, 2) + ("" if resolved else " (not resolved)"),
                number(rmse / scale if scale else float("nan"), 2),
                number(float(row[f"{estimated}_claimed"]), 2),
                coverage,
                *(NONE if math.isnan(ratio) else bound + number(ratio, 2) for ratio in ratios),
                rates[name] if name not in methods[i + 1 :] else "",
            )
        )
    head = (
        "method",
        "samples",
        "solves",
        "CPU time",
        with_unit("RMSE", f"({results.unit(output)})"),
        "relative",
        "claimed",
        "coverage",
        "plain samples for this error",
        "gain in solves",
        "gain in CPU time",
        "gain over the textbook",
        "rate",
    )
    return Table(head, rows)


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

    needs = ("fidelity_cost",)

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
        rows.append((output, written(here, "gain"), number(float(dataset["spent"]), 4), *needed))
    words = {"monte-carlo": "plain Monte Carlo", "sensitivity-monte-carlo": "the tangent", "expansion": "an expansion"}
    head = ("output", "gain over plain Monte Carlo", "spent (solves)")
    return Table((*head, *(f"{words[name]}, predicted" for name in others)), rows)


class Levels(Section):
    """Costs and accuracy of the levels of multilevel chaos."""

    needs = ("level_change",)

    def content(self, results: Results) -> Iterator[Block]:
        """A table, a picture, and the moments by control variates."""
        yield Heading("Levels")
        yield Text(
            "Every level starts its samples from the expansion of the previous level. Residuals are relative to the "
            "loads."
        )
        yield levels(results)
        caption = "Residuals at the samples, relative to the loads, and relative change of the moments, level by level."
        yield Pictures([Picture.drawn(plots.levels(results.dataset), caption)])
        yield Text(
            "Moments from the samples of the last level, with the expansion of the previous level, which does not "
            "depend on them, as control variate; the distance between these and the moments of the expansion is part "
            "of the errors of the latter."
        )
        yield controlled(results)


def levels(results: Results) -> Table:
    """Costs and accuracy of the levels of multilevel chaos."""
    rows = []
    for k in results.dataset["level"].to_numpy():
        level = results.dataset.sel(level=k)
        work = {str(name): int(level["level_work"].sel(operation=name)) for name in level["operation"].to_numpy()}
        iterations = int(level["level_iterations"])
        rows.append(
            (
                f"{k}",
                f"{iterations}" if iterations else "to the tolerance",
                f"{int(level['level_solves'])}",
                f"{int(level['level_converged'])}",
                number(float(level["level_residual"]), 2),
                number(float(level["level_residual_median"]), 2),
                number(float(level["level_change"]), 2),
                *(f"{work[name]:,}" for name in ("residuals", "back_substitutions", "factorisations")),
            )
        )
    head = (
        *("level", "iterations", "samples", "at equilibrium", "largest residual", "median residual"),
        *("change of the moments", "residuals", "back-substitutions", "factorisations"),
    )
    return Table(head, rows)


def controlled(results: Results) -> Table:
    """Moments from the samples of the last level, with the expansion of the previous level as control variate."""
    names = ("control_mean", "control_std")
    rows = [(output, *(results.estimate(output, name) for name in names)) for output in results.outputs]
    return Table(("output", "mean", "standard deviation"), rows)
