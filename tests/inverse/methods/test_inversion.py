"""Inversion as a study: records, few parameters and fields, batches, synthetic data, and the command line."""

import csv
import json
import re
import tomllib
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import xarray as xr
from mpi4py import MPI
from scipy.special import chdtri

import inverse.methods.invert_field
from benchmarks import buckling
from forward.model import SolveError, Stability
from forward.pointwise import FunctionModel
from inverse.criticism import questions
from inverse.criticism.field_samples import weigh_field
from inverse.data.measurements import Measurements
from inverse.data.registration import turned
from inverse.fields.low_rank import LowRankPosterior
from inverse.fields.newton_cg import find_mode
from inverse.methods.infer import Problem
from inverse.methods.invert import Invert
from inverse.methods.invert_few import Nearby, invert_few
from inverse.methods.invert_field import Vertices, invert_field
from inverse.methods.record import as_dataset, stacked
from inverse.methods.synthesize import Synthesize
from tests.launch import TISSUQ, on_kept_ranks, run, run_script
from tests.problems import curved
from uq.evaluation.checkpoint import Checkpoint
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.hdf5 import stored_dataset
from uq.inputs.distributions import LogNormal, LogUniform, Normal
from uq.inputs.random_parameters import Inputs
from workflows.config.mistakes import StudyError
from workflows.config.study import document, load, parse, schema
from workflows.run import run as study_runs
from workflows.run.plan import plan
from workflows.run.run import run as run_study
from workflows.starter import starter
from workflows.studies.inversion_results import _volumes, arviz_groups

ROOT = Path(__file__).parent.parent.parent.parent

# --- records ---------------------------------------------------------------------------------------------------------


def test_what_is_left_of_several_data_sets_is_filled_up():
    one = {"mode": np.array([1.0, 2.0]), "log_evidence": np.array(5), "why": "because", "residual": np.ones(3)}
    other = one | {"residual": np.ones(4)}
    found = stacked([as_dataset(one), None, as_dataset(other)], {"iteration": 7})
    assert set(found) == {"mode", "log_evidence", "residual"}
    np.testing.assert_array_equal(found["mode"][1], [[1, 2], [np.nan, np.nan], [1, 2]])
    np.testing.assert_array_equal(found["log_evidence"][1], [5, np.nan, 5])
    assert found["residual"][0] == ("data_set", "datum")
    np.testing.assert_array_equal(np.isnan(found["residual"][1]).sum(axis=1), [1, 4, 0])


# --- few parameters, by closed forms ---------------------------------------------------------------------------------

RNG = np.random.default_rng(5)
MATRIX = RNG.standard_normal((12, 3))
PRIORS = {name: Normal(mean=mean, std=std) for name, mean, std in (("a", 1.0, 0.5), ("b", -1.0, 2.0), ("c", 0.0, 1.0))}
AT = RNG.uniform(size=(12, 3))
VALUES = MATRIX @ [1.2, -0.5, 0.4] + 0.1 * RNG.standard_normal(12)
DATA = Measurements.of(VALUES, np.full(12, 0.1), np.repeat([0, 1], 6), np.arange(12) % 3, places=AT)


def linear():
    return FunctionModel(lambda p: MATRIX @ p, ("a", "b", "c"), tuple(map(str, range(12))), lambda p: MATRIX)


def exactly(rows):
    """Mean and covariance of the posterior by some of the data."""
    A = MATRIX[rows] / 0.1
    mean, std = np.array([(p.mean, p.std) for p in PRIORS.values()]).T
    precision = A.T @ A + np.diag(std**-2.0)
    right = A.T @ DATA.values[rows] / 0.1 + mean / std**2
    return np.linalg.solve(precision, right), np.linalg.inv(precision)


def few(method):
    return invert_few(
        Inputs(PRIORS), SerialEvaluate(linear()), Problem(DATA, method), lambda points: points[:, :1]
    ).dataset


def test_linear_models_have_the_exact_posterior():
    method = Invert(samples=64, starts=2)
    record = few(method)
    prior_std = np.array([p.std for p in PRIORS.values()])
    mean = np.array([p.mean for p in PRIORS.values()])

    exact, covariance = exactly(np.arange(12))
    np.testing.assert_allclose(record["mode"], exact, rtol=1e-8)
    np.testing.assert_allclose(record["together_std"], np.sqrt(np.diag(covariance)), rtol=1e-8)
    np.testing.assert_allclose(record["std"], np.sqrt(np.diag(covariance)), rtol=0.3)
    np.testing.assert_allclose(record["laplace_std"], np.sqrt(np.diag(covariance)), rtol=0.02)
    S = 0.01 * np.eye(12) + (MATRIX * prior_std**2) @ MATRIX.T
    gap = DATA.values - MATRIX @ mean
    log_evidence = -(gap @ np.linalg.solve(S, gap) + np.linalg.slogdet(S)[1] + 12 * np.log(2 * np.pi)) / 2
    assert record["log_evidence"] == pytest.approx(log_evidence, abs=1e-8)
    for k in range(2):
        rows = np.flatnonzero(DATA.cases == k)
        np.testing.assert_allclose(record["alone_std"][k], np.sqrt(np.diag(exactly(rows)[1])), rtol=1e-8)
        A = MATRIX[rows] * prior_std / 0.1
        np.testing.assert_allclose(record["alone_eigenvalue"][k], np.linalg.eigvalsh(A.T @ A)[::-1], rtol=1e-8)
        assert record["misfit"][k] == pytest.approx((record["residual"][rows] ** 2).sum())
    assert (record["alone_eigenvalue"] <= record["eigenvalue"]).all()
    assert record["misfit_degrees"].sum() == pytest.approx(record["residual_degrees"])
    assert record["why"].item().startswith("Laplace's Gaussian can be trusted")


