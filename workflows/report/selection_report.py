"""The report of a comparison of models: its tables and pictures."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.words import NONE, number, settings, with_error, with_unit
from inverse.criticism.weights import RULE
from workflows.report import plots
from workflows.report.tables import Table
from workflows.report.words import unit_of
from workflows.studies.findings_selection import bayes_factor, by_probability, conflicts, grade, ranking

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from workflows.studies.selection import Comparison


UNITS = {"stress": "Pa", "displacement": "m"}


def context(dataset: xr.Dataset, study: Comparison) -> dict[str, Any]:
    """Return what the template shows beside what all reports have."""
    return {
        "rule": RULE,
        "source": study.source,
        "priors": priors(study),
        "evidences": evidences(dataset),
        "routes": routes(dataset),
        "meshes": meshes(dataset) if "mesh_checked" in dataset else None,
        "variants": variants(dataset),
        "criticism": criticism(dataset),
        "held_out": held_out(dataset) if "held_out_score" in dataset else None,
        "constants": constants(dataset),
        "averages": averages(dataset),
    }


def pictures(dataset: xr.Dataset) -> Iterator[tuple[str, list[tuple[Axes, str]]]]:
    """Draw evidences, probabilities and, test by test, the curves over the data; headings, each with its pictures."""
    yield (
        "Evidences",
        [
            (evidence_bars(dataset), "ln Z less that of the most probable model, with three standard errors."),
            (probability_bars(dataset), "Probability of each model, and with other errors, data and priors."),
        ],
    )
    tests = list(dict.fromkeys(zip(dataset["output_group"].values, dataset["output_test"].values, strict=True)))
    several = dataset.sizes["group"] > 1
    if dataset.attrs["quantity"] == "displacement":
        drawn = [
            (residuals(dataset, str(test)), f"{test}: measured less predicted, over the errors.") for _, test in tests
        ]
        yield "What is left of the data", drawn
    else:
        drawn = [
            (curves(dataset, str(group), str(test)), f"{test}{f' of {group}' if several else ''}: mean and 90 % band.")
            for group, test in tests
        ]
        yield "Curves over the data", drawn
    best = by_probability(dataset, dataset["log_evidence"])[0]
    pairs = [(str(m), str(g)) for m in dataset.model.values for g in dataset.group.values]
    drawn = [
        (corner(dataset, *pair), f"{pair[0]}{f' ({pair[1]})' if several else ''}")
        for pair in pairs
        if not several or pair[0] == best
    ]
    yield "Posteriors of the constants" + (f" of {best}" if several else ""), drawn


# --- tables --------------------------------------------------------------------------------------------------------


def priors(study: Comparison) -> Table:
    """The candidates with the priors of their constants."""
    rows = []
    for name, candidate in study.candidates.items():
        for constant, distribution in candidate.parameters.items():
            block = distribution.model_dump()
            unit = _unit(constant)
            rows.append((name, study.described(name), constant, f"{block['kind']}: {settings(block, 'kind')}", unit))
    return Table(("candidate", "model", "constant", "prior", "unit"), rows, text=frozenset(range(5)))


def evidences(dataset: xr.Dataset) -> Table:
    """Evidence, Bayes factor and probability of each model, nested sampling beside it."""
    order = ranking(dataset["log_evidence"])
    nested = "nested_log_evidence" in dataset
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
    ]
    return Table([*head, *(["ln Z by nested sampling"] if nested else [])], rows, text=frozenset({0, 4}))


def routes(dataset: xr.Dataset) -> Table:
    """How each evidence was found, and what its weights are worth."""
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


def meshes(dataset: xr.Dataset) -> Table:
    """What a finer mesh does to data, evidence and unknowns of each candidate."""
    rows = []
    for model in dataset.model.values:
        one = dataset.sel(model=model).isel(group=0)
        if not bool(one["mesh_checked"]):
            rows.append((str(model), NONE, NONE, NONE, f"not checked: {one['mesh_why'].item()}"))
            continue
        error, shift = one["mesh_error"].to_numpy(), one["mesh_shift"].dropna("parameter")
        listed = [f"{name} {float(shift.sel(parameter=name)):+.2g}" for name in shift.parameter.values]
        size, most = (f"{value:.2g}" for value in (float(np.sqrt(np.nanmean(error**2))), float(np.nanmax(abs(error)))))
        rows.append((str(model), f"{float(one['mesh_log_evidence']):+.3g}", size, most, ", ".join(listed)))
    head = ("model", "ln Z", "data, over the errors", "at most", "unknowns, in deviations of the posterior")
    return Table(head, rows, text=frozenset({0, 4}), long=frozenset({4}))


def variants(dataset: xr.Dataset) -> Table:
    """Evidence and probability with other errors, data and priors."""
    rows = []
    for variant in dataset.variant.values:
        one = dataset.sel(variant=variant)
        cells = [
            f"{with_error(float(z), float(e))} ({number(100 * float(p), 3)} %)"
            for z, e, p in zip(
                one["variant_log_evidence"].values,
                one["variant_log_evidence_error"].values,
                one["variant_probability"].values,
                strict=True,
            )
        ]
        rows.append((str(variant), *cells))
    return Table(("", *map(str, dataset.model.values)), rows)


def criticism(dataset: xr.Dataset) -> Table:
    """Predictive scores and checks."""
    rows = []
    for model in ranking(dataset["score"]):
        one = dataset.sel(model=model)
        behind = float(one["score_behind"])
        rows.append(
            (
                model,
                with_error(float(one["score"]), float(one["score_error"])),
                with_error(behind, float(one["score_behind_error"])) if behind else NONE,
                number(float(one["score_tail"]), 2),
                "yes" if bool(one["score_trusted"]) else "no",
                number(float(one["misfit_probability"].min()), 2),
                number(float(one["correlation_probability"].min()), 2),
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
        "p of more alike neighbours",
        "conflict",
    )
    return Table(head, rows, text=frozenset({0, 4, 7}), long=frozenset({7}))


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


def constants(dataset: xr.Dataset) -> Table:
    """Posterior of every constant."""
    rows = []
    for model in dataset.model.values:
        for group in dataset.group.values:
            one = dataset.sel(model=model, group=group)
            for name in dataset.parameter.values:
                of_name = one.sel(parameter=name)
                if np.isnan(float(of_name["constant_mode"])):
                    continue
                unit = _unit(str(name))
                low, high = of_name["constant_quantiles"].values
                values = (of_name["constant_mode"], of_name["constant_mean"], of_name["constant_std"], low, high)
                rows.append((str(model), str(group), str(name), *(with_unit(number(float(v)), unit) for v in values)))
    head = ("model", "group", "constant", "mode", "mean", "standard deviation", "5 %", "95 %")
    return Table(head, rows, text=frozenset({0, 1, 2}))


def averages(dataset: xr.Dataset) -> Table:
    """Predictions averaged over the models at the end of each test, with both parts of their variance."""
    rows = []
    quantity = str(dataset.attrs["quantity"])
    tests = list(zip(dataset["output_group"].values, dataset["output_test"].values, strict=True))
    for group, test in dict.fromkeys(tests):
        members = [i for i, pair in enumerate(tests) if pair == (group, test)]
        at = dataset["output_at"].values[members]
        # Data of displacements have numbers only: there, what moved most.
        far = np.abs(at - at[0]) if quantity == "stress" else np.abs(dataset["measured"].values[members])
        one = dataset.isel(output=members[int(np.argmax(far))])
        stds = (np.sqrt(float(one[name])) for name in ("average_within", "average_between"))
        rows.append(
            (
                str(group),
                str(test),
                number(float(one["output_at"])),
                with_unit(number(float(one["measured"])), UNITS[quantity]),
                with_unit(number(float(one["average_mean"])), UNITS[quantity]),
                *(with_unit(number(std, 3), UNITS[quantity]) for std in stds),
            )
        )
    place = "at" if quantity == "stress" else "datum"
    head = ("group", "test", place, "measured", "averaged prediction", "std within models", "std between models")
    return Table(head, rows, text=frozenset({0, 1}))


# --- pictures ------------------------------------------------------------------------------------------------------


def evidence_bars(dataset: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw ln Z of each model less the largest, with three standard errors."""
    order = ranking(dataset["log_evidence"])[::-1]
    ax = ax or plots.axes(height=1.2 + 0.5 * len(order))
    values = dataset["log_evidence"].sel(model=order).values
    errors = dataset["log_evidence_error"].sel(model=order).values
    places = np.arange(len(order))
    below = values - values.max()
    ax.barh(places, below, xerr=3 * errors, color=plots.CONTROLLED, ecolor=plots.DARK, capsize=4, height=0.6)
    # Beside models that are hopeless, what the others differ in cannot be seen: the numbers stand with the names.
    labels = [f"{model}\n{with_error(float(z), float(e))}" for model, z, e in zip(order, below, errors, strict=True)]
    ax.set_yticks(places, labels, fontsize="small")
    ax.set_xlim(1.15 * min(below.min(), -1.0), 0.05 * abs(below.min()) + 3 * errors.max())
    ax.set_xlabel("ln Z − ln Z of the most probable")
    return ax


