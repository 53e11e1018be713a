"""Results of inversions: the dataset of all data sets with verdicts on each, batch.csv, ArviZ's groups."""

from __future__ import annotations

import csv
import io
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from forward.bodies.inclusions import derived, log_factor
from forward.findings import Finding, Severity
from forward.finer_meshes import counted as counted_on
from forward.model import FloatArray
from forward.readable import told
from inverse.criticism import assumptions, questions
from inverse.criticism import doubts as criticism
from inverse.data.shared_motion import said as said_of_motion
from inverse.low_dimensional.posterior import NOISE
from inverse.methods.record import COLUMNS, ENDS, WORDS, stacked, usual_sizes
from uq.findings import add
from uq.inputs.distributions import Distribution, Normal
from workflows.results.summary import DOUBTFUL, NEITHER, of_meshes
from workflows.studies import predicted
from workflows.studies.assumptions import KEPT, TakenForGranted
from workflows.studies.study import of_file

if TYPE_CHECKING:
    import xarray as xr

    from forward.bodies.random_fields import NodalPrior
    from inverse.data.measurements import Measurements
    from uq.evaluation.tasks import Outcome
    from workflows.studies.inversion_blocks import InversionBlocks

BATCH = "batch.csv"
PRIOR_DRAWS = 1024
Vertices = tuple[FloatArray, NDArray[np.int64], int]
SEVERITY: dict[int, Severity] = {NEITHER: "error", DOUBTFUL: "warning"}
STATISTICS = ("mode", "mean", "std", "lower", "upper", "true")
EVIDENCE = ("log_evidence", "log_evidence_error", "determined")
NUMBERS = (*EVIDENCE, "residual_square", "residual_degrees", "residual_probability")


def dataset(
    study: InversionBlocks,
    outcomes: Sequence[Outcome],
    vertices: Vertices | None,
    taken: TakenForGranted | None = None,
) -> xr.Dataset:
    """Collect the results of inversions of all data sets in a dataset, with what else is known.

    Vertices of a specimen are places (N, 3), cells (n_cells, k), and VTK's number of their kind; None of other models.
    What is taken for granted is that of the study, or of one with more data sets, of which these are some.
    """
    import xarray as xr

    taken = study.taken if taken is None else taken
    each = [one.dataset for one in outcomes]
    record = stacked(each, usual_sizes(study.method, field=study.field) | {"case": len(study.parts)})
    held: dict[str, Any] = dict(record)
    first = next(one for one in each if one is not None)
    for name in WORDS:
        if name in first:
            lost = [one.reason if name == "why" else "" for one in outcomes]
            words = [no if one is None else str(one[name].item()) for one, no in zip(each, lost, strict=True)]
            held[name] = ("data_set", words)
    held["ok"] = ("data_set", [one is not None for one in each])
    prior = study.model.fields[0].prior(study.model.body) if study.field else None
    mean, std = _prior_moments(study, prior)
    held["prior_mean"], held["prior_std"] = ("parameter", mean), ("parameter", std)
    true = np.full((len(each), len(study.names)), np.nan)
    for k, m in enumerate(study.measurements):
        for name, value in ({} if m is None else m.truth).items():
            if name in study.names:
                true[k, study.names.index(name)] = value
    held["true"] = (("data_set", "parameter"), true)
    if vertices is not None:
        held |= _of_specimen(study, {name: values for name, (_, values) in record.items()}, vertices, prior)
        if prior is not None:  # the first unknown is the mean over the body
            true[:, 0] = held["stiffness_true"][1] @ prior.matern.mass / prior.matern.mass.sum()
    sets, names, columns = study.data.sets, list(study.names), COLUMNS["field" if study.field else "parameters"]
    coordinates = {"data_set": [item.name for item in sets], "parameter": names, "partner": names}
    coordinates |= {"case": list(study.parts), "axis": ["x", "y", "z"], "column": list(columns)}
    if taken is not None and "assumption_shift" in held:
        assumed = taken.shown
        coordinates |= {"assumption": [one.name for one in assumed], "uncertain": list(taken.groups)}
        held |= {f"assumption_{key}": ("assumption", [getattr(one, key) for one in assumed]) for key in KEPT}
        by = taken.loadings
        acting = np.flatnonzero(by.any(axis=1))
        if "uncertain_point" in held and len(acting):
            held["uncertain_weight"] = (("number", "uncertain"), by[acting])
            held["uncertain_value"] = ("number", taken.values[acting])
            coordinates["number"] = [taken.numbers[k].name for k in acting]
    if study.asked:
        coordinates["question"] = list(study.asked)
    if study.predict is not None:
        goals = study.predicted.returned
        coordinates["goal"] = [one.name for one in goals]
        held["goal_unit"] = ("goal", [one.unit for one in goals])
    # Displacements of a specimen are what is meant where nothing is said.
    return xr.Dataset(held, coordinates, {} if vertices is not None else {"quantity": study.data.quantity})