def test_the_noise_can_be_unknown():
    method = Invert(samples=256, starts=1, noise=LogUniform(lower=0.1, upper=10.0))
    record = few(method)
    assert len(record["mode"]) == 4
    assert record["lower"][3] < 1 < record["upper"][3]
    assert np.isnan(record["alone_std"][:, 3]).all()
    np.testing.assert_array_equal(record["direction_parameter"][:, 3], 0)


@pytest.mark.fem
def test_solves_near_the_mode_are_screened_rather_than_counted():
    case = buckling.column()
    model = case.spec.build(MPI.COMM_SELF, case.inputs.names)
    near = Nearby.at(model, np.array([90.0]), case.inputs.std).on(model)
    points = np.linspace(82.0, 100.0, 10)[:, None]
    assert [model.solve(point, near(point)).stability for point in points].count(Stability.SCREENED) >= 6
    for point in np.array([[130.0], [145.0]]):
        with pytest.raises(SolveError, match="the body buckles"):
            model.solve(point, near(point))


@pytest.mark.parametrize("kind", ["pcn", pytest.param("emcee", marks=pytest.mark.slow)])
def test_what_is_left_is_of_chains_that_have_mixed(kind):
    """Moments, intervals and draws: those of the exact posterior, closer than so few weighted points come."""
    method = Invert(samples=32, starts=1, chains=kind)
    record = few(method)
    exact, covariance = exactly(np.arange(12))
    std = np.sqrt(np.diag(covariance))
    assert record["chains"] == {"pcn": 4, "emcee": 8}[kind]
    assert record["chain_effective"] > 400
    halves = 2 * record["chains"]  # R̂ of chains that agree: less by chance in 99 runs of a hundred, of three quantities
    assert record["chain_rhat"] < max(1.01, np.sqrt(1 + chdtri(halves - 1, 0.01 / 3) / (halves - 1) * halves / 400))
    np.testing.assert_allclose(record["mean"], exact, atol=0.15 * std.min())
    np.testing.assert_allclose(record["std"], std, rtol=0.1)
    np.testing.assert_allclose((record["upper"] - record["lower"]) / std, 2 * 1.96, rtol=0.1)
    assert len(np.unique(record["draw"], axis=0)) > 200  # of 32 points there would be no more
    r = (record["draw"][0].to_numpy() @ MATRIX.T - DATA.values) / 0.1
    np.testing.assert_allclose(record["draw_log_likelihood"][0], -(r**2) / 2 - np.log(0.1 * np.sqrt(2 * np.pi)))


def test_what_is_predicted_is_as_sure_as_the_parameters():
    method = Invert(samples=32, starts=1)
    record = few(method)
    _, covariance = exactly(np.arange(12))
    np.testing.assert_allclose(record["predicted_std"], np.sqrt(np.diag(MATRIX @ covariance @ MATRIX.T)), rtol=1e-8)


def test_what_is_left_of_a_field_is_what_is_to_be_trusted(monkeypatch):
    """Laplace's moments and draws where it can be trusted; else those of the weighted samples, with their evidence."""
    posterior = curved()
    n = len(posterior.data)
    data = Measurements.of(posterior.data, posterior.noise.sigma, [0] * n, [0] * n, places=np.zeros((n, 3)))
    vertices = Vertices(np.full(posterior.size, 0.1), np.ones(posterior.size))
    method = Invert(samples=512, draws=100)
    plain = invert_field(posterior, Problem(data, method), vertices)
    assert plain["trust"] == 0
    np.testing.assert_array_equal(plain["stiffness_mean"], plain["stiffness_mode"])
    assert abs(plain["log_evidence"] - plain["laplace_log_evidence"]) > 1e-6
    assert 0 < plain["log_evidence_error"] < 0.5
    verdict = inverse.methods.invert_field.Verdict("corrected", "")
    monkeypatch.setattr(inverse.methods.invert_field, "verdict_on_field", lambda *_: verdict)
    record = invert_field(posterior, Problem(data, method), vertices)
    mode = find_mode(posterior)
    weighed = weigh_field(mode.point, LowRankPosterior.at(mode.point), 512)
    np.testing.assert_allclose(record["stiffness_mean"], 0.1 + weighed.mean, rtol=1e-6)
    np.testing.assert_allclose(record["stiffness_std"], weighed.std, rtol=1e-6)
    assert record["mean"][0] == pytest.approx(0.1 + weighed.mean.mean())
    assert record["lower"][0] < record["mean"][0] < record["upper"][0]
    distance = np.abs(record["stiffness_draw"].to_numpy()[:, None] - 0.1 - weighed.values).max(axis=2).min(axis=1)
    assert distance.max() < 1e-6


def test_synthetic_data_have_the_errors_that_were_asked():
    points = np.repeat(np.arange(200), 3)
    cases = np.repeat([0, 1], 300)
    model = FunctionModel(
        lambda p: p[0] * np.where(cases == 0, 1.0, 10.0), ("a",), tuple(map(str, range(600))), lambda p: None
    )
    method = Synthesize(noise={"relative": 0.1}, fraction=(1.0, 0.25), missing=0.2, seed=3)
    inputs = Inputs({"a": LogNormal(mean=2.0, std=0.5)})
    found = method.run(inputs, SerialEvaluate(model), cases, points)
    a = found["truth"].to_numpy()[:, 0]
    np.testing.assert_allclose(found["sigma"].to_numpy()[:, [0, 300]], np.outer(a, [0.1, 1.0]))
    z = ((found["values"] - found["clean"]) / found["sigma"]).to_numpy()
    assert np.nanstd(z) == pytest.approx(1, abs=0.1)
    assert np.isnan(z[0]).mean() == pytest.approx(0.2, abs=0.05)
    kept = np.isfinite(z[1]).reshape(200, 3)
    assert kept.any(axis=1).sum() <= 50
    xr.testing.assert_identical(found, method.run(inputs, SerialEvaluate(model), cases, points))


# --- studies ---------------------------------------------------------------------------------------------------------

