"""Estimates with their errors: the names under which results hold them, and how errors add up."""

import ast
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from uq.estimators.estimate import OF_MESH, PARTS, estimate_of, holds, part, parts_of, single, with_mesh

ROOT = Path(__file__).parents[3]
pytestmark = pytest.mark.unit


@pytest.mark.parametrize(
    ("name", "names"),
    [
        ("mean", "mean_error mesh_error mesh_error_doubt total_error mean_corrected mean_corrected_error"),
        ("std", "std_error std_mesh_error std_mesh_error_doubt std_total_error std_corrected std_corrected_error"),
        ("", "error mesh_error mesh_error_doubt total_error corrected corrected_error"),
    ],
)
def test_names_are_those_of_the_documentation(name, names):
    """As docs/results.md lists them, whatever reads results.nc."""
    assert [part(name, which) for which in PARTS] == names.split()


def test_errors_add_up():
    """3-4-5 triangles: a sampling error of 3, and 4 from the mesh."""
    found = with_mesh(np.array([10.0]), np.array([3.0]), np.array([-3.0]), np.array([1.0]))
    assert (found.total, found.corrected) == (5.0, 7.0)
    assert found.left == pytest.approx(np.sqrt(10.0))
    assert with_mesh(np.array([10.0]), 0.0, np.array([-3.0]), np.array([1.0])).total == 4.0


def test_what_is_written_is_read():
    """All parts, of several dimensions; in a selection of one element too, and in a summary."""
    rng = np.random.default_rng(0)
    value, error, mesh, doubt = rng.normal(size=(4, 2, 3))
    written = with_mesh(value, np.abs(error), mesh, np.abs(doubt))
    dims = ("output", "parameter")
    dataset = xr.Dataset({"derivative": (dims, value), **parts_of(written, "derivative", dims, tuple(PARTS))})
    read = estimate_of(dataset, "derivative")
    for field in ("value", *PARTS):
        np.testing.assert_array_equal(getattr(read, field), getattr(written, field))
        one = dataset.isel(output=1, parameter=2)
        summary = {str(name): float(of) for name, of in one.items()}
        assert getattr(single(one, "derivative"), field) == getattr(written, field)[1, 2]
        assert getattr(single(summary, "derivative"), field) == getattr(written, field)[1, 2]


def test_what_results_do_not_hold_is_not_known():
    """Results of an earlier version hold no errors of the mesh; a summary says None where a number is not known."""
    old = xr.Dataset({"mean": ("output", [1.0, 2.0]), "mean_error": ("output", [0.1, 0.2])})
    assert [which for which in PARTS if holds(old, "mean", which)] == ["error"]
    found = estimate_of(old, "mean")
    assert found.error.tolist() == [0.1, 0.2]
    assert all(np.isnan(getattr(found, which)).all() for which in OF_MESH)
    assert np.isnan(single({"mean": 1.0, "mesh_error": None}, "mean").mesh)


def test_of_what_is_not_sampled_the_doubt_is_left():
    """A corrected value at the mean parameters is uncertain by what is not known of the error of the mesh."""
    results = {"nominal": 2.0, "nominal_mesh_error": 0.5, "nominal_mesh_error_doubt": 0.1, "nominal_corrected": 2.5}
    assert single(results, "nominal").left == 0.1


def test_names_are_put_together_in_one_file():
    """No other file of uq, inverse and workflows writes the name of an error of a mesh (docstrings may)."""
    there = {
        str(path.relative_to(ROOT))
        for package in ("uq", "inverse", "workflows")
        for path in (ROOT / package).rglob("*.py")
        for text in [path.read_text()]
        if "_mesh_error" in text
        for tree in [ast.parse(text)]
        for said in [{id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}]
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and id(node) not in said
        if isinstance(node.value, str) and "_mesh_error" in node.value
    }
    assert there == {"uq/estimators/estimate.py"}