def _of_specimen(
    study: InversionBlocks, record: Mapping[str, FloatArray], vertices: Vertices, prior: NodalPrior | None
) -> dict[str, Any]:
    """What is known beside the inversions of a specimen: of its points, its inclusions, its mesh."""
    places, cells, kind = vertices
    found = list(study.measurements)
    moves, size = [np.zeros(0) if m is None else m.moves for m in found], record["place"].shape[1]
    each = (np.zeros(0) if m is None else m.moved for m in found)  # how far (m) the point of each datum was moved
    moved = [np.pad(one, (0, size - len(one)), constant_values=np.nan) for one in each]
    before = study.stiffness(places, prior_draws(study)).std(axis=0) if prior is None else np.sqrt(prior.variance)
    return {
        "points_moved": ("data_set", [int((one > 0).sum()) for one in moves]),
        "largest_move": ("data_set", [float(one.max(initial=0.0)) for one in moves]),
        "rms_move": ("data_set", [float(np.linalg.norm(one) / np.sqrt(max(len(one), 1))) for one in moves]),
        "points_left_out": ("data_set", [0 if m is None else len(m.left_out) for m in found]),
        "datum_move": (("data_set", "datum"), np.array(moved)),
        "stiffness_prior_std": ("node", before),
        **_volumes(study, record, found),
        "stiffness_true": (("data_set", "node"), np.array([_true_at(m, places) for m in found])),
        "node_position": (("node", "axis"), places),
        "cell_nodes": (("cell", "corner"), cells, {"vtk_cell_type": kind}),
    }


def _volumes(study: InversionBlocks, record: Mapping[str, FloatArray], found: list[Any]) -> dict[str, Any]:
    """Posterior of the volumes (m³) of inclusions whose radii are unknown, from the stored draws."""
    names = study.inputs.names
    before = derived(study.model.inclusions, names, prior_draws(study)) if not study.field else {}
    labels = [label for label, values in before.items() if np.ptp(values) > 0]
    if not labels:
        return {}

    def of(points: FloatArray, inclusions: tuple[Any, ...] = study.model.inclusions) -> FloatArray:
        values = derived(inclusions, names if points.shape[1] else (), points)
        return np.column_stack([values.get(label, np.full(len(points), np.nan)) for label in labels])

    draws = np.array([of(rows[:, : len(names)]) for rows in record["draw"]])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of data sets that could not be inverted there are none
        lower, upper = np.nanquantile(draws, ENDS, axis=1)
        mean, std = np.nanmean(draws, axis=1), np.nanstd(draws, axis=1)
    true = np.array([of(np.zeros((1, 0)), (m.truth.get("inclusions", ()) if m is not None else ()))[0] for m in found])
    here = {"mode": of(record["mode"][:, : len(names)]), "mean": mean, "std": std, "lower": lower, "upper": upper}
    prior = np.column_stack([before[label] for label in labels])
    return {
        **{f"volume_{name}": (("data_set", "inclusion"), values) for name, values in here.items()},
        "volume_true": (("data_set", "inclusion"), true),
        "volume_prior_mean": ("inclusion", prior.mean(axis=0)),
        "volume_prior_std": ("inclusion", prior.std(axis=0)),
        "inclusion": ("inclusion", [label.split(".")[1] for label in labels]),
    }


def _prior_moments(study: InversionBlocks, prior: NodalPrior | None) -> tuple[FloatArray, FloatArray]:
    """Prior mean and standard deviation (c,) of the parameters."""
    if prior is not None:
        field = study.model.fields[0]
        volumes = prior.matern.mass
        g = volumes / volumes.sum()
        width = float(np.linalg.norm(prior.root_transposed(g)))
        moments = [(float(np.log(field.mean) - field.log_std**2 / 2), width)]
    else:
        moments = list(zip(study.inputs.mean, study.inputs.std, strict=True))
    if study.method.noise is not None:
        moments.append(study.method.noise.moments)
    mean, std = np.array(moments).T
    return mean, std


