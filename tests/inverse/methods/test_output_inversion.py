"""Inversion of measured outputs: linear models by closed forms, files and batches, bodies, servers, mistakes."""

import json

import h5py
import numpy as np
import pytest
import xarray as xr
from mpi4py import MPI

from inverse.criticism.doubts import not_estimable
from inverse.data.outputs import read_outputs, stated
from inverse.data.table import DataError
from tests.launch import TISSUQ, in_process, run, tissuq_on_two_ranks, without_pictures
from uq.evaluation.hdf5 import stored_dataset
from workflows.__main__ import main
from workflows.config.mistakes import StudyError
from workflows.config.study import document, load, parse
from workflows.data.measured_outputs import MeasuredOutputs
from workflows.run.plan import plan

A = np.array([[1.0, 2.0], [0.5, -1.0], [3.0, 0.2]])
MEAN, STD = np.array([1.0, -1.0]), np.array([0.5, 2.0])
LINES = """
import numpy as np

A = np.array([[1.0, 2.0], [0.5, -1.0], [3.0, 0.2]])


def linear(p):
    return A @ p


def slopes(p):
    return A
"""
STUDY = """
[model]
kind = "python"
function = "lines_MODULE.linear"
jacobian = "lines_MODULE.slopes"
parameters = { a = 1.0, b = -1.0 }
outputs = [{ name = "u", unit = "m" }, "v", "w"]

[parameters]
a = { kind = "normal", mean = 1.0, std = 0.5 }
b = { kind = "normal", mean = -1.0, std = 2.0 }

[data]
outputs = { u = 0.4, w = [3.1, 2.9] }
noise = { absolute = 0.2, relative = 0.1 }
sigma = { u = 0.05 }

[method]
kind = "invert"
samples = 32
starts = 1
draws = 50
"""
TABLE = "# by hand\n# truth.a = 1.1\noutput,value,sigma\nu,0.4,0.05\nw,3.1,\nw,2.9,0.2\n"


def exactly(rows, values, sigma):
    """Mode, covariance and ln Z of the linear model with independent normal priors and errors."""
    B = A[rows]
    precision = np.diag(STD**-2.0) + (B / sigma[:, None] ** 2).T @ B
    covariance = np.linalg.inv(precision)
    mode = covariance @ (B.T @ (values / sigma**2) + MEAN / STD**2)
    S = np.diag(sigma**2) + (B * STD**2) @ B.T
    gap = values - B @ MEAN
    log_evidence = -(gap @ np.linalg.solve(S, gap) + np.linalg.slogdet(2 * np.pi * S)[1]) / 2
    return mode, covariance, log_evidence


