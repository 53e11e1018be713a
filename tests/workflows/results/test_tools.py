"""Surfaces of tools for pictures and ParaView."""

import numpy as np
import pytest
import xarray as xr

from forward.terms.indenter import Indenter
from tests.forward.terms.test_indenter import SHAPES, SIDE, only
from workflows.report.plots.places import pressure_map
from workflows.results.surfaces import surface, tools_of

CORNERS = SIDE * np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T


@pytest.mark.parametrize("shape", SHAPES)
def test_a_surface_lies_where_the_distance_is_zero(shape):
    tool = Indenter.model_validate(only(shape, at=(0.4 * SIDE, 0.5 * SIDE, SIDE)))
    points, triangles = surface(tool, CORNERS)
    assert len(triangles) >= 2
    assert np.abs(tool.gaps(points)).max() < 0.02 * SIDE
    foremost = np.array(tool.at) + tool.depth * np.array(tool.along)
    assert np.linalg.norm(points - foremost, axis=1).min() < (SIDE if shape == "plane" else 0.05 * SIDE)


STUDY = """
[model]
kind = "path"
[[model.loads]]
kind = "gravity"
density = 1000
[[model.loads]]
kind = "indenter"
name = "ball"
shape = "sphere"
radius = 5e-3
on = "z-max"
at = [0, 0, 0.02]
direction = [0, 0, -1]
depth = [1e-3, 2e-3]
"""


def test_tools_are_those_of_the_study_at_its_last_step_and_mean():
    dataset = xr.Dataset(
        {"parameter_mean": ("parameter", [6e-3, 1e-3, 500.0])},
        {"parameter": ["loads.ball.radius", "loads.ball.x", "material.C1"]},
        {"config": STUDY},
    )
    (tool,) = tools_of(dataset)
    assert (tool.radius, tool.depth, tool.at, tool.label) == (6e-3, 2e-3, (1e-3, 0.0, 0.02), "ball")
    assert not list(tools_of(xr.Dataset(attrs={"config": "[model]\nkind = 'specimen'"})))


def test_the_map_shows_the_area_in_contact_and_the_cells_around_it():
    x, y = np.meshgrid(np.linspace(0, 0.01, 11), np.linspace(0, 0.01, 11))
    pressure = np.maximum(1e3 * (1 - (np.hypot(x, y) / 3.5e-3) ** 2), 0).ravel()
    places = np.column_stack([x.ravel(), np.full(121, SIDE), y.ravel()])
    dataset = xr.Dataset(
        {"contact_position": (("contact_vertex", "axis"), places), "contact_pressure": ("contact_vertex", pressure)},
        {"contact_tool": ("contact_vertex", ["ball"] * 121)},
    )
    ax = pressure_map(dataset, "ball", (0.0, -1.0, 0.0))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x (mm)", "z (mm)")
    np.testing.assert_allclose([*ax.get_xlim(), *ax.get_ylim()], [0, 4, 0, 4])
