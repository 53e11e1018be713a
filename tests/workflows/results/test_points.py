"""Measured points of an inversion: vectors in the axes of the body, files for ParaView, pictures."""

import numpy as np
import pytest
import xarray as xr

from inverse.data.registration import turned
from workflows.report.plots.figure import png
from workflows.report.plots.places import distances, residuals
from workflows.results.points import measured_points, points_grid

R = turned((0.0, 0.0, 5.0))  # its columns are the axes of the scanner in the body
PLACES = np.array([[0.0, 0, 0], [0.05, 0, 0], [0, 0.05, 0.05]])
MEASURED, PREDICTED = np.random.default_rng(0).normal(size=(2, 2, 3, 3))  # case, point, axis of the body


@pytest.fixture
def one():
    """Two load cases of three points, all components but one."""
    rows = [(case, point, axis) for case in (0, 1) for point in range(3) for axis in range(3)]
    rows.remove((1, 2, 0))
    case, point, axis = np.array(rows).T
    along = R.T[axis]
    measured, predicted = ((along * u[case, point]).sum(axis=1) for u in (MEASURED, PREDICTED))
    columns = {
        "datum_axis": axis,
        "datum_case": case,
        "measured": measured,
        "predicted": predicted,
        "residual": (measured - predicted) / 0.1,
        "datum_move": 1e-4 * (1 + point),
    }
    held = {name: ("datum", np.append(values, np.nan)) for name, values in columns.items()}  # filled up, as of several
    held["place"] = (("datum", "axis"), np.vstack([PLACES[point], [[np.nan] * 3]]))
    held["datum_direction"] = (("datum", "axis"), np.vstack([along, [[np.nan] * 3]]))
    held["node_position"] = (("node", "axis"), 0.05 * np.array(list(np.ndindex(2, 2, 2)), dtype=float))
    return xr.Dataset(held, {"case": ["shear", "press"]})


def test_points_are_put_together_from_their_components(one):
    shear, press = measured_points(one)
    order = [int(np.linalg.norm(PLACES - place, axis=1).argmin()) for place in shear.places]
    np.testing.assert_allclose(shear.measured, MEASURED[0][order], atol=1e-15)
    np.testing.assert_allclose(shear.residuals, (MEASURED - PREDICTED)[0][order], atol=1e-15)
    np.testing.assert_allclose(shear.over, np.linalg.norm(shear.residuals, axis=1) / 0.1 / np.sqrt(3))
    np.testing.assert_allclose(shear.moved, 1e-4 * (1 + np.array(order)))
    left = MEASURED[1, 2] - R[:, 0] * (R[:, 0] @ MEASURED[1, 2])  # without the missing component
    np.testing.assert_allclose(press.measured[order.index(2)], left, atol=1e-15)
    grid = points_grid(one)
    assert grid.points.shape == (6, 3)
    np.testing.assert_allclose(grid.point_data["residuals"][:3], shear.residuals)
    assert grid.point_data["load_case"].tolist() == [0, 0, 0, 1, 1, 1]


def test_pictures_of_points(one):
    for picture, panels in ((residuals(one), 4), (distances(one), 2)):
        figure = picture.get_figure(root=True)
        assert sum(not ax.axison for ax in figure.axes) == panels  # the others are bars of colours
        assert png(picture).startswith(b"\x89PNG")