CUBE = """
[model]
kind = "specimen"
body = { size = [1.0, 1.0, 1.0], cells = [CELLS, CELLS, CELLS], degree = 1 }
material = { kind = "neo-hookean-coupled", mu = 1e4, lmbda = 4e4 }
cases = [
    { name = "shear", clamp = ["z-min"], loads = [TRACTION, direction = [1, 0, 0] }] },
    { name = "pull", clamp = ["z-min"], loads = [TRACTION, direction = [0, 0, 1] }] },
]
""".replace("TRACTION", '{ kind = "traction", on = "z-max", size = 900')
LUMP = 'inclusions = [{ name = "lump", x = 0.6, y = 0.5, z = 0.5, radius = 0.3, contrast = 4, width = 0.4 }]\n'
MADE = (
    CUBE.replace("CELLS", "3")
    + LUMP
    + """
observed = [{ on = "x-max" }, { on = "z-max" }]

[method]
kind = "synthesize"
noise = { relative = 0.02 }
fraction = [1.0, 0.3]
seed = 1
"""
)
FEW = (
    CUBE.replace("CELLS", "2")
    + LUMP
    + """
[parameters]
"inclusions.lump.contrast" = { kind = "log-uniform", lower = 1, upper = 16 }
"material.mu" = { kind = "log-normal", mean = 1e4, std = 2e3 }

[data]
files = ["data"]

[method]
kind = "invert"
samples = 32
starts = 1
draws = 50
"""
)
FIELD = (
    CUBE.replace("CELLS", "2")
    + """
fields = [{ of = "stiffness", length = 0.6, std = 0.4, basis = "nodes" }]

[data]
files = ["data/made-1.csv"]

[method]
kind = "invert"
draws = 20
"""
)


def here(path, out, *changes, report=True):
    """Run a study in this process."""
    return run_study(load(path, changes), path.stem, out, quiet=True, report=report)


# Finer meshes take most of the time: fewer cells, and none that are thin where there are fields.
COARSE = {"forward.finer_meshes.LEAST": {1.5: 3, 1.0: 2}, "forward.bodies.tetrahedra.THINNEST": 1.0}
# What a run on these meshes keeps is counted, if asked until it is killed; all modules are left as they were.
COARSELY = f"""
import os
import sys
from pytest import MonkeyPatch
from uq.evaluation.checkpoint import Checkpoint
from workflows.__main__ import main

save, saved = Checkpoint.save, []


def kill_after(self, key, block):
    save(self, key, block)
    saved.append(key)
    if len(saved) == int(os.environ.get("BLOCKS", 0)):
        os._exit(9)


with MonkeyPatch.context() as patched:
    for name, value in {COARSE}.items():
        patched.setattr(name, value)
    patched.setattr("workflows.run.run._report", lambda directory: None)
    patched.setattr(Checkpoint, "save", kill_after)
    code = main(sys.argv[1:])
print(f"{{len(saved)}} blocks")
sys.exit(code)
"""


