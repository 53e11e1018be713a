"""Studies that refine their mesh first: once, whatever the ranks, and kept with the results."""

import json
import shutil
import tomllib

import meshio
import numpy as np
import pytest
import pyvista
import xarray as xr

from forward.bodies.mesh_file import MeshFile
from tests.launch import TISSUQ, assert_same_bits, in_process, run, tissuq_on_two_ranks, without_pictures
from tests.meshes import corner
from workflows.config.mistakes import StudyError
from workflows.config.study import load, parse
from workflows.report import plots

STUDY = """
mesh_error = false

[model]
body = { kind = "mesh", file = "corner.msh", degree = 1 }
material = { kind = "neo-hookean-coupled", mu = 2e4, lmbda = 4e4 }
formulation = "displacement"
clamp = ["top"]
loads = [{ kind = "traction", on = "right", direction = [0, -1, 0], size = 400 }]
outputs = [
    { name = "near", kind = "displacement", at = [0.55, 0.45, 0.125], component = "y" },
    { name = "stress", kind = "max-von-mises" },
]
adapt = { tolerance = 0.2 }

[parameters]
"material.mu" = { kind = "uniform", lower = 1.8e4, upper = 2.4e4 }

[method]
kind = "monte-carlo"
samples = 6
seed = 1
"""


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("adapted")
    meshio.write(folder / "corner.msh", corner(), file_format="gmsh22", binary=False)
    (folder / "corner.toml").write_text(STUDY)
    return folder / "corner.toml"


def tissuq(*arguments, ranks=None):
    done = in_process(*arguments) if ranks is None else run(ranks, TISSUQ, *arguments)
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def finished(study):
    directory = study.parent / "one"
    with without_pictures():
        done = tissuq("run", study, "--out", directory)
    assert "mesh of 48 unknowns: estimated errors near" in done.stderr
    return directory


def test_samples_are_solved_on_the_mesh_that_was_refined(study, finished):
    found = xr.load_dataset(finished / "results.nc")
    summary = json.loads((finished / "summary.json").read_text())
    told = summary["adapted"]
    unknowns = [cycle["unknowns"] for cycle in told["cycles"]]
    assert unknowns[0] == 48
    assert found.cycle_unknowns.to_numpy().tolist() == unknowns
    assert 3 * found.sizes["node"] == unknowns[-1]
    assert told["stopped"] is None
    last = told["cycles"][-1]
    assert abs(last["errors"][0]) <= 0.2 * abs(last["values"][0] + last["errors"][0])
    assert last["errors"][1] is None  # of a largest stress there is no estimate
    np.testing.assert_allclose(found.cycle_value[-1], last["values"], rtol=1e-12)
    assert np.isnan(found.cycle_mesh_error[-1, 1])
    (finding,) = [one for one in summary["findings"] if "refined" in one["text"]]
    assert finding["severity"] == "note"
    assert f"from 48 to {unknowns[-1]:,} unknowns" in finding["text"]
    # The mean of the parameters is where it was refined.
    assert float(found.nominal.sel(output="near")) == pytest.approx(last["values"][0], rel=1e-6)


def test_the_map_of_indicators_is_in_the_report_and_for_paraview(finished, looked_at):
    found = xr.load_dataset(finished / "results.nc")
    grid = pyvista.read(finished / "fields" / "mesh.vtu")
    assert grid.n_cells == found.sizes["mesh_cell"] == found.sizes["cell"]
    assert grid.volume == pytest.approx(0.1875)
    assert grid.cell_data["indicator"].sum() == pytest.approx(1)
    by_volume = grid.cell_data["indicator by volume (1/m³)"] * grid.compute_cell_sizes().cell_data["Volume"]
    np.testing.assert_allclose(by_volume, grid.cell_data["indicator"], rtol=1e-6)
    assert (finished / "fields" / "displacement.vtu").exists()
    page = (finished / "report.html").read_text()
    looked_at(finished)
    assert ">The mesh</h2>" in page
    assert "Estimated errors, mesh by mesh." in page
    assert "cells in bright colours" in page
    assert plots.png(plots.refinement(found, ["near"], 0.2)).startswith(b"\x89PNG")


@pytest.mark.slow
def test_the_number_of_ranks_does_not_matter(study, finished):
    directory = study.parent / "on three"
    tissuq("run", study, "--out", directory, "--no-report", ranks=3)
    assert (directory / "mesh.npz").read_bytes() == (finished / "mesh.npz").read_bytes()
    assert_same_bits(directory, finished)


