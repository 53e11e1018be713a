"""Studies of a body in several steps."""

import json
import tomllib

import numpy as np
import pytest
import xarray as xr
from mpi4py import MPI

from forward.hyperelastic import Path
from inverse.data.outputs import read_outputs, steps_of
from tests.launch import assert_same_bits, in_process, tissuq_on_two_ranks
from workflows.__main__ import main

STUDY = """
[model]
kind = "path"
body = { kind = "box", size = [1.0, 0.7, 0.8], cells = [2, 1, 1], cell = "hexahedron", degree = 1 }
formulation = "displacement"
material = { kind = "neo-hookean-coupled", mu = 2e4, lmbda = 4e4 }
clamp = ["x-min"]
displacements = [{ name = "grip", on = "x-max", x = [0.1, 0.2, -0.3], y = 0, z = 0 }]
outputs = [
  { name = "force", kind = "reaction", on = "x-max", component = "x" },
  { name = "narrow", kind = "max-displacement", component = "y" },
]

[parameters]
"material.mu" = { kind = "uniform", lower = 1.8e4, upper = 2.2e4 }

[method]
kind = "sensitivity-monte-carlo"
samples = 6
"""


@pytest.mark.slow
@pytest.mark.fem
@pytest.mark.mpi
def test_curves_are_the_same_on_any_number_of_ranks(tmp_path, looked_at):
    study = tmp_path / "curve.toml"
    study.write_text(STUDY)
    assert main(["run", str(study), "--out", str(tmp_path / "None")]) == 0
    done = tissuq_on_two_ranks("run", study, "--out", tmp_path / "2", "--no-report")
    assert done.returncode == 0, done.stderr
    assert_same_bits(tmp_path / "None", tmp_path / "2")
    found = xr.load_dataset(tmp_path / "2" / "results.nc")
    assert found["output_of"].values.tolist() == ["force", "narrow"] * 3
    assert found["step"].values.tolist() == [1, 1, 2, 2, 3, 3]
    assert found["displacements.grip.x"].values.tolist() == [0.1, 0.1, 0.2, 0.2, -0.3, -0.3]
    forces = found["mean"].values[::2]
    assert 0 < forces[0] < forces[1]
    assert forces[2] < 0
    np.testing.assert_allclose(np.abs(found["field_mean"].values).max(), 0.3, rtol=1e-12)  # fields are of the last step
    summary = json.loads((tmp_path / "2" / "summary.json").read_text())
    assert list(summary["outputs"])[-1] == "narrow.3"
    assert summary["outputs"]["force.1"]["mesh_error"] is not None
    page = (tmp_path / "None" / "report.html").read_text()
    looked_at(tmp_path / "None")
    assert "Over the path" in page
    assert "grip x: 10, 20, −30 cm in 3 steps" in page
    assert "How large are force and narrow at the last step of the path" in page


@pytest.mark.fem
@pytest.mark.slow
def test_a_measured_curve_is_inverted(tmp_path, looked_at):
    study = tmp_path / "curve.toml"
    measured = STUDY.partition("[parameters]")[0] + INVERSION
    study.write_text(measured)
    model = Path.model_validate(tomllib.loads(measured)["model"]).build(MPI.COMM_SELF, ("material.mu",))
    exact = model.solve(np.array([2.13e4])).outputs[::2]
    errors = 0.02 * np.abs(exact) * np.array([0.5, -0.7, 0.3])
    rows = [f"{x},{1e3 * y:.6g}" for x, y in zip((100, 200, -300), exact + errors, strict=True)]
    (tmp_path / "curve.csv").write_text("x [mm],force [mN]\n" + "\n".join(rows) + "\n")
    done = in_process("run", study, "--out", tmp_path / "out")
    assert done.returncode == 3, done.stderr  # two cells: the error of the mesh exceeds the noise, and is only reported
    found = xr.load_dataset(tmp_path / "out" / "results.nc").isel(data_set=0)
    # The forces are linear in mu at a fixed Poisson's ratio, nearly so at a fixed lmbda: weighted means.
    slopes = model.solve(np.array([2.13e4])).tangent(np.array([1.0]))[::2] / (0.02 * np.abs(exact + errors))
    expected = 2.13e4 + slopes @ (errors / (0.02 * np.abs(exact + errors))) / (slopes @ slopes)
    assert float(found["mean"][0]) == pytest.approx(expected, abs=0.1 * float(found["std"][0]))
    assert float(found["std"][0]) == pytest.approx((slopes @ slopes) ** -0.5, rel=0.1)
    assert "force, measured and predicted." in (tmp_path / "out" / "report.html").read_text()
    looked_at(tmp_path / "out")


