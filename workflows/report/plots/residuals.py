"""Pictures of measured points: residuals as arrows and as a map, and how far points were from the body."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from forward.readable import scale
from workflows.report.plots.figure import COLOURS, DARK, HIGH, axes, grid, text_of
from workflows.report.plots.view import box, seen
from workflows.results.points import MeasuredPoints, displacements, measured_points

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from forward.model import FloatArray

LONGEST = 0.15  # of the extent of the body: the longest arrow
PANEL, INSIDE = (3.5, 2.7), (0.15, 0.25, 0.4, 0.25)  # inches


def residuals(one: xr.Dataset) -> Axes:
    """Draw the residuals of each load case: as arrows, and over their errors as a map."""
    parts = [part for part in measured_points(one) if len(part.places)]
    found = grid(2 * len(parts), 2, PANEL, INSIDE)
    most = max(3.0, *(float(part.over.max()) for part in parts))
    ends = _ends(one)
    extent = float(np.ptp(ends, axis=0).max())
    for part, arrows, coloured in zip(parts, found[::2], found[1::2], strict=True):
        factor = LONGEST * extent / max(float(np.linalg.norm(part.residuals, axis=1).max()), 1e-300)
        box(arrows, ends)
        tails, tips = seen(part.places)[:, :2].T, seen(factor * part.residuals)[:, :2].T
        arrows.quiver(*tails, *tips, color=HIGH, angles="xy", scale_units="xy", scale=1, width=0.006)
        arrows.set_title(f"{text_of(part.case)}: arrows {factor:.3g} times as long", fontsize="small")
        _map(coloured, ends, part, part.over, most, "over the error")
    return found[0]


def agreement(one: xr.Dataset) -> Axes:
    """Draw the measured over the predicted displacements of each load case, and the line on which both are equal."""
    ax = axes(height=3.6)
    rows = displacements(one)
    measured, predicted, case = (one[name].to_numpy()[rows] for name in ("measured", "predicted", "datum_case"))
    size, unit = scale(float(np.abs(measured).max()), "m")
    for k, name in enumerate(one["case"].values):
        here = case == k
        if here.any():
            colour = COLOURS[k % len(COLOURS)]
            ax.plot(
                predicted[here] / size,
                measured[here] / size,
                ".",
                ms=4,
                alpha=0.7,
                color=colour,
                label=text_of(str(name)),
            )
    both = np.concatenate([measured, predicted]) / size
    ends = [float(both.min()), float(both.max())]
    ax.plot(ends, ends, color=DARK, linewidth=0.8, zorder=1)
    ax.set_xlabel(f"predicted displacement ({unit})")
    ax.set_ylabel(f"measured ({unit})")
    ax.legend(fontsize="small", frameon=False)
    return ax


def distances(one: xr.Dataset) -> Axes:
    """Draw how far points were from the body before they were moved onto it."""
    parts = [part for part in measured_points(one) if len(part.places)]
    found = grid(len(parts), 1, PANEL, INSIDE)
    most, ends = max(float(part.moved.max()) for part in parts), _ends(one)
    size, unit = scale(most, "m")
    for part, ax in zip(parts, found, strict=True):
        _map(ax, ends, part, part.moved / size, most / size, f"distance ({unit})")
    return found[0]


def _ends(one: xr.Dataset) -> FloatArray:
    """Return both ends (2, 3) of the box around the body (m)."""
    nodes = one["node_position"].to_numpy()
    return np.stack([nodes.min(axis=0), nodes.max(axis=0)])


def _map(ax: Axes, ends: FloatArray, part: MeasuredPoints, values: FloatArray, most: float, words: str) -> None:
    box(ax, ends)
    places = seen(part.places)
    order = np.argsort(places[:, 2], kind="stable")  # near points over far ones
    x, y, _ = places[order].T
    drawn = ax.scatter(x, y, c=values[order], vmin=0.0, vmax=most, cmap="viridis", s=14)
    ax.figure.colorbar(drawn, ax=ax, label=words, shrink=0.7, pad=0.02, fraction=0.07)
    ax.set_title(text_of(part.case), fontsize="small")
