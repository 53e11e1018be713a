"""Pressure under tools."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from forward.bodies.geometry import AXES
from workflows.report.plots.figure import axes, text_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from forward.bodies.geometry import Vector


def pressure_map(dataset: xr.Dataset, tool: str, direction: Vector, ax: Axes | None = None) -> Axes:
    """Draw the pressure of a tool on the undeformed boundary, seen along the direction of the tool."""
    from matplotlib.tri import Triangulation

    ax = ax or axes(height=3.6, width=4.6)
    here = dataset.isel(contact_vertex=np.flatnonzero(dataset["contact_tool"].to_numpy() == tool))
    across = np.sort(np.argsort(np.abs(direction))[:2])
    x, y = 1e3 * here["contact_position"].to_numpy()[:, across].T
    pressure = here["contact_pressure"].to_numpy()
    seen = Triangulation(x, y)
    drawn = ax.tripcolor(seen, pressure, shading="gouraud", cmap="viridis", vmin=0)
    ax.plot(x, y, ".", color="white", ms=2, alpha=0.6)
    corners = seen.triangles[(pressure[seen.triangles] > 0).any(axis=1)].ravel()
    if len(corners):  # the area in contact and the cells around it
        for values, limit in ((x[corners], ax.set_xlim), (y[corners], ax.set_ylim)):
            limit(float(values.min()), float(values.max()))
    figure = ax.get_figure(root=True)
    assert figure is not None
    figure.colorbar(drawn, ax=ax, label=f"pressure of {text_of(tool)} (Pa)")
    ax.set_aspect("equal")
    ax.set_xlabel(f"{AXES[int(across[0])]} (mm)")
    ax.set_ylabel(f"{AXES[int(across[1])]} (mm)")
    return ax
