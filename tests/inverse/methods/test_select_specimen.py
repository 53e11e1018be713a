"""Selection among models of a specimen: evidence against quadrature, meshes as candidates, mistakes, ranks."""

import json
import os
import signal
import subprocess
import time
import tomllib
import weakref
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from mpi4py import MPI
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

import forward.finer_meshes
from forward.fem.finer import OtherMesh, extrapolated
from forward.pointwise import FunctionModel
from inverse.criticism.finer import Finer
from inverse.methods.infer import Problem
from tests.launch import TISSUQ, run
from tests.rubber import CONFIGS
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.hdf5 import stored_dataset
from uq.inputs.distributions import LogNormal
from workflows.__main__ import main
from workflows.config.mistakes import StudyError
from workflows.config.study import dump, load, parse
from workflows.report.section import Results
from workflows.report.sections.errors import finer_meshes
from workflows.results.comparison import doubts_of_selection, trusted_on_meshes
from workflows.run import run as study_runs
from workflows.run.plan import plan
from workflows.studies import selection_job
from workflows.studies.study import meshes_of, of_file

pytestmark = pytest.mark.fem
STUDY = """
[model]
kind = "specimen"
body = { kind = "box", size = [1, 0.7, 0.8], cells = [2, 1, 1], cell = "hexahedron", degree = 1 }
solver = { tolerance = 1e-10 }

[[model.cases]]
name = "bent"
clamp = ["x-min"]
loads = [{ kind = "traction", on = "x-max", direction = [0, 0, 1], size = 1e3 }]

[data]
file = "table.csv"

[candidates.right]
model.material = { kind = "neo-hookean", C1 = 1e4, D1 = 1e5 }
parameters."material.C1" = { kind = "log-normal", mean = 1.2e4, std = 4e3 }

[candidates.stiff]
model.material = { kind = "neo-hookean", C1 = 1e4, D1 = 1e5 }
model.body.cells = [1, 1, 1]
parameters."material.C1" = { kind = "log-normal", mean = 1.2e4, std = 4e3 }
weight = 3

[method]
kind = "select"
samples = 32
starts = 1
noise = {}
"""
POINTS = ((1.0, 0.0, 0.8), (1.0, 0.7, 0.8), (0.5, 0.35, 0.8), (0.5, 0.7, 0.0))
HEAD = "# made up\nx,y,z,ux,uy,uz,sigma\n"


@pytest.fixture(autouse=True)
def fewer_cells(monkeypatch):
    """Finer meshes of two cells along an edge, for time; as they are: `tests/forward/fem/test_finer.py`."""
    monkeypatch.setattr(forward.finer_meshes, "LEAST", {1.5: 2, 1.0: 1})


@pytest.fixture(scope="module")
def table():
    """Data of the right candidate with errors of 3 mm."""
    text = HEAD + "".join(f"{x},{y},{z},0,0,0,3e-3\n" for x, y, z in POINTS)
    folder = Path(os.environ.get("TMPDIR", "/tmp"))
    path = folder / f"select-{os.getpid()}.csv"
    path.write_text(text)
    study = parse(tomllib.loads(STUDY.replace("table.csv", path.name)), folder=folder)
    path.unlink()
    exact = study.build("right", "all", MPI.COMM_SELF).solve(np.array([1e4])).outputs.reshape(-1, 3)
    noisy = exact + 3e-3 * np.random.default_rng(0).standard_normal(exact.shape)
    rows = (",".join(map(str, (*point, *u, 3e-3))) for point, u in zip(POINTS, noisy.tolist(), strict=True))
    return HEAD + "\n".join(rows) + "\n"


@pytest.fixture
def study(table, tmp_path):
    (tmp_path / "study.toml").write_text(STUDY)
    (tmp_path / "table.csv").write_text(table)
    return tmp_path / "study.toml"