@pytest.fixture(scope="module", autouse=True)
def coarse():
    """What is looked at on finer meshes in this process is looked at on those of the programs that are started."""
    with pytest.MonkeyPatch.context() as patched:
        for name, value in COARSE.items():
            patched.setattr(name, value)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Studies with two synthetic data sets, one that has the wrong columns, and one of other units."""
    place = tmp_path_factory.mktemp("inversion")
    for name, text in (("made", MADE), ("few", FEW), ("field", FIELD)):
        (place / f"{name}.toml").write_text(text)
    assert here(place / "made.toml", place / "made") == 0
    (place / "made" / "data").rename(place / "data")
    (place / "data" / "wrong.csv").write_text("x,y,z,vx\n0,0,0,1\n")
    return place


def test_synthetic_data_say_what_they_are_of(folder, looked_at):
    text = (folder / "data" / "made-2.csv").read_text()
    assert "# truth.inclusions.lump.contrast = 4.0\n" in text
    assert text.startswith("# Synthetic: 3 × 3 × 3 cells (hexahedron, degree 1), errors relative 0.02, seed 1.")
    study = load(folder / "few.toml", ["data.files=['data/made-*.csv']"])
    counts = [len(set(map(tuple, m.places))) for m in study.measurements]
    assert counts == [28, round(0.3 * 28)]
    assert study.measurements[0].truth["material.mu"] == 1e4
    looked_at(folder / "made")
    page = (folder / "made" / "report.html").read_text()
    assert all(text in page for text in (">made-1</h2>", ">made-2</h2>", "largest standard error"))


@pytest.mark.parametrize("form", ["csv", "vtu", "vtk", "ply", "xdmf"])
def test_synthetic_scans_are_read_again(tmp_path, form):
    """In mm and in a frame of their own, components missing there: what was written is what is read."""
    changes = [
        "model.body.cells=[1,1,1]",
        "method.fraction=0.8",
        "method.missing=0.2",
        f'method.format="{form}"',
        'method.units="mm"',
        "method.frame={rotation=[0, 0, 5.0], translation=[10.0, 0, 0]}",
    ]
    (tmp_path / "made.toml").write_text(MADE)
    asked = load(tmp_path / "made.toml", [one.replace("0.8", "[0.8]") for one in changes])
    assert run_study(asked, "made", tmp_path / "out", quiet=True, report=False) == 0
    made = stored_dataset(tmp_path / "out" / "results.nc").isel(data_set=0)
    (tmp_path / "few.toml").write_text(FEW.replace('files = ["data"]', 'files = ["out/data"]'))
    registration = 'data.registration={kind="given", rotation=[0, 0, 5.0], translation=[10.0, 0, 0]}'
    # Tables, and descriptions of clouds, say their unit, which is that of the registration too.
    study = load(tmp_path / "few.toml", [registration])
    (measurement,) = study.measurements
    rows, values = measurement, made["values"].to_numpy()
    # Points of an edge are on two boundaries, and are written once.
    gaps = np.abs(rows.values[:, None] - values[np.isfinite(values)]).min(axis=1)
    assert len(gaps) > 20
    assert (gaps <= 1e-5 * np.abs(rows.values)).all()
    assert rows.sigma.max() == pytest.approx(made["sigma"].to_numpy().max(), rel=1e-4)
    assert np.abs(rows.places - np.round(rows.places)).max() < 1e-7  # corners of the cube
    assert measurement.truth["inclusions.lump.contrast"] == 4
    np.testing.assert_allclose(rows.along[rows.axes == 0], [turned((0, 0, 5.0))[:, 0]] * (rows.axes == 0).sum())


def test_synthetic_surfaces_are_read_again(tmp_path):
    """Pairs of STL files in mm: differences of corners are the displacements that were made; mistakes in a line."""
    changes = ["model.body.cells=[2,2,2]", "method.fraction=[1.0]", 'method.format="stl"', 'method.units="mm"']
    changes += ["method.noise={absolute=1e-3}", "method.frame={rotation=[0, 0, 5.0], translation=[10.0, 0, 0]}"]
    (tmp_path / "made.toml").write_text(MADE)
    assert run_study(load(tmp_path / "made.toml", changes), "made", tmp_path / "out", quiet=True, report=False) == 0
    made = stored_dataset(tmp_path / "out" / "results.nc").isel(data_set=0)
    (tmp_path / "few.toml").write_text(FEW.replace('files = ["data"]', 'files = ["out/data"]'))
    registration = 'data.registration={kind="given", rotation=[0, 0, 5.0], translation=[10.0, 0, 0]}'
    (measurement,) = load(tmp_path / "few.toml", [registration]).measurements
    rows, values = measurement, made["values"].to_numpy()
    assert len(np.unique(rows.places.round(6), axis=0)) == len(rows.values) / 3 / len(np.unique(rows.cases))
    gaps = np.abs(rows.values[:, None] - values).min(axis=1)
    assert gaps.max() < 1e-9  # m, of displacements of centimetres
    np.testing.assert_array_equal(rows.sigma, 1e-3)
    assert measurement.on_surface
    for wrong, said in (
        ("method.fraction=[0.5]", "surfaces have all their points"),
        ("method.noise={relative=0.1}", "expected absolute errors"),
        ("model.observed=[{at=[[1.0, 0.5, 0.5]]}]", "surfaces are of boundaries"),
    ):
        with pytest.raises(StudyError, match=said):
            load(tmp_path / "made.toml", [*changes, wrong])


@pytest.mark.slow
def test_a_scan_in_its_own_frame_gives_the_same_posterior(folder):
    """Turned by 5°, shifted by 10 mm, in mm, with a missing component; and a wider one if that is uncertain."""
    place = folder / "turned"
    place.mkdir()
    rows = list(csv.DictReader(line for line in (folder / "data" / "made-2.csv").open() if not line.startswith("#")))
    turn, shift = turned((0.0, 0.0, 5.0)), np.array([0.01, 0, 0])
    heads = [*(f"{name} [mm]" for name in ("x", "y", "z", "ux", "uy", "uz", "sigma")), "case"]
    for name, R, t in (("plain", np.eye(3), np.zeros(3)), ("turned", turn, shift)):
        lines = [",".join(heads)]
        for number, row in enumerate(rows):
            at, motion = (np.array([float(row[f"{u}{axis}"]) for axis in "xyz"]) for u in ("", "u"))
            cells = [repr(float(x)) for x in 1e3 * np.concatenate([(at - t) @ R, motion @ R])]
            cells += [repr(1e3 * float(row["sigma"])), row["case"]]
            if number == 3:
                cells[5] = ""  # along the axis about which it is turned
            lines.append(",".join(cells))
        (place / f"{name}.csv").write_text("\n".join(lines))
    known = 'data.registration={ kind = "given", rotation = [0, 0, 5], translation = [10, 0, 0], MORE }'
    found = {}
    for name, more, changes in (
        ("plain", "", ["method.mesh_error=false"]),
        ("turned", "rotation_std = 0", ["method.mesh_error=false"]),
        ("unsure", "rotation_std = 2, translation_std = 20", []),
        ("field", "rotation_std = 2, translation_std = 20", ["method.mesh_error=false", "method.draws=10"]),
    ):
        study = folder / ("field.toml" if name == "field" else "few.toml")
        file = "plain" if name == "plain" else "turned"
        scan = [known.replace("MORE", more), "data.units='mm'"] if more else []
        asked = load(study, [f"data.files=['turned/{file}.csv']", *scan, *changes])
        assert run_study(asked, name, place / f"{name}-out", quiet=True, report=False) in {0, 3}
        found[name] = stored_dataset(place / f"{name}-out" / "results.nc").isel(data_set=0)
    np.testing.assert_allclose(found["turned"]["mode"], found["plain"]["mode"], rtol=1e-6)
    np.testing.assert_allclose(found["turned"]["laplace_std"], found["plain"]["laplace_std"], rtol=1e-5)
    wider = found["unsure"]["laplace_std"] / found["turned"]["laplace_std"]
    assert wider.sel(parameter="material.mu") > 1.5, wider
    assert found["unsure"].sizes["motion"] == found["field"].sizes["motion"] == 6
    said = [one["text"] for one in json.loads((place / "unsure-out" / "summary.json").read_text())["findings"]]
    assert any(
        "turned: registered: rotated by 0, 0, 5° about x, y and z, shifted by 0.01, 0, 0 m" in one for one in said
    )
    assert any("of 6 rigid motions that are uncertain, the data determine" in one for one in said)


FEWER = ("method.samples=32",)


def kept_blocks(ran, code):
    """How many blocks a run in this process keeps that ends with the code."""
    saved = []

    def counted(self, key, block):
        saved.append(key)
        save(self, key, block)

    save = Checkpoint.save
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Checkpoint, "save", counted)
        assert ran() == code
    return len(saved)


@pytest.fixture(scope="module")
def one(folder):
    """The batch, run in this process: how many blocks it kept."""
    return kept_blocks(lambda: here(folder / "few.toml", folder / "one"), 3)


@pytest.mark.usefixtures("one")
def test_one_bad_file_does_not_stop_the_others(folder, looked_at):
    rows = list(csv.DictReader((folder / "one" / "batch.csv").read_text().splitlines()))
    assert [(row["data_set"], row["ok"]) for row in rows] == [("made-1", "yes"), ("made-2", "yes"), ("wrong", "no")]
    assert "unknown column" in rows[2]["why"]
    widths = [float(row["inclusions.lump.contrast std"]) for row in rows[:2]]
    assert widths[1] > widths[0]
    summary = json.loads((folder / "one" / "summary.json").read_text())
    assert summary["failed"] == 1
    assert summary["data_sets"]["wrong"] == {"failed": rows[2]["why"]}
    keys = {"mode", "std", "lower", "upper", "mesh_shift", "mesh_left"}
    one = summary["data_sets"]["made-1"]
    assert set(one["posterior"]["material.mu"]) == keys
    assert one["mesh"]["corrected"]
    assert rows[0]["mesh_corrected"] == "yes"
    assert float(rows[0]["mesh_error"]) == pytest.approx(one["mesh"]["error"], rel=1e-3)
    shift = one["posterior"]["material.mu"]["mesh_shift"]
    assert float(rows[0]["material.mu mesh_shift"]) == pytest.approx(shift, rel=1e-3)
    assert rows[2]["mesh_error"] == rows[2]["material.mu mesh_shift"] == ""
    page = (folder / "one" / "report.html").read_text()
    looked_at(folder / "one")
    for words in ("All data sets", "could not be inverted", "Load cases", "data:image/svg+xml", "log-uniform"):
        assert words in page
    assert (folder / "one" / "fields" / "made-1.vtu").exists()
    found = stored_dataset(folder / "one" / "results.nc")
    np.testing.assert_array_equal(found["ok"], [True, True, False])
    assert (found["alone_std"] >= found["together_std"] * (1 - 1e-9)).sel(data_set="made-1").all()
    assert summary["zero_likelihood"] == 0
    arviz = pytest.importorskip("arviz")
    kept = arviz.from_netcdf(folder / "one" / "results.nc")
    counts = np.isfinite(found["measured"]).sum("datum").to_numpy()
    assert set(kept.log_likelihood.data_vars) == {"displacement", "made-1", "made-2"}
    for name, count in zip(("made-1", "made-2"), counts, strict=False):
        left_out = arviz.loo(kept, var_name=name)
        assert left_out.n_data_points == count
        assert np.isfinite(left_out.elpd_loo)


@pytest.mark.slow
def test_solves_without_a_model_are_counted_in_batches_too(folder, monkeypatch):
    monkeypatch.setattr(study_runs, "_report", lambda directory: None)
    prior = "parameters.material.mu={ kind = 'normal', mean = 1e4, std = 3e4 }"
    changes = ("data.files=['data/made-*.csv']", "method.mesh_check=false", "method.samples=128", prior)
    here(folder / "few.toml", folder / "tails", *changes)
    found = stored_dataset(folder / "tails" / "results.nc")
    summary = json.loads((folder / "tails" / "summary.json").read_text())
    assert summary["failed"] == 0 < summary["zero_likelihood"] == found["zero_likelihood"].sum()
    told = (
        f"{summary['zero_likelihood']:,} of {summary['solves']:,} solves were of parameters for which there is no model"
    )
    assert any(one["text"].startswith(told) for one in summary["findings"])


KILLED = 40  # blocks, of which the second data set has some


@pytest.mark.slow
@pytest.mark.mpi
def test_an_interrupted_batch_keeps_its_solves_and_its_rows(folder, one, monkeypatch):
    """Killed in the second data set: nothing is solved twice, and what is finished is shown.

    Two ranks end it: the same bytes, and all solves are counted in a line off the terminal.
    """
    study, out = folder / "few.toml", folder / "killed"
    blocks, rows = [], []
    for count, ranks in ((KILLED, None), (0, 2)):
        monkeypatch.setenv("BLOCKS", str(count))
        start = run_script if count else on_kept_ranks
        done = start(ranks, COARSELY, "run", study, "--out", out)
        assert done.returncode == (9 if count else 3), done.stderr
        blocks.append(count or sum(map(int, re.findall(r"^(\d+) blocks$", done.stdout, re.MULTILINE))))
        table = out / "batch.csv"
        rows.append([row["data_set"] for row in csv.DictReader(table.open())] if table.exists() else [])
    assert rows == [["made-1"], ["made-1", "made-2", "wrong"]]
    assert not (out / "evaluations").exists()
    assert (folder / "one/batch.csv").read_bytes() == (out / "batch.csv").read_bytes()
    assert (folder / "one/results.nc").read_bytes() == (out / "results.nc").read_bytes()
    # A solve that two data sets need is one where the second comes before the first has finished, and two else.
    assert sum(blocks) <= one
    assert "wrong: failed: wrong.csv: unknown column 'vx'; did you mean" in done.stdout
    solves = json.loads((out / "summary.json").read_text())["solves"]
    assert re.search(rf"^{solves}/{solves} solves, .* per second, 0:00 left$", done.stderr, re.MULTILINE), done.stderr


@pytest.fixture(scope="module")
def whole_field(folder):
    """A field whose mesh is too coarse, which is found, run in this process: how many blocks it kept."""
    return kept_blocks(lambda: here(folder / "field.toml", folder / "field-whole", *FEWER, report=False), 3)


IDLE = "{} groups of ranks were started for {} task"


@pytest.mark.slow
@pytest.mark.mpi
def test_an_interrupted_field_keeps_its_solves(folder, whole_field, monkeypatch):
    """States, products with the Hessian, finer meshes: nothing is computed twice, and the result is the same.

    On two ranks too, of which one has nothing to do.
    """
    command = ("run", folder / "field.toml", "--out", folder / "field-killed", "--set", *FEWER, "--quiet")
    monkeypatch.setenv("BLOCKS", "60")
    assert run_script(None, COARSELY, *command).returncode == 9
    monkeypatch.setenv("BLOCKS", "0")
    done = run_script(2, COARSELY, *command)
    assert done.returncode == 3, done.stderr
    assert IDLE.format(2, 1) in done.stderr
    assert ": 1 of them will be idle" in done.stderr
    rest = sum(map(int, re.findall(r"(\d+) blocks", done.stdout)))
    assert whole_field == 60 + rest > 80
    assert not (folder / "field-killed" / "evaluations").exists()
    assert (folder / "field-whole/results.nc").read_bytes() == (folder / "field-killed/results.nc").read_bytes()


@pytest.mark.slow
@pytest.mark.mpi
def test_fewer_data_sets_than_ranks(folder):
    done = run_script(3, COARSELY, "run", folder / "made.toml", "--out", folder / "made-three", "--quiet")
    assert done.returncode == 0, done.stderr
    assert IDLE.format(3, 2) in done.stderr
    assert ": 1 of them will be idle" in done.stderr
    assert (folder / "made/results.nc").read_bytes() == (folder / "made-three/results.nc").read_bytes()


REPORTED = "method.mesh_error='report'"
ALONE = ("data.files=['data/made-1.csv']", REPORTED)
ASKED = ("data.files=['shear.csv']", "method.mesh_check=false", "method.question=true")
SHEAR = 'model.cases=[{ name = "shear", clamp = ["z-min"], loads = [{ kind = "traction", on = "z-max", size = 900, '
ASKED = (*ASKED, f"{SHEAR}direction = [1, 0, 0] }}] }}]")


@pytest.fixture(scope="module")
def single(folder):
    """The results of one data set on two cells along an edge: the program finds itself that they are too few."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(study_runs, "_report", lambda directory: None)
        assert here(folder / "few.toml", folder / "single", *ALONE) == 3
    return folder / "single"


