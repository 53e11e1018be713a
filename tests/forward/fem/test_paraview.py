"""Files for ParaView, read again by VTK: names, values, and cells of high order that interpolate as the elements do."""

import warnings

import numpy as np
import pytest
import pyvista
import xarray as xr
from mpi4py import MPI

from forward.bodies.geometry import Box
from forward.fem.dolfinx import meshes, spaces
from forward.fem.layout import Layout
from workflows.results.directory import label, with_random_fields, write_fields

UNITS = {"material.C1": "Pa", "loads.gravity.density": "kg/m³"}
SIZE = (2.0, 1.0, 0.5)


def layout(cell, degree):
    body = Box(size=SIZE, cells=(2, 1, 1), cell=cell, degree=degree)
    return Layout(spaces.vector_space(meshes.mesh_body(MPI.COMM_SELF, body)[0], degree), MPI.COMM_SELF)


def polynomial(x, degree):
    """What elements of a degree hold exactly."""
    a, b, c = x.T
    linear = np.stack([a - 2 * b + c, 3 * c - a, b + 0.5], axis=1)
    return linear if degree == 1 else linear + np.stack([a * a - b * c, c * c + a * b, b * b], axis=1)


def results(where, degree):
    """What studies leave by node: moments, derivatives, indices, and realisations of a field."""
    nodes = where.coordinates
    shape = ("node", "component")
    by_parameter = np.arange(2.0)[:, None, None] * polynomial(nodes, degree)
    dataset = xr.Dataset(
        {
            "field_mean": (shape, polynomial(nodes, degree)),
            "field_std": (shape, np.abs(polynomial(nodes, 1))),
            "field_derivative": (("parameter", *shape), by_parameter),
            "node_sobol_first": (("parameter", "node"), by_parameter[..., 0]),
            "dominating": (("node",), np.arange(len(nodes))),
        },
        {"output": ["u"], "parameter": ["material.C1", "loads.gravity.density"], "component": ["x", "y", "z"]},
    )
    dataset = label(dataset, {"u": "m"}, nodes, *where.cells())
    return with_random_fields(dataset, {"stiffness": nodes[None, :, 0]}, {"stiffness": 0.9})


def test_errors_that_are_not_known_do_not_spoil_the_file(tmp_path):
    where = layout("tetrahedron", 1)
    dataset = results(where, 1)
    unknown = xr.full_like(dataset["field_mean"], np.inf)
    half = unknown.copy()
    half[0] = 0.0
    path = write_fields(tmp_path, dataset.assign(field_mean_error=unknown, field_std_error=half))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        grid = pyvista.read(path)
    assert "mean_error (m)" not in grid.point_data
    assert np.isnan(grid["std_error (m)"][1:]).all()


@pytest.mark.parametrize(
    ("cell", "degree", "kind"),
    [
        ("hexahedron", 2, pyvista.CellType.LAGRANGE_HEXAHEDRON),
        ("tetrahedron", 2, pyvista.CellType.LAGRANGE_TETRAHEDRON),
        ("hexahedron", 1, pyvista.CellType.HEXAHEDRON),
        ("tetrahedron", 1, pyvista.CellType.TETRA),
    ],
)
def test_fields_are_read_again(tmp_path, cell, degree, kind):
    where = layout(cell, degree)
    dataset = results(where, degree)
    path = write_fields(tmp_path / "fields", dataset, lambda label: UNITS)
    grid = pyvista.read(path)
    assert set(grid.celltypes) == {kind} or degree == 1
    assert grid.n_cells == 2 * (6 if cell == "tetrahedron" else 1)
    np.testing.assert_array_equal(grid.points, where.coordinates)
    assert set(grid.point_data) == {
        "mean (m)",
        "std (m)",
        "derivative material.C1 (m/Pa)",
        "derivative loads.gravity.density (m/(kg/m³))",
        "sobol_first material.C1",
        "sobol_first loads.gravity.density",
        "dominating",
        "factor stiffness 0",
    }
    np.testing.assert_array_equal(grid["mean (m)"], dataset["field_mean"])
    np.testing.assert_array_equal(
        grid["sobol_first loads.gravity.density"], dataset["node_sobol_first"].sel(parameter="loads.gravity.density")
    )
    # Between the nodes, VTK interpolates as the elements do: the order of the nodes in the cells is right.
    inside = np.random.default_rng(1).uniform(0.02, 0.98, (50, 3)) * SIZE
    sampled = pyvista.PolyData(inside).sample(grid)
    found = np.asarray(sampled["vtkValidPointMask"]) > 0
    assert found.mean() > 0.9
    np.testing.assert_allclose(sampled["mean (m)"][found], polynomial(inside, degree)[found], atol=1e-6)
    volume = grid.compute_cell_sizes()["Volume"].sum() if degree == 1 else 1.0
    assert volume == pytest.approx(1.0)
    warped = grid.warp_by_vector("mean (m)")
    np.testing.assert_allclose(warped.points, grid.points + grid["mean (m)"])
