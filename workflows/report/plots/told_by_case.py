"""What each load case tells of each parameter, as a map: ``one = dataset.isel(data_set=0)``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from forward.words import number
from workflows.report.plots.figure import axes, text_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

PALE = 0.55  # shades above it are written on in white
SAID = 1.05  # times narrower from which it is written
LEAST = 4.0  # times narrower that the darkest shade stands for, at least


def told_by_case(one: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw how many times narrower each load case alone makes each parameter, and all together.

    With the model linearised at the mode: σ before / σ after; 1 where that is wider than the prior.
    """
    names = [str(name) for name in one.parameter.values if name != "noise"]
    before = one["prior_std"].sel(parameter=names).to_numpy()
    widths = np.vstack([one["alone_std"].sel(parameter=names), one["together_std"].sel(parameter=names).values[None]])
    factors = np.maximum(before / widths, 1.0)
    shades = np.log(factors) / max(np.log(factors.max()), np.log(LEAST))
    rows = [*(str(case) for case in one.case.values), "all together"]
    ax = ax or axes(height=1.6 + 0.32 * len(rows), width=max(5.4, 1.6 + 0.85 * len(names)))
    ax.imshow(shades, cmap="Blues", vmin=0, vmax=1.1, aspect="auto")
    for (i, j), factor in np.ndenumerate(factors):
        colour = "white" if shades[i, j] > PALE else "black"
        text = f"{number(float(factor), 2)} ×" if factor >= SAID else ""
        ax.annotate(text, (j, i), ha="center", va="center", fontsize="small", color=colour)
    ax.set_xticks(range(len(names)), [text_of(name) for name in names], rotation=25, ha="right")
    ax.set_yticks(range(len(rows)), [text_of(row) for row in rows])
    ax.spines[["left", "bottom"]].set_visible(False)
    ax.tick_params(length=0)
    return ax