VALUES, SIGMA = np.array([0.4, 3.1, 2.9]), np.array([0.05, 0.31, 0.29])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Studies of a linear model, whose module has a name of its own: it stays imported in this process."""
    place = tmp_path_factory.mktemp("outputs")
    (place / "lines_shared.py").write_text(LINES)
    (place / "stated.toml").write_text(STUDY.replace("MODULE", "shared"))
    (place / "data").mkdir()
    for name, scale in (("one", 1.0), ("two", 1.1)):
        (place / "data" / f"{name}.csv").write_text(TABLE.replace("0.4,", f"{0.4 * scale},"))
    (place / "data" / "wrong.csv").write_text("output,value\nux,1\n")
    return place


def results(out):
    return stored_dataset(out / "results.nc")


def ran(study, out, *changes, report=False):
    """Run a study in this process, without its words."""
    sets = [word for change in changes for word in ("--set", change)]
    return main(["run", str(study), "--out", str(out), "--quiet", *([] if report else ["--no-report"]), *sets])


HEAVY = "data.errors={kind='student-t', degrees=4}"
FILES = "data={files='data', noise={relative=0.1}}"


@pytest.fixture(scope="module")
def alone(folder):
    """The results of the data that the study states."""
    assert ran(folder / "stated.toml", folder / "stated", report=True) == 0
    return folder / "stated"


@pytest.fixture(scope="module")
def batch(folder):
    """The results of three files, of which one cannot be read."""
    with without_pictures():  # of its report the words are looked at
        assert ran(folder / "stated.toml", folder / "batch", FILES, report=True) == 3
    return folder / "batch"


def test_a_linear_model_has_its_exact_posterior(alone, looked_at):
    """Mode, standard deviations and evidence; the residuals, repeated measurements among them; nothing of meshes."""
    one = results(alone).isel(data_set=0)
    mode, covariance, log_evidence = exactly([0, 2, 2], VALUES, SIGMA)
    np.testing.assert_allclose(one["mode"], mode, rtol=1e-8)
    np.testing.assert_allclose(one["together_std"], np.sqrt(np.diag(covariance)), rtol=1e-8)
    np.testing.assert_allclose(one["log_evidence"], log_evidence, rtol=1e-9)
    np.testing.assert_allclose(one["sigma"], SIGMA)
    np.testing.assert_allclose(one["residual"], (A[[0, 2, 2]] @ mode - VALUES) / SIGMA, rtol=1e-7)
    assert [str(name) for name in one["case"].values] == ["u", "w"]
    np.testing.assert_allclose(one["alone_std"][0], np.sqrt(np.diag(exactly([0], VALUES[:1], SIGMA[:1])[1])), rtol=1e-8)
    assert not {"mesh_checked", "place", "stiffness_mode", "cell_nodes"} & set(one.data_vars)
    assert np.isfinite(one["agreement_probability"])  # of the repeated ones
    summary = json.loads((alone / "summary.json").read_text())
    assert set(summary["posterior"]) == {"a", "b"}
    assert "can be trusted" in summary["verdict"]
    page = (alone / "report.html").read_text()
    looked_at(alone)
    assert "values of outputs" in page
    assert "predicted" in page
    assert "oad case" not in page


def test_what_is_taken_for_granted_is_told(alone, batch, folder):
    """Scales of the data in closed form, in deviations of the posterior; said and shown; in a batch too; or not."""
    one = results(alone).isel(data_set=0)
    covariance = exactly([0, 2, 2], VALUES, SIGMA)[1]
    B, part = A[[0, 2, 2]], 0.01 * VALUES / SIGMA**2
    right = np.array([covariance @ (B.T @ (part * here)) for here in ([1, 0, 0], [0, 1, 1])])  # of u, and of w
    assert one["assumption"].values.tolist() == ["data.scale.displacement", "data.scale.w"]
    np.testing.assert_allclose(one["assumption_shift"], right / one["std"].to_numpy(), rtol=1e-5)
    assert one["assumption_part"].values.tolist() == [0.01, 0.01]
    found = json.loads((alone / "summary.json").read_text())["findings"]
    (note,) = (one for one in found if one["code"] == "taken-for-granted")
    assert note["severity"] == "note"
    assert "if measured w is 1 % larger than stated, " in note["text"]
    page = (alone / "report.html").read_text()
    assert "Taken for granted" in page
    assert "measured displacement is 1 % larger" in page
    assert results(batch)["assumption_shift"].shape == (3, 2, 2)
    assert ran(folder / "stated.toml", folder / "without", "method.assumptions=false") == 0
    assert "assumption" not in results(folder / "without").dims


def test_what_is_uncertain_is_among_the_errors(folder):
    """Of a linear model and normal errors exactly: a scale that all data share, and one of each quantity."""
    changes = ["uncertain={'data.scale'=0.2}", "uncertain={'data.scale.displacement'=0.2, 'data.scale.w'={std=0.2}}"]
    B, apart = A[[0, 2, 2]], [1, 0, 0]
    for number, change in enumerate(changes):
        out = folder / f"uncertain-{number}"
        assert ran(folder / "stated.toml", out, change) == 0
        one = results(out).isel(data_set=0)
        mode = MEAN
        for _ in range(2):  # of what is predicted at the mean of the prior, and then at the mode
            scaled = 0.2 * B @ mode
            parts = [scaled] if number == 0 else [scaled * apart, scaled * np.subtract(1, apart)]
            errors = np.diag(SIGMA**2) + np.transpose(parts) @ parts
            covariance = np.linalg.inv(B.T @ np.linalg.solve(errors, B) + np.diag(STD**-2.0))
            mode = covariance @ (B.T @ np.linalg.solve(errors, VALUES) + MEAN / STD**2)
        np.testing.assert_allclose(one["mode"], mode, rtol=1e-6)
        np.testing.assert_allclose(one["together_std"], np.sqrt(np.diag(covariance)), rtol=1e-6)
        assert "motion_eigenvalue" not in one
        told = ["data.scale"] if number == 0 else ["data.scale.displacement", "data.scale.w"]
        assert one["assumption"].values.tolist() == told
        assert one["assumption_part"].values.tolist() == [0.2] * len(told)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("uncertain={'data.scale'=0}", "uncertain.data.scale.std: input should be greater than 0; given 0"),
        ("uncertain={a=0.1}", "uncertain.a: is a parameter too, expected one of both; given 'a'"),
        ("uncertain={'data.scales'=0.1}", "uncertain.data.scales: not a number that is taken for granted; did you"),
        ("uncertain={'data.shift.x'={std=1e-3}}", "uncertain.data.shift.x: not a number that is taken for granted"),
        ("uncertain={'data.scale'={}}", "uncertain.data.scale: expected either relative or std"),
        ("uncertain={'data.scale'={std=0.1,group='a'}}", "uncertain.data.scale.group: is the name of a parameter"),
        (f"uncertain={{'data.scale'=0.1}};{HEAVY}", "uncertain.data.scale: cannot be sampled, as errors of kind 'stu"),
        (f"uncertain={{'data.scale.w'=0.1}};{HEAVY}", "expected only numbers of the model, or errors of kind 'normal'"),
        ("model.parameters.c=0;uncertain={c={relative=0.1}}", "uncertain.c: a part of zero is zero, expected std; giv"),
    ],
)
def test_what_cannot_be_uncertain_is_refused(folder, given, told):
    with pytest.raises(StudyError) as error:
        load(folder / "stated.toml", given.split(";"))
    assert told in str(error.value)


@pytest.mark.few(1)
def test_with_heavy_tails_what_is_uncertain_is_sampled(folder):
    """y = a L t of L ± 10 %, with Student's errors: against a grid, which knows that all data share L."""
    t, a, dof, sigma = np.array([0.5, 1, 1.5, 2, 3]), np.exp(np.linspace(0, 2, 1200))[:, None], 4, 0.1
    y = np.array([1.22, 2.73, 4.46, 5.96, 9.04])
    (folder / "levers.py").write_text(
        "import numpy as np\nt = np.array([0.5, 1, 1.5, 2, 3])\n"
        "def lever(p): return p[0] * p[1] * t\ndef slopes(p): return np.c_[p[1] * t, p[0] * t]\n"
    )
    model = "{kind='python', function='levers.lever', jacobian='levers.slopes', parameters={a=1.0, L=1.0}, "
    changes = [f"model={model}outputs=[{{name='y', size=5}}]}}", "parameters={a={kind='log-normal', mean=2, std=1}}"]
    changes += [f"data={{outputs={{y={y.tolist()}}}, sigma={{y={sigma}}}}}", HEAVY, "uncertain={L=0.1}"]
    assert ran(folder / "stated.toml", folder / "heavy", *changes, "method.samples=128") == 0
    one = results(folder / "heavy").isel(data_set=0)
    z = np.linspace(-5, 5, 1001)
    r = (y - a[:, :, None] * (1 + 0.1 * z)[:, None] * t) / sigma
    log = -(dof + 1) / 2 * np.log1p(r**2 / dof).sum(axis=2) - z**2 / 2
    log = log - (np.log(a) - np.log(2 / np.sqrt(1.25))) ** 2 / 2 / np.log(1.25)  # of ln a, of which the grid is even
    weights = np.exp(log - log.max())
    weights = weights.sum(axis=1) / weights.sum()
    mean = weights @ a[:, 0]
    std = np.sqrt(weights @ (a[:, 0] - mean) ** 2)
    assert float(one["mean"][0]) == pytest.approx(mean, abs=0.1 * std)
    assert float(one["std"][0]) == pytest.approx(std, rel=0.08)
    codes = [one["code"] for one in json.loads((folder / "heavy" / "summary.json").read_text())["findings"]]
    assert "uncertain-sampled" in codes
    assert "errors-too-large" not in codes