@pytest.fixture(scope="module")
def asked(folder):
    """The results of the data of one load case, with what the body could have."""
    rows = (folder / "data" / "made-1.csv").read_text().splitlines()
    (folder / "shear.csv").write_text("\n".join(row for row in rows if not row.endswith("pull")))
    assert here(folder / "few.toml", folder / "asked", *ASKED, report=False) == 3
    return folder / "asked"


@pytest.mark.usefixtures("one")
def test_one_data_set_and_what_others_read_of_it(folder, single):
    summary = json.loads((single / "summary.json").read_text())
    assert summary["evaluations"] > 32
    assert set(summary["posterior"]) == {"inclusions.lump.contrast", "material.mu"}
    assert summary["log_evidence_error"] < 1
    assert summary["verdict"].startswith("not to be trusted: ")
    said = [one["text"] for one in summary["findings"] if one["severity"] == "error"]
    assert any("a finer mesh moves the data by" in text and "material.mu +" in text for text in said)
    arviz = pytest.importorskip("arviz")
    kept = arviz.from_netcdf(single / "results.nc")
    assert kept.posterior["material.mu"].shape == (1, 50)
    assert kept.log_likelihood["displacement"].shape[:2] == (1, 50)
    assert np.isfinite(arviz.loo(kept).elpd_loo)
    assert set(kept.prior.data_vars) == set(kept.posterior.data_vars)
    # By default the posterior is corrected, and says so.
    assert not summary["mesh"]["corrected"]
    batch = json.loads((folder / "one" / "summary.json").read_text())
    mended = batch["data_sets"]["made-1"]
    assert mended["mesh"]["corrected"]
    assert abs(mended["posterior"]["material.mu"]["mesh_shift"]) > 1
    said = [one["text"] for one in batch["findings"] if one["text"].startswith("made-1: ")]
    assert any("was corrected, which moved" in text for text in said)
    assert not any("its mesh is too coarse" in text for text in said)


