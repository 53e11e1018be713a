"""What each load case tells of each parameter, as a map: ``one = dataset.isel(data_set=0)``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from forward.readable import percent
from workflows.report.plots.figure import axes, text_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

PALE = 0.55  # shares above it are written in white


def told_by_case(one: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw the share of the prior variance of each parameter that each load case alone removes, and all together.

    With the model linearised at the mode: 1 − (σ alone / σ before)²; nothing where that is wider than the prior.
    """
    names = [str(name) for name in one.parameter.values if name != "noise"]
    before = one["prior_std"].sel(parameter=names).to_numpy()
    widths = np.vstack([one["alone_std"].sel(parameter=names), one["together_std"].sel(parameter=names).values[None]])
    shares = np.clip(1 - (widths / before) ** 2, 0.0, 1.0)
    rows = [*(str(case) for case in one.case.values), "all together"]
    ax = ax or axes(height=1.6 + 0.32 * len(rows), width=max(5.4, 1.6 + 0.85 * len(names)))
    ax.imshow(shares, cmap="Blues", vmin=0, vmax=1.1, aspect="auto")
    for i, row in enumerate(shares):
        for j, share in enumerate(row):
            colour = "white" if share > PALE else "black"
            text = percent(float(share)) if share >= 1e-3 else "0"
            ax.annotate(text, (j, i), ha="center", va="center", fontsize="small", color=colour)
    ax.set_xticks(range(len(names)), [text_of(name) for name in names], rotation=25, ha="right")
    ax.set_yticks(range(len(rows)), [text_of(row) for row in rows])
    ax.spines[["left", "bottom"]].set_visible(False)
    ax.tick_params(length=0)
    return ax
