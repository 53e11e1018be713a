"""The gain of a control variate, or of quasi-random points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from forward.words import number, worth
from uq.estimators.moments import half_width
from workflows.report.blocks import Block, Text
from workflows.report.section import Results, Section

if TYPE_CHECKING:
    import xarray as xr


class ControlVariate(Section):
    """The gain of a control variate, or of quasi-random points."""

    def applies(self, results: Results) -> bool:
        """Whether there is something better than plain samples."""
        return "variance_ratio" in results.dataset

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
