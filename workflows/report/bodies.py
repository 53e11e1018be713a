"""Pictures of bodies, by matplotlib alone: for paper, notebooks, and where no browser turns them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.errors import UnknownError
from forward.model import FloatArray
from forward.readable import named, scale
from workflows.report.plots.figure import DARK
from workflows.report.plots.places import looking
from workflows.report.scene.scene import COLOURS, Quantity, Scene, ends, forward_scene, up_of
from workflows.results.directory import TETRAHEDRON, mesh_grid
from workflows.results.surfaces import IntArray, crossing, flat, outer, skin, tetrahedra

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

SIZE = (7.2, 4.8)  # inches
PLACE, BAR = (0.01, 0.01, 0.84, 0.98), (0.86, 0.15, 0.025, 0.7)  # left, bottom, width and height, of the picture
DPI = 110
LIGHT = np.array([0.25, 0.5, 0.83])  # from the viewer
LEAST = 0.6  # brightness of a face that looks away from it
CATEGORIES = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#bcbd22", "#17becf")
STILL = "#c9ced4"  # of nodes without a number
BEFORE = "#9aa5b1"  # of edges where a body was, or of what is cut away
TRANSPARENT = 0.28
HALF = 0.5  # of the range of a quantity
DIMMEST = 1e-3  # of the largest contribution of a cell: smaller ones have its colour


def body(dataset: xr.Dataset, shown: str = "") -> Figure:
    """Draw the body of results with fields, deformed, coloured by the first quantity whose name begins like this.

    Names are those of the report: "Standard deviation", "Total index of the displacement for material.C2".

    Raises
    ------
    UnknownError
        If there is no such quantity; the message lists those that there are.
    """
    scene = forward_scene(dataset, every=True)
    for quantity in scene.quantities:
        if quantity.name.startswith(shown):
            return still(scene, quantity)
    known = ", ".join(quantity.name for quantity in scene.quantities)
    raise UnknownError(f"no quantity begins with {shown!r}, expected one of: {known}")


def still(scene: Scene, quantity: Quantity) -> Figure:
    """Draw a body, deformed and coloured: triangles from far to near."""
    import matplotlib as mpl
    from matplotlib.colors import Colormap, ListedColormap, Normalize, to_rgb

    view, skin_ = looking(scene.up), scene.skin
    one, unit = scale(float(np.nanmax(np.abs(quantity.values), initial=0.0)), quantity.unit)
    colours: Colormap = mpl.colormaps[quantity.colours]
    low, high = ends(quantity)
    norm = Normalize(low / one, high / one)
    if count := len(quantity.names):
        colours = ListedColormap([STILL, *(CATEGORIES[i % len(CATEGORIES)] for i in range(count))])
        norm = Normalize(-1.5, count - 0.5)
    moved = scene.points + (0 if quantity.still else scene.motion)
    triangles = skin_.nodes[skin_.triangles]
    with np.errstate(invalid="ignore"):
        values = quantity.values[triangles] / one
        of_faces = values[:, 0] if quantity.names else values.mean(axis=1)
    rgb = np.where(np.isfinite(of_faces)[:, None], colours(norm(np.nan_to_num(of_faces)))[:, :3], to_rgb(STILL))
    inner = [inside for inside in scene.insides if inside.shown and len(inside.triangles)]
    at, between = np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    if scene.cut == "v" and quantity is scene.quantities[0]:  # the viewer begins with where it is half-way
        above = quantity.values - (low + HALF * (high - low))
        four = tetrahedra(scene.cells, scene.kind)
        at, between = crossing(scene.points, np.where(above == 0, 1e-300, above), four)
    hidden = bool(len(between)) or any(inside.kind == "inside" for inside in inner)
    faces = []
    for inside in inner:
        nodes = (moved if inside.points is None else inside.points) @ view.T
        faces.append(_faces(nodes, inside.triangles, to_rgb(COLOURS[inside.kind]), inside.opacity, culled=False))
    if len(between):
        faces.append(_faces(at @ view.T, between, colours(HALF)[:3], 1.0, culled=False))
    faces.append(_faces(moved @ view.T, triangles, rgb, TRANSPARENT if hidden else 1.0, culled=True))
    # From far to near; a transparent skin is in front of what is inside.
    layers = [faces[:-1], faces[-1:]] if hidden else [faces]
    before = (scene.points @ view.T)[:, :2]
    edges = before[skin_.edges] if scene.motion.any() and not quantity.still else None
    label = named(quantity.name, unit).replace("$", r"\$")
    figure, bar = _painted(layers, before, edges, "none" if hidden else None, (colours, norm, label))
    if count:
        bar.set_ticks(range(-1, count), labels=["–", *(name.replace("$", r"\$") for name in quantity.names)])
    return figure


def refined(dataset: xr.Dataset, *, cut: bool = False) -> Figure:
    """Draw a mesh that was refined, coloured by what its cells add to the error; `cut`: behind the one that adds most.

    Colours are the decades of contributions by volume, 0 on average.
    """
    import matplotlib as mpl

    grid, up = mesh_grid(dataset), up_of(dataset)
    view, front = looking(up), np.cross(np.eye(3)[1 if up[0] else 0], up)
    corners = grid.points[grid.cells]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6
    density = grid.cell_data["indicator by volume"] * volumes.sum()
    values = np.log10(np.maximum(density, DIMMEST * density.max()))
    near = corners.mean(axis=1) @ front
    kept = np.flatnonzero(near <= near[density.argmax()]) if cut else np.arange(len(near))
    triangles, owners = outer(grid.cells[kept], flat(TETRAHEDRON))
    colours, norm = mpl.colormaps["viridis"], mpl.colors.Normalize(float(values.min()), float(values.max()))
    at = grid.points @ view.T
    faces = _faces(at, triangles, colours(norm(values[kept[owners]]))[:, :3], 1.0, culled=True)
    edges = at[skin(grid.points, grid.cells, TETRAHEDRON).edges][:, :, :2] if cut else None
    label = "log10 of contributions to the error by volume"
    return _painted([[faces]], at[:, :2], edges, DARK, (colours, norm, label))[0]


def _painted(
    layers: Sequence[Sequence[tuple[FloatArray, FloatArray]]],
    places: FloatArray,
    before: FloatArray | None,
    edges: str | None,
    bar: tuple[Any, Any, str],
) -> tuple[Figure, Any]:
    """Return a figure of faces (`_faces`), and its bar: of colours, their ends, and what they are of.

    Layers of faces are behind each other, each from far to near, and lines `before` (m, 2, 2) behind all of them. Edges
    of faces have a colour, or their own. The picture holds all that, and `places` (n, 2).
    """
    import matplotlib as mpl
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE, dpi=DPI)
    ax = figure.add_axes(PLACE)
    depth = np.repeat(np.arange(len(layers)), [sum(len(at) for at, _ in layer) for layer in layers])
    corners, paints = (np.concatenate(part) for part in zip(*(faces for of in layers for faces in of), strict=True))
    far_first = np.lexsort((corners[:, :, 2].mean(axis=1), depth))
    flat, paints = corners[far_first][:, :, :2], paints[far_first]
    if before is not None:
        ax.add_collection(LineCollection(list(before), colors=BEFORE, linewidths=0.8))
    ax.add_collection(PolyCollection(flat, facecolors=paints, edgecolors=edges or paints, linewidths=0.3))
    places = np.concatenate([flat.reshape(-1, 2), places])
    low, high = places.min(axis=0), places.max(axis=0)
    margin = 0.03 * (high - low).max()
    ax.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin), aspect="equal")
    ax.axis("off")
    colours, norm, label = bar
    drawn = figure.colorbar(mpl.cm.ScalarMappable(norm, colours), cax=figure.add_axes(BAR))
    drawn.set_label(label, fontsize=8)
    drawn.ax.tick_params(labelsize=8)
    return figure, drawn


def _faces(
    points: FloatArray, triangles: IntArray, rgb: Any, alpha: float, *, culled: bool
) -> tuple[FloatArray, FloatArray]:
    """Return corners (t, 3, 3) and colours (t, 4) of triangles in the light; `culled`: of those seen from outside.

    They have one colour (3,), or each its own (t, 3).
    """
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    seen = normals[:, 2] > 0 if culled else np.ones(len(corners), dtype=bool)
    light = LEAST + (1 - LEAST) * np.abs(normals[seen] @ LIGHT)
    shaded = np.broadcast_to(rgb, (len(corners), 3))[seen] * light[:, None]
    paints = np.column_stack([shaded, np.full(len(shaded), alpha)])
    return corners[seen], np.clip(paints, 0, 1)
