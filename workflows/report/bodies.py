"""Pictures of the deformed body with pyvista, on screen or in a separate process."""

from __future__ import annotations

import io
import os
import pickle
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.model import FloatArray
from workflows.report.scene.scene import up_of
from workflows.results.directory import body_grid, mesh_grid
from workflows.results.tools import tool_grid, tools_of

if TYPE_CHECKING:
    import xarray as xr

SUBDIVISION = 3  # number of times that a face of high order is halved
SAMPLES = "4"  # of a pixel: eight, the default, take twice as long where processors draw
DRAWING_SECONDS = 600  # time limit for drawing all bodies
FIRST, SECOND, DARK = "#9aa5b1", "#d1622b", "#1d2733"
COLUMNS, ROWS = 3, 3  # of names of colours
TOOL = "#6b7480"
STILL = "#c9ced4"  # of nodes that do not move
BY_NUMBER = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#bcbd22", "#17becf")


@dataclass(frozen=True, eq=False)
class Skin:
    """The surface of an undeformed body with all fields, and its edges: what all pictures of a body share.

    Curved faces of high order are subdivided until smooth. Points move with the fields interpolated there, as the
    elements do.
    """

    surface: Any
    edges: Any

    @staticmethod
    def of(dataset: xr.Dataset) -> Skin:
        """Return the surface of the body of some results."""
        whole = body_grid(dataset).pyvista()
        surface = whole.extract_surface(nonlinear_subdivision=SUBDIVISION, algorithm="dataset_surface").clean()
        return Skin(
            surface,
            surface.extract_feature_edges(feature_angle=40, manifold_edges=False, non_manifold_edges=False),
        )


def body(dataset: xr.Dataset, shown: str = "mean", skin: Skin | None = None) -> Any:
    """Draw the body, deformed by its mean displacement (the nominal one if there is no mean) and coloured.

    Parameters
    ----------
    dataset
        Results with fields.
    shown
        "mean", "std", "mean_error", "std_error", "nominal", or "derivative PARAMETER" (times the standard deviation
        of that parameter): the field whose magnitude is the colour. With "std", lines show the edges of the body
        where all components are one standard deviation larger, and smaller, than their mean. "sobol_first PARAMETER",
        "sobol_total PARAMETER": that index of the displacement at the node. "dominating": a colour for the parameter
        with the largest total index. "factor FIELD i": realisation i of the factor of a random field, on the undeformed
        body.
    skin
        `Skin.of(dataset)`, where several pictures are drawn.

    Returns
    -------
    pyvista.Plotter
        Off-screen: `show()` shows it in a notebook, `screenshot(path)` writes it.
    """
    import pyvista

    skin = Skin.of(dataset) if skin is None else skin
    motion = "mean" if "mean" in skin.surface.point_data else "nominal"
    parameter = shown.removeprefix("derivative ") if shown.startswith("derivative ") else None
    factor = 1.0 if parameter is None else float(dataset["parameter_std"].sel(parameter=parameter))
    undeformed = shown.startswith("factor ")
    still = dataset["node_position"].to_numpy()
    moved = still if undeformed else still + dataset[f"field_{motion}"].to_numpy()

    # Two panels, so that the scale of the colours never covers the body.
    plotter: Any = pyvista.Plotter(
        off_screen=True, window_size=[1200, 860], shape=(2, 1), row_weights=[6, 1], border=False
    )
    plotter.set_background("white")
    plotter.add_mesh(skin.edges, color=FIRST, line_width=2)
    if shown == "std":
        for sign in (-1, 1):
            edges = _moved(skin.edges, motion)
            edges.points += sign * np.sign(edges.point_data[motion]) * edges.point_data["std"]
            plotter.add_mesh(edges, color=SECOND, line_width=2)
    surface, edges = (one if undeformed else _moved(one, motion) for one in (skin.surface, skin.edges))
    # The magnitude after the subdivision: between the nodes it is that of the interpolated vector, never negative.
    colour = factor * np.asarray(surface.point_data[shown])
    scalar = colour.ndim == 1
    surface.point_data["magnitude"] = colour if scalar else np.linalg.norm(colour, axis=1)
    colours: Any = "cividis" if scalar else "plasma" if shown == "std" else "viridis"
    ends: tuple[float, float] | None = None
    names = [str(name) for name in dataset["parameter"].values]
    if shown.startswith("factor "):
        ends = _range(dataset, shown)
    elif shown.startswith("sobol_"):
        ends = (0.0, 1.0)
    elif shown == "dominating":
        surface.point_data["magnitude"] = np.round(np.clip(colour, -1, len(names) - 1))
        colours, ends = [STILL, *(_colour_of(i) for i in range(len(names)))], (-1.0, len(names) - 1.0)
    coloured = plotter.add_mesh(
        surface,
        scalars="magnitude",
        cmap=colours,
        clim=ends,
        interpolate_before_map=shown != "dominating",
        ambient=0.45,
        diffuse=0.6,
        smooth_shading=True,
        split_sharp_edges=True,
        show_scalar_bar=False,
        nan_color=STILL,
    )
    plotter.add_mesh(edges, color=DARK, line_width=1.5)
    for tool in () if undeformed else tools_of(dataset):
        plotter.add_mesh(tool_grid(tool, still).pyvista(), color=TOOL, opacity=0.45, smooth_shading=True)
    _show_lengths(plotter, np.concatenate([still, moved]), up_of(dataset))
    _look(plotter, up_of(dataset))
    plotter.subplot(1, 0)
    if shown == "dominating":
        _name_colours(plotter, [(i, names[i]) for i in np.unique(dataset["dominating"].astype(int)) if i >= 0])
    else:
        _show_colours(plotter, coloured.mapper, _colour_title(shown, parameter))
    plotter.subplot(0, 0)
    return plotter


