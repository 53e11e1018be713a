"""Studies of a body that a tool touches."""

import json
import tomllib

import numpy as np
import pytest
import xarray as xr
from mpi4py import MPI

from forward.model import WORK
from tests.launch import ROOT, TISSUQ, assert_same_bits, in_process, run
from uq.evaluation.evaluate import Recorder, SerialEvaluate
from uq.surrogates.linearisation import linearise
from workflows.__main__ import main
from workflows.config.mistakes import StudyError
from workflows.config.study import load, parse
from workflows.studies.solves import with_contact

STUDY = """
[model]
kind = "path"
body = { kind = "box", size = [0.02, 0.02, 0.02], cells = [2, 2, 2], degree = 1, grading = { z-max = 4 } }
formulation = "displacement"
material = { kind = "neo-hookean", C1 = 1e3, D1 = 2e3 }
clamp = ["z-min"]
outputs = [{ name = "force", kind = "force" }, { name = "pressure", kind = "max-pressure" }]

[[model.loads]]
kind = "indenter"
shape = "sphere"
radius = 5e-3
on = "z-max"
at = [0.004, 0.003, 0.02]
direction = [0, 0, -1]
depth = [0.5e-3, 1e-3]

[parameters]
"material.C1" = { kind = "uniform", lower = 900, upper = 1100 }
"loads.indenter.x" = { kind = "uniform", lower = 3e-3, upper = 5e-3 }

[method]
kind = "sensitivity-monte-carlo"
samples = 5

[accuracy]
mesh_error = false
"""


@pytest.mark.fem
@pytest.mark.mpi
@pytest.mark.slow
def test_any_number_of_ranks(tmp_path):
    """Groups give the same bytes; ranks that share a model agree to rounding."""
    study = tmp_path / "ball.toml"
    study.write_text(STUDY)
    assert main(["run", str(study), "--out", str(tmp_path / "one"), "--no-report", "--quiet"]) == 0
    for name, ranks, words in (
        ("three", 3, ()),
        ("shared", 2, ("--set", "parallel.ranks_per_model=2")),
    ):
        done = run(ranks, TISSUQ, "run", study, "--out", tmp_path / name, "--no-report", "--quiet", *words)
        assert done.returncode == 0, done.stderr
    assert_same_bits(tmp_path / "one", tmp_path / "three")
    one, shared = (xr.load_dataset(tmp_path / name / "results.nc") for name in ("one", "shared"))
    for name in ("values", "mean", "field_mean", "contact_position", "contact_pressure"):
        scale = np.abs(one[name].values).max()
        np.testing.assert_allclose(shared[name], one[name], atol=1e-8 * scale, err_msg=name)
    assert list(json.loads((tmp_path / "one" / "summary.json").read_text())["outputs"])[-1] == "pressure.2"


@pytest.mark.fem
def test_no_error_of_the_mesh_is_estimated_where_that_is_known_to_fail(tmp_path, capsys):
    """Elements of one degree more enter a ball between the points that touch it; a plane they follow."""
    text = STUDY.replace("mesh_error = false", "mesh_error = true").replace(
        "sensitivity-monte-carlo", "local-sensitivity"
    )
    text = text.replace("samples = 5", "")
    study = tmp_path / "ball.toml"
    study.write_text(text)
    planned = load(study)
    assert planned.estimates == 0
    assert [one.severity for one in planned.findings if one.code == "mesh-with-memory"] == ["warning"]
    plane = text.replace('shape = "sphere"\nradius = 5e-3', 'shape = "plane"')
    assert parse(tomllib.loads(plane)).estimates > 0
    assert main(["run", str(study), "--out", str(tmp_path / "out"), "--no-report"]) == 0
    said = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert any("not estimated with the tool 'indenter'" in one["text"] for one in said["findings"])
    assert "mesh not known" in capsys.readouterr().out


@pytest.mark.fem
def test_the_map_of_pressures_begins_where_the_mean_was_solved():
    """Another solve at the mean would cost as much as the first; without its state the map is the same."""
    study = parse(tomllib.loads(STUDY))
    model = study.spec.build(MPI.COMM_SELF, study.inputs.names)
    method = Recorder(SerialEvaluate(model))
    linearise(study.inputs, method)
    cost, maps = [], []
    for first in (method.first, None):
        asked = Recorder(method)
        maps.append(with_contact(xr.Dataset(), model, study.inputs, asked, first))
        cost.append(dict(zip(WORK, asked.log[0].work[0].tolist(), strict=True)))
    assert cost[0]["factorisations"] <= 2  # one for each step, of its reference
    assert cost[1]["factorisations"] >= 6
    for name in ("contact_position", "contact_pressure"):
        np.testing.assert_allclose(maps[0][name], maps[1][name], rtol=1e-6)
    alone = {rows.shape for rows in model.solve(study.inputs.mean).visit().touched().values()}
    assert alone == {(maps[0].sizes["contact_vertex"], 4)}


@pytest.mark.parametrize("name", ["indentation", "palpation"])
def test_forces_of_the_wrong_sign_are_refused(tmp_path, name):
    """Many programs count forces that press as negative; a few below 0 may be so by their errors."""
    text = (ROOT / "configs" / "data" / f"{name}.csv").read_text()
    place = text.index("force,", text.index("\n4-4") if name == "palpation" else 0)

    def turned(most):
        rows, done = [], 0
        for row in text.splitlines():
            cells = row.split(",")
            column = 2 if name == "palpation" else 1
            if place and row[:1].isdecimal() and done < most:
                cells[column], done = f"-{cells[column]}", done + 1
            rows.append(",".join(cells))
        (tmp_path / "turned.csv").write_text("\n".join(rows))
        return load(ROOT / "configs" / f"{name}.toml", [f"data.files=['{tmp_path}/turned.csv']"])

    assert len(turned(3).measurements) == 1
    with pytest.raises(StudyError) as caught:
        turned(100)
    (line,) = caught.value.args
    assert ": 'force' is -0." in line
    assert "are below 0, which it cannot be: a force is positive where the tool presses" in line


@pytest.mark.slow  # its forms are its own
@pytest.mark.fem
def test_the_shipped_map_of_stiffness_from_forces(tmp_path):
    """On a coarse mesh: each force sees best what is in its corner, and the report maps what all of them tell."""
    changes = ("model.body.cells=[3, 3, 1]", "model.body.degree=1", "method.mesh_error=false")
    words = [word for change in changes for word in ("--set", change)]
    study = ROOT / "configs" / "palpation-field.toml"
    done = in_process("run", study, "--out", tmp_path / "map", "--quiet", *words)
    assert done.returncode in {0, 3}, done.stderr
    found = xr.load_dataset(tmp_path / "map" / "results.nc").isel(data_set=0)
    prior = found["stiffness_prior_std"].to_numpy()
    assert (found["stiffness_std"].to_numpy() < prior).all()
    places = found["node_position"].to_numpy()
    for case in ("4-4", "16-4", "4-16", "16-16"):
        seen = places[(found["alone_stiffness_std"].sel(case=case).to_numpy() / prior).argmin()]
        at = np.array([float(number) for number in case.split("-")]) / 1e3
        assert ((seen[:2] > 0.01) == (at > 0.01)).all()
    assert "by each load case alone" in (tmp_path / "map" / "report.html").read_text()
