"""Pictures of measured points: residuals as arrows and as a map, and how far points were from the body."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from workflows.report.plots.figure import PLAIN, text_of
from workflows.results.points import MeasuredPoints, measured_points

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from forward.model import FloatArray

LONGEST = 0.15  # of the extent of the body: the longest arrow
EDGES = [(i, i ^ bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]  # of a box whose corners count in bits
MM = 1e3


def residuals(one: xr.Dataset) -> Axes:
    """Draw the residuals of each load case: as arrows, and over their errors as a map."""
    parts = [part for part in measured_points(one) if len(part.places)]
    panels = _panels(len(parts), 2)
    most = max(3.0, *(float(part.over.max()) for part in parts))
    extent = float(np.ptp(one["node_position"].to_numpy(), axis=0).max())
    for part, (arrows, coloured) in zip(parts, panels, strict=True):
        factor = LONGEST * extent / max(float(np.linalg.norm(part.residuals, axis=1).max()), 1e-300)
        _box(arrows, one)
        tips = np.hstack([part.places, factor * part.residuals]).T * MM
        arrows.quiver(*tips, color="#d1622b", linewidth=0.8, arrow_length_ratio=0.3)
        arrows.set_title(f"{text_of(part.case)}: arrows {factor:.3g} times as long", fontsize="small")
        _map(coloured, one, part, part.over, most, "over the error")
    first: Axes = panels[0][0]
    return first


def distances(one: xr.Dataset) -> Axes:
    """Draw how far points were from the body before they were moved onto it."""
    parts = [part for part in measured_points(one) if len(part.places)]
    panels = _panels(len(parts), 1)
    most = max(float(part.moved.max()) for part in parts) * MM
    for part, (ax,) in zip(parts, panels, strict=True):
        _map(ax, one, part, part.moved * MM, most, "distance (mm)")
    first: Axes = panels[0][0]
    return first


def _panels(rows: int, columns: int) -> list[list[Any]]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    # It does not see the ticks of boxes, which would lie on the title below.
    layout = ConstrainedLayoutEngine(h_pad=0.12, hspace=0.1)
    figure = Figure(figsize=(2.9 * columns + 0.8, 3.0 * rows), layout=layout)
    FigureCanvasAgg(figure)
    return [
        [figure.add_subplot(rows, columns, columns * row + k + 1, projection="3d") for k in range(columns)]
        for row in range(rows)
    ]


def _map(ax: Any, one: xr.Dataset, part: MeasuredPoints, values: FloatArray, most: float, words: str) -> None:
    _box(ax, one)
    drawn = ax.scatter(*(part.places.T * MM), c=values, vmin=0.0, vmax=most, cmap="viridis", s=14, depthshade=False)
    ax.get_figure(root=True).colorbar(drawn, ax=ax, shrink=0.6, pad=0.1, label=words)
    ax.set_title(text_of(part.case), fontsize="small")


def _box(ax: Any, one: xr.Dataset) -> None:
    """Draw the box around the body, in mm."""
    nodes = one["node_position"].to_numpy() * MM
    ends = np.stack([nodes.min(axis=0), nodes.max(axis=0)])
    corners = np.array([[ends[i >> axis & 1, axis] for axis in range(3)] for i in range(8)])
    for i, j in EDGES:
        ax.plot(*corners[[i, j]].T, color=PLAIN, linewidth=0.6)
    ax.set_box_aspect(np.ptp(ends, axis=0))
    ax.tick_params(labelsize=6, pad=-2)
    for axis in "xyz":
        getattr(ax, f"set_{axis}label")(f"{axis} (mm)", fontsize=6, labelpad=-6)
