"""Norms of fields over a body, on all cells: of polynomials exactly, and the same on every mesh."""

import json

import numpy as np
import pytest
import xarray as xr
from mpi4py import MPI

from forward.hyperelastic import Hyperelastic
from workflows.config.study import load
from workflows.results.norms import squares
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
    nodes, (cells, _) = model.layout.coordinates, model.layout.cells()
    x, y, z = nodes.T
    linear = np.column_stack([x, 2 * y, np.ones_like(z)])
    whole = [linear, np.column_stack([x * x, y * z, 0 * z])] if degree == 2 else [linear]
    found, volume = squares(nodes, cells, np.array(whole))
    assert volume == pytest.approx(1.0, rel=1e-13)
    exact = [8 / 3 * 0.5 + 4 / 3 + 1, 32 / 5 * 0.5 + 2 / 3 * 0.125 / 3]
    np.testing.assert_allclose(found, exact[: len(whole)], rtol=1e-12)


LOCAL = """
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
        assert run_study(load(study), name, tmp_path / name, quiet=True) == 0
        found.append(xr.load_dataset(tmp_path / name / "results.nc", engine="h5netcdf"))
    for key in ("field_derivative_norm", "field_derivative_rms", "field_derivative_norm_per_range"):
        np.testing.assert_allclose(found[0][key], found[1][key], rtol=0.06)
    one = found[1]
    np.testing.assert_allclose(one["field_derivative_rms"], one["field_derivative_norm"] / np.sqrt(0.09), rtol=1e-12)
    np.testing.assert_allclose(one["field_derivative_norm_per_range"], 200 * one["field_derivative_norm"], rtol=1e-12)