def prior_draws(study: InversionBlocks) -> FloatArray:
    """Prior draws (n, d) of the parameters."""
    return study.inputs.drawn(np.random.default_rng(study.method.seed), PRIOR_DRAWS)


def _true_at(measurement: Measurements | None, places: FloatArray) -> FloatArray:
    """Logarithm (N,) of the true stiffness factor at the vertices; NaN where it is unknown."""
    if measurement is None:
        return np.full(len(places), np.nan)
    truth = measurement.truth
    if truth.get("inclusions"):
        return np.asarray(log_factor(truth["inclusions"], (), np.zeros((1, 0)), places)[0])
    if len(truth.get("stiffness", ((), ()))[0]):
        from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

        linear, nearest = (of(*truth["stiffness"])(places) for of in (LinearNDInterpolator, NearestNDInterpolator))
        return np.asarray(np.where(np.isfinite(linear), linear, nearest))  # beyond the hull, by rounding
    return np.full(len(places), np.nan)


# --- verdicts --------------------------------------------------------------------------------------------------------


def judged(dataset: xr.Dataset, study: InversionBlocks) -> xr.Dataset:
    """Look for everything that makes the posteriors of an inversion doubtful; return the results with verdicts."""
    words, trust = [str(why) for why in dataset["why"].values], dataset["trust"].to_numpy().copy()
    said: list[Finding] = []
    if study.predict is not None:
        predicted.keep_unknown_meshes(study, dataset)
    for k, name in enumerate(dataset.data_set.values):
        if not bool(dataset["ok"][k]):
            said.append(Finding("not-inverted", "warning", {"name": name, "why": words[k]}))
            continue
        doubts = doubts_of(dataset.isel(data_set=k), study, k)
        words[k], trust[k] = _verdict(words[k], int(trust[k]), doubts)
        said.append(Finding("verdict", SEVERITY.get(int(trust[k]), "note"), {"verdict": words[k]}, subject=str(name)))
        said += [one.of(str(name)) for one in doubts]
        if study.predict is not None:
            said += [one.of(f"{name}: predictions") for one in predicted.findings(dataset.isel(data_set=k))]
    found = dataset.assign(why=("data_set", words), trust=("data_set", trust))
    add(found, *said)
    return found


def _verdict(words: str, trust: int, doubts: list[Finding]) -> tuple[str, int]:
    """Return the sentence and the number of a verdict, given those before any doubts."""
    errors = [doubt.short for doubt in doubts if doubt.severity == "error"]
    warnings = [doubt.short for doubt in doubts if doubt.severity == "warning"]
    if trust == NEITHER:
        return "; ".join([words, *errors, *warnings]), NEITHER
    if errors:
        return f"not to be trusted: {'; '.join([*errors, *warnings])}", NEITHER
    if warnings:
        return f"doubtful: {'; '.join(warnings)}; but for that: {words}", DOUBTFUL
    return words, trust