@pytest.mark.fem
def test_curves_are_made_and_read_again(tmp_path):
    study = tmp_path / "made.toml"
    made = STUDY.partition("[method]")[0]
    study.write_text(made + '[method]\nkind = "synthesize"\nnoise = { relative = 0.01 }\nfraction = [1, 0.7]\n')
    assert in_process("run", study, "--out", tmp_path / "out", "--no-report").returncode == 0
    spec = Path.model_validate(tomllib.loads(made)["model"])
    model = spec.build(MPI.COMM_SELF, ("material.mu",))
    outputs = tuple(output.name for output in spec.returned)
    one, other = (read_outputs(tmp_path / "out" / "data" / f"made-{k}.csv", outputs, steps_of(spec)) for k in (1, 2))
    assert set(one.names) == set(outputs)
    assert len(other.names) == 4  # of two steps
    for found in (one, other):
        exact = model.solve(np.array([found.truth["material.mu"]])).outputs[
            [outputs.index(name) for name in found.names]
        ]
        assert (np.abs(found.values - exact) < 4 * found.sigma).all()
        assert (found.values != exact).all()
    whole = model.solve(np.array([one.truth["material.mu"]])).outputs
    forces = one.sigma[[name.startswith("force") for name in one.names]]
    np.testing.assert_allclose(forces, 0.01 * np.sqrt(np.mean(whole[::2] ** 2)), rtol=1e-3)


def test_what_is_measured_of_a_function_is_an_output_in_each_row(tmp_path):
    (tmp_path / "made.toml").write_text(
        '[model]\nkind = "python"\nfunction = "line.both"\nparameters = { a = 2.0 }\noutputs = ["one", "two"]\n'
        '[method]\nkind = "synthesize"\nnoise = { absolute = 1e-3 }\n'
    )
    (tmp_path / "line.py").write_text("def both(x):\n    return [x[0], 2 * x[0]]\n")
    done = in_process("run", tmp_path / "made.toml", "--out", tmp_path / "out", "--no-report")
    assert done.returncode == 0, done.stderr
    found = read_outputs(tmp_path / "out" / "data" / "made.csv", ("one", "two"))
    np.testing.assert_allclose(found.values, [2, 4], atol=5e-3)


INVERSION = """
[parameters]
"material.mu" = { kind = "uniform", lower = 1e4, upper = 4e4 }

[data]
files = ["curve.csv"]
noise = { relative = 0.02 }

[method]
kind = "invert"
samples = 64
mesh_error = "report"
"""


@pytest.mark.fem
def test_paths_that_stop_are_said(tmp_path):
    study = tmp_path / "curve.toml"
    # Beyond a certain squeeze a Saint Venant–Kirchhoff body has no equilibrium: the softer, the earlier.
    study.write_text(
        STUDY.replace("neo-hookean-coupled", "saint-venant-kirchhoff")
        .replace('displacements = [{ name = "grip", on = "x-max", x = [0.1, 0.2, -0.3], y = 0, z = 0 }]', LOADS)
        .replace('kind = "reaction", on = "x-max"', 'kind = "mean-displacement", on = "x-max"')
        .replace("lower = 1.8e4, upper = 2.2e4", "lower = 1e4, upper = 3e4")
        .replace("sensitivity-monte-carlo", "monte-carlo")
    )
    plain = ("--no-report", "--set", "accuracy.mesh_error=false")
    done = in_process("run", study, "--out", tmp_path / "out", *plain)
    assert done.returncode == 3, done.stderr
    found = xr.load_dataset(tmp_path / "out" / "results.nc")
    lost = ~found["ok"].values
    assert 0 < lost.sum() < 6
    assert np.isfinite(found["values"].values[lost, :2]).all()
    assert np.isnan(found["values"].values[lost, -1]).all()
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert all("of 3 (loads.push.size = " in failure["reason"] for failure in summary["failures"])
    assert any("stop on their way" in finding["text"] for finding in summary["findings"])


LOADS = 'loads = [{ kind = "traction", name = "push", on = "x-max", direction = [-1, 0, 0], size = [500, 1000, 4500] }]'
