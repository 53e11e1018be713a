"""Studies that make reduced models, and studies that use them."""

import json
import signal
import subprocess
import time

import numpy as np
import pytest
import xarray as xr

from forward.pointwise import FunctionModel
from forward.reduced.data import load as load_model
from forward.reduced.model import ReducedModel
from tests import launch
from tests.launch import ROOT
from workflows.__main__ import main
from workflows.config.mistakes import StudyError
from workflows.config.study import load

pytestmark = pytest.mark.fem

BODY = """
[model]
kind = "hyperelastic"
formulation = "displacement"
body = { kind = "box", size = [0.1, 0.05, 0.03], cells = [2, 1, 1], cell = "hexahedron", degree = 1 }
material = { kind = "neo-hookean", C1 = 1000, D1 = 3000 }
clamp = ["x-min"]
loads = [{ kind = "gravity", density = 1000 }]
outputs = [{ name = "u_max", kind = "max-displacement" }, { name = "energy", kind = "strain-energy" }]
[parameters]
"material.C1" = { kind = "uniform", lower = 800, upper = 1200 }
"loads.gravity.density" = { kind = "uniform", lower = 900, upper = 1100 }
"""
SAMPLED = BODY + '[method]\nkind = "monte-carlo"\nsamples = 16\n'
USED = """
[model]
kind = "reduced"
file = "model.npz"
{more}
[parameters]
"material.C1" = {{ kind = "uniform", lower = 800, upper = {upper} }}
"loads.gravity.density" = {{ kind = "uniform", lower = 900, upper = 1100 }}
[method]
kind = "quasi-monte-carlo"
samples = 16
scrambles = 4
"""
SIZES = [
    "--set",
    "method.snapshots=12",
    "--set",
    "method.unseen=6",
    "--set",
    "method.rounds=2",
    "--set",
    "method.modes=6",
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A study that samples a body, reduced by the command."""
    place = tmp_path_factory.mktemp("reduction")
    (place / "body.toml").write_text(SAMPLED)
    reduced = ["reduce", place / "body.toml", *SIZES, "--out", place / "made", "--output", place / "model.npz"]
    assert main([*map(str, reduced), "--quiet"]) == 0
    return place


@pytest.fixture(scope="module")
def body(folder):
    """Results of the body itself."""
    (folder / "direct.toml").write_text(BODY + '[method]\nkind = "quasi-monte-carlo"\nsamples = 16\nscrambles = 4\n')
    words = ("--set", "mesh_error=false", "--out", str(folder / "direct"), "--quiet", "--no-report")
    assert main(["run", str(folder / "direct.toml"), *words]) == 0
    return xr.load_dataset(folder / "direct" / "results.nc")


def slid(page, file):
    """Move the sliders of the report that was looked at: they give what a reduced model does, to few errors."""
    data = load_model(file)
    model = ReducedModel(data, data.parameters)
    page.call("Emulation.setEmulatedMedia", media="")
    assert "solves of the reduced model, which itself errs by" in page.run(
        "document.querySelector('.sliders').textContent"
    )
    viewer = "document.querySelector('.viewer').viewer"
    error = page.run(f"{viewer}.expansion.wanted.map((o) => o.error)")
    rounding, loo = page.run(f"[{viewer}.expansion.field.rounding, {viewer}.expansion.field.loo]")
    for point in ([850.0, 1050.0], [1150.0, 920.0], [1010.0, 1000.0]):
        solution = model.solve(np.array(point))
        found = page.run(f"{viewer}.at({json.dumps(dict(zip(data.parameters, point, strict=True)))})")["outputs"]
        assert [one["name"] for one in found] == list(model.outputs)
        off = np.abs(np.array([one["mean"] for one in found]) - solution.outputs)
        assert (off < 3 * np.array(error)).all()
        moved = np.array(page.run(f"Array.from({viewer}.motion)"))
        assert np.abs(moved - solution.state).max() < rounding + 4 * loo * np.abs(solution.state).max()


def test_the_command_makes_a_model_with_known_errors(folder, looked_at, chromium):
    told = json.loads((folder / "made" / "summary.json").read_text())["reduced"]
    assert told["snapshots"] == 12
    assert told["unseen"] == 6
    assert all(error < 1e-2 for error in told["errors"].values())
    assert set(told["effectivity"]) == {"u_max", "energy"}
    assert all(error < 0.02 for error in told["errors of gradients"].values())
    assert told["share of samples at the same place"] == {"u_max": 1, "energy": 1}
    assert told["errors of gradients, at the same place"] == told["errors of gradients"]
    assert (folder / "made" / "reduced.npz").read_bytes() == (folder / "model.npz").read_bytes()
    assert (folder / "made" / "report.html").exists()
    looked_at(folder / "made")
    if chromium is not None:
        slid(chromium, folder / "model.npz")
    found = xr.load_dataset(folder / "made" / "results.nc")
    assert found.reduced_error.shape == (6, 2)
    assert np.abs(found.reduced_error - found.reduced_estimate).max() < np.abs(found.reduced_error).max()


def test_a_study_of_it_gives_what_the_body_gives(folder, body, looked_at, chromium):
    (folder / "used.toml").write_text(USED.format(upper=1200, more=""))
    with launch.without_pictures():
        assert main(["run", str(folder / "used.toml"), "--out", str(folder / "used"), "--quiet"]) == 0
    found = xr.load_dataset(folder / "used" / "results.nc")
    for name in ("mean", "std"):
        np.testing.assert_allclose(found[name], body[name], rtol=5e-3)
    np.testing.assert_allclose(found.field_mean, body.field_mean, atol=5e-3 * float(np.abs(body.field_mean).max()))
    assert (folder / "used" / "report.html").exists()
    looked_at(folder / "used")
    if chromium is not None:
        slid(chromium, folder / "model.npz")


def test_without_loads_nothing_moves(folder):
    """Forces are measured against those of the snapshots where there are none: loads may be random around zero."""
    data = load_model(folder / "model.npz")
    for tested in (True, False):
        model = ReducedModel(data, data.parameters, tested=tested)
        points = np.array([[900.0, 0.0], [1100.0, 1e-12]])
        for found in (*model.solve_many(points), *map(model.solve, points)):
            assert np.abs(found.outputs).max() < 1e-9


@pytest.mark.flags
def test_beyond_the_snapshots_it_says_so_before_anything_is_solved(folder):
    (folder / "beyond.toml").write_text(USED.format(upper=2000, more=""))
    said = [one.text for one in load(folder / "beyond.toml").findings]
    assert any("material.C1 goes from 800 to 2000" in text and "was trained from" in text for text in said)
    within = folder / "within.toml"
    within.write_text(USED.format(upper=1200, more=""))
    assert not any("trained" in one.text for one in load(within).findings)


def test_the_mesh_of_its_body_is_never_forgotten(folder):
    stands = f'[model]\nkind = "reduced"\nfile = "model.npz"\n{BODY[BODY.index("[parameters]") :]}'
    data = load_model(folder / "model.npz")
    moved = ReducedModel(data, data.parameters).solve(data.nominal).outputs[0]
    (folder / "asked.toml").write_text(f"{stands}[accuracy]\ntolerance = 0.05\n")
    (folder / "inverted.toml").write_text(
        f"{stands}[data]\noutputs = {{ u_max = [{moved}] }}\nnoise = {{ relative = 0.1 }}\n"
        '[method]\nkind = "invert"\nsamples = 32\nstarts = 1\n'
    )
    for name, code in (("asked", 3), ("inverted", 0)):
        assert (
            main(["run", str(folder / f"{name}.toml"), "--out", str(folder / name), "--quiet", "--no-report"]) == code
        )
    asked, inverted = (json.loads((folder / name / "summary.json").read_text()) for name in ("asked", "inverted"))
    assert not asked["accuracy"]["kept"]
    assert asked["accuracy"]["shares"]["total"] < 1
    assert any("what the mesh of its body (36 unknowns) errs" in one["text"] for one in asked["findings"])
    assert inverted["verdict"].startswith("doubtful: ")
    assert "not checked for the mesh" in inverted["verdict"]
    assert any("an inversion of the body itself with method.reduced" in one["text"] for one in inverted["findings"])


def test_candidates_that_are_reduced_models_are_not_checked_for_their_meshes(folder):
    prior = '"material.C1" = { kind = "uniform", lower = 800, upper = 1200 }'
    (folder / "selected.toml").write_text(
        f'[model]\nkind = "reduced"\nfile = "model.npz"\n[candidates.one.parameters]\n{prior}\n'
        f"[candidates.other]\nmodel.larger = true\n[candidates.other.parameters]\n{prior}\n"
        '[data]\noutputs = { u_max = [1.2e-2] }\nsigma = { u_max = 1e-3 }\n[method]\nkind = "select"\nnoise = {}\n'
    )
    unchecked = load(folder / "selected.toml").unchecked
    assert set(unchecked) == {"one", "other"}
    assert all("the model is a reduced one" in why for why in unchecked.values())


def test_the_full_model_is_asked_above_a_tolerance(folder):
    (folder / "checked.toml").write_text(USED.format(upper=1200, more="tolerance = 1e-12").replace("16", "8"))
    assert main(["run", str(folder / "checked.toml"), "--out", str(folder / "checked"), "--quiet", "--no-report"]) == 0
    assert json.loads((folder / "checked" / "summary.json").read_text())["work"]["factorisations"] > 0


def test_it_is_a_cheap_model_beside_the_body(folder, body):
    method = """
[accuracy]
mesh_error = false
[method]
kind = "multifidelity"
samples = 24
seed = 1
cheap = [{ kind = "model", name = "few modes", cost = 0.01, model = { kind = "reduced", file = "model.npz" } }]
"""
    (folder / "several.toml").write_text(BODY + method)
    words = ["run", str(folder / "several.toml"), "--out", str(folder / "several"), "--quiet", "--no-report"]
    assert main(words) == 0
    summary = json.loads((folder / "several" / "summary.json").read_text())
    assert not [one for one in summary["findings"] if one["severity"] == "error"]
    found = xr.load_dataset(folder / "several" / "results.nc")
    assert (np.abs(found["mean"] - body["mean"]) < 4 * found.mean_error + 1e-3 * np.abs(body["mean"])).all()


@pytest.mark.slow
def test_the_model_and_its_nested_larger_one_are_cheap_models(folder, body):
    few = [*SIZES[:2], *(part for one in ("unseen=0", "rounds=0", "modes=2") for part in ("--set", f"method.{one}"))]
    reduced = ["reduce", folder / "body.toml", *few, "--out", folder / "few", "--output", folder / "few.npz"]
    assert main([*map(str, reduced), "--quiet", "--no-report"]) == 0
    (folder / "alone.toml").write_text(USED.format(upper=1200, more="").replace("model.npz", "few.npz"))
    assert any("Nobody has measured" in one.text for one in load(folder / "alone.toml").findings)
    method = """
[method]
kind = "multifidelity"
samples = 40
control = "tangent"
cheap = [{ kind = "reduced", file = "few.npz" }, { kind = "reduced", file = "few.npz", larger = true, cost = 0.5 }]
"""
    (folder / "both.toml").write_text(BODY + method)
    assert main(["run", str(folder / "both.toml"), "--out", str(folder / "both"), "--quiet", "--no-report"]) == 0
    found = xr.load_dataset(folder / "both" / "results.nc")
    assert list(found["fidelity"].values) == ["model", "reduced", "larger reduced"]
    assert 0 < float(found["fidelity_cost"][1]) < float(found["fidelity_cost"][2]) == 0.5
    left = 1 - found["fidelity_correlation"].values[:, 1:] ** 2
    assert (left[:, 1] < 0.1 * left[:, 0]).all()
    assert (left < 1e-2).all()
    assert (np.abs(found["mean"] - body["mean"]) < 4 * found.mean_error + 1e-3 * np.abs(body["mean"])).all()


def test_without_derivatives_there_are_no_adjoints_and_nothing_is_factorised(folder):
    out, sizes = folder / "states", [*SIZES, "--set", "method.derivatives=false"]
    assert main(["reduce", str(folder / "body.toml"), *sizes, "--out", str(out), "--quiet", "--no-report"]) == 0
    told = json.loads((out / "summary.json").read_text())["reduced"]
    with_them = json.loads((folder / "made" / "summary.json").read_text())["reduced"]
    assert told["modes of the larger model"] <= told["snapshots"] < with_them["modes of the larger model"]
    assert max(told["errors"].values()) < 0.1


def test_a_body_in_blocks(folder):
    out, sizes = folder / "blocks", [*SIZES, "--set", "method.blocks={ cut = [2, 1, 1], full = [[0.1, 0.02, 0.01]] }"]
    assert main(["reduce", str(folder / "body.toml"), *sizes, "--out", str(out), "--quiet", "--no-report"]) == 0
    told = json.loads((out / "summary.json").read_text())["reduced"]
    assert told["modes"] == 24  # all free nodes are in the block that is kept in full, and on its interface
    assert max(told["errors"].values()) < 1e-6
    (folder / "wrong.toml").write_text(BODY + '[method]\nkind = "reduce"\nblocks = { cut = [2, 0, 1] }\n')
    with pytest.raises(StudyError, match="greater than or equal to 1"):
        load(folder / "wrong.toml")


def test_a_number_that_was_kept_is_no_parameter(folder):
    text = USED.format(upper=1200, more="").replace("loads.gravity.density", "material.D1")
    text = text.replace("900, upper = 1100", "1e3, upper = 2e3")
    (folder / "kept.toml").write_text(text)
    with pytest.raises(StudyError, match="kept its value when the model was reduced"):
        load(folder / "kept.toml")


def test_another_file_under_the_same_name_is_refused(folder):
    study = load(folder / "used.toml") if (folder / "used.toml").exists() else None
    (folder / "used2.toml").write_text(USED.format(upper=1200, more=f'digest = "{"0" * 16}"'))
    with pytest.raises(StudyError, match="has changed since the study was begun"):
        load(folder / "used2.toml")
    assert study is None or study.identity()["model"]["digest"] != "0" * 16


def test_bodies_that_cannot_be_reduced_are_refused_in_one_line(tmp_path):
    (tmp_path / "rubbed.toml").write_text(SAMPLED)
    tool = "kind='indenter', shape='sphere', on='x-max', at=[0.1, 0.02, 0.01], direction=[-1, 0, 0], depth=1e-3"
    rubbed = [f"model.loads=[{{ {tool}, radius=0.01, friction=0.3 }}]", "method={ kind = 'reduce' }"]
    rubbed += ["parameters={ 'material.C1' = { kind = 'uniform', lower = 800, upper = 1200 } }"]
    with pytest.raises(StudyError, match="no friction, which depends on the way"):
        load(tmp_path / "rubbed.toml", rubbed)


@pytest.mark.mpi
def test_on_ranks_it_is_the_same_model(folder):
    out = folder / "ranks"
    made = launch.tissuq_on_two_ranks("reduce", folder / "body.toml", *SIZES, "--out", out, "--no-report")
    assert made.returncode == 0, made.stderr
    one, other = load_model(folder / "model.npz"), load_model(out / "reduced.npz")
    assert (folder / "model.npz").read_bytes() == (out / "reduced.npz").read_bytes(), (one.about, other.about)


@pytest.mark.slow
def test_after_a_kill_it_is_the_same_model(folder, tmp_path):
    """Ended while the snapshots of a later round are solved."""
    command = [
        launch.TISSUQ,
        "reduce",
        folder / "body.toml",
        *SIZES,
        "--no-report",
        "--quiet",
        "--out",
        tmp_path / "out",
    ]
    process = subprocess.Popen(list(map(str, command)), env=launch.environment())
    ends = time.monotonic() + 120
    while len(list((tmp_path / "out").glob("evaluations/*.block"))) < 9:
        assert process.poll() is None
        assert time.monotonic() < ends
        time.sleep(0.01)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    assert not (tmp_path / "out" / "reduced.npz").exists()
    done = launch.run(None, *command)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "reduced.npz").read_bytes() == (folder / "model.npz").read_bytes()


COLUMN = """
[model]
kind = "hyperelastic"
formulation = "displacement"
body = { kind = "box", size = [0.02, 0.02, 0.2], cells = [1, 1, 8], cell = "hexahedron", degree = 2 }
material = { kind = "neo-hookean", C1 = 1000, D1 = 3000 }
clamp = ["z-min"]
loads = [{ kind = "gravity", direction = [0, 0, -1], density = 10 }]
outputs = [
    { name = "u_max", kind = "max-displacement" },
    { name = "side", kind = "mean-displacement", on = "z-max", component = "x" },
]
[parameters]
"loads.gravity.density" = { kind = "uniform", lower = 5, upper = 25 }
[method]
kind = "reduce"
snapshots = 8
unseen = 6
"""


def test_a_column_that_buckles(tmp_path):
    """All that it has shown is straight: the model finds it straight beyond its load, and says so."""
    (tmp_path / "column.toml").write_text(COLUMN)
    file = tmp_path / "column.npz"
    command = ["reduce", tmp_path / "column.toml", "--output", file, "--out", tmp_path / "made"]
    assert main([*map(str, command), "--quiet", "--no-report"]) == 3
    told = json.loads((tmp_path / "made" / "summary.json").read_text())
    assert told["reduced"]["of these answered all the same"] > 0
    assert max(told["reduced"]["errors"].values()) < 0.01  # of the side, which never moves, beside what moves
    used = USED.format(upper=1200, more="").replace("model.npz", "column.npz")
    used = "\n".join(line for line in used.splitlines() if "material.C1" not in line)
    (tmp_path / "used.toml").write_text(used.replace("900", "5").replace("1100", "25"))
    for texts in (
        [one["text"] for one in told["findings"]],
        [one.text for one in load(tmp_path / "used.toml").findings],
    ):
        assert any("may find an equilibrium there all the same" in text for text in texts)
    # The larger model is as stable as the body, so that this is asked where it buckles, and nowhere else.
    data, asked = load_model(file), []
    body = FunctionModel(lambda p: asked.append(float(p[0])) or [0.0, 0.0], data.parameters, ("u_max", "side"))
    model = ReducedModel(data, data.parameters, tolerance=0.05, full=lambda: body)
    for density in (6.0, 12.0, 16.0, 20.0, 24.0):
        model.solve(np.array([density]))
    assert asked == [20.0, 24.0]


@pytest.mark.fem
def test_without_unseen_samples_there_is_a_report(tmp_path, undrawn):
    few = ("snapshots=4", "modes=3", "rounds=0", "derivatives=false", "unseen=0")
    sets = [word for one in few for word in ("--set", f"method.{one}")]
    tiny = ROOT / "configs" / "tiny.toml"
    cells = ("--set", "model.body.cells=[2, 1, 1]")
    places = ("--output", str(tmp_path / "r.npz"), "--out", str(tmp_path / "D"))
    assert main(["reduce", str(tiny), *places, *sets, *cells]) == 0
    assert "Nobody has measured how well it follows the body" in (tmp_path / "D" / "report.html").read_text()