def doubts_of(one: xr.Dataset, study: InversionBlocks, number: int) -> list[Finding]:
    """Say what is doubtful about one data set, given by its number."""
    found: list[Finding] = []
    names = [str(name) for name in one.parameter.values]
    mode, mean = one["mode"].to_numpy(), one["mean"].to_numpy()
    square, degrees = float(one["prior_square"]), float(one["prior_degrees"])
    d, units = len(names) - (study.method.noise is not None), study.units_of("/")
    if study.field:
        centre, width = float(one["prior_mean"][0]), float(one["prior_std"][0])
        priors: dict[str, Distribution] = {names[0]: Normal(mean=centre, std=width)}
        stiffness = (one[name].to_numpy() for name in ("stiffness_std", "stiffness_prior_std", "node_position"))
        found += criticism.little_seen(*stiffness)
    else:
        priors = dict(study.inputs.marginals)
        found += criticism.heavy_tails(names, one["outermost"].to_numpy())
        found += criticism.tails_cut(float(one["cut"]))
        found += criticism.at_an_end(priors, mode[:d], one["draw"].to_numpy()[:, :d], units)
    found += criticism.far_from_prior(priors, mode[:d], mean[:d], square, degrees, units)
    found += assumptions.findings_in(one) if "assumption_shift" in one else []
    found += questions.findings_in(one) if study.asked else []
    seen = np.isfinite(one["measured"].to_numpy())
    residual, resolution = one["residual"].to_numpy()[seen], one["resolution"].to_numpy()[seen]
    if study.method.noise is not None:
        sigma, measured = one["sigma"].to_numpy()[seen], one["measured"].to_numpy()[seen]
        found += criticism.noise_far(float(mode[-1]), study.method.noise.at(0.5), sigma, measured)
    else:
        found += criticism.too_large_errors(
            *(float(one[f"residual_{n}"]) for n in ("square", "degrees", "probability"))
        )
    labels = study.measurements[number].data_labels()
    found += criticism.strangers(residual, resolution, labels, heavy=study.data.errors.kind != "normal")
    if "points_moved" in one:
        data, count = study.measurements[number], int(one["points_moved"])
        if count:
            moves = {"farthest": told(float(one["largest_move"]), "m"), "rms": told(float(one["rms_move"]), "m")}
            where = "" if data.on_surface else " outside the body"
            points = "1 point" if count == 1 else f"{count} points"
            found.append(Finding("data-moved", "note", {"points": points, "where": where, **moves}))
        if data.registered is not None:
            found.append(Finding("registered", "note", {"how": data.registered.described}))
        found += data.findings
    return [*found, *_of_errors(one), *_of_mesh(one, study, number)]


def _of_errors(one: xr.Dataset) -> list[Finding]:
    """Say what errors beside those of the data one data set was inverted with."""
    found: list[Finding] = []
    if "process_size" in one:
        size, length = (told(float(one[f"process_{name}"]), "m") for name in ("size", "length"))
        found.append(Finding("unexplained", "note", {"size": size, "length": length}))
    if "motion_eigenvalue" in one:
        motions = one["motion_eigenvalue"].to_numpy()
        found.append(said_of_motion(motions[np.isfinite(motions)]))
    if "expansion_error" in one:
        found += criticism.expansion_off(float(one["expansion_error"]), int(one["expansion_solves"]))
    if "model_error" in one:
        found.append(criticism.learnt(one))
    if "reduced_share" in one:
        shift = dict(zip(one.parameter.values.tolist(), one["reduced_shift"].to_numpy().tolist(), strict=True))
        found += criticism.reduced_off(float(one["reduced_share"]), shift, int(one["solves"]))
    return found


def _of_mesh(one: xr.Dataset, study: InversionBlocks, number: int) -> list[Finding]:
    """Say what the mesh does to one data set, given by its number, and what of it is doubtful."""
    if "mesh_checked" not in one:
        return []
    error = one["mesh_error"].to_numpy()[np.isfinite(one["measured"].to_numpy())]
    settled, counted = bool(one["mesh_settled"]), not study.field or counted_on(study.model)
    found = criticism.of_mesh(one, error, settled=settled, counted=counted, from_file=of_file(study.model))
    return criticism.not_estimable(study.not_estimable(number)) + found


# --- batch.csv, and ArviZ's groups -----------------------------------------------------------------------------------


def batch_table(found: xr.Dataset) -> str:
    """Return a table of comma-separated values with a row for each data set."""
    names, cases = ([str(name) for name in found[key].values] for key in ("parameter", "case"))
    return _table(names, cases, (_row(found.sel(data_set=label)) for label in found.data_set.values))