def test_data_sets_need_not_have_all_outputs(folder):
    """The second of three tables lacks one: what is taken for granted of it moves nothing there."""
    (folder / "some").mkdir()
    for name, text in (("one", TABLE), ("two", TABLE.partition("w,")[0]), ("zero", TABLE)):
        (folder / "some" / f"{name}.csv").write_text(text)
    assert ran(folder / "stated.toml", folder / "lacking", "data={files='some', noise={relative=0.1}}") == 0
    found = results(folder / "lacking")
    assert found["assumption"].values.tolist() == ["data.scale.displacement", "data.scale.w"]
    assert not found["assumption_shift"][1, 1].any()
    table = (folder / "lacking" / "batch.csv").read_text().splitlines()
    assert [line.split(",")[:2] for line in table[1:]] == [["one", "yes"], ["two", "yes"], ["zero", "yes"]]


def test_tables_are_data_sets_side_by_side(batch, capsys):
    """The same numbers as stated in the study; one that cannot be read does not stop the others."""
    found = results(batch)
    assert found["ok"].to_numpy().tolist() == [True, True, False]
    assert "the model has no output 'ux'" in str(found["why"].values[2])
    sigma = np.array([0.05, 0.31, 0.2])
    mode, _, log_evidence = exactly([0, 2, 2], VALUES, sigma)
    np.testing.assert_allclose(found["mode"][0], mode, rtol=1e-8)
    np.testing.assert_allclose(found["log_evidence"][0], log_evidence, rtol=1e-9)
    assert found["true"].sel(parameter="a").to_numpy()[:2].tolist() == [1.1, 1.1]
    table = (batch / "batch.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in table] == ["data_set", "one", "two", "wrong"]
    assert "All data sets" in (batch / "report.html").read_text()
    assert main(["check", str(batch / "study.toml")]) == 2  # a record, which names its data
    assert "records a study without its data, expected the study that was run" in capsys.readouterr().err


def test_a_wrong_jacobian_is_named(folder):
    """Of inversions and of studies that sample; exit code 3."""
    wrong = LINES.replace("return A\n", "return A * np.array([1.0, 0.9])\n")
    (folder / "lines_wrong.py").write_text(wrong)
    (folder / "wrong.toml").write_text(STUDY.replace("MODULE", "wrong"))
    sampled = STUDY.replace("MODULE", "wrong").partition("[data]")[0] + '[method]\nkind = "chaos"\nsamples = 12\n'
    (folder / "wrong-chaos.toml").write_text(sampled)
    for name in ("wrong", "wrong-chaos"):
        assert ran(folder / f"{name}.toml", folder / name) == 3
        found = json.loads((folder / name / "summary.json").read_text())["findings"]
        assert any("of u by b 10 % off" in one["text"] for one in found if one["severity"] == "error")


def test_a_file_that_cannot_be_read_is_refused_alone(folder):
    """One that is there, and neither a folder nor text."""
    found = load(folder / "stated.toml", ["data={files=['/proc/self/mem', 'data/one.csv'], noise={relative=0.1}}"])
    assert [bool(one.refused) for one in found.data.sets] == [True, False]


def test_files_of_one_name_in_different_folders_are_different_data(folder):
    """In all that is called after a data set: results, rows, solves that are kept."""
    for place, name in (("monday", "one"), ("tuesday", "two")):
        (folder / place).mkdir()
        (folder / place / "scan.csv").write_text((folder / "data" / f"{name}.csv").read_text())
    files = "data={files='*day/scan.csv', noise={relative=0.1}}"
    assert ran(folder / "stated.toml", folder / "days", files) == 0
    found = results(folder / "days")
    assert [str(name) for name in found["data_set"].values] == ["monday-scan.csv", "tuesday-scan.csv"]
    for mode, u in zip(found["mode"], (0.4, 0.44), strict=True):
        right, _, _ = exactly([0, 2, 2], np.array([u, 3.1, 2.9]), np.array([0.05, 0.31, 0.2]))
        np.testing.assert_allclose(mode, right, rtol=1e-8)
    evaluations = h5py.File(folder / "days" / "evaluations.h5")
    assert set(evaluations) == {"monday-scan.csv", "tuesday-scan.csv"}


@pytest.mark.mpi
def test_groups_of_ranks_give_the_same_bytes(folder, alone, batch):
    for there, changes in ((alone, ()), (batch, ("--set", FILES))):
        out = folder / f"{there.name}-shared"
        done = tissuq_on_two_ranks("run", folder / "stated.toml", "--out", out, "--quiet", "--no-report", *changes)
        assert done.returncode in (0, 3), done.stderr
        left, right = (results(place) for place in (there, out))
        xr.testing.assert_identical(left.drop_attrs(), right.drop_attrs())


BAR = """
[model]
body = { size = [1.0, 1.0, 1.0], cells = [2, 1, 1], degree = 1 }
material = { kind = "neo-hookean-coupled", mu = 1e4, lmbda = 4e4 }
clamp = ["x-min"]
loads = [{ kind = "traction", on = "x-max", direction = [1, 0, 0], size = 900 }]
outputs = [
    { name = "uy", kind = "max-displacement", component = "y" },
    { name = "ux", kind = "max-displacement", component = "x" },
]

[parameters]
"material.mu" = { kind = "log-normal", mean = 1e4, std = 3e3 }

[data]
outputs = { ux = 0.03 }
noise = { relative = 0.01 }

[method]
kind = "invert"
samples = 32
starts = 1
draws = 50
"""


@pytest.mark.slow
def test_outputs_of_a_body(tmp_path):
    """What is predicted at the mode is what was measured; the error of its two linear cells is the true one."""
    (tmp_path / "bar.toml").write_text(BAR)
    study = load(tmp_path / "bar.toml")
    assert any("mesh check  about 4 solves" in line for line in plan(study))
    assert ran(tmp_path / "bar.toml", tmp_path / "out") in (0, 3)
    one = results(tmp_path / "out").isel(data_set=0)
    assert one["predicted"].item() == pytest.approx(0.03, rel=2e-3)
    assert one["predicted_std"].item() >= 3e-4 * 0.9  # with what is uncertain of the error of the mesh
    assert bool(one["mesh_checked"])
    names = ("material.mu",)
    model = study.spec.build(MPI.COMM_SELF, names)
    thin = {"x-min": 24, **dict.fromkeys(("y-min", "y-max", "z-min", "z-max"), 6)}
    body = {**study.spec.body.model_dump(), "cells": (7, 6, 6), "degree": 2, "grading": thin}
    fine = type(study.spec).model_validate(study.spec.model_dump() | {"body": body}).build(MPI.COMM_SELF, names)
    mode = one["mode"].to_numpy()
    error = (fine.solve(mode).outputs - model.solve(mode).outputs)[1] / one["sigma"].item()
    # Linear cells of half the size told 0.7 of it.
    assert one["mesh_error"].item() == pytest.approx(error, rel=0.03)
    assert error > 5


def test_outputs_that_follow_single_cells_are_named(tmp_path):
    """Of a body, where one was measured: no finer mesh tells what a largest stress tends to."""
    text = BAR.replace("outputs = [\n", 'outputs = [\n    { name = "peak", kind = "max-von-mises" },\n')
    (tmp_path / "bar.toml").write_text(text)
    assert load(tmp_path / "bar.toml").not_estimable(0) == ()
    (tmp_path / "bar.toml").write_text(text.replace("ux = 0.03 }", "ux = 0.03, peak = 2e3 }"))
    study = load(tmp_path / "bar.toml")
    assert study.not_estimable(0) == ("peak",)
    (doubt,) = not_estimable(study.not_estimable(0))
    assert (doubt.severity, doubt.short) == ("warning", "the error of the mesh in peak is not known")


def test_studies_are_written_down(folder, capsys):
    study = load(folder / "stated.toml")
    assert parse(document(study)) == study
    assert main(["check", str(folder / "stated.toml")]) == 0
    assert "unknown     2: a, b" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("u = 0.4", "ux = 0.4", "data.outputs.ux: not an output of the model; did you mean 'u'?"),
        ("sigma = { u", "sigma = { q", "data.sigma.q: not an output of the model"),
        ("outputs = { u = 0.4, w = [3.1, 2.9] }", "", "data: expected either files or outputs"),
        (
            "noise = { absolute = 0.2, relative = 0.1 }",
            "",
            "data.outputs.w: the standard deviation of the error is not",
        ),
        ("w = [3.1", "w = ['x'", "data.outputs.w"),
        ('a = { kind = "normal"', 'q = { kind = "normal"', "parameters: not a number of the model"),
        ("[method]", "[parallel]\nranks_per_model = 2\n[method]", "is not shared by ranks, expected 1"),
    ],
)
def test_mistakes_have_their_places(folder, old, new, told):
    (folder / "bad.toml").write_text((folder / "stated.toml").read_text().replace(old, new))
    with pytest.raises(StudyError) as error:
        load(folder / "bad.toml")
    assert told in str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_a_model_without_derivatives_is_refused(folder, capsys):
    """By `check` and by a run, in one line."""
    text = (folder / "stated.toml").read_text()
    (folder / "plain.toml").write_text("\n".join(line for line in text.splitlines() if "jacobian" not in line))
    for arguments in (
        ["check", str(folder / "plain.toml")],
        ["run", str(folder / "plain.toml"), "--out", str(folder / "plain")],
    ):
        assert main(arguments) in (1, 2)
        assert "has no derivatives, without which the most probable parameters are not found" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("output,value\n", "t.csv: no rows"),
        ("output,val\nu,1\n", "unknown column 'val'; did you mean 'value'?"),
        ("value\n1\n", "no column 'output'"),
        ("output,value\nuu,1\n", "line 2: the model has no output 'uu'; did you mean 'u'?"),
        ("output,value\nu,nan\n", "line 2: value is 'nan', expected a number"),
        ("output,value,sigma\nu,1,0\n", "line 2: sigma is '0', expected a number more than 0"),
        ("# truth.a = big\noutput,value\nu,1\n", "truth.a is 'big', expected a number"),
    ],
)
def test_tables_with_mistakes(tmp_path, text, told):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(DataError) as error:
        read_outputs(tmp_path / "t.csv", ("u", "v"))
    assert told in " ".join(error.value.args)


