"""A population of specimens: typical and new ones, and each specimen by itself and as one of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from forward.readable import interval, quantity, scale, size, spoken
from forward.words import named, number, with_error
from workflows.report.blocks import Answer, Block, Card, Heading, Picture, Pictures, Table, Text
from workflows.report.plots import population as plots
from workflows.report.section import Results, Section
from workflows.report.small_density import CURVE, curve_of, smooth

if TYPE_CHECKING:
    import xarray as xr

    from forward.model import FloatArray


class PopulationOfSpecimens(Section):
    """Tables of the population and of its specimens."""

    def applies(self, results: Results) -> bool:
        """Whether there is one."""
        return "population_draw" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """The population, then the specimens."""
        of = results.dataset
        yield Heading("The population")
        logarithmic = bool(int(of["logarithmic"]))
        what = (
            "ln |parameter|, whose standard deviation is given, is normal" if logarithmic else "parameters are normal"
        )
        yield Text(
            f"Over specimens, {what}. Intervals hold 95 %: that of the typical specimen is what is not known of it, "
            "that of a new one has the spread of the population too."
        )
        rows = [
            (
                name,
                *(
                    _interval(
                        of[f"{which}_quantiles"].sel(parameter=name),
                        "1" if logarithmic and which == "scale" else results.parameter_unit(name),
                    )
                    for which in ("typical", "scale", "new")
                ),
            )
            for name in results.parameters
        ]
        yield Table(("parameter", "typical specimen", "standard deviation", "new specimen"), rows)
        pairs = [(a, b) for i, a in enumerate(results.parameters) for b in results.parameters[i + 1 :]]
        if pairs:
            correlations = of["correlation_quantiles"]
            cells = [(a, b, _interval(correlations.sel(parameter=a, partner=b))) for a, b in pairs]
            yield Table(("parameter", "with", "correlation"), cells, text=frozenset({0, 1}))
        if "slope_quantiles" in of:
            yield Text("How means change with what specimens differ in, by one unit of it:")
            slopes = of["slope_quantiles"]
            changes = [
                (str(by), name, _interval(slopes.sel(covariate=by, parameter=name)))
                for by in of["covariate"].values
                for name in results.parameters
            ]
            yield Table(("covariate", "parameter", "change"), changes, text=frozenset({0, 1}))
        yield Heading("Its specimens")
        caption = "Each specimen by its own data (95 %), and as one of the population; bands hold 95 %."
        units = {name: results.parameter_unit(name) for name in results.parameters}
        yield Pictures([Picture.drawn(plots.specimens(of, name, units[name]), caption) for name in results.parameters])
        yield Text(
            "By its own data alone, and with what the others say on what specimens are like. The last column is how "
            "many of its draws lie where the population is."
        )
        yield specimens(results)


def specimens(results: Results) -> Table:
    """A line for each specimen."""
    of = results.dataset
    sizes = {
        name: scale(float(of["typical_quantiles"].sel(parameter=name)[1]), results.parameter_unit(name))
        for name in results.parameters
    }
    lines = []
    for specimen in map(str, of["specimen"].values):
        one = of.sel(specimen=specimen)
        cells = [
            with_error(*(float(one[f"{who}_{which}"].sel(parameter=name)) / size for which in ("mean", "std")))
            for name, (size, _) in sizes.items()
            for who in ("own", "specimen")
        ]
        lines.append((specimen, *cells, number(float(one["specimen_effective"]), 3)))
    heads = [
        f"{named(spoken(name), unit)}, {who}"
        for name, (_, unit) in sizes.items()
        for who in ("by itself", "of the population")
    ]
    return Table(("specimen", *heads, "effective"), lines)


def _interval(quantiles: xr.DataArray, unit: str = "1") -> str:
    """Write a median, to the place of a deviation, with the ends of an interval."""
    lower, middle, upper = (float(x) for x in quantiles.to_numpy())
    return f"{quantity(middle, (upper - lower) / 4, unit)} ({interval(lower, upper, unit, middle)})"


def card(results: Results) -> Card:
    """Each parameter: the typical specimen, and a new one."""
    of = results.dataset
    question = f"From {of.sizes['specimen']} specimens: what is typical of their kind, and what will a new one be like?"
    answers = []
    for name in results.parameters:
        unit = results.parameter_unit(name)
        (low, mid, high), new, scale = (
            [float(x) for x in of[f"{which}_quantiles"].sel(parameter=name)] for which in ("typical", "new", "scale")
        )
        factor = f"a factor of {number(float(np.exp(scale[1])), 3)}"
        spread_ = factor if int(of["logarithmic"]) else f"± {size(scale[1], unit)}"
        at, curve = _new_specimens(
            _trimmed(of["population_draw"].sel(parameter=name).to_numpy()), logarithmic=bool(of["logarithmic"])
        )
        lines = [
            f"typical specimen, 95\u00a0%: {interval(low, high, unit, mid)}",
            f"a new specimen, 95\u00a0%: {interval(new[0], new[2], unit, new[1])}",
            f"specimens differ by {spread_} (one standard deviation)",
        ]
        shown = curve_of(at, curve, (new[0], new[2]), unit, mid)
        answers.append(Answer(spoken(name), quantity(mid, (high - low) / 4, unit), lines, *shown))
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


def _trimmed(values: FloatArray) -> FloatArray:
    """Return values without the outer per cent at each end, which may be far away."""
    low, high = np.quantile(values, (0.01, 0.99))
    return np.asarray(values[(values >= low) & (values <= high)])
