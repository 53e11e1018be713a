"""Specimens of a population."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from forward.words import named
from workflows.report.plots.figure import CONTROLLED, HIGH, PLAIN, axes, text_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

SHOWN = 40  # specimens
RATIO = 30.0  # of the ends of an axis above which it is logarithmic


def specimens(of: xr.Dataset, name: str, unit: str, ax: Axes | None = None) -> Axes:
    """Draw a parameter of each specimen, by its own data and as one of the population, over what new ones are like."""
    names = [str(specimen) for specimen in of["specimen"].values][:SHOWN]
    ax = ax or axes(height=1.6 + 0.32 * len(names))
    here = of.sel(parameter=name)
    places = np.arange(len(names))[::-1]
    lower, _, upper = here["new_quantiles"].to_numpy()
    ax.axvspan(lower, upper, color=PLAIN, alpha=0.15, linewidth=0, label="new specimens, 95 %")
    low, _, high = here["typical_quantiles"].to_numpy()
    ax.axvspan(low, high, color=PLAIN, alpha=0.3, linewidth=0, label="the typical specimen, 95 %")
    one = here.sel(specimen=names)
    own = one["own_mean"].to_numpy(), 1.96 * one["own_std"].to_numpy()
    ax.errorbar(own[0], places + 0.14, xerr=own[1], fmt="o", ms=4, color=CONTROLLED, capsize=3, label="by its own data")
    ends = one["specimen_mean"].to_numpy(), one["specimen_lower"].to_numpy(), one["specimen_upper"].to_numpy()
    reach = np.maximum([ends[0] - ends[1], ends[2] - ends[0]], 0.0)
    ax.errorbar(ends[0], places - 0.14, xerr=reach, fmt="s", ms=4, color=HIGH, capsize=3, label="of the population")
    ax.set_yticks(places, [text_of(one) for one in names])
    ax.set_ylim(-0.6, len(names) - 0.4)
    left, right = ax.get_xlim()
    if lower > 0 and RATIO * lower < upper:
        ax.set_xscale("log")
    else:
        wide = upper - lower
        ax.set_xlim(max(left, min(lower, float(ends[1].min())) - 0.3 * wide), right)
        ax.locator_params(axis="x", nbins=5)
    ax.set_xlabel(named(text_of(name), unit))
    ax.figure.legend(loc="outside lower center", ncols=2, fontsize="small", frameon=False)
    return ax
