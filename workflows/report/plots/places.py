"""Maps of the places at which tools were pressed against a body: ``one = dataset.isel(data_set=0)``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from workflows.report.plots.figure import CONTROLLED, DARK, HIGH, PLAIN, axes

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from forward.model import FloatArray

Extent = Sequence[tuple[float, float]]


def told(one: xr.Dataset, places: Mapping[str, FloatArray], bounds: Extent, lump: str, ax: Axes | None = None) -> Axes:
    """Draw what each place tells alone, with draws of where an inclusion is.

    Parameters
    ----------
    one
        Results of a data set.
    places
        Where (3,) the tool is in each load case (m).
    bounds
        Of the body (m).
    lump
        Name of the inclusion; empty where its place is known.
    """
    ax = ax or axes(height=4.2)
    points = np.array(list(places.values()))
    across = np.sort(np.argsort(-np.ptp(points, axis=0), kind="stable")[:2])
    names = [f"inclusions.{lump}.{'xyz'[axis]}" for axis in across]
    known = [str(name) for name in one.parameter.values]
    if all(name in known for name in names):
        x, y = (one["draw"].sel(parameter=name).to_numpy() for name in names)
        ax.scatter(x, y, s=5, color=PLAIN, alpha=0.5, linewidth=0, label=f"draws of the place of '{lump}'")
        true = [float(one["true"].sel(parameter=name)) for name in names]
        if np.isfinite(true).all():
            ax.plot(*true, "x", color=HIGH, markersize=11, markeredgewidth=2.5, label="truth")
    worth, (x, y) = information(one, places), points[:, across].T
    shown = ax.scatter(x, y, s=170, c=worth, cmap="viridis", edgecolor=DARK, zorder=3)
    ax.figure.colorbar(shown, ax=ax, label="information of the place alone (nat)")
    ax.set_xlim(*bounds[across[0]])
    ax.set_ylim(*bounds[across[1]])
    ax.set_aspect("equal")
    ax.set_xlabel(f"{'xyz'[across[0]]} (m)")
    ax.set_ylabel(f"{'xyz'[across[1]]} (m)")
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, fontsize="small", frameon=False)
    return ax


def information(one: xr.Dataset, places: Mapping[str, FloatArray]) -> FloatArray:
    """Return what the data of each load case tell alone (nat): ½ Σ ln(1 + λ), of the model linearised at the mode."""
    values = np.maximum(np.nan_to_num(one["alone_eigenvalue"].sel(case=list(places)).to_numpy()), 0.0)
    return np.asarray(np.log1p(values).sum(axis=1) / 2)


def forces(one: xr.Dataset, which: Sequence[int], names: Sequence[str], quantity: str, ax: Axes | None = None) -> Axes:
    """Draw measured and predicted outputs of load cases: numbers of the data, their names, quantity and unit."""
    ax = ax or axes()
    here, x = one.isel(datum=list(which)), np.arange(len(which))
    error, reach = 1.96 * here["sigma"].to_numpy(), 1.96 * here["predicted_std"].to_numpy()
    label = "measured, 95 % of its errors"
    ax.errorbar(x - 0.1, here["measured"].to_numpy(), error, fmt="o", ms=4, color=DARK, capsize=3, label=label)
    label = "predicted, 95 % band of the unknowns"
    ax.errorbar(x + 0.1, here["predicted"].to_numpy(), reach, fmt="s", ms=4, color=CONTROLLED, capsize=3, label=label)
    ax.set_xticks(x, names, rotation=45 if len(names) > 5 else 0)
    ax.set_ylabel(quantity)
    ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
    ax.legend(fontsize="small", frameon=False)
    return ax
