"""Studies that sample a model: specimens too, and what is said of several meshes."""

import json
import tomllib

import numpy as np
import pytest
import xarray as xr
from mpi4py import MPI

from forward.model import SolveError
from tests.launch import ROOT
from workflows.__main__ import main
from workflows.config.mistakes import StudyError
from workflows.config.study import load, parse
from workflows.run.run import run

STUDY = """
[model]
kind = "specimen"
body = { kind = "box", size = [0.05, 0.05, 0.05], cells = [1, 1, 1], cell = "hexahedron", degree = 2 }
material = { kind = "neo-hookean-coupled", mu = 1e3, lmbda = 1e3 }
cases = [
  { name = "shear", clamp = ["z-min"], loads = [{ kind = "traction", on = "z-max", direction = [1, 0, 0], size = 9 }] },
  { name = "pull", clamp = ["z-min"], loads = [{ kind = "traction", on = "z-max", direction = [0, 0, 1], size = 9 }] },
]
observed = [{ name = "tip", at = [[0.05, 0.05, 0.05]], components = "xz" }]

[parameters]
"material.mu" = { kind = "uniform", lower = 900, upper = 1100 }

[method]
kind = "monte-carlo"
samples = 3
"""


@pytest.mark.fem
def test_a_specimen_is_sampled_like_any_model(tmp_path):
    study = parse(tomllib.loads(STUDY))
    assert run(study, "tip", tmp_path / "out", quiet=True, report=False) == 0
    found = xr.load_dataset(tmp_path / "out" / "results.nc")
    assert found.output.values.tolist() == [f"{case}.tip.0.{axis}" for case in ("shear", "pull") for axis in "xz"]
    assert set(found.unit.values) == {"m"}
    assert "node" not in found.dims
    model = study.spec.build(MPI.COMM_SELF, ("material.mu",))
    exact = [model.solve(point).outputs for point in found["points"].to_numpy()]
    np.testing.assert_allclose(found["mean"], np.mean(exact, axis=0), rtol=1e-6)


@pytest.mark.fem
def test_numbers_that_nobody_made_uncertain_are_looked_at(tmp_path, undrawn):
    """Each load case apart, by differences of the model; said where they matter, and shown."""
    study = parse(tomllib.loads(STUDY + "\n[sensitivity]\nall = true\n"))
    assert run(study, "tip", tmp_path / "out", quiet=True) == 0
    found = xr.load_dataset(tmp_path / "out" / "results.nc")
    names = [f"cases.{case}.loads.traction.size" for case in ("shear", "pull")]
    assert found["assumption"].values.tolist() == ["material.lmbda", *names]
    changes = found["assumption_change"].transpose("assumption", "output").to_numpy()
    assert not changes[1, 2:].any()
    assert not changes[2, :2].any()
    model, size = study.spec.build(MPI.COMM_SELF, ("material.mu", *names[:1])), 1e-3 * 9
    ends = [np.asarray(model.solve(np.array([1e3, 9 + sign * size])).outputs) for sign in (1, -1)]
    np.testing.assert_allclose(changes[1], (ends[0] - ends[1]) / 2 * 10, atol=1e-5 * np.abs(changes[1]).max())
    assert found["assumption_size"].values.tolist() == pytest.approx([10.0, 0.09, 0.09])
    said = [one["code"] for one in json.loads((tmp_path / "out" / "summary.json").read_text())["findings"]]
    assert "not-random" in said
    assert "What nobody made uncertain" in (tmp_path / "out" / "report.html").read_text()


def test_nodes_of_a_boundary_are_no_outputs():
    blocks = tomllib.loads(STUDY)
    blocks["model"]["observed"] = [{"on": "z-max"}]
    with pytest.raises(StudyError, match=r"^model\.observed: observed\[0\]\.on: its nodes are not known"):
        parse(blocks)


@pytest.mark.fem
def test_what_was_solved_on_each_mesh_is_in_the_summary(tmp_path):
    blocks = tomllib.loads(STUDY)
    model = {name: blocks["model"][name] for name in ("body", "material")} | blocks["model"]["cases"][1]
    del model["name"]
    model["outputs"] = [{"name": "up", "kind": "max-displacement", "component": "z"}]
    method = {"kind": "multilevel-monte-carlo", "samples": 4, "pilot": 4, "levels": 2}
    study = parse({"model": model, "parameters": blocks["parameters"], "method": method})
    assert list(study.models) == ["mesh 1"]
    assert run(study, "meshes", tmp_path / "out", quiet=True, report=False) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [one["unknowns"] for one in summary["meshes"]] == [3 * 27, 3 * 125]
    assert summary["evaluations"] == sum(one["solves"] for one in summary["meshes"]) == study.planned


def own(tmp_path, monkeypatch, *changes):
    """A study of a model that answers at the mean alone."""
    monkeypatch.syspath_prepend(str(tmp_path))
    lines = [
        "def f(p):",
        "    if abs(p[0] - 0.5) > 1e-9:",
        "        raise ValueError('too stiff')",
        "    return [p[0]]",
    ]
    (tmp_path / "answers_once.py").write_text("\n".join(lines))
    blocks = {
        "model": {"kind": "python", "function": "answers_once.f", "parameters": {"a": 0.5}, "outputs": ["y"]},
        "parameters": {"a": {"kind": "uniform", "lower": 0.0, "upper": 1.0}},
    }
    return parse(blocks, changes)


@pytest.mark.parametrize("method", ["{kind='chaos', samples=16}", "{kind='sobol', samples=16}"])
def test_expansions_say_why_no_sample_has_an_answer(method, tmp_path, monkeypatch):
    study = own(tmp_path, monkeypatch, f"method={method}")
    with pytest.raises(SolveError, match=r"0 samples have an answer.*raised ValueError: too stiff"):
        study.run()


@pytest.mark.parametrize("config", ["inclusion-material", "treloar", "tiny"])
def test_a_model_that_is_no_table_is_one_line(config, capsys):
    assert main(["check", str(ROOT / "configs" / f"{config}.toml"), "--set", "model=3"]) == 2
    assert capsys.readouterr().err == "model: expected a table, { key = value }; given 3\n"


@pytest.mark.fem
def test_a_body_of_which_everything_is_held():
    """One linear cell between two held faces has no unknown: F is known, and so is the energy."""
    held = "model.displacements=[{on='x-max', x=0.028, y=0, z=0}]"
    cell = ("model.body.cells=[1, 1, 1]", "model.body.degree=1", "model.loads=[]", "mesh_error=false", held)
    output = "model.outputs=[{name='energy', kind='strain-energy'}]"
    constants = "parameters={'material.C1'={kind='uniform', lower=1e4, upper=2e4}}"
    found = load(ROOT / "configs" / "tiny.toml", [*cell, output, constants, "method.samples=4"]).run()
    assert found["ok"].all()
    assert (found["values"] > 0).all()
