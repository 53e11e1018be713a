"""Studies that sample a model: specimens too, and what is said of several meshes."""

import json
import tomllib

import numpy as np
import pytest
import xarray as xr
from mpi4py import MPI

from workflows.config.mistakes import StudyError
from workflows.config.study import parse
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