def test_evidence_is_that_of_quadrature(study):
    """One parameter: ln Z of both meshes by the trapezoidal rule over the prior; the coarse mesh is found out."""
    it = load(study)
    models = {name: it.build(name, "all", MPI.COMM_SELF) for name in it.candidates}
    found = it.method.run(it.models, it.data_groups, lambda name, _: SerialEvaluate(models[name]))
    data = it.data_groups["all"]
    grid = np.arange(-2.4, 0.7, 0.08)  # beyond, the data are far away
    prior = LogNormal(mean=1.2e4, std=4e3)
    for k, model in enumerate(models.values()):
        logs = []
        for x in grid:
            r = (model.solve(prior.from_normal(np.array([x]))[0]).outputs - data.values) / data.sigma
            logs.append(-r @ r / 2 - np.log(data.sigma * np.sqrt(2 * np.pi)).sum())
        exact = logsumexp(logs, b=0.08 * np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi))
        assert min(max(logs) - logs[0], max(logs) - logs[-1]) > 8
        assert found["log_evidence"].values[k] == pytest.approx(exact, abs=0.05)
        assert abs(found["log_evidence"].values[k] - exact) < 5 * found["log_evidence_error"].values[k] + 1e-3
    assert found["probability"].values[0] > 0.95
    assert found["misfit_probability"].values[0, 0] > 0.01


@pytest.mark.slow
def test_motions_that_are_uncertain_are_integrated_out(study):
    """ln Z by the trapezoidal rule with the dense covariance σ² + GᵀG of the data."""
    uncertain = 'registration = { kind = "given", rotation_std = 1.0, translation_std = 0.01 }'
    study.write_text(study.read_text().replace('file = "table.csv"', f'file = "table.csv"\n{uncertain}'))
    it = load(study)
    assert parse(tomllib.loads(dump(it))) == it
    without = ("--set", "method.mesh_error=false")
    assert main(["run", str(study), "--out", str(study.parent / "out"), "--quiet", "--no-report", *without]) == 0
    found = stored_dataset(study.parent / "out" / "results.nc")
    data = it.data_groups["all"]
    model, motion = it.build("right", "all", MPI.COMM_SELF), it.shared("right", "all")
    mode = found["constant_mode"].values[0, 0, :1]
    G = motion.errors_by(SerialEvaluate(model.observing(*motion.observed)))(mode)["shared"]
    assert G.shape == (6, len(data.values))
    law = multivariate_normal(np.zeros(len(data.values)), np.diag(data.sigma**2) + G.T @ G)
    grid, prior = np.arange(-2.4, 0.7, 0.08), LogNormal(mean=1.2e4, std=4e3)
    points = prior.from_normal(grid)[0]
    logs = [law.logpdf(model.solve(np.array([x])).outputs - data.values) for x in points]
    exact = logsumexp(logs, b=0.08 * np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi))
    assert found["log_evidence"].values[0] == pytest.approx(exact, abs=0.05)
    assert "of 6 rigid motions that are uncertain" in (study.parent / "out" / "summary.json").read_text()


def test_studies_are_complete_in_themselves(study):
    it = load(study)
    assert parse(tomllib.loads(dump(it))) == it
    assert it.data.source == ("made up",)
    assert it.described("stiff") == "neo-hookean on 1 × 1 × 1 cells (hexahedron, degree 1)"
    assert any("12 displacements of 1 load cases" in line for line in plan(it))
    shipped = load(CONFIGS / "inclusion-material.toml")
    assert len(shipped.candidates) == 5
    assert any("truth: material.C20 = 400.0" in line for line in shipped.data.source)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("table.csv", "tabel.csv", "cannot be read: No such file"),
        ('kind = "neo-hookean"', 'kind = "neo-hokean"', "candidates.right.model.material"),
        ('parameters."material.C1"', 'parameters."material.C2"', "not a number of the model; did you mean"),
        ("cells = [1, 1, 1]", "cels = [1, 1, 1]", "candidates.stiff.model.body.*unknown key"),
        ("starts = 1", 'check = "dynesty"', "method.check: nested sampling takes ten thousand solves"),
        (
            '"log-normal", mean = 1.2e4',
            '"normal", mean = -1e4',
            "candidates.right.parameters: 99.4 % of the values are impossible; at the medians, material: not stable",
        ),
        ('file = "table.csv"', 'file = "table.csv"\nunit_ = 1', "data.unit_: unknown key; did you mean 'unit"),
        ('file = "table.csv"', 'file = "table.csv"\nunits = 1', "data.units: input should be a valid string; given 1"),
    ],
)
def test_one_line_for_a_mistake(study, old, new, told):
    study.write_text(STUDY.replace(old, new, 1))
    with pytest.raises(StudyError, match=told) as caught:
        load(study)
    assert len(caught.value.args) == 1


