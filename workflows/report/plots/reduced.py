"""Errors of a reduced model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from workflows.report.plots.figure import COLOURS, CONTROLLED, DARK, HIGH, axes, text_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

SHOWN = 8  # outputs


def estimates(found: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw the estimated against the true errors of each output at unseen samples, over their root mean square."""
    ax = ax or axes(height=3.6)
    ends = [np.inf, 0.0]
    for colour, name in zip(COLOURS, found["output"].values[:SHOWN], strict=False):
        error, estimate = (
            np.abs(found[f"reduced_{what}"].sel(output=name).to_numpy()) for what in ("error", "estimate")
        )
        good = (error > 0) & (estimate > 0)
        if not good.any():
            continue
        scale = np.sqrt((error[good] ** 2).mean())
        x, y = error[good] / scale, estimate[good] / scale
        ends = [min(ends[0], x.min(), y.min()), max(ends[1], x.max(), y.max())]
        ax.plot(x, y, ".", color=colour, markersize=4, alpha=0.7, label=text_of(str(name)))
    if ends[0] < ends[1]:
        ax.plot(ends, ends, color=DARK, linewidth=0.8)
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.legend(fontsize="small", frameon=False)
    ax.set_xlabel("true error over its root mean square")
    ax.set_ylabel("estimated error over the same")
    return ax


def energies(found: xr.Dataset, kept: int, ax: Axes | None = None) -> Axes:
    """Draw what each number of modes leaves of the snapshots, relative, and how many were kept."""
    ax = ax or axes(height=3.6)
    energy = found["mode_energy"].to_numpy()
    left = np.sqrt(np.maximum(energy[::-1].cumsum()[::-1], 1e-300) / energy.sum())
    ax.plot(np.arange(len(left)), left, color=CONTROLLED)
    ax.axvline(kept, color=HIGH, linestyle="--", linewidth=1, label=f"{kept} kept")
    ax.set_yscale("log")
    ax.set_xlabel("modes")
    ax.set_ylabel("part that is left out")
    ax.legend(fontsize="small", frameon=False)
    return ax