def test_errors_of_data():
    """By table, by output, and in general; relative errors of zero need another."""
    given = {"outputs": {"u": 2.0, "v": (0.0, 1.0)}, "sigma": {"u": 0.5}}
    found, both = stated(given["outputs"], ("u", "v")), {"relative": 0.1, "absolute": 0.2}
    np.testing.assert_allclose(MeasuredOutputs(**given, noise=both).with_errors(found).sigma, [0.5, 0.2, 0.2])
    with pytest.raises(DataError, match=r"data.outputs.v: the standard deviation .* not known, expected"):
        MeasuredOutputs(**given, noise={"relative": 0.1}).with_errors(found)


@pytest.mark.slow
@pytest.mark.mpi
def test_chains_by_gradients_on_several_ranks(tmp_path):
    """The numbers of one rank; where a rank is killed within them all end, and the same command finds them again."""
    pytest.importorskip("mici")
    study, module = tmp_path / "chained.toml", tmp_path / "lines_chained.py"
    study.write_text(STUDY.replace("MODULE", "chained").replace("samples = 32", 'samples = 32\nchains = "hmc"'))
    module.write_text(LINES)
    alone, killed = tmp_path / "alone", tmp_path / "killed"
    assert in_process("run", study, "--out", alone, "--no-report").returncode == 0
    when = f"len(calls) == 500 and not os.path.exists({str(killed / 'on')!r})"
    ends = f"    calls.append(p)\n    if {when}:\n        os._exit(9)\n"
    module.write_text("import os\n\ncalls = []\n" + LINES.replace("    return A @ p\n", f"{ends}    return A @ p\n"))
    command = (2, TISSUQ, "run", study, "--out", killed, "--no-report")
    assert run(*command, timeout=100).returncode not in {0, 3}
    assert not (killed / "summary.json").exists()
    (killed / "on").touch()
    done = run(*command)
    assert done.returncode == 0, done.stderr
    one, two = results(alone), results(killed)
    assert (one["chains"] == 2).all()
    for name in ("mean", "std", "draw", "log_evidence", "chain_rhat"):
        np.testing.assert_array_equal(one[name], two[name])