def looking(method, it, finer, say=lambda line: None):
    """What makes the problem of a candidate that is looked at on finer meshes."""

    def problem(name, group):
        return Problem(it.data_groups[group].seen(), method, finer=Finer.by(SerialEvaluate(finer[name])), say=say)

    return problem


@pytest.mark.slow
def test_what_a_mesh_does_to_an_evidence(study):
    """Beside the evidence of a model that has no such error, of one candidate that moves little and one that does."""
    it = load(study, ["method.noise.absolute=0.06", "method.samples=64", "method.mesh_error='report'"])
    coarse = {name: it.build(name, "all", MPI.COMM_SELF) for name in it.candidates}
    finer = {name: extrapolated(model, np.array([1e3])).of(model) for name, model in coarse.items()}

    def solve(model):
        return FunctionModel(
            lambda p: model.solve(p).outputs[:12],
            model.parameters,
            model.outputs[:12],
            lambda p: model.solve(p).tangent(np.eye(1)).T[:12],
        )

    assert it.unchecked == {"right": "", "stiff": ""}
    runs = (coarse, {name: solve(model) for name, model in finer.items()})
    here, there = (
        it.method.run(
            it.models,
            it.data_groups,
            lambda name, _, models=models: SerialEvaluate(models[name]),
            looking(it.method, it, finer),
        )
        for models in runs
    )
    assert here["mesh_checked"].all()
    assert not here["mesh_corrected"].any()
    moves = here["mesh_log_evidence"].values[:, 0]
    exact = (there["log_evidence"] - here["log_evidence"]).values
    assert abs(exact).min() > 0.3
    np.testing.assert_allclose(moves, exact, atol=0.4)  # of a model that is linear at the mode
    mode = here["constant_mode"].values[1, 0]
    error = finer["stiff"].solve(mode).outputs[:12] - coarse["stiff"].solve(mode).outputs
    np.testing.assert_allclose(here["mesh_error"].values[1], error / 0.06, rtol=1e-6)
    shift = here["mesh_shift"].values[1, 0, 0] * here["constant_std"].values[1, 0, 0]
    gone = (there["constant_mode"] - here["constant_mode"]).values[1, 0, 0]
    assert shift == pytest.approx(gone, rel=0.5)