def probability_bars(dataset: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw the probabilities of the models side by side, a bar for each variant."""
    names = [str(variant) for variant in dataset.variant.values]
    ax = ax or plots.axes(height=1.6 + 0.36 * len(names))
    places = np.arange(len(names))[::-1]
    left = np.zeros(len(names))
    for k, model in enumerate(dataset.model.values):
        share = dataset["variant_probability"].sel(model=model).values
        ax.barh(places, share, left=left, color=plots.COLOURS[k % len(plots.COLOURS)], label=str(model), height=0.6)
        left = left + share
    ax.set_yticks(places, names)
    ax.set_xlim(0, 1)
    ax.set_xlabel("probability")
    ax.figure.legend(loc="outside lower center", ncols=3, fontsize="small", frameon=False)
    return ax


def corner(dataset: xr.Dataset, model: str, group: str) -> Axes:
    """Draw the posterior of the constants of a model, each alone and in pairs; large points have large weights."""
    one = dataset.sel(model=model, group=group)
    names = [
        str(name) for name in dataset.parameter.values if np.isfinite(float(one["constant_mode"].sel(parameter=name)))
    ]
    n = len(names)
    first = plots.axes(height=1.0 + 1.25 * n, width=1.4 + 1.45 * n)
    figure = first.get_figure(root=True)
    assert figure is not None
    first.remove()
    grid = figure.subplots(n, n, squeeze=False, sharex="col")
    weights = one["point_weight"].values
    used = weights > 1e-6 * weights.max()
    weights = weights[used]
    columns = [one["point"].sel(parameter=name).values[used] for name in names]
    modes = [float(one["constant_mode"].sel(parameter=name)) for name in names]
    ends = [plots.span(x, weights) for x in columns]
    colour = plots.COLOURS[list(dataset.model.values).index(model) % len(plots.COLOURS)]
    for i, j in np.ndindex(n, n):
        ax = grid[i, j]
        if j > i:
            ax.remove()
            continue
        if i == j:
            ax.hist(columns[i], bins=24, range=ends[i], weights=weights, color=colour, alpha=0.6)
            ax.axvline(modes[i], color=plots.DARK, linewidth=1)
            ax.set_yticks([])
        else:
            ax.scatter(columns[j], columns[i], s=300 * weights / weights.max() / np.sqrt(len(weights)), color=colour)
            ax.plot(modes[j], modes[i], "+", color=plots.DARK)
            ax.set_ylim(ends[i])
        ax.set_xlim(ends[j])
        ax.ticklabel_format(style="sci", scilimits=(-2, 3), useMathText=True)
        ax.tick_params(labelsize="x-small")
        ax.xaxis.get_offset_text().set_fontsize("x-small")
        ax.yaxis.get_offset_text().set_fontsize("x-small")
        ax.spines[["top", "right"]].set_visible(False)
        if i == n - 1:
            ax.set_xlabel(_with_unit(names[j]), fontsize="small")
        if j == 0 and i > 0:
            ax.set_ylabel(_with_unit(names[i]), fontsize="small")
        elif j > 0:
            ax.tick_params(labelleft=False)
    corner_axes: Axes = grid[0, 0]
    return corner_axes


def _unit(constant: str) -> str:
    """SI unit of a constant of a material, or of a number of a model by its path."""
    return "1" if constant == "noise" else unit_of(constant if "." in constant else f"material.{constant}")


def _with_unit(constant: str) -> str:
    unit = _unit(constant)
    return constant if unit == "1" else f"{constant} ({unit})"


def residuals(dataset: xr.Dataset, test: str, ax: Axes | None = None) -> Axes:
    """Draw what each model leaves of the data of a test, over the stated errors, against what was measured."""
    from matplotlib.ticker import MaxNLocator

    ax = ax or plots.axes(height=3.4)
    one = dataset.isel(output=np.flatnonzero(dataset["output_test"].values == test))
    measured = one["measured"].values
    for k, model in enumerate(dataset.model.values):
        left = (measured - one["prediction_mean"].sel(model=model).values) / one["sigma"].values
        P = float(dataset["probability"].sel(model=model))
        colour = plots.COLOURS[k % len(plots.COLOURS)]
        ax.plot(measured, left, ".", markersize=4, color=colour, label=f"{model} ({P:.2g})")
    ax.axhspan(-2, 2, color=plots.DARK, alpha=0.08, linewidth=0)
    ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.set_xlabel("measured displacement (m)")
    ax.set_ylabel("residual / σ")
    ax.legend(fontsize="small", frameon=False)
    return ax


def curves(dataset: xr.Dataset, group: str, test: str, ax: Axes | None = None) -> Axes:
    """Draw the posterior curves of all models over the data of a test."""
    ax = ax or plots.axes(height=3.4)
    chosen = (dataset["output_group"].values == group) & (dataset["output_test"].values == test)
    one = dataset.isel(output=np.flatnonzero(chosen))
    one = one.isel(output=np.argsort(one["output_at"].values, kind="stable"))
    at = one["output_at"].values
    for k, model in enumerate(dataset.model.values):
        low, high = one["prediction_quantiles"].sel(model=model).values
        ax.fill_between(at, low, high, color=plots.COLOURS[k % len(plots.COLOURS)], alpha=0.25, linewidth=0)
        P = float(dataset["probability"].sel(model=model))
        ax.plot(
            at,
            one["prediction_mean"].sel(model=model).values,
            color=plots.COLOURS[k % len(plots.COLOURS)],
            label=f"{model} ({P:.2g})",
        )
    ax.errorbar(at, one["measured"].values, yerr=one["sigma"].values, fmt=".", color=plots.DARK, label="measured")
    ax.set_xlabel(f"{test}: stretch or amount of shear")
    ax.set_ylabel("stress (Pa)")
    ax.legend(fontsize="small", frameon=False)
    return ax
