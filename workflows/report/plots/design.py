"""Pictures of designs: what chosen observations tell, and where they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from workflows.report.plots.figure import COLOURS, CONTROLLED, DARK, PLAIN, axes

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes


def against_number(found: xr.Dataset, quantity: str, ax: Axes | None = None) -> Axes:
    """Draw what the first, the first two, … of the chosen observations are worth, and of random ones."""
    ax = ax or axes()
    x = found["random_number"].to_numpy()
    lower, middle, upper = (found[f"random_{name}"].to_numpy() for name in ("lower", "median", "upper"))
    ax.fill_between(x, lower, upper, color=PLAIN, alpha=0.3, linewidth=0, label="random: 90 %")
    ax.plot(x, middle, color=PLAIN, label="random: median")
    chosen, n = found["worth"].to_numpy(), np.arange(1, found.sizes["choice"] + 1)
    ax.plot(n, chosen, "o-", ms=3, color=CONTROLLED, label="chosen")
    ax.hlines(chosen[-1], n[-1], x[-1], color=CONTROLLED, linestyle=":", linewidth=1)
    ax.locator_params(axis="x", integer=True)
    ax.set_xlabel("number of observations")
    ax.set_ylabel(quantity)
    ax.set_ylim(bottom=0)
    ax.legend(fontsize="small", frameon=False)
    return ax


def on_body(found: xr.Dataset, bounds: Sequence[tuple[float, float]], ax: Any = None) -> Any:
    """Draw the edges of the box around a body (m), the candidates, and the chosen points with their order.

    Points are coloured by load case.
    """
    if ax is None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(5.4, 4.4), layout="constrained")
        FigureCanvasAgg(figure)
        ax = figure.add_subplot(projection="3d")
    ends = np.array(bounds)
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij")).reshape(3, -1).T
    for a in corners:
        for axis in np.flatnonzero(a == 0):
            b = a + (np.arange(3) == axis)
            line = np.array([ends[range(3), a], ends[range(3), b]]).T
            ax.plot(*line, color=DARK, linewidth=0.8)
    places, chosen = found["candidate_place"].to_numpy(), found["chosen"].to_numpy()
    every = np.unique(places[np.isfinite(places).all(axis=1)], axis=0)
    ax.scatter(*every.T, s=5, color=PLAIN, alpha=0.8, linewidth=0, depthshade=False, label="candidates")
    cases = found["candidate_case"].values[chosen]
    for colour, case in zip(COLOURS * 9, dict.fromkeys(cases), strict=False):
        here = places[chosen[cases == case]]
        ax.scatter(*here.T, s=30, color=colour, depthshade=False, label=case or "all load cases")
    said: dict[tuple[float, ...], list[str]] = {}
    for k, one in enumerate(chosen, start=1):
        if np.isfinite(places[one]).all():
            said.setdefault(tuple(places[one]), []).append(str(k))
    for place, numbers in said.items():
        ax.text(*place, f" {', '.join(numbers)}", fontsize=8)
    ax.set_box_aspect(np.ptp(ends, axis=1), zoom=0.85)
    for name, axis in zip("xyz", (ax.xaxis, ax.yaxis, ax.zaxis), strict=True):
        axis.set_label_text(f"{name} (m)")
        axis.set_major_locator(_few())
    ax.legend(fontsize="small", frameon=False, loc="upper left")
    return ax


def _few() -> Any:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(3)