def mesh(dataset: xr.Dataset, shown: str = "mesh") -> Any:
    """Draw a mesh that was refined, coloured by the contributions of its cells to errors.

    Parameters
    ----------
    dataset
        Results with such a mesh.
    shown
        "mesh": its surface; "mesh cut": what is behind the cell that contributes most.

    Returns
    -------
    pyvista.Plotter
        As in `body`.
    """
    import pyvista

    grid, up = mesh_grid(dataset).pyvista(), up_of(dataset)
    density = grid.cell_data["indicator by volume"] * grid.volume
    grid.cell_data["colour"] = np.log10(np.maximum(density, 1e-3 * density.max()))
    plotter: Any = pyvista.Plotter(
        off_screen=True, window_size=[1200, 860], shape=(2, 1), row_weights=[6, 1], border=False
    )
    plotter.set_background("white")
    part = grid
    if shown == "mesh cut":
        _, front = _sides(up)
        depth = grid.cell_centers().points @ front
        part = grid.extract_cells(np.flatnonzero(depth <= depth[density.argmax()]))
        outline = grid.extract_surface(algorithm="dataset_surface").extract_feature_edges(40, boundary_edges=False)
        plotter.add_mesh(outline, color=FIRST, line_width=2)
    surface = part.extract_surface(algorithm="dataset_surface")
    coloured = plotter.add_mesh(
        surface, scalars="colour", cmap="viridis", show_edges=True, edge_color=DARK, show_scalar_bar=False, ambient=0.45
    )
    _show_lengths(plotter, grid.points, up)
    _look(plotter, up)
    plotter.subplot(1, 0)
    _show_colours(plotter, coloured.mapper, "log10 of contributions of cells to the error by volume, 0 on average")
    plotter.subplot(0, 0)
    return plotter


def pictures(dataset: xr.Dataset, shown: Sequence[str]) -> dict[str, bytes] | None:
    """Draw bodies as PNG, each as `body` or `mesh` does, in a separate process; None if they cannot be drawn.

    A graphics library that is missing or broken kills its process: it must not kill the study.
    """
    needed = dataset[[name for name in dataset.data_vars if "sample" not in dataset[name].dims]]
    try:
        done = subprocess.run(
            [sys.executable, "-m", "workflows.report.bodies"],
            input=pickle.dumps((needed, list(shown))),
            capture_output=True,
            check=True,
            timeout=DRAWING_SECONDS,
            env={"PYVISTA_MULTI_SAMPLES": SAMPLES, **os.environ},
            cwd=Path(__file__).resolve().parents[2],
        )
        return dict(pickle.loads(done.stdout))
    except (OSError, subprocess.SubprocessError, pickle.UnpicklingError, EOFError):
        return None


def _range(dataset: xr.Dataset, shown: str) -> tuple[float, float]:
    """Smallest and largest factor over all realisations of a random field, which share one scale of colours."""
    factors = dataset["factor"].sel(random_field=shown.split()[1])
    return float(factors.min()), float(factors.max())


def _moved(mesh: Any, motion: str) -> Any:
    """Return a copy of a mesh whose points are moved by one of its fields."""
    found = mesh.copy()
    found.points = mesh.points + mesh.point_data[motion]
    return found


