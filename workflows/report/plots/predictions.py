"""What is predicted, before and after the data."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from workflows.report.plots.figure import COLOURS, axes, text_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

SHOWN = 12  # outputs


def bands(one: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw the interval of each output by the prior and by the posterior; 0 and 1 are the ends of that by the prior.

    Where nothing is known of the prior, those of the posterior are 0 and 1.
    """
    outputs = [str(name) for name in one["goal"].values][:SHOWN]
    ax = ax or axes(height=1.3 + 0.4 * len(outputs), width=7.0)
    some = one.sel(goal=outputs)
    after = np.array([some[f"prediction_{end}"] for end in ("lower", "mean", "upper")])
    before = np.array([some[f"prediction_prior_{end}"] for end in ("lower", "mean", "upper")])
    frame = np.where(np.isfinite(before), before, after)
    size = frame[2] - frame[0]
    known = size > 0
    places = np.arange(len(outputs))[::-1]
    for values, colour, height, label in (
        (before, COLOURS[1], 0.7, "before the data"),
        (after, COLOURS[0], 0.35, "after"),
    ):
        lower, middle, upper = (values[:, known] - frame[0, known]) / size[known]
        ax.barh(places[known], upper - lower, left=lower, height=height, color=colour, alpha=0.6, label=label)
        ax.plot(middle, places[known], "|", color=colour, markersize=14, markeredgewidth=2)
    ax.set_yticks(places, [text_of(name) for name in outputs])
    ax.set_xlabel("from the lower to the upper end of the interval before the data")
    ax.legend(fontsize=7, ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    return ax
