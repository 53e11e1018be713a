"""Moments, quantiles and distributions of outputs, and what controls and expansions did for them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from forward.readable import and_error, margin, size
from forward.words import number, worth
from uq.estimators.estimate import estimate_of, part, single
from uq.estimators.moments import half_width
from workflows.report import plots
from workflows.report.blocks import Block, Heading, Picture, Pictures, Table, Text
from workflows.report.section import Results, Section

if TYPE_CHECKING:
    import xarray as xr

CORRECTED = tuple(part(name, "corrected") for name in ("mean", "std"))  # with the estimated error of the mesh


class Moments(Section):
    """Mean and standard deviation of the outputs, with their errors."""

    needs = ("mean", "nominal")

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("Mean and standard deviation")
        yield Text("± is one standard error; a 95\u00a0% interval is about twice as wide on either side.")
        yield moments(results)


def moments(results: Results) -> Table:
    """Mean and standard deviation of the outputs, with those of plain Monte Carlo beside controlled ones."""
    names = [n for n in ("mean", "std", *CORRECTED, "plain_mean", "plain_std") if n in results.dataset]
    words = {
        "mean": "mean",
        "std": "standard deviation",
        CORRECTED[0]: "mean, error of the mesh added",
        CORRECTED[1]: "standard deviation, error of the mesh added",
        "plain_mean": "mean, plain Monte Carlo",
        "plain_std": "standard deviation, plain Monte Carlo",
    }
    rows = [(output, *(results.estimate(output, name) for name in names)) for output in results.outputs]
    return Table(("output", *(words[name] for name in names)), rows)


class TotalErrors(Section):
    """Errors of means and standard deviations by source."""

    needs = ("bias_error",)

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("Total errors", level=3)
        yield Text("The error of the mesh is estimated from the differences between meshes.")
        yield total_errors(results)


def total_errors(results: Results) -> Table:
    """Errors of means and standard deviations by where they come from."""
    rows = []
    for output in results.outputs:
        of_output = results.of(output)
        for name, word, first in (("mean", "mean", ""), ("std", "standard deviation", "std_")):
            one = single(of_output, name)
            found = (one.error, float(of_output[f"{first}bias_error"]), one.total)
            errors = [margin(error, results.unit(output)) for error in found]
            rows.append((f"{word} of {output}", *errors))
    return Table(("estimate", "sampling", "mesh", "total"), rows)


class Quantiles(Section):
    """Quantiles of the outputs."""

    needs = ("quantiles",)

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("Quantiles", level=3)
        yield quantiles(results)


def quantiles(results: Results) -> Table:
    """Quantiles of the outputs."""
    rows = []
    for output in results.outputs:
        found = estimate_of(results.of(output), "quantiles")
        for words, values, errors in (
            (output, found.value, found.error),
            (f"{output}, corrected for the mesh", found.corrected, found.left),
        ):
            if words == output or np.isfinite(values).all():
                pairs = zip(values.tolist(), errors.tolist(), strict=True)
                rows.append((words, *(and_error(value, error, results.unit(output)) for value, error in pairs)))
    return Table(("output", *(f"{100 * p:g} %" for p in results.dataset["quantile"].to_numpy())), rows)


class Nominal(Section):
    """The outputs at the mean parameters."""

    needs = ("nominal",)

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("Outputs at the mean parameters")
        yield nominal(results)


def nominal(results: Results) -> Table:
    """Outputs at the mean parameters."""
    values = results.dataset["nominal"].to_numpy()
    rows = [(o, size(float(v), results.unit(o), 6)) for o, v in zip(results.outputs, values, strict=True)]
    return Table(("output", "value"), rows)


class Distribution(Section):
    """Samples of the outputs, and how their estimates converge."""

    def applies(self, results: Results) -> bool:
        """Whether there are samples, and no expansion."""
        return {"values", "nominal"} <= set(results.dataset) and "density" not in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """Pictures of each output."""
        dataset = results.dataset
        yield Heading("Distribution and convergence")
        for output in results.drawn:
            yield Heading(output, level=3)
            samples = f"Samples of {output}: density, mean and quantiles."
            running = f"Running mean of {output} with its 95 % confidence band."
            pictures = [
                Picture.drawn(plots.histogram(dataset, output), samples),
                Picture.drawn(plots.convergence(dataset, output), running),
                Picture.drawn(plots.standard_error(dataset, output), f"Standard error of the mean of {output}."),
            ]
            yield Pictures(pictures, small=True)


class Density(Section):
    """Densities of the outputs by an expansion."""

    needs = ("density",)

    def content(self, results: Results) -> Iterator[Block]:
        """A picture of each output."""
        yield Heading("Distribution and convergence")
        drawn = [
            Picture.drawn(
                plots.histogram(results.dataset, output), f"Density of {output} by the expansion, mean and quantiles."
            )
            for output in results.drawn
        ]
        yield Pictures(drawn, small=True)


class ControlVariate(Section):
    """The gain of a control variate, or of quasi-random points."""

    needs = ("variance_ratio",)

    def content(self, results: Results) -> Iterator[Block]:
        """A sentence for each output."""
        for gain in gains(results.dataset):
            yield Text(gain.text, "warning" if gain.hurts else "")


@dataclass(frozen=True)
class Gain:
    """The gain of a control variate, in words."""

    text: str
    hurts: bool


def gains(dataset: xr.Dataset) -> Iterator[Gain]:
    """Say what the control variate, or quasi-random points, gain, output by output."""
    means = "the control variate"
    if "scramble" in dataset:
        means = "Sobol' points and the control variate" if "coefficient" in dataset else "Sobol' points"
        R = int(dataset["scramble"].max()) + 1
        spread = number(100 * (2 / (R - 1)) ** 0.5, 2)
        yield Gain(
            f"Errors come from the scatter of {R} independent scrambles, so that their squares are known to about "
            f"{spread} %; a 95 % interval is ± {number(half_width(dataset), 3)} of them.",
            hurts=False,
        )
    if "control_samples" in dataset:
        error, fitted = number(float(dataset["loo_error"].max()), 2), int(dataset["control_samples"])
        yield Gain(
            f"The control variate is an expansion fitted to {fitted} separate samples, with a leave-one-out "
            f"error of at most {error} standard deviations.",
            hurts=False,
        )
    for output in dataset["output"].values:
        mean, std = (float(dataset[name].sel(output=output)) for name in ("variance_ratio", "std_variance_ratio"))
        text = (
            f"{output}: with {means}, one sample is worth {worth(mean)} plain samples for the mean "
            f"and {worth(std)} for the standard deviation."
        )
        worse = [word for word, ratio in (("mean", mean), ("standard deviation", std)) if ratio < 1]
        if worse:
            text += f" For the {' and the '.join(worse)}, plain Monte Carlo is better."
        yield Gain(text, bool(worse))


class Expansion(Section):
    """The polynomials of an expansion, and their errors."""

    needs = ("multi_index",)

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("Polynomial chaos")
        yield Text("The leave-one-out error is that at each sample of the expansion fitted to the others.")
        yield expansion(results)


def expansion(results: Results) -> Table:
    """The polynomials of an expansion and their errors, output by output."""
    dataset = results.dataset
    used, order = int(dataset["ok"].sum()), int(dataset["order"])
    rows = [
        (
            output,
            f"{order}",
            f"{dataset.sizes['term']}",
            f"{used}",
            number(float(dataset["loo_error"].sel(output=output)), 2),
        )
        for output in results.outputs
    ]
    return Table(("output", "order", "terms", "samples", "leave-one-out error / standard deviation"), rows)