def test_a_study_that_was_interrupted_keeps_its_mesh(study, finished):
    directory = study.parent / "again"
    shutil.copytree(finished, directory)
    for name in ("summary.json", "results.nc", "evaluations.h5", "report.html"):
        (directory / name).unlink()
    made = (directory / "mesh.npz").stat().st_mtime_ns
    done = tissuq("run", study, "--out", directory, "--no-report")
    assert "estimated errors" not in done.stderr
    assert (directory / "mesh.npz").stat().st_mtime_ns == made
    assert_same_bits(directory, finished)


def test_results_that_were_moved_are_reported(study, finished, undrawn):
    directory = study.parent / "elsewhere" / "moved"
    shutil.copytree(finished, directory)
    (directory / "mesh.npz").unlink()
    (directory / "report.html").unlink()
    tissuq("report", directory)
    assert ">The mesh</h2>" in (directory / "report.html").read_text()


def test_the_mesh_serves_other_studies(study, finished):
    blocks = tomllib.loads(STUDY)
    blocks["model"]["body"] = {"kind": "mesh", "file": str(finished / "mesh.npz"), "degree": 1}
    del blocks["model"]["adapt"]
    body = parse(blocks).model.body
    assert isinstance(body, MeshFile)
    assert set(body.boundaries) == {"top", "right"}
    assert body.contents.regions == pytest.approx({"body": 0.1875})


def test_a_limit_that_is_reached_is_a_warning(study):
    directory = study.parent / "limited"
    tissuq("run", study, "--out", directory, "--no-report", "--set", "model.adapt.unknowns=60")
    (finding,) = [
        one
        for one in json.loads((directory / "summary.json").read_text())["findings"]
        if "model.adapt.tolerance" in one["text"]
    ]
    assert finding["severity"] == "warning"
    assert "above model.adapt.tolerance = 0.2: the next mesh would have" in finding["text"]


@pytest.mark.parametrize("ranks", [None, 2])
def test_a_body_without_an_answer_leaves_no_folder(study, ranks):
    directory = study.parent / f"failed {ranks}"
    words = ("run", study, "--out", directory, "--no-report", "--set", "model.solver.solve_seconds=1e-9")
    done = tissuq_on_two_ranks(*words) if ranks else in_process(*words)
    assert done.returncode == 1
    assert "the solve took longer than solve_seconds" in done.stderr
    assert "Traceback" not in done.stderr
    assert not directory.exists()


@pytest.mark.slow
def test_boxes_and_finer_meshes_of_what_was_refined(study):
    directory = study.parent / "box"
    body = 'model.body={size=[1.0, 0.7, 0.25], cells=[2, 1, 1], cell="tetrahedron", degree=1}'
    tissuq(
        *("run", study, "--out", directory, "--no-report", "--set", body),
        *("--set", 'model.clamp=["y-max"]', "--set", "model.loads.traction.on=x-max"),
        *("--set", 'method.kind="multilevel-monte-carlo"', "--set", "method.levels=2", "--set", "method.samples=8"),
    )
    summary = json.loads((directory / "summary.json").read_text())
    coarse, fine = (mesh["unknowns"] for mesh in summary["meshes"])
    assert coarse == summary["adapted"]["cycles"][-1]["unknowns"]
    assert 5 * coarse < fine < 8 * coarse


def test_what_check_says(study):
    done = tissuq("check", study)
    assert "unknowns    at first 48 (18 cells: tetrahedron, degree 1" in done.stdout
    assert "refined at the mean of the parameters until the error of near is below 20 %" in done.stdout
    done = tissuq("check", study, "--set", "model.adapt.unknowns=50000000")
    assert "warning     the mesh is refined as far as memory allows: about" in done.stdout


@pytest.mark.parametrize("kind", ["invert", "select"])
def test_studies_that_do_not_sample_say_so(study, kind):
    blocks = tomllib.loads(STUDY)
    del blocks["mesh_error"]
    blocks |= {"data": {"outputs": {"near": -0.05}, "sigma": {"near": 1e-3}}, "method": {"kind": kind}}
    if kind == "select":
        blocks["method"]["noise"] = {"absolute": 1e-3}
        blocks["candidates"] = {"one": {"parameters": blocks.pop("parameters")}}
    with pytest.raises(StudyError) as caught:
        parse(blocks, folder=study.parent)
    assert len(caught.value.args) == 1, caught.value.args
    assert "meshes are refined by studies that sample a model; run one" in caught.value.args[0]


def test_a_study_is_what_is_written_of_it(study):
    found = load(study)
    assert found.model.adapt.unknowns == 100_000
    assert found.model.unrefined
    assert parse(found.model_dump(mode="json", exclude_none=True)) == found