def _table(names: Sequence[str], cases: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """Return a table with all columns; what a row does not have is empty."""
    columns = ["data_set", "ok", "data", "points_moved"]
    columns += [*(f"{name} {key}" for name in names for key in STATISTICS), *NUMBERS]
    columns += [*(f"misfit {case}" for case in cases), "why", "mesh_error", "mesh_corrected"]
    columns += [f"{name} mesh_shift" for name in names]
    file = io.StringIO()
    writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return file.getvalue()


def _row(one: xr.Dataset) -> dict[str, Any]:
    """Cells of a data set, by columns."""
    names = [str(name) for name in one.parameter.values]
    values = {f"{name} {key}": one[key].sel(parameter=name) for name in names for key in STATISTICS}
    values |= {key: one[key] for key in NUMBERS}
    values |= {f"misfit {case}": one["misfit"].sel(case=case) for case in one.case.values}
    row = {key: f"{float(value):.8g}" for key, value in values.items() if np.isfinite(float(value))} | {
        "data_set": str(one.data_set.item()),
        "ok": "yes" if bool(one["ok"]) else "no",
        "data": str(int(np.isfinite(one["measured"]).sum())),
        "points_moved": str(int(one["points_moved"]) if "points_moved" in one else 0),
        "why": str(one["why"].item()),
    }
    if "mesh_checked" not in one or one["mesh_checked"] != 1:  # finer meshes said nothing
        return row
    error, shifts = of_meshes(one)["error"], zip(names, one["mesh_shift"].to_numpy(), strict=True)
    row |= {"mesh_error": "" if error is None else f"{error:.4g}"}
    row |= {"mesh_corrected": "yes" if one["mesh_corrected"] == 1 else "no"}
    return row | {f"{name} mesh_shift": f"{shift:.4g}" for name, shift in shifts if np.isfinite(shift)}


def table_of_finished(
    study: InversionBlocks, vertices: Vertices | None, write: Callable[[str], None]
) -> Callable[[int, Outcome], None]:
    """Return what takes a finished data set, by its number, and writes the table of all that are finished, in order.

    Vertices are as in `dataset`.
    """
    rows: dict[int, Mapping[str, Any]] = {}

    def add(number: int, outcome: Outcome) -> None:
        one, measurement = study.data.sets[number], study.measurements[number]
        if outcome.dataset is None:
            moved = 0 if measurement is None else int((measurement.moves > 0).sum())
            why = outcome.reason
            rows[number] = {"data_set": one.name, "ok": "no", "data": 0, "points_moved": moved, "why": why}
        else:
            data = study.data.model_copy(update={"sets": (one,)})
            alone = study.model_copy(update={"data": data, "measurements": (measurement,)})
            rows[number] = _row(judged(dataset(alone, [outcome], vertices, study.taken), alone).isel(data_set=0))
        write(_table(study.names, study.parts, (rows[number] for number in sorted(rows))))

    return add


def arviz_groups(study: InversionBlocks, found: xr.Dataset) -> dict[str, xr.Dataset]:
    """Return ArviZ's groups: `arviz.from_netcdf("results.nc")`."""
    import xarray as xr

    of_set = found if found.sizes["data_set"] > 1 else found.isel(data_set=0, drop=True)

    # The draws of all chains follow one another, the same number of each.
    counts = set(found["chains"].to_numpy()[found["ok"].to_numpy()].astype(int).tolist())
    chains = max(counts.pop() if len(counts) == 1 and not study.field else 1, 1)
    each = found.sizes["sample"] // chains

    def draws(name: str) -> xr.DataArray:
        whole = of_set[name].isel(sample=slice(chains * each)).coarsen(sample=each)
        return whole.construct(sample=("chain", "draw"), keep_attrs=False).transpose("chain", "draw", ...)

    left: dict[str, xr.Dataset] = {}
    observed = {study.data.quantity: of_set["measured"]}
    left["observed_data"] = xr.Dataset(observed).drop_vars("parameter", errors="ignore")
    if study.field:
        left["posterior"] = xr.Dataset({"stiffness": draws("stiffness_draw")})
        return left
    whole = draws("draw")
    left["posterior"] = xr.Dataset({str(name): whole.sel(parameter=name, drop=True) for name in found.parameter.values})
    before = prior_draws(study)
    columns = {name: (("chain", "draw"), before[None, :, i]) for i, name in enumerate(study.inputs.names)}
    if study.method.noise is not None:
        z = np.random.default_rng([study.method.seed, 1]).standard_normal(PRIOR_DRAWS)
        columns[NOISE] = (("chain", "draw"), study.method.noise.from_normal(z)[0][None])
    left["prior"] = xr.Dataset(columns)
    dense = draws("draw_log_likelihood")
    left["log_likelihood"] = xr.Dataset({study.data.quantity: dense})
    seen = np.isfinite(found["measured"].to_numpy())
    # For different numbers of data: one variable for each, without padding.
    if len(seen) > 1 and not seen.all():
        parts = {
            str(name): dense.sel(data_set=name, drop=True)[..., here].rename(datum=f"datum_{name}")
            for name, here in zip(found.data_set.values, seen, strict=True)
            if here.any()
        }
        left["log_likelihood"] = left["log_likelihood"].assign(parts)
    return left
