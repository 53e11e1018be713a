"""Norms of fields over a body, on all cells: of polynomials exactly, and the same on every mesh."""

import json

import numpy as np
import pytest
import xarray as xr
from mpi4py import MPI

from forward.hyperelastic import Hyperelastic
from workflows.config.study import load
from workflows.results.norms import node_volumes, squares
from workflows.run.run import run as run_study

BLOCK = {
    "material": {"kind": "neo-hookean", "C1": 1e4, "D1": 1e5},
    "clamp": ["x-min"],
    "loads": [{"kind": "gravity", "direction": [0, 0, -1], "density": 1000}],
    "outputs": [{"name": "u", "kind": "max-displacement", "component": "z"}],
}


@pytest.mark.fem
@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron"])
@pytest.mark.parametrize("degree", [1, 2])
def test_polynomials_are_integrated_exactly(cell, degree):
    """On boxes cut in any way: linear fields on cells of degree 1, quadratic ones on those of degree 2."""
    body = {"kind": "box", "size": [2.0, 1.0, 0.5], "cells": [3, 2, 1], "cell": cell, "degree": degree}
    model = Hyperelastic.model_validate(BLOCK | {"body": body}).build(MPI.COMM_SELF, ())
    nodes, (cells, _) = model.space.coordinates, model.space.cells()
    x, y, z = nodes.T
    linear = np.column_stack([x, 2 * y, np.ones_like(z)])
    whole = [linear, np.column_stack([x * x, y * z, 0 * z])] if degree == 2 else [linear]
    found, volume = squares(nodes, cells, np.array(whole))
    assert volume == pytest.approx(1.0, rel=1e-13)
    exact = [8 / 3 * 0.5 + 4 / 3 + 1, 32 / 5 * 0.5 + 2 / 3 * 0.125 / 3]
    np.testing.assert_allclose(found, exact[: len(whole)], rtol=1e-12)


@pytest.mark.fem
@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron"])
@pytest.mark.parametrize("degree", [1, 2])
def test_nodes_stand_for_shares_of_the_body(cell, degree):
    """Positive ones, by which linear functions are integrated exactly, and squares nearly."""
    grading = {"x-min": 5.0, "z-max": 3.0}
    body = {"kind": "box", "size": [2, 1, 0.5], "cells": [4, 3, 3], "cell": cell, "degree": degree, "grading": grading}
    model = Hyperelastic.model_validate(BLOCK | {"body": body}).build(MPI.COMM_SELF, ())
    nodes, (cells, _) = model.space.coordinates, model.space.cells()
    volumes = node_volumes(nodes, cells)
    assert (volumes > 0).all()
    assert volumes.sum() == pytest.approx(1.0, rel=1e-12)
    np.testing.assert_allclose(volumes @ nodes, [1.0, 0.5, 0.25], rtol=1e-12)
    exact = cell == "hexahedron" and degree == 2
    np.testing.assert_allclose(volumes @ nodes**2, [4 / 3, 1 / 3, 1 / 12], rtol=1e-12 if exact else 0.15)


LOCAL = """
mesh_error = false

[model]
body = { kind = "box", size = [1.0, 0.3, 0.3], cells = CELLS, degree = 2 }
material = { kind = "neo-hookean", C1 = 1e5, D1 = 1e6 }
clamp = ["x-min"]
loads = [{ kind = "gravity", direction = [0, 0, -1], density = 1000 }]
outputs = [{ name = "u", kind = "max-displacement", component = "z" }]

[parameters]
"loads.gravity.density" = { kind = "uniform", lower = 900, upper = 1100 }

[method]
kind = "local-sensitivity"
"""


@pytest.mark.fem
def test_norms_do_not_depend_on_the_mesh(tmp_path):
    found = []
    for name, cells in (("coarse", [4, 2, 2]), ("fine", [8, 2, 2])):
        study = tmp_path / f"{name}.toml"
        study.write_text(LOCAL.replace("CELLS", json.dumps(cells)))
        assert run_study(load(study), name, tmp_path / name, quiet=True, report=False) == 0
        found.append(xr.load_dataset(tmp_path / name / "results.nc", engine="h5netcdf"))
    for key in ("field_derivative_norm", "field_derivative_rms", "field_derivative_norm_per_range"):
        np.testing.assert_allclose(found[0][key], found[1][key], rtol=0.06)
    one = found[1]
    np.testing.assert_allclose(one["field_derivative_rms"], one["field_derivative_norm"] / np.sqrt(0.09), rtol=1e-12)
    np.testing.assert_allclose(one["field_derivative_norm_per_range"], 200 * one["field_derivative_norm"], rtol=1e-12)


SOBOL = """
mesh_error = false

[model]
body = { kind = "box", size = [1.0, 0.3, 0.3], cells = [8, 1, 1], cell = "hexahedron", degree = 1, grading = GRADING }
material = { kind = "neo-hookean", C1 = 1e5, D1 = 1e5 }
displacements = [{ on = "x-min", x = 0, y = 0, z = 0 }]
loads = [{ kind = "traction", on = "x-max", direction = [1, 0, 0], size = 5e4 }]
outputs = [
    { name = "ux", kind = "displacement", at = [1, 0, 0], component = "x" },
    { name = "uy", kind = "displacement", at = [1, 0, 0], component = "y" },
]

[parameters]
"displacements.x-min.y" = { kind = "uniform", lower = -0.1, upper = 0.1 }
"loads.traction.size" = { kind = "uniform", lower = 1e4, upper = 5e4 }

[method]
kind = "sobol"
"""


@pytest.mark.slow
@pytest.mark.fem
@pytest.mark.parametrize("design", ["samples = 8", 'samples = 16\ndesign = "saltelli"\nscrambles = 4'])
def test_indices_of_fields_do_not_depend_on_the_mesh(tmp_path, design):
    """Thin cells at the end that is held and moves as a whole, or at the one that is pulled."""
    found = []
    for name in ("x-min", "x-max"):
        study = tmp_path / f"{name}.toml"
        study.write_text(SOBOL.replace("GRADING", f"{{ {name} = 8 }}") + design)
        run_study(load(study), name, tmp_path / name, quiet=True, report=False)
        found.append(xr.load_dataset(tmp_path / name / "results.nc", engine="h5netcdf"))
    one, other = found
    plain = []
    for each in found:
        variance = (each["field_std"] ** 2).sum("component").to_numpy()
        nodes = each["node_sobol_total"].fillna(0.0).to_numpy() @ variance
        plain.append(nodes / variance.sum())
        volumes = node_volumes(each["node_position"].to_numpy(), each["cell_nodes"].to_numpy())
        exact = each["node_sobol_total"].fillna(0.0).to_numpy() @ (volumes * variance) / (volumes @ variance)
        if "saltelli" not in design:
            np.testing.assert_allclose(each["field_sobol_total"], exact, rtol=1e-6)
    for which in ("first", "total"):
        np.testing.assert_allclose(one[f"field_sobol_{which}"], other[f"field_sobol_{which}"], atol=0.01)
    assert abs(plain[0] - plain[1]).max() > 0.02  # of sums over the nodes
