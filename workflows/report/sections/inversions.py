"""What goes with inversions: batches, predictions, populations, designs, synthetic data."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, product
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.readable import NONE, and_error, interval, number, percent, place, quantity, size, spoken, with_error
from uq.estimators.estimate import single
from workflows.report.blocks import CURVE, Answer, Block, Card, Heading, Pictures, Table, Text, curve_of, smooth
from workflows.report.plots import places as maps
from workflows.report.plots import posterior as plots
from workflows.report.section import Results, section
from workflows.results.summary import against_random

if TYPE_CHECKING:
    import xarray as xr

    from forward.model import FloatArray

TRUSTED = ("Laplace's", "corrected", "not to be trusted", "doubtful")
SHOWN = 24  # rows of the table of a data set
SETS = 12  # data sets that have a table
PREDICTED = ("output", "predicted", "95 %", "before the data", "share of the variance removed", "error of the mesh")
WORTH = {
    "information": "What they tell (nat)",
    "parameters": "Share of the parameters' variances that they take away",
    "predictions": "Share of the predictions' variances that they take away",
    "models": "Expected ln Bayes factor of the true model (nat)",
}
FIRST = 5  # observations on the card


@section("alone_eigenvalue", heading="All data sets", when=lambda results: results.dataset.sizes["data_set"] > 1)
def batch(results: Results) -> Iterator[Block]:
    """All data sets that were inverted, one row each."""
    yield Text(
        "± is one posterior standard deviation; batch.csv has more digits. The first data sets that could be "
        "inverted follow one by one."
    )
    dataset = results.dataset
    sizes = results.columns(abs(dataset["mean"]).median("data_set"))
    rows = []
    for label in dataset.data_set.values:
        one = dataset.sel(data_set=label)
        if not bool(one["ok"]):
            rows.append((str(label), "", "failed", *[""] * (len(sizes) + 3)))
            continue
        values = _in_units(one, sizes, "")
        digits = {"determined": 3, "residual_probability": 2, "log_evidence": 6}
        rest = (number(float(one[name]), most) for name, most in digits.items())
        count = f"{int(np.isfinite(one['measured']).sum()):,}"
        rows.append((str(label), count, TRUSTED[int(one["trust"])], *values, *rest))
    units = [head for _, head in sizes.values()]
    head = ("data set", "data", "posterior", *units, "directions determined", "p of larger residuals", "ln Z")
    yield Table(head, rows, text={0, 2})


def _in_units(one: xr.Dataset, sizes: dict[str, tuple[float, str]], *whose: str) -> list[str]:
    """Write means of parameters with their deviations, in the units of `Results.columns`; names begin with whose."""
    return [
        with_error(*(float(one[f"{who}{which}"].sel(parameter=name)) / size for which in ("mean", "std")))
        for name, (size, _) in sizes.items()
        for who in whose
    ]


@section("prediction_share", heading="Predictions")
def predictions(results: Results) -> Iterator[Block]:
    """What is predicted from each data set, and what its data added."""
    of = results.dataset
    yield Text(
        "Outputs that were not measured, by the posterior: mean ± standard deviation, and the interval that holds "
        "95 %. Beside it what was known before the data, and the share of the variance that the data have removed. "
        "The error of the mesh is what is to be added to the mean; intervals do not hold it."
    )
    done = [str(name) for name, ok in zip(of["data_set"].values, of["ok"].values, strict=True) if bool(ok)]
    for name in done[:SETS]:
        one, rows = of.sel(data_set=name), []
        if len(done) > 1:
            yield Heading(name, level=3)
        for goal in one["goal"].values[:SHOWN]:
            at = one.sel(goal=goal)
            unit, mesh = str(at["goal_unit"].item()), single(at, "prediction_mean").mesh
            before, wide, share = (float(at[f"prediction_{name}"]) for name in ("prior_mean", "prior_std", "share"))
            removed = percent(share) if np.isnan(share) or share >= 0 else "none"
            error = size(mesh, unit) if np.isfinite(mesh) else "not estimated"
            rows.append((str(goal), *_band(at), and_error(before, wide, unit), removed, error))
        yield Table(PREDICTED, rows)
        if "prediction_process_mean" in one:
            yield Text("With what the model does not explain, where it is known from displacements around there:")
            parts = (one.sel(goal=goal) for goal in one["goal"].values[:SHOWN])
            yield Table(PREDICTED[:3], [(str(at["goal"].item()), *_band(at, "process_")) for at in parts])
        if np.isfinite(one["prediction_std"]).any():
            caption = "95 % intervals before and after the data, each relative to the one before."
            yield Pictures.of((plots.bands(one), caption))
    if len(done) > SETS:
        yield Text(f"Those of {len(done) - SETS} more data sets are in results.nc.")


def _band(at: xr.Dataset, kind: str = "") -> tuple[str, str]:
    """A prediction and its interval; of the kind "process_" with what the model does not explain."""
    unit, names = str(at["goal_unit"].item()), ("mean", "std", "lower", "upper")
    mean, std, lower, upper = (float(at[f"prediction_{kind}{name}"]) for name in names)
    return and_error(mean, std, unit), interval(lower, upper, unit, max(mean, std, key=abs))


@section("population_draw", heading="The population")
def population_of_specimens(results: Results) -> Iterator[Block]:
    """Tables of the population and of its specimens."""
    of = results.dataset
    logarithmic = bool(int(of["logarithmic"]))
    what = "ln |parameter|, whose standard deviation is given, is normal" if logarithmic else "parameters are normal"
    yield Text(
        f"Over specimens, {what}. Intervals hold 95 %: that of the typical specimen is what is not known of it, "
        "that of a new one has the spread of the population too."
    )
    rows = []
    for name in results.parameters:
        unit = results.parameter_unit(name)
        kinds = {"typical": unit, "scale": "1" if logarithmic else unit, "new": unit}
        rows.append((name, *(_interval(of[f"{k}_quantiles"].sel(parameter=name), u) for k, u in kinds.items())))
    yield Table(("parameter", "typical specimen", "standard deviation", "new specimen"), rows)
    if len(results.parameters) > 1:
        of_pair, pairs = of["correlation_quantiles"], combinations(results.parameters, 2)
        rows = [(a, b, _interval(of_pair.sel(parameter=a, partner=b))) for a, b in pairs]
        yield Table(("parameter", "with", "correlation"), rows, text={0, 1})
    if "slope_quantiles" in of:
        yield Text("How means change with what specimens differ in, by one unit of it:")
        slopes, each = of["slope_quantiles"], product(of["covariate"].values, results.parameters)
        rows = [(str(by), name, _interval(slopes.sel(covariate=by, parameter=name))) for by, name in each]
        yield Table(("covariate", "parameter", "change"), rows, text={0, 1})
    yield Heading("Its specimens")
    caption = "Each specimen by its own data (95 %), and as one of the population; bands hold 95 %."
    drawn = (plots.specimens(of, name, results.parameter_unit(name)) for name in results.parameters)
    yield Pictures.of(*((ax, caption) for ax in drawn))
    yield Text(
        "By its own data alone, and with what the others say on what specimens are like. The last column is how "
        "many of its draws lie where the population is."
    )
    sizes = results.columns(of["typical_quantiles"].transpose(..., "parameter")[1])
    alone = {str(name): of.sel(specimen=name) for name in of["specimen"].values}
    rows = [
        (name, *_in_units(one, sizes, "own_", "specimen_"), number(float(one["specimen_effective"]), 3))
        for name, one in alone.items()
    ]
    heads = [f"{head}, {who}" for _, head in sizes.values() for who in ("by itself", "of the population")]
    yield Table(("specimen", *heads, "effective"), rows)


def _interval(quantiles: xr.DataArray, unit: str = "1") -> str:
    """Write a median, to the place of a deviation, with the ends of an interval."""
    lower, middle, upper = (float(x) for x in quantiles.to_numpy())
    return f"{quantity(middle, (upper - lower) / 4, unit)} ({interval(lower, upper, unit, middle)})"


def population_card(results: Results) -> Card:
    """Each parameter: the typical specimen, and a new one."""
    of = results.dataset
    question = f"From {of.sizes['specimen']} specimens: what is typical of their kind, and what will a new one be like?"
    answers = []
    for name in results.parameters:
        unit, kinds = results.parameter_unit(name), ("typical", "new", "scale")
        (low, mid, high), new, scale = (of[f"{k}_quantiles"].sel(parameter=name).to_numpy().tolist() for k in kinds)
        logarithmic = bool(of["logarithmic"])
        differ = f"a factor of {number(float(np.exp(scale[1])), 3)}" if logarithmic else f"± {size(scale[1], unit)}"
        values = of["population_draw"].sel(parameter=name).to_numpy()
        least, most = np.quantile(values, (0.01, 0.99))  # the outer per cent at each end may be far away
        drawn = _new_specimens(values[(values >= least) & (values <= most)], logarithmic=logarithmic)
        lines = [
            f"typical specimen, 95\u00a0%: {interval(low, high, unit, mid)}",
            f"a new specimen, 95\u00a0%: {interval(new[0], new[2], unit, new[1])}",
            f"specimens differ by {differ} (one standard deviation)",
        ]
        shown = curve_of(*drawn, (new[0], new[2]), unit, mid)
        answers.append(Answer(spoken(name), quantity(mid, (high - low) / 4, unit), lines, shown))
    return Card(question, answers)


def _new_specimens(values: FloatArray, *, logarithmic: bool) -> tuple[FloatArray, FloatArray]:
    """Return places (m,) and the density (m,) of draws (n,) there; of those of one sign by their logarithms."""
    if not logarithmic:
        return smooth(values)
    sign = np.sign(np.median(values))
    logs = np.log(sign * values[sign * values > 0])
    at, curve = smooth(logs)
    sizes = np.linspace(np.exp(logs.min()), np.exp(logs.max()), CURVE)
    found = np.interp(np.log(sizes), at, curve) / sizes
    order = np.argsort(sign * sizes)
    return (sign * sizes)[order], found[order]


@section("chosen", heading="Which observations tell most")
def chosen_observations(results: Results) -> Iterator[Block]:
    """Pictures and a table of the chosen observations, and what they leave of the unknowns."""
    found, design = results.dataset, results.summary["design"]
    against, criterion = against_random(design), results.study.method.criterion
    known = number(float(found["information"][-1]))
    tell = f"Together they tell {known} nat on average over the draws of what is not known"
    if criterion == "models":
        tell = f"If one of the models is true, its expected ln Bayes factor against another is {known} nat"
    yield Text(f"{against[0].upper()}{against[1:]}. {tell}. They are in design.csv in their order.", "lead")
    random = "Chosen observations, and the band of 90 % of random ones."
    drawn = [(maps.against_number(found, WORTH[criterion]), random)]
    if np.isfinite(found["candidate_place"].to_numpy()[found["chosen"].to_numpy()]).all(axis=1).any():
        bounds = results.study.specs[0].body.bounds
        drawn.append((maps.on_body(found, bounds), "Candidates and chosen points, in their order."))
    yield Pictures.of(*drawn)
    rows = []
    for k, one in enumerate(design["chosen"], start=1):
        where = NONE if None in one["place"] else place(one["place"])
        numbers = (number(one[what]) for what in ("gain", "information", "cost"))
        rows.append((str(k), one["name"], one["case"] or NONE, where, one["measured"], *numbers))
    head = ("", "observation", "load case", "place", "measured", "adds (nat)", "together (nat)", "cost together")
    yield Table(head, rows, text={1, 2, 3, 4})
    if "log_bayes_factor" in found:
        names, factors = [str(name) for name in found["model"].values], found["log_bayes_factor"].to_numpy()
        rows = [(name, *(number(float(x)) for x in row)) for name, row in zip(names, factors, strict=True)]
        yield Text("Expected ln Bayes factor (nat) of a model that is true against each other one:")
        yield Table(("true", *names), rows)
    if "field_variance_told" in found:
        share = number(100 * float(found["field_variance_told"][-1]), 3)
        yield Text(f"Share of the variance of the field over the body that they take away: {share} %.")
    if "posterior_std" in found:
        rows = []
        for name in results.leading(found["posterior_std"] / found["prior_std"]):
            stds = [float(found[f"{which}_std"].sel(parameter=name)) for which in ("prior", "posterior")]
            rows.append((name, *(size(std, results.parameter_unit(name), 3, like=stds[0]) for std in stds)))
        yield Text("Standard deviations before and after all chosen observations, by the linearised models:")
        yield Table(("parameter", "before", "after"), rows)


def design_card(results: Results) -> Card:
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


@section("clean", heading="The data")
def synthetic_data(results: Results) -> Iterator[Block]:
    """How many data were made, how large they are, and their errors."""
    values, sigma = (results.dataset[name].to_numpy() for name in ("values", "sigma"))
    units, rows = units_of(results.study.model), []
    kinds = [(name.partition(".")[0], units.get(name, "m")) for name in results.outputs]
    first = [part for part, _ in kinds]  # parts are in their order, with their units together
    for kind in sorted(dict.fromkeys(kinds), key=lambda kind: first.index(kind[0])):
        here = [k for k, one in enumerate(kinds) if one == kind]
        made = np.isfinite(values[:, here])
        if made.any():
            largest, error = (float(np.abs(x[:, here][made]).max()) for x in (values, sigma))
            rows.append((kind[0], f"{int(made.sum()):,}", size(largest, kind[1], 3), size(error, kind[1])))
    yield Table(("of", "data", "largest", "largest standard error"), rows)


def units_of(model: Any) -> dict[str, str]:
    """Units of what is measured of a model beside displacements (m), by name."""
    if model.placed:
        return {f"{case}.{name}": unit for case, of in model.measurable.items() for name, unit in of.items()}
    return {output.name: output.unit for output in model.returned}
