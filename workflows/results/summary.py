"""What summary.json says about results: each kind of result has its part."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.words import with_error
from uq.estimators.estimate import ESTIMATED, OF_MESH, PARTS, holds, part
from uq.estimators.moments import ESTIMATES
from uq.estimators.scores import gains
from uq.findings import NOT_KNOWN

if TYPE_CHECKING:
    import xarray as xr

Part = dict[str, Any]
LISTED = 20  # observations of a design
OTHER_ESTIMATES = (
    *("variance_ratio", "std_variance_ratio", "loo_error"),
    *("bias_error", part("mean", "total"), "std_bias_error", part("std", "total")),
    *(part(name, which) for name in ESTIMATED for which in OF_MESH),
)
# Of these, what is not estimated of every output.
NOT_OF_ALL = {part(name, which) for name in ESTIMATED for which in (*OF_MESH, "total")}


def summarise(dataset: xr.Dataset) -> Part:
    """Return the part of summary.json that follows from the results: `outputs`, `local`, `methods`, or `models`."""
    summary: Part = {}
    for needed, told in _PARTS:
        if needed <= set(dataset.variables):
            summary |= told(dataset)
    if "accuracy" in dataset.attrs:
        summary["accuracy"] = json.loads(dataset.attrs["accuracy"])
    return summary


def inverted(summary: Mapping[str, Any], unknown: Collection[str]) -> list[str]:
    """Say in a line what was found for each data set, if data were inverted.

    Of the predictions in `unknown`, whose error of the mesh nobody knows, that is said too.
    """
    lines = []
    for name, found in summary.get("data_sets", {}).items():
        if "failed" in found:
            lines.append(f"{name}: failed: {found['failed']}")
            continue
        values = [f"{path} {with_error(at['mode'], at['std'])}" for path, at in found["posterior"].items()]
        by = "by Laplace, " if (found.get("source"), found.get("trust")) == ("laplace", "neither") else ""
        lines.append(f"{name}: {by}{', '.join(values)}")
        lines += [
            _predicted(f"{name}: {goal}", at, known=goal not in unknown)
            for goal, at in found.get("predictions", {}).items()
        ]
    if "data" in summary:
        lines.append(f"{summary['data']} data made")
    if "design" in summary:
        lines += _design_in_words(summary["design"])
    return lines


def _predicted(what: str, at: Mapping[str, Any], *, known: bool) -> str:
    """Say in a line what is predicted of an output."""
    if at["mean"] is None:
        return f"{what} is not predicted"
    untold = "" if known else f", {NOT_KNOWN}"
    mesh = untold if at["mesh_error"] is None else f", mesh {at['mesh_error']:+.2g}"
    before = "" if at["prior_mean"] is None else f" (before the data {with_error(at['prior_mean'], at['prior_std'])})"
    return f"{what} {with_error(at['mean'], at['std'])}{before}{mesh}"


def _inversion(dataset: xr.Dataset) -> Part:
    from workflows.studies.inversion_results import summary

    return summary(dataset)


def _synthetic(dataset: xr.Dataset) -> Part:
    return {"data": int(np.isfinite(dataset["values"]).sum())}


def _design(dataset: xr.Dataset) -> Part:
    chosen = dataset.isel(candidate=dataset["chosen"].to_numpy())
    place = [[None if np.isnan(x) else x for x in at] for at in chosen["candidate_place"].to_numpy().tolist()]
    columns = {
        "name": [str(name) for name in chosen["candidate"].values],
        "case": [str(case) for case in chosen["candidate_case"].values],
        "place": place,
        "measured": [str(part) for part in chosen["candidate_part"].values],
        "gain": dataset["gain"].to_numpy().tolist(),
        "information": dataset["information"].to_numpy().tolist(),
        "cost": dataset["cost"].to_numpy().tolist(),
    }
    equal = _number(dataset["random_equal"])
    return {
        "design": {
            "candidates": dataset.sizes["candidate"],
            "chosen": [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)],
            "random_equal": None if equal is None else int(equal),
            "random_most": dataset.sizes["random_number"],
        }
    }


def _design_in_words(design: Mapping[str, Any]) -> list[str]:
    """Say which observations were chosen, and how many random ones are worth as much."""
    chosen = design["chosen"]
    lines = [
        f"{k}. {one['name']}: {one['gain']:+.3g} nat, {one['information']:.4g} nat together"
        for k, one in enumerate(chosen[:LISTED], start=1)
    ]
    if len(chosen) > LISTED:
        last = chosen[-1]["information"]
        lines.append(f"{len(chosen) - LISTED} more are in design.csv, {last:.4g} nat together")
    return [*lines, against_random(design)]


def against_random(design: Mapping[str, Any]) -> str:
    """Say what the chosen observations are worth beside random ones: nothing is to be said if all are chosen."""
    n, candidates, equal = len(design["chosen"]), design["candidates"], design["random_equal"]
    if n == candidates:
        return f"all {n} candidates are chosen: only their order tells something"
    worth = f"{equal:,}" if equal is not None else f"more than {design['random_most']:,}"
    return f"{n} chosen of {candidates:,} candidates are worth {worth} random ones"


def _comparison(dataset: xr.Dataset) -> Part:
    shown = ("log_evidence", "log_evidence_error", "probability", *(("stacking",) if "stacking" in dataset else ()))
    trusted = dataset["trusted"].all("group")
    return {
        "models": {
            str(model): {name: _number(dataset[name].sel(model=model)) for name in shown}
            | {"trusted": bool(trusted.sel(model=model))}
            for model in dataset.model.values
        }
    }


def _moments(dataset: xr.Dataset) -> Part:
    names = [name for name in (*ESTIMATES, *OTHER_ESTIMATES) if name in dataset]
    return {
        "outputs": {
            str(output): {
                name: _number(value) if name in NOT_OF_ALL else value
                for name in names
                for value in [float(dataset[name].sel(output=output))]
            }
            for output in dataset.output.values
        }
    }


def _quantiles(dataset: xr.Dataset) -> Part:
    probabilities = [f"{p:g}" for p in dataset["quantile"].to_numpy()]
    names = _with_errors(dataset, "quantiles", "value")
    return {
        "quantiles": {
            str(output): {
                p: {short: _number(dataset[name].sel(output=output)[i]) for short, name in names.items()}
                for i, p in enumerate(probabilities)
            }
            for output in dataset.output.values
        }
    }


def _sobol(dataset: xr.Dataset) -> Part:
    def both(kind: str) -> dict[str, str]:
        return _with_errors(dataset, f"{kind}_first", "first") | _with_errors(dataset, f"{kind}_total", "total")

    found = {"sobol": _by(dataset, "parameter", both("sobol"))}
    if "sobol_group_first" in dataset:
        found["sobol_groups"] = _by(dataset, "group", both("sobol_group"))
    return found


def _averaged(dataset: xr.Dataset) -> Part:
    names = ("mean", "mean_error", "std", "std_error", "within", "between")
    outputs = dataset.output.values
    return {"outputs": {str(one): {name: _number(dataset[name].sel(output=one)) for name in names} for one in outputs}}


def _shapley(dataset: xr.Dataset) -> Part:
    return {"shapley": _by(dataset, "parameter", _with_errors(dataset, "shapley", "value"))}


def _second(dataset: xr.Dataset) -> Part:
    names = _with_errors(dataset, "sobol_second", "second")
    pairs = {
        str(parameter): _by(dataset.sel(parameter=parameter), "partner", names)
        for parameter in dataset.parameter.values
    }
    return {
        "sobol_second": {
            str(output): {
                parameter: {other: of for other, of in found[str(output)].items() if other != parameter}
                for parameter, found in pairs.items()
            }
            for output in dataset.output.values
        }
    }


def _bounds(dataset: xr.Dataset) -> Part:
    return {"bounds": _by(dataset, "parameter", _with_errors(dataset, "total_bound", "total"))}


def _with_errors(dataset: xr.Dataset, name: str, short: str) -> dict[str, str]:
    """Return the variables that say how exact one is, which there are, by shorter names."""
    first = "" if short == "value" else short
    errors = {part(first, which): part(name, which) for which in PARTS if holds(dataset, name, which)}
    return {short: name} | errors


def _local(dataset: xr.Dataset) -> Part:
    names = {
        "local": "derivative",
        "local_per_std": "derivative_per_std",
        "local_per_range": "derivative_per_range",
    } | {part("local", which): part("derivative", which) for which in OF_MESH}
    return {
        key: {
            output: {parameter: numbers[""] for parameter, numbers in of_output.items()}
            for output, of_output in _by(dataset, "parameter", {"": variable}).items()
        }
        for key, variable in names.items()
        if variable in dataset
    }


def _nominal(dataset: xr.Dataset) -> Part:
    """What is known of outputs at the mean parameters, where nothing is sampled."""
    names = _with_errors(dataset, "nominal", "value")
    return {
        "nominal": {
            str(output): {short: _number(dataset[name].sel(output=output)) for short, name in names.items()}
            for output in dataset.output.values
        }
    }


def _by(dataset: xr.Dataset, what: str, names: Mapping[str, str]) -> dict[str, dict[str, dict[str, float | None]]]:
    """Return some variables (output, what) under shorter names, by output and parameter, say."""
    return {
        str(output): {
            str(one): {
                short: _number(dataset[name].sel({"output": output, what: one})) for short, name in names.items()
            }
            for one in dataset[what].values
        }
        for output in dataset.output.values
    }


def _methods(dataset: xr.Dataset) -> Part:
    """Cost and error by method and budget; `error` is the root mean square error of the mean of the first output."""
    gained = {estimated: gains(dataset, estimated) for estimated in ESTIMATED}
    methods: dict[str, list[dict[str, Any]]] = {}
    for i, name in enumerate(dataset["row_method"].to_numpy().tolist()):
        row = dataset.isel(row=i)
        outputs = {
            str(output): {
                estimated: {
                    "rmse": _number(of_output[f"{estimated}_rmse"]),
                    "rmse_error": _number(of_output[f"{estimated}_rmse_error"]),
                    "resolved": bool(of_output[f"{estimated}_resolved"]),
                    "claimed": _number(of_output[f"{estimated}_claimed"]),
                    "coverage": _number(of_output[f"{estimated}_coverage"]),
                    "understated": bool(of_output[f"{estimated}_understated"]),
                    **{
                        f"gain_{key}": _number(g.isel(row=i).sel(output=output)) for key, g in gained[estimated].items()
                    },
                }
                for estimated in ESTIMATED
            }
            for output in dataset.output.values
            for of_output in [row.sel(output=output)]
        }
        methods.setdefault(name, []).append(
            {
                "cost": int(row["solves"]),
                "cpu_seconds": float(row["cpu_seconds"]),
                "error": next(iter(outputs.values()))["mean"]["rmse"],
                "budget": int(row["budget"]),
                "derived": bool(row["derived"]),
                "outputs": outputs,
            }
        )
    return {"methods": methods}


def _number(value: Any) -> float | None:
    """A number, or None where it is not finite: JSON has no NaN."""
    number = float(value)
    return number if np.isfinite(number) else None


_PARTS: tuple[tuple[set[str], Callable[[xr.Dataset], Part]], ...] = (  # what each needs
    ({"alone_eigenvalue"}, _inversion),
    ({"clean"}, _synthetic),
    ({"random_equal"}, _design),
    ({"probability"}, _comparison),
    ({"nominal", "mean"}, _moments),
    ({"quantiles", "mean"}, _quantiles),
    ({"sobol_first"}, _sobol),
    ({"sobol_second"}, _second),
    ({"shapley"}, _shapley),
    ({"candidate_mean"}, _averaged),
    ({"total_bound"}, _bounds),
    ({"derivative"}, _local),
    ({"derivative", part("nominal", "corrected")}, _nominal),
    ({"row_method"}, _methods),
)