def _sides(up: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the directions (3,) to the right and to the front."""
    right = np.eye(3)[1 if up[0] else 0]
    return right, np.cross(right, up)


def _look(plotter: Any, up: FloatArray) -> None:
    """Look from the front, a little from the right and from above."""
    right, front = _sides(up)
    plotter.show_axes()
    plotter.view_vector(front + 0.6 * right + 0.4 * up, viewup=up)
    plotter.reset_camera()
    extents = np.ptp(np.reshape(plotter.bounds, (3, 2)), axis=1)
    tall = extents @ np.abs(up) > 0.8 * (extents * (1 - np.abs(up))).max()
    plotter.camera.zoom(0.86 if tall else 1.02)  # room for the numbers below and above a tall body
    plotter.camera.SetWindowCenter(0, -0.06)  # the numbers of the axes are below the body


def _colour_of(parameter: int) -> str:
    return BY_NUMBER[parameter % len(BY_NUMBER)]


def _name_colours(plotter: Any, present: list[tuple[int, str]]) -> None:
    """Write the parameters that dominate somewhere, each in its colour, in three columns."""
    plotter.add_text("dominating parameter:", position=(0.1, 0.75), viewport=True, font_size=14, color="black")
    for k, (i, name) in enumerate(present[: COLUMNS * ROWS]):
        place = (0.1 + 0.28 * (k % COLUMNS), 0.48 - 0.22 * (k // COLUMNS))
        text = name.replace("$", "")
        plotter.add_text(text, position=place, viewport=True, font_size=14, color=_colour_of(i), name=f"parameter {i}")


def _show_colours(plotter: Any, mapper: Any, title: str) -> None:
    """Draw the scale of the colours with what they show below it."""
    plotter.add_scalar_bar(
        mapper=mapper,
        title="",
        fmt="%.3g",
        n_labels=5,
        label_font_size=26,
        color="black",
        width=0.8,
        height=0.35,
        position_x=0.1,
        position_y=0.52,
    )
    plotter.add_text(title, position=(0.1, 0.14), viewport=True, font_size=14, color="black")


def _show_lengths(plotter: Any, points: FloatArray, up: FloatArray) -> None:
    """Draw axes around the points (n, 3) that begin, end and are numbered at multiples of a round length.

    Two axes meet in the corners at the lower left and lower right: one of them omits its number.
    """
    extent = float(np.ptp(points, axis=0).max())
    power = 10 ** np.floor(np.log10(extent / 4))
    step = power * max(factor for factor in (1, 2, 5) if factor * power <= extent / 4)
    first = np.floor(points.min(axis=0) / step + 0.1)
    last = np.maximum(np.ceil(points.max(axis=0) / step - 0.1), first + 1)
    counts = (last - first + 1).astype(int)
    actor = plotter.show_bounds(
        bounds=np.column_stack([first, last]).ravel() * step,
        location="outer",
        xtitle="x (m)",
        ytitle="y (m)",
        ztitle="z (m)",
        n_xlabels=counts[0],
        n_ylabels=counts[1],
        n_zlabels=counts[2],
        fmt=f"%.{max(0, -int(np.floor(np.log10(step))))}f",
        font_size=18,
        color="#5b6875",
    )
    for direction in (-up, _sides(up)[1]):
        axis = int(np.abs(direction).argmax())
        written = actor.GetAxisLabels(axis)
        written.SetValue(written.GetNumberOfValues() - 1 if direction[axis] > 0 else 0, "")


def _colour_title(shown: str, parameter: str | None) -> str:
    # A dollar sign would start a formula in VTK.
    if parameter is not None:
        return f"displacement by one standard deviation of {parameter} (m)".replace("$", "")
    if shown.startswith("sobol_"):
        which, _, name = shown.partition(" ")
        kind = "first-order" if which == "sobol_first" else "total"
        return f"{kind} index of the displacement for {name}".replace("$", "")
    if shown.startswith("factor "):
        _, field, _ = shown.split()
        return f"random factor {field} (1)".replace("$", "")
    words = {
        "mean": "magnitude of the mean displacement (m)",
        "std": "magnitude of the standard deviation of the displacement (m)",
        "nominal": "displacement at the mean parameters (m)",
    }
    return words.get(shown, f"{shown} of the displacement (m)")


def _draw_for_parent() -> None:
    """Read a dataset and what to show from standard input, and write the pictures to standard output."""
    dataset, shown = pickle.load(sys.stdin.buffer)
    skin = Skin.of(dataset) if any(not name.startswith("mesh") for name in shown) else None
    drawn = {name: mesh(dataset, name) if name.startswith("mesh") else body(dataset, name, skin) for name in shown}
    pickle.dump({name: _png(plotter) for name, plotter in drawn.items()}, sys.stdout.buffer)


def _png(plotter: Any) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(plotter.screenshot(return_img=True)).save(file, "png")
    plotter.close()
    return file.getvalue()


if __name__ == "__main__":
    _draw_for_parent()
