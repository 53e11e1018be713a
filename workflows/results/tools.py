"""Rigid tools as surfaces, from the study that results carry: at their depth, with the mean of what is random."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from forward.model import FloatArray
from workflows.results.level import IntArray, level
from workflows.results.vtu import Grid

if TYPE_CHECKING:
    import xarray as xr

    from forward.terms.indenter import Indenter

TRIANGLE = 5  # of VTK
POINTS = 40  # of the lattice on which distances are computed, along each axis
SHOWN = 0.35  # part of the body's extent that a tool without end is drawn over, to each side


def tools_of(dataset: xr.Dataset) -> Iterator[Indenter]:
    """Return the tools of a study, along a path at the last step."""
    model = tomllib.loads(dataset.attrs.get("config", "")).get("model", {})
    loads = [load for load in model.get("loads", ()) if isinstance(load, Mapping) and load.get("kind") == "indenter"]
    if not loads:
        return
    from forward.terms.indenter import Indenter

    means: dict[str, float] = {}
    if "parameter_mean" in dataset:
        names = [str(name) for name in dataset["parameter"].values]
        means = dict(zip(names, map(float, dataset["parameter_mean"].values), strict=True))
    means |= {path: values[-1] for path, values in model.get("steps", {}).items()}
    for load in loads:
        block = {key: value[-1] if key == "depth" and isinstance(value, list) else value for key, value in load.items()}
        label = Indenter.model_construct(**block).label
        own = {path.rpartition(".")[2]: v for path, v in means.items() if path.rpartition(".")[0] == f"loads.{label}"}
        block["at"] = [own.pop(axis, value) for axis, value in zip("xyz", block["at"], strict=True)]
        yield Indenter.model_validate(block | own)


def surface(tool: Indenter, points: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return points (n, 3) and triangles (t, 3) of the surface of a tool at its depth: where the distance is zero.

    Parameters
    ----------
    points
        Points (n, 3) of the body (m); tools without end are drawn as far as it reaches.
    """
    if tool.shape != "plane":
        return level(tool.gaps, *around(tool, points), POINTS)
    centre, extent = middle(tool, points)
    d = np.array(tool.along)
    one = np.cross(d, np.eye(3)[int(np.abs(d).argmin())])
    one *= 0.55 * extent / np.linalg.norm(one)
    other = np.cross(d, one) / np.linalg.norm(d)
    corners = centre + np.array([one + other, other - one, -one - other, one - other])
    return corners, np.array([[0, 1, 2], [0, 2, 3]])


def middle(tool: Indenter, points: FloatArray) -> tuple[FloatArray, float]:
    """Return where (3,) a plane at its depth is nearest to the middle of points (n, 3), and how far these reach (m)."""
    low, high = points.min(axis=0), points.max(axis=0)
    d = np.array(tool.along)
    tip = np.array(tool.at) + tool.depth * d
    return tip + (np.eye(3) - np.outer(d, d)) @ ((low + high) / 2 - tip), float((high - low).max())


def around(tool: Indenter, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the corners (3,) of a box around the part of a tool, at its depth, that is drawn beside points (n, 3)."""
    low, high = points.min(axis=0), points.max(axis=0)
    extent, d = float((high - low).max()), np.array(tool.along)
    tip = np.array(tool.at) + tool.depth * d
    half = min(1.2 * (tool.radius or np.inf), SHOWN * extent)
    ahead = 0.05 * half
    lengths = np.full(3, half)
    if tool.axis is not None:  # it is longer than the body
        along = np.abs(tool.axis) / np.linalg.norm(tool.axis)
        lengths = np.maximum(lengths, along * (extent / 2 + 0.2 * half))
        tip = tip + np.outer(tool.axis, tool.axis) @ ((low + high) / 2 - tip) / np.dot(tool.axis, tool.axis)
    centre = tip - (half - ahead) * d
    return centre - lengths, centre + lengths


def tool_grid(tool: Indenter, points: FloatArray) -> Grid:
    """Return the surface of a tool, in triangles."""
    places, triangles = surface(tool, points)
    return Grid(places, triangles, TRIANGLE)
