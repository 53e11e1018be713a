"""Pictures of designs: what chosen observations tell, and where they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from workflows.report.plots.figure import COLOURS, CONTROLLED, LEGEND, PLAIN, axes, grid
from workflows.report.plots.view import box, seen

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


def on_body(found: xr.Dataset, bounds: Sequence[tuple[float, float]]) -> Axes:
    """Draw the edges of the box around a body (m), the candidates, and the chosen points with their order.

    Points are coloured by load case.
    """
    (ax,) = grid(1, 1, (5.4, 4.4), (0.2, 0.25, 0.2, 0.2), LEGEND)
    box(ax, np.array(bounds).T)
    places, chosen = found["candidate_place"].to_numpy(), found["chosen"].to_numpy()
    every = np.unique(places[np.isfinite(places).all(axis=1)], axis=0)
    x, y, _ = seen(every).T
    ax.scatter(x, y, s=5, color=PLAIN, alpha=0.8, linewidth=0, label="candidates")
    cases = found["candidate_case"].values[chosen]
    for colour, case in zip(COLOURS * 9, dict.fromkeys(cases), strict=False):
        x, y, _ = seen(places[chosen[cases == case]]).T
        ax.scatter(x, y, s=30, color=colour, label=case or "all load cases")
    said: dict[tuple[float, ...], list[str]] = {}
    for k, one in enumerate(chosen, start=1):
        if np.isfinite(places[one]).all():
            said.setdefault(tuple(places[one]), []).append(str(k))
    for place, numbers in said.items():
        x, y, _ = seen(np.array(place))
        ax.text(x, y, f"  {', '.join(numbers)}", fontsize=8, va="center")
    ax.figure.legend(fontsize="small", frameon=False, loc="lower center", ncols=4)
    return ax
