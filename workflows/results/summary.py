"""What a run writes to summary.json: the study, what it took, and what results say, of which each kind has its part."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Collection, Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.model import WORK, FloatArray
from uq.estimators import failure_domain
from uq.estimators.estimate import BAND, ESTIMATED, OF_MESH, PARTS, holds, part
from uq.estimators.scores import gains
from uq.findings import findings
from workflows.run import own_code
from workflows.run.version import commit, versions

if TYPE_CHECKING:
    import xarray as xr

    from uq.evaluation.request import Evaluations
    from uq.evaluation.tasks import Outcome
    from workflows.studies.job import Job
    from workflows.studies.study import StudyKind

Part = dict[str, Any]
NEITHER, DOUBTFUL = 2, 3  # values of `trust`, see docs/results.md
LISTED = 50  # failures that are listed; evaluations.h5 has all
ALONE = ""  # name of a number that stands without one
NUMBERS = ("rmse", "rmse_error", "claimed", "coverage")  # of a method at a budget
MOMENTS = (*ESTIMATED, "variance_ratio", "std_variance_ratio", "loo_error", "bias_error", "std_bias_error")
# Of outputs that were not measured: bands by the posterior and the prior, and errors of the mesh.
PREDICTED = {
    **{f"{first}{end}": f"prediction_{first}{end}" for first in ("", "prior_", "process_") for end in BAND},
    "share": "prediction_share",
    part("", "mesh"): part("prediction_mean", "mesh"),
}


def summarise(dataset: xr.Dataset) -> Part:
    """Return the part of summary.json that follows from the results: `outputs`, `local`, `methods`, or `models`."""
    summary: Part = {}
    for needed, told in _PARTS:
        if needed <= set(dataset.variables):
            summary |= told(dataset)
    if "accuracy" in dataset.attrs:
        summary["accuracy"] = json.loads(dataset.attrs["accuracy"])
    return summary


def leading(dataset: xr.Dataset, names: Collection[str], most: int) -> list[str]:
    """Return the names of outputs; of more than `most`, those that vary most beside others of the same unit."""
    listed = list(names)
    if len(listed) <= most or "std" not in dataset:
        return listed[:most]
    of = dataset.sel(output=listed)
    std, units = np.nan_to_num(of["std"].to_numpy()), of["unit"].to_numpy()
    largest = np.array([std[units == unit].max() for unit in units])
    first = np.argsort(-std / np.where(largest > 0, largest, 1.0), kind="stable")[:most]
    return [listed[i] for i in np.sort(first)]


def _inversion(dataset: xr.Dataset) -> Part:
    """Return what is known of each data set; of a single one at the top level too."""
    sets = {str(name): _data_set(dataset.sel(data_set=name)) for name in dataset.data_set.values}
    only = next(iter(sets.values())) if len(sets) == 1 else {}
    shared = int(np.nanmax(dataset["expansion_solves"])) if "expansion_solves" in dataset else 0
    return {**only, "solves": int(np.nansum(dataset["solves"])) + shared, "data_sets": sets}


def _data_set(found: xr.Dataset) -> Part:
    from inverse.methods.record import SOURCES, TRUST

    if not bool(found["ok"]):
        return {"failed": str(found["why"].item())}
    checked = "mesh_checked" in found
    keys = ("mode", "std", "lower", "upper", *(("mesh_shift", "mesh_left") if checked else ()))
    numbers = ("log_evidence", "log_evidence_error", "determined", "residual_probability")
    return {
        "posterior": _by("parameter", found, {key: key for key in keys}),
        **{key: _number(found[key]) for key in numbers},
        **({"mesh": of_meshes(found)} if checked else {}),
        **({"predictions": _by("goal", found, PREDICTED)} if "goal" in found.coords else {}),
        **({"source": SOURCES[int(found["source"])]} if "source" in found else {}),
        "trust": (*TRUST, "doubtful")[int(found["trust"])],
        "verdict": str(found["why"].item()),
    }


def of_meshes(found: xr.Dataset) -> Part:
    """What finer meshes said: the error over the noise (root mean square), whether it is corrected, and solves."""
    error = found["mesh_error"].to_numpy()
    size = float(np.sqrt(np.nanmean(error**2))) if np.isfinite(error).any() else np.nan
    corrected, solves = bool(found["mesh_corrected"] == 1), found["mesh_solves"]
    return {"error": _number(size), "corrected": corrected, "solves": int(solves) if np.isfinite(solves) else 0}


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
    models = _by("model", dataset, {name: name for name in shown})
    return {"models": {name: one | {"trusted": bool(trusted.sel(model=name))} for name, one in models.items()}}


def _nested(labels: Sequence[tuple[str, Sequence[str]]], values: Mapping[str, FloatArray], above: str = "") -> Any:
    """Return values of one shape under names of dimensions within each other: numbers by the names of the values.

    Of what is below the label `above` a partner of the same name is left out.
    """
    if not labels:
        numbers = {short: _number(value) for short, value in values.items()}
        return numbers.get(ALONE, numbers)
    (dimension, names), *rest = labels
    return {
        name: _nested(rest, {short: value[i] for short, value in values.items()}, name)
        for i, name in enumerate(names)
        if dimension != "partner" or name != above
    }


def _by(dimension: str, found: xr.Dataset, names: Mapping[str, str]) -> Any:
    """Return variables of one dimension, by its labels and then by short names."""
    labels = [str(name) for name in found[dimension].values]
    there = {short: found[name].to_numpy() for short, name in names.items() if name in found}
    return _nested([(dimension, labels)], there)


def _methods(dataset: xr.Dataset) -> Part:
    """Cost and error by method and budget; `error` is the root mean square error of the mean of the first output."""
    found = dataset.assign({f"{name}_gain_{key}": of for name in ESTIMATED for key, of in gains(dataset, name).items()})
    methods: dict[str, list[dict[str, Any]]] = {}
    for i, name in enumerate(dataset["row_method"].to_numpy().tolist()):
        row, outputs = found.isel(row=i), {}
        for output in map(str, dataset.output.values):
            of = row.sel(output=output)
            outputs[output] = {
                estimated: {key: _number(of[f"{estimated}_{key}"]) for key in NUMBERS}
                | {key: bool(of[f"{estimated}_{key}"]) for key in ("resolved", "understated")}
                | {key: _number(of[f"{estimated}_{key}"]) for key in ("gain_solves", "gain_cpu", "gain_textbook")}
                for estimated in ESTIMATED
            }
        error = next(iter(outputs.values()))["mean"]["rmse"]
        told: Part = {"cost": int(row["solves"]), "cpu_seconds": float(row["cpu_seconds"]), "error": error}
        told |= {"budget": int(row["budget"]), "derived": bool(row["derived"]), "outputs": outputs}
        methods.setdefault(name, []).append(told)
    return {"methods": methods}


def _number(value: Any) -> float | None:
    """A number, or None where it is not finite: JSON has no NaN."""
    number = float(value)
    return number if np.isfinite(number) else None


def _numbers(dataset: xr.Dataset, variables: Mapping[str, str]) -> Part:
    """Return every number of variables of the same dimensions, by output and the other dimensions in their order.

    They have their names there, with what is known of their errors; one that is `ALONE` stands without a name, and
    without errors.
    """
    names: dict[str, str] = {}
    there = {short: name for short, name in variables.items() if name in dataset}
    for short, name in there.items():
        first, parts = "" if short == "value" else short, () if short == ALONE else PARTS
        names[short] = name
        names |= {part(first, which): part(name, which) for which in parts if holds(dataset, name, which)}
    dims = sorted(dataset[next(iter(there.values()))].dims, key=lambda dimension: dimension != "output")
    number = {str(one): "{:g}" if dataset[one].dtype.kind == "f" else "{}" for one in dims}
    labels = [(one, [*map(shown.format, dataset[one].to_numpy().tolist())]) for one, shown in number.items()]
    values = {short: dataset[name].transpose(*dims).to_numpy() for short, name in names.items()}
    return dict(_nested(labels, values))


def _told(key: str, variables: Mapping[str, str], *needs: str) -> tuple[set[str], Callable[[xr.Dataset], Part]]:
    """Return what variables are told under a key by: what that needs, unless said otherwise all of them, and how."""
    return set(needs or variables.values()), lambda dataset: {key: _numbers(dataset, variables)}


_PARTS: tuple[tuple[set[str], Callable[[xr.Dataset], Part]], ...] = (  # what each needs
    ({"alone_eigenvalue"}, _inversion),
    ({"clean"}, lambda dataset: {"data": int(np.isfinite(dataset["values"]).sum())}),
    ({"random_equal"}, _design),
    ({"probability"}, _comparison),
    ({"row_method"}, _methods),
    _told("outputs", {name: name for name in MOMENTS}, "nominal", "mean"),
    _told("quantiles", {"value": "quantiles"}, "quantiles", "mean"),
    _told("sobol", {"first": "sobol_first", "total": "sobol_total"}),
    _told("sobol_groups", {"first": "sobol_group_first", "total": "sobol_group_total"}),
    _told("sobol_second", {"second": "sobol_second"}),
    _told("shapley", {"value": "shapley"}),
    _told("outputs", {name: name for name in ("mean", "std", "within", "between")}, "candidate_mean"),
    _told("bounds", {"total": "total_bound"}),
    _told("local", {ALONE: "derivative"}),
    *(_told(f"local_per_{one}", {ALONE: f"derivative_per_{one}"}) for one in ("std", "range")),
    *(_told(part("local", which), {ALONE: part("derivative", which)}) for which in OF_MESH),
    _told("nominal", {"value": "nominal"}, "derivative", part("nominal", "corrected")),
)


# --- the whole of it --------------------------------------------------------------------------------------------------


def summarised(
    study: StudyKind, name: str, dataset: xr.Dataset, job: Job, ranks: int, rank_groups: int, wall: float
) -> dict[str, Any]:
    """Return the contents of summary.json: the study, its results, their cost, and the versions that made them."""
    evaluations = job.evaluations
    every, done = evaluations.values(), _counts(study, evaluations, job.outcomes)
    seconds = sum(one.seconds for one in job.outcomes) or float(sum(found.seconds.sum() for found in every))
    source = own_code.digest(study)
    stability, joined = failure_domain.counts(every), failure_domain.joined_counts(every)
    none = np.zeros(len(WORK), dtype=np.int64)
    return {
        "study": name,
        "method": study.method.kind,
        "status": "partial" if done["failed"] else "complete",
        "stopped": dataset.attrs.get("stopped", study.stopped),
        **({"note": dataset.attrs["note"]} if "note" in dataset.attrs else {}),
        "findings": [{"severity": one.severity, "text": one.text, "code": one.code} for one in findings(dataset)],
        **done,
        **({"stability": stability} if stability else {}),
        **({"joined": joined} if joined else {}),
        "wall_seconds": wall,
        "cpu_seconds": seconds * study.parallel.ranks_per_model,
        "own_seconds": job.own_seconds,
        "work": dict(zip(WORK, sum((found.work.sum(axis=0) for found in every), none).tolist(), strict=True)),
        **summarise(dataset),
        "provenance": {
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "seed": getattr(study.method, "seed", None),
            "ranks": ranks,
            "groups": rank_groups,
            "processor": platform.machine(),
            "commit": commit(),
            **({} if source is None else {"source": source}),
            "versions": {"python": platform.python_version(), **versions()},
        },
        **job.told,
    }


def _counts(study: StudyKind, evaluations: Mapping[str, Evaluations], outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Number of solves, or of data sets that were inverted side by side, and which failed."""
    explains = study.explains
    solves = [(label, failure) for label, found in evaluations.items() for failure in found.failures]
    failed = [(label, failure) for label, failure in solves if not (explains and failure.inadmissible)]
    lost = [(k, one.reason) for k, one in enumerate(outcomes) if one.dataset is None]
    listed: list[dict[str, Any]] = [
        {"parameters": {"data_set": float(k)}, "reason": reason} for k, reason in lost[:LISTED]
    ]
    if not outcomes:
        listed = [
            {
                **({} if label == "/" else {"model": label}),
                "parameters": dict(zip(study.parameters_of(label), failure.parameters, strict=True)),
                "reason": failure.reason,
            }
            for label, failure in failed[:LISTED]
        ]
    unlikely = sum(failure.inadmissible for _, failure in solves)  # at parameters for which there is no model
    return {
        "evaluations": len(outcomes) or sum(len(found.points) for found in evaluations.values()),
        "failed": len(lost if outcomes else failed),
        **({"zero_likelihood": unlikely} if outcomes or explains else {}),
        "failures": listed,
    }