def test_it_is_asked_what_the_body_could_have(asked):
    """Of errors of the mesh, which are not corrected here, the data make something else: it is said, with its form."""
    found = stored_dataset(asked / "results.nc")
    names = ["edge of lump", "shape of lump", "another lump", "a layer", "a field", "fibres"]
    assert found["question"].values.tolist() == names
    one = found.isel(data_set=0)
    assert one["question_move"].dims == ("question", "parameter")
    assert np.isfinite(one["question_left"]).all()
    assert len(str(one["question_forms"].item()).split("; ")) == len(names)
    called = questions.findings_in(one)[0]
    assert called.severity == "warning"
    assert called.values["probability"] == float(one["question_probability"].min())
    verdict = json.loads((asked / "summary.json").read_text())["verdict"]
    assert f"the data call for {called.values['question']}" in verdict


@pytest.mark.slow
@pytest.mark.mpi
def test_all_groups_share_one_data_set(folder, single, asked):
    """The same bytes as of one rank, the solve on the finer mesh and questions among them."""
    for there, given in ((single, ALONE), (asked, ASKED)):
        out = folder / f"{there.name}-shared"
        changes = tuple(word for one in given for word in ("--set", one))
        done = on_kept_ranks(2, COARSELY, "run", folder / "few.toml", "--out", out, *changes)
        assert done.returncode == 3, done.stderr
        assert (there / "results.nc").read_bytes() == (out / "results.nc").read_bytes()


def test_without_the_finer_mesh_nothing_is_trusted(folder, monkeypatch):
    monkeypatch.setattr(study_runs, "_report", lambda directory: None)
    changes = ("data.files=['data/made-2.csv']", "method.mesh_check=false", "model.body.cells=[3,3,3]")
    here(folder / "few.toml", folder / "unchecked", *changes)
    summary = json.loads((folder / "unchecked" / "summary.json").read_text())
    assert "not checked for the mesh" in summary["verdict"]
    said = [(one["severity"], one["text"]) for one in summary["findings"]]
    assert ("warning", "made-2: not checked for the mesh: method.mesh_check = false.") in said
    assert any("no result will be called trusted" in line for line in plan(load(folder / "few.toml", changes)))
    assert any("mesh check  about 4 solves of 1,029 displ" in line for line in plan(load(folder / "few.toml")))