@pytest.mark.slow
def test_a_corrected_candidate_has_the_evidence_of_a_finer_one(study):
    """A mesh that is too coarse no longer loses for that alone, but for what is uncertain of its correction."""
    it = load(study, ["method.noise.absolute=0.02"])
    coarse = {name: it.build(name, "all", MPI.COMM_SELF) for name in it.candidates}
    finer = {name: extrapolated(model, np.array([1e3])).of(model) for name, model in coarse.items()}
    lines = []
    found = it.method.run(
        it.models,
        it.data_groups,
        lambda name, _: SerialEvaluate(coarse[name]),
        looking(it.method, it, finer, lines.append),
    )
    assert found["mesh_corrected"].all()
    before = "at the mean of the prior the error of the mesh is"
    assert [line.startswith(before) for line in lines] == [True] * 2
    report = it.method.model_copy(update={"mesh_error": "report"})
    plain = report.run(
        it.models, it.data_groups, lambda name, _: SerialEvaluate(coarse[name]), looking(report, it, finer)
    )
    apart = abs(np.diff(plain["log_evidence"].values.ravel())).item()
    assert abs(np.diff(found["log_evidence"].values.ravel())).item() < 0.5 * apart
    # What is uncertain of that is said; a candidate on whose evidence the correction decides is not trusted.
    inputs = {name: candidate.inputs for name, candidate in it.candidates.items()}
    assert (found["mesh_left"] > 0.01).all()
    said = [one.text for one in doubts_of_selection(found, inputs, None)]
    assert any("makes up to" in text and "makes up to 0 of" not in text for text in said)
    second = int(found["probability"].argmin())
    far = found.assign(trusted=xr.ones_like(found["trusted"]), mesh_shift=found["mesh_shift"].copy())
    far["mesh_shift"][second] = 25.0
    assert trusted_on_meshes(far)["trusted"].values[second].item() is False
    assert trusted_on_meshes(far)["trusted"].values[1 - second].item() is True
    texts = [one.text for one in doubts_of_selection(far, inputs, None) if "It decides on the result" in one.text]
    assert [text.partition(":")[0] for text in texts] == [str(found["model"].values[second])]
    # On meshes of files, corrections hold for errors up to twice the noise, as for inversions.
    assert not any(of_file(spec) for spec in it.of_candidates.values())
    error = xr.zeros_like(found["mesh_error"]) + 1.5
    of_files = far.assign(mesh_shift=found["mesh_shift"], mesh_error=error, mesh_of_file=("model", [True, True]))
    assert trusted_on_meshes(of_files)["trusted"].values.all()
    of_files["mesh_error"][second] = 3.0
    assert trusted_on_meshes(of_files)["trusted"].values[:, 0].tolist() == [k != second for k in range(2)]
    warnings = [one.text for one in doubts_of_selection(of_files, inputs, None) if one.severity == "warning"]
    name = str(found["model"].values[second])
    assert any(text.startswith(f"{name}: the error of the mesh") and "take a finer one" in text for text in warnings)
    assert any(text.startswith(f"The corrected errors of the meshes of {name} are") for text in warnings)
    assert trusted_on_meshes(of_files.assign(mesh_of_file=("model", [False, False])))["trusted"].values.all()
    # Evidences of candidates that are corrected are not said to move; one that could not be looked at does not compare.
    assert not any("Finer meshes move" in text or "could not be looked at" in text for text in said)
    blind = found.assign({name: found[name].copy() for name in ("mesh_checked", "mesh_corrected")})
    blind["mesh_checked"][second] = blind["mesh_corrected"][second] = False
    text = f"those of {found['model'].values[second]} could not be looked at"
    assert any(text in one.text for one in doubts_of_selection(blind, inputs, None))


@pytest.mark.slow
def test_finer_meshes_of_one_candidate_at_a_time_are_in_memory(study, monkeypatch):
    """And what they correct is said."""
    alive, made, before = weakref.WeakSet(), [], []
    mesh, build = OtherMesh._mesh.fget, selection_job.build_finer

    def remembered(self):
        found = mesh(self)
        if found not in alive:
            made.append(found.spec.body.cells)
            alive.add(found)
        return found

    def built(*given):
        before.append(len(alive))
        return build(*given)

    monkeypatch.setattr(OtherMesh, "_mesh", property(remembered))
    monkeypatch.setattr(selection_job, "build_finer", built)
    monkeypatch.setattr(study_runs, "_report", lambda directory: None)
    main(["run", str(study), "--out", str(study.parent / "once"), "--quiet"])
    assert made == [(2, 2, 2), (1, 1, 1)] * 2
    assert before == [0, 0]
    texts = [one["text"] for one in json.loads((study.parent / "once" / "summary.json").read_text())["findings"]]
    assert any("the error of the mesh" in text and "was corrected" in text for text in texts)
    assert not any("moves the data by" in text for text in texts)


