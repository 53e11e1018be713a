"""Mean, standard deviation and quantiles of the outputs, with their errors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from forward.words import number, worth
from uq.estimators.moments import half_width
from workflows.report.blocks import Block, Heading, Table, Text
from workflows.report.section import Results, Section

if TYPE_CHECKING:
    import xarray as xr


class Moments(Section):
    """Mean, standard deviation and quantiles of the outputs, with their errors."""

    def applies(self, results: Results) -> bool:
        """Whether the outputs vary."""
        return "mean" in results.dataset and "nominal" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """A table of estimates, and what the control variate was worth."""
        yield Heading("Mean and standard deviation")
        yield Text("± is one standard error; a 95\u00a0% interval is about twice as wide on either side.")
        yield moments(results)
        for gain in gains(results.dataset):
            yield Text(gain.text, "warning" if gain.hurts else "")


def moments(results: Results) -> Table:
    """Mean and standard deviation of the outputs, and those of plain Monte Carlo beside controlled ones."""
    names = [n for n in ("mean", "std", "plain_mean", "plain_std") if n in results.dataset]
    words = {
        "mean": "mean",
        "std": "standard deviation",
        "plain_mean": "mean, plain Monte Carlo",
        "plain_std": "standard deviation, plain Monte Carlo",
    }
    rows = [(output, *(results.estimate(output, name) for name in names)) for output in results.outputs]
    return Table(("output", *(words[name] for name in names)), rows)


@dataclass(frozen=True)
class Gain:
    """What a control variate is worth, in words."""

    text: str
    hurts: bool


def gains(dataset: xr.Dataset) -> Iterator[Gain]:
    """Say what the control variate, or quasi-random points, are worth, output by output."""
    if "variance_ratio" not in dataset:
        return
    means = "the control variate"
    if "scramble" in dataset:
        means = "Sobol' points and the control variate" if "coefficient" in dataset else "Sobol' points"
        R = int(dataset["scramble"].max()) + 1
        spread = number(100 * (2 / (R - 1)) ** 0.5, 2)
        yield Gain(
            f"Errors are from the scatter of {R} independent scrambles, and so known to {spread} % or so when squared; "
            f"a 95 % interval is ± {number(half_width(dataset), 3)} of them.",
            hurts=False,
        )
    if "control_samples" in dataset:
        error, fitted = number(float(dataset["loo_error"].max()), 2), int(dataset["control_samples"])
        yield Gain(
            f"The control variate is an expansion fitted to {fitted} samples of its own, with a leave-one-out "
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
            text += f" It hurts the {' and the '.join(worse)}: there, plain Monte Carlo is better."
        yield Gain(text, bool(worse))