@pytest.mark.slow
def test_what_the_model_does_not_explain_is_inferred(folder, monkeypatch):
    """On a mesh that is too coarse, whose error is not corrected: with a process intervals hold the truth."""
    monkeypatch.setattr(study_runs, "_report", lambda directory: None)
    changes = ("data.files=['data/made-1.csv']", "method.mesh_check=false")
    found = []
    # Ends from 32 points, worth 25, miss those from 1 024 by up to half a deviation.
    for number, more in enumerate(((), ("data.errors={kind='normal',process=true}", "method.samples=256"))):
        here(folder / "few.toml", folder / f"unexplained-{number}", *changes, *more)
        found.append(json.loads((folder / f"unexplained-{number}" / "summary.json").read_text()))
    for name, true in (("material.mu", 1e4), ("inclusions.lump.contrast", 4.0)):
        ends = [(one["posterior"][name]["lower"], one["posterior"][name]["upper"]) for one in found]
        assert not ends[0][0] < true < ends[0][1]
        assert ends[1][0] < true < ends[1][1]
    (said,) = (one["text"] for one in found[1]["findings"] if one["code"] == "unexplained")
    assert "taken to be a process among the errors" in said


@pytest.mark.slow
def test_what_is_strange_is_said_with_the_inversion(folder, monkeypatch):
    """Data that do not belong by their line, on the mesh that made the data; and the end of a range."""
    monkeypatch.setattr(study_runs, "_report", lambda directory: None)
    rows = (folder / "data" / "made-1.csv").read_text().splitlines()
    first = next(i for i, line in enumerate(rows) if line.startswith("1,"))
    cells = rows[first].split(",")
    cells[3] = str(float(cells[3]) + 20 * float(cells[6]))
    (folder / "strange.csv").write_text("\n".join([*rows[:first], ",".join(cells), *rows[first + 1 :]]))
    changes = ("data.files=['strange.csv']", "method.mesh_check=false")
    contrast = "parameters.inclusions.lump.contrast={ kind = 'log-uniform', lower = 1, upper = 2 }"
    for out, more in (("strange", "model.body.cells=[3,3,3]"), ("narrow", contrast)):
        assert here(folder / "few.toml", folder / out, *changes, more) == 3
    strange, narrow = (
        [one["text"] for one in json.loads((folder / out / "summary.json").read_text())["findings"]]
        for out in ("strange", "narrow")
    )
    assert any(f"strange.csv: line {first + 1} at (1, " in text and "1 datum does not" in text for text in strange)
    assert any("inclusions.lump.contrast is at the upper end of its range (2)" in text for text in narrow)


def test_volumes_of_inclusions(folder):
    """Those of the draws; nothing where no radius is unknown, or nothing was found."""
    radius = "parameters.inclusions.lump.radius={kind = 'uniform', lower = 0.2, upper = 0.4}"
    study = load(folder / "few.toml", [radius])
    draws = np.full((3, 50, 3), [2.0, 9e3, 0.3])
    draws[0, :, 2] = np.linspace(0.25, 0.35, 50)
    draws[2] = np.nan
    found = _volumes(study, {"draw": draws, "mode": draws[:, 0]}, list(study.measurements))
    ball = 4 / 3 * np.pi * np.linspace(0.25, 0.35, 50) ** 3
    for name, expected in (
        ("mean", ball.mean()),
        ("std", ball.std()),
        ("mode", ball[0]),
        ("true", 4 / 3 * np.pi * 0.027),
    ):
        np.testing.assert_allclose(found[f"volume_{name}"][1][0], [expected])
    assert found["volume_std"][1][1] == pytest.approx([0], abs=1e-12)
    assert np.isnan(found["volume_mean"][1][2])
    assert found["inclusion"][1] == ["lump"]
    assert not _volumes(load(folder / "few.toml"), {"draw": draws, "mode": draws[:, 0]}, list(study.measurements))


def test_chains_are_those_of_arviz(folder):
    """Draws that stand chain after chain become chains, where all data sets have as many."""
    study = load(folder / "few.toml", ["data.files=['data/made-1.csv']"])
    draws = np.arange(100.0).reshape(1, 50, 2)
    found = xr.Dataset(
        {
            "draw": (("data_set", "sample", "parameter"), draws),
            "draw_log_likelihood": (("data_set", "sample", "datum"), draws),
            "measured": (("data_set", "datum"), np.zeros((1, 2))),
            "chains": ("data_set", [4.0]),
            "ok": ("data_set", [True]),
        },
        {"data_set": ["made-1"], "parameter": list(study.names)},
    )
    kept = arviz_groups(study, found)
    assert kept["log_likelihood"]["displacement"].shape == (4, 12, 2)
    np.testing.assert_array_equal(kept["posterior"]["material.mu"], 1 + 2 * np.arange(48).reshape(4, 12))
    assert arviz_groups(study, found.assign(chains=("data_set", [0.0])))["posterior"]["material.mu"].shape == (1, 50)


@pytest.mark.usefixtures("undrawn")
def test_a_field_and_its_report(folder):
    assert here(folder / "field.toml", folder / "field", REPORTED) == 3
    found = stored_dataset(folder / "field" / "results.nc").isel(data_set=0)
    assert found.sizes["node"] == 27
    assert (found["stiffness_std"] < found["stiffness_prior_std"]).all()
    assert (found["alone_stiffness_std"] >= found["stiffness_std"] - 1e-9).all()
    assert int((found["eigenvalue"] > 1).sum()) > int((found["alone_eigenvalue"] > 1).sum("direction").max())
    assert np.isfinite(found["stiffness_true"]).all()
    weights = np.where(abs(found["node_position"] - 0.5) < 0.1, 0.5, 0.25).prod(axis=1)  # of the vertices in the mean
    assert float(found["true"][0]) == pytest.approx(weights @ found["stiffness_true"].to_numpy())
    centre = int(np.abs(found["node_position"] - [0.5, 0.5, 0.5]).sum("axis").argmin())
    assert float(found["stiffness_true"][centre]) == pytest.approx(np.log(4), abs=0.5)
    page = (folder / "field" / "report.html").read_text()
    for words in ("directions that the data constrain most", "by each load case alone", "log-normal field", "penalty"):
        assert words in page