@pytest.mark.slow
def test_a_study_says_what_its_meshes_do(study, monkeypatch, capsys):
    """Coarse meshes are found out: exit code 3, evidences that are not trusted; and nothing is where no one looked."""
    monkeypatch.setattr(study_runs, "_report", lambda directory: None)
    out = study.parent / "out"
    assert main(["run", str(study), "--out", str(out), "--quiet", "--set", "method.mesh_error='report'"]) == 3
    summary = json.loads((out / "summary.json").read_text())
    assert not any(one["trusted"] for one in summary["models"].values())
    said = [one["text"] for one in summary["findings"] if one["severity"] == "error"]
    assert any("a finer mesh moves the data by" in text and "material.C1" in text for text in said)
    assert "Evidences not to be trusted for what meshes do to them: right, stiff." in said
    assert any(
        text.startswith("Finer meshes move ln Z by: right ") for text in (f["text"] for f in summary["findings"])
    )
    found = stored_dataset(out / "results.nc")
    *_, table = finer_meshes().content(Results(found, {}, None))
    assert [row[0] for row in table.rows] == ["right", "stiff"]
    blind = study.parent / "blind"
    assert main(["run", str(study), "--out", str(blind), "--set", "method.mesh_check=false"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith(("right: ", "stiff: "))]
    assert len(lines) == 2
    assert all("; mesh not known" in line for line in lines)
    summary = json.loads((blind / "summary.json").read_text())
    assert not any(one["trusted"] for one in summary["models"].values())
    said = [one["text"] for one in summary["findings"] if one["severity"] == "warning"]
    assert "stiff: not checked for the mesh: method.mesh_check = false." in said
    assert "right: not checked for the mesh: method.mesh_check = false." in said
    assert any("no result will be called trusted" in line for line in plan(load(study, ["method.mesh_check=false"])))
    assert any("mesh check  about 4 solves of" in line for line in plan(load(study)))


@pytest.mark.mpi
@pytest.mark.slow
def test_a_study_from_the_command_line(study):
    """One rank or two: the same bytes; the report shows what is left of the data."""
    for name, ranks, words in (("one", None, ()), ("two", 2, ("--no-report",))):
        done = run(ranks, TISSUQ, "run", study, "--out", study.parent / name, "--set", "method.samples=256", *words)
        assert done.returncode == 0, done.stderr  # the error of its coarse meshes is corrected
    assert (study.parent / "one/results.nc").read_bytes() == (study.parent / "two/results.nc").read_bytes()
    page = (study.parent / "one" / "report.html").read_text()
    for words in ("Residuals", "Posteriors of the constants", "neo-hookean on 1 × 1 × 1 cells"):
        assert words in page
    found = stored_dataset(study.parent / "one" / "results.nc")
    assert found["prior_probability"].to_numpy() == pytest.approx([0.25, 0.75])


@pytest.mark.slow
def test_same_bits_after_a_kill(study):
    directory = study.parent / "killed"
    command = [TISSUQ, "run", study, "--out", directory, "--no-report", "--set", "method.samples=256"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)
    while process.poll() is None and len(list(directory.glob("evaluations/*"))) < 12:
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    for out in (directory, study.parent / "whole"):
        done = run(None, *command[:4], out, *command[5:])  # in this process finer meshes are others
        assert done.returncode == 0, done.stderr  # the error of its coarse meshes is corrected
    assert (directory / "results.nc").read_bytes() == (study.parent / "whole/results.nc").read_bytes()


def test_a_plan_counts_searches_derivatives_and_finer_meshes(study):
    """Time and memory: searches are solved by the textbook, each solve has derivatives; the finer mesh has a factor."""
    it, blind = load(study), load(study, ["method.mesh_check=false"])
    cost = {name: specimen.cost() for name, specimen in it.of_candidates.items()}
    least = sum(12 * one.textbook + 32 * one.corrected for one in cost.values())
    assert 1.2 * least < it.seconds_of_solves < 3 * least
    more = [sum(one.cost().bytes for one in meshes_of(specimen)) for specimen in it.of_candidates.values()]
    assert it.memory - blind.memory == pytest.approx(max(more))  # one candidate after the other
    assert any("if it has no answer" in line for line in it.plan(1))
