"""What is where on a body: measured points and their residuals, places of tools, pressures, designs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.bodies.geometry import AXES, Vector
from forward.model import FloatArray
from forward.readable import number, scale
from workflows.report.plots.figure import COLOURS, CONTROLLED, DARK, HIGH, ON_DEEP, PLAIN, axes, finished, grid, text_of
from workflows.results.points import MeasuredPoints, displacements, measured_points

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes


EDGES = [(i, i ^ bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]  # of a box whose corners count in bits
# Edges with names, all in front: their corners, the side of the name, its alignment, its turn in degrees.
NAMED = ((0, 1, (0, -1), "right", 0), (1, 3, (0.5, -1), "left", 0), (0, 4, (-1, 0), "right", 90))
GAP = 0.03  # between an edge and its name, in extents
ROUNDING = 1e-9  # of the extent
LONGEST = 0.15  # of the extent of the body: the longest arrow
PANEL, INSIDE = (3.5, 2.7), (0.15, 0.25, 0.4, 0.25)  # inches
Extent = Sequence[tuple[float, float]]


def looking(up: FloatArray) -> FloatArray:
    """Return the directions (3, 3) to the right, up and towards the viewer, who is in front, to the right and above."""
    right = np.eye(3)[1 if up[0] else 0]
    towards = np.cross(right, up) + 0.6 * right + 0.4 * up
    towards /= np.linalg.norm(towards)
    side = np.cross(up, towards)
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(towards, side), towards])


def seen(points: FloatArray) -> FloatArray:
    """Return where points or arrows (n, 3) are on a picture with z upwards: (n, 3) to the right, up, to the viewer."""
    return np.asarray(points @ looking(np.eye(3)[2]).T)


def box(ax: Axes, ends: FloatArray) -> None:
    """Draw the box between two corners, ends (2, 3) in m, with its size along three edges; nothing else is there."""
    from matplotlib.collections import LineCollection

    corners = seen(np.array([[ends[i >> axis & 1, axis] for axis in range(3)] for i in range(8)]))[:, :2]
    ax.add_collection(LineCollection([corners[[i, j]] for i, j in EDGES], colors=DARK, linewidths=0.6))
    largest = float(np.abs(ends).max())
    one, unit = scale(largest, "m")
    gap = GAP * float(np.ptp(corners, axis=0).max())
    for axis, (i, j, off, across, turned) in enumerate(NAMED):
        low, high = (number(0.0 if abs(end) < ROUNDING * largest else end / one, 3) for end in ends[:, axis])
        words = f"{'xyz'[axis]}: {low} to {high} {unit}"
        x, y = corners[[i, j]].mean(axis=0) + gap * np.array(off)
        ax.text(x, y, words, fontsize="x-small", ha=across, va="center" if turned else "top", rotation=turned)
    ax.set_aspect("equal")
    ax.axis("off")


def residuals(one: xr.Dataset) -> Axes:
    """Draw the residuals of each load case: as arrows, and over their errors as a map."""
    parts, ends = measured_points(one), _ends(one)
    found = grid(2 * len(parts), 2, PANEL, INSIDE)
    most = max(3.0, *(float(part.over.max()) for part in parts))
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
    both = np.stack([predicted, measured]) / size
    for k in np.unique(case).astype(int):
        name = text_of(str(one["case"].values[k]))
        ax.plot(*both[:, case == k], ".", ms=4, alpha=0.7, color=COLOURS[k % len(COLOURS)], label=name)
    ends = [float(both.min()), float(both.max())]
    ax.plot(ends, ends, color=DARK, linewidth=0.8, zorder=1)
    return finished(ax, f"predicted displacement ({unit})", f"measured ({unit})")


def distances(one: xr.Dataset) -> Axes:
    """Draw how far points were from the body before they were moved onto it."""
    parts = measured_points(one)
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


def told(one: xr.Dataset, places: Mapping[str, FloatArray], bounds: Extent, lump: str, ax: Axes | None = None) -> Axes:
    """Draw what each place (3,) of a tool (m) tells alone, by load case, within the bounds of a body (m).

    With draws of where an inclusion of this name is, unless its place is known.
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
    ax.set(xlim=bounds[across[0]], ylim=bounds[across[1]], aspect="equal")
    below: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.16), "ncols": 2}
    return finished(ax, *(f"{'xyz'[axis]} (m)" for axis in across), **below)


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
    ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
    return finished(ax, y=quantity)


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
    ax.plot(x, y, ".", color=ON_DEEP, ms=2, alpha=0.6)
    corners = seen.triangles[(pressure[seen.triangles] > 0).any(axis=1)].ravel()
    if len(corners):  # the area in contact and the cells around it
        ax.set(xlim=(x[corners].min(), x[corners].max()), ylim=(y[corners].min(), y[corners].max()))
    ax.figure.colorbar(drawn, ax=ax, label=f"pressure of {text_of(tool)} (Pa)")
    ax.set_aspect("equal")
    return finished(ax, f"{AXES[int(across[0])]} (mm)", f"{AXES[int(across[1])]} (mm)")


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
    ax.set_ylim(bottom=0)
    return finished(ax, "number of observations", quantity)


def on_body(found: xr.Dataset, bounds: Sequence[tuple[float, float]]) -> Axes:
    """Draw the edges of the box around a body (m), the candidates, and the chosen points with their order.

    Points are coloured by load case.
    """
    (ax,) = grid(1, 1, (5.4, 4.4), (0.2, 0.25, 0.2, 0.2), legend=1)
    box(ax, np.array(bounds).T)
    places, chosen = found["candidate_place"].to_numpy(), found["chosen"].to_numpy()
    every = np.unique(places[np.isfinite(places).all(axis=1)], axis=0)
    x, y, _ = seen(every).T
    ax.scatter(x, y, s=5, color=PLAIN, alpha=0.8, linewidth=0, label="candidates")
    cases = found["candidate_case"].values[chosen]
    for colour, case in zip(COLOURS * 9, dict.fromkeys(cases), strict=False):
        x, y, _ = seen(places[chosen[cases == case]]).T
        ax.scatter(x, y, s=30, color=colour, label=case or "all load cases")
    for place in dict.fromkeys(tuple(places[k]) for k in chosen if np.isfinite(places[k]).all()):
        numbers = 1 + np.flatnonzero((places[chosen] == place).all(axis=1))
        x, y, _ = seen(np.array(place))
        ax.text(x, y, f"  {', '.join(map(str, numbers))}", fontsize=8, va="center")
    return finished(ax, below=4)