@pytest.mark.parametrize(
    ("text", "old", "new", "told"),
    [
        (FEW, 'files = ["data"]', 'files = ["nothing"]', r"data.files: nothing: no such file"),
        (FEW, 'files = ["data"]', 'files = ["data/wrong.csv"]', r"data: wrong.csv: unknown column 'vx'"),
        (FEW, 'files = ["data"]', 'files = ["data/made-1.csv"]\nunit = 1e3', r"expected a smaller one: is data\.unit"),
        (FEW, 'files = ["data"]', 'files = "data/made-1.csv"\ntruth = { "material.nu" = 1 }',
         "data.truth.material.nu: not a number of the model; did you mean 'material.mu'"),
        (FEW, "draws = 50", 'noise = { kind = "normal", mean = 1, std = 1 }', "method.noise: reaches -.*is positive"),
        (FEW, "lump.contrast", "lump.contarst", "parameters: not a number of the model; did you mean"),
        (FEW, "lower = 1,", "lower = -1,", "lower"),
        (FIELD, "[data]", "[data]\nerrors = { kind = 'normal', process = true }",
         "data.errors.process: varies along a body"),
        (FIELD, "draws = 20", "question = true", "method.question: is asked of one body that is solved itself"),
        (FIELD, "[data]", '[parameters]\n"material.mu" = { kind = "log-normal", mean = 1e4, std = 2e3 }\n[data]',
         "a field of nodal values is inverted alone"),
        (FIELD, "draws = 20", 'chains = "emcee"', "expected 'pcn'"),
        (FIELD, "draws = 20", "samples = 8", "expected at least 32"),
        (FIELD, 'of = "stiffness"', 'of = "density"', "no load is gravity"),
        (MADE, "observed = ", "# observed = ", "model.observed: nothing is observed"),
        (MADE, "relative = 0.02", "", "expected either relative or absolute"),
        (MADE, "fraction = [1.0, 0.3]", "fraction = [1.5]", "method.fraction"),
    ],
)  # fmt: skip
def test_one_line_for_a_mistake(folder, text, old, new, told):
    path = folder / "mistake.toml"
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(StudyError, match=told):
        load(path)


def test_points_outside_the_body_are_told(folder):
    text = (folder / "data" / "made-1.csv").read_text().splitlines()
    first = next(i for i, line in enumerate(text) if line.startswith("1,"))
    text[first] = "1.001" + text[first][1:]
    (folder / "outside.csv").write_text("\n".join(text))
    study = load(folder / "few.toml", ["data.files=['outside.csv']"])  # a thousandth of a diagonal of √3 m is allowed
    assert study.measurements[0].moved.max() == pytest.approx(1e-3)
    assert any("1 point outside the body is moved to its surface, by up to 1 mm" in line for line in plan(study))
    with pytest.raises(StudyError, match=rf"line {first + 1}.*lies 0.001 m outside the body.*data\.tolerance = 0 m"):
        load(folder / "few.toml", ["data.files=['outside.csv']", "data.tolerance=0.0"])
    text[first] = "1.002" + text[first][5:]
    (folder / "outside.csv").write_text("\n".join(text))
    with pytest.raises(StudyError, match=r"lies 0.002 m outside the body.*data\.tolerance = 0.001732 m"):
        load(folder / "few.toml", ["data.files=['outside.csv']"])


def test_starters(tmp_path):
    (tmp_path / "measured.csv").write_text("x,y,z,uz\n0.025,0.025,0.05,0.002\n")
    study = parse(tomllib.loads(starter("invert")), folder=tmp_path)
    assert study.method.kind == "invert"
    validator = jsonschema.Draft202012Validator(schema())
    for blocks in (tomllib.loads(starter("invert")), document(study)):
        validator.validate(blocks)
    assert parse(document(study)) == study
    assert parse(tomllib.loads(starter("synthesize"))).method.kind == "synthesize"


# --- what is recovered -----------------------------------------------------------------------------------------------


def shipped(name, out, code):
    done = run(None, TISSUQ, "run", ROOT / "configs" / f"{name}.toml", "--out", out, timeout=1500)
    assert done.returncode == code, done.stderr
    return stored_dataset(out / "results.nc")


@pytest.mark.slow
def test_the_shipped_inclusion_is_recovered(tmp_path):
    # Data of graded tetrahedra: the mesh errs by as much as the noise, and is corrected. Few points of the prior have
    # large weights, which a polynomial tells too.
    found = shipped("inclusion", tmp_path / "out", 0).isel(data_set=0)
    assert bool(found["mesh_corrected"])
    assert "mesh" not in str(found["why"].item())
    assert float(np.sqrt((found["mesh_error"] ** 2).mean())) == pytest.approx(1.1, abs=0.1)
    assert float(abs(found["mesh_shift"]).min()) > 2  # without it, no truth would be in its interval
    assert ((found["lower"] < found["true"]) & (found["true"] < found["upper"])).all()
    assert float(found["residual_probability"]) > 0.05


@pytest.mark.slow
def test_the_shipped_field_is_recovered(tmp_path):
    found = shipped("stiffness-field", tmp_path / "out", 0).isel(data_set=0)
    z = np.abs(found["stiffness_mean"] - found["stiffness_true"]) / found["stiffness_std"]
    assert float((z < 2).mean()) >= 0.9
    assert np.corrcoef(found["stiffness_mean"], found["stiffness_true"])[0, 1] > 0.7
    assert int((found["eigenvalue"] > 1).sum()) > int((found["alone_eigenvalue"] > 1).sum("direction").max())
