"""Kinds from outside the program, as the how-to page has them: one file each, checked, run on two ranks, reported."""

import importlib.util
import json
import re
import shutil
import tomllib
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest
import xarray as xr

from forward.findings import CATALOGUE
from tests.launch import ROOT, TISSUQ, in_process, run, tissuq_on_two_ranks
from uq.findings import findings
from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs

PAGE = ROOT / "docs" / "how-to" / "extending.md"


CORNERS = "Only 8 corners were looked at: inside, outputs may be smaller or larger."


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The files of the page."""
    made = tmp_path_factory.mktemp("extending")
    files = re.findall(r"^```(?:python|toml)\n# (\S+)\n(.*?)^```", PAGE.read_text(), re.M | re.S)
    for name, text in files:
        (made / name).write_text(text)
    return made


@pytest.fixture(scope="module")
def schema():
    done = in_process("schema")
    return jsonschema.Draft202012Validator(json.loads(done.stdout))


def test_the_page_has_one_file_for_each_kind(folder):
    assert {path.name for path in folder.iterdir()} >= {
        "my_tissue.py", "my_loads.py", "my_outputs.py", "my_methods.py", "my_sections.py", "my_models.py",
        "my_readers.py", "my_studies.py", "wound.toml", "beam.toml", "scan.toml",
    }  # fmt: skip


def test_a_method_brings_findings_of_its_own(folder, monkeypatch):
    monkeypatch.setattr("forward.findings.CATALOGUE", dict(CATALOGUE))
    spec = importlib.util.spec_from_file_location("my_methods", folder / "my_methods.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)

    def evaluate(request):
        return SimpleNamespace(outputs=request.points.sum(axis=1, keepdims=True))

    evaluate.outputs = ("sum",)
    inputs = Inputs({name: Uniform(lower=0, upper=1) for name in "abc"})
    found = module.Corners(kind="my_methods.Corners").run(inputs, evaluate)
    assert [(one.severity, one.text) for one in findings(found)] == [("note", CORNERS)]


@pytest.mark.fem
@pytest.mark.mpi
@pytest.mark.slow
def test_a_study_of_a_body_on_two_ranks(folder, schema):
    study, out = folder / "wound.toml", folder / "wound"
    schema.validate(tomllib.loads(study.read_text()))
    checked = run(None, TISSUQ, "check", study)
    assert checked.returncode == 0, checked.stderr
    done = run(2, TISSUQ, "run", study, "--out", out, "--no-report")
    assert done.returncode == 0, done.stderr
    assert run(None, TISSUQ, "report", "--code", out).returncode == 0
    data = xr.load_dataset(out / "results.nc")
    assert (data["smallest"] > 0).all()
    assert (data["smallest"] < data["largest"]).all()
    area = 0.02 * 0.02  # of the face that is pulled: what it sweeps is its mean displacement times that
    swept, stretch = (data["largest"].sel(output=name).item() for name in ("swept", "stretch"))
    assert swept == pytest.approx(area * stretch, rel=1e-10)
    page = (out / "report.html").read_text()
    assert "The ends of what is likely" in page
    own = {"severity": "note", "text": CORNERS, "code": "my_methods.corners"}
    assert own in json.loads((out / "summary.json").read_text())["findings"]
    assert CORNERS in page  # though nothing loads the module to write a report
    assert f"{swept:.4g}" in page
    sources = json.loads((out / "sources.json").read_text())["files"]
    assert {"my_tissue", "my_loads", "my_outputs", "my_methods"} <= sources.keys()
    again = run(None, TISSUQ, "run", study, "--out", folder / "one", "--no-report")
    assert again.returncode == 0, again.stderr
    assert (folder / "one" / "results.nc").read_bytes() == (out / "results.nc").read_bytes()
    loads = folder / "my_loads.py"
    loads.write_text(loads.read_text().replace("/ 2", "/ 3"))
    other = run(None, TISSUQ, "run", study, "--out", out)
    loads.write_text(loads.read_text().replace("/ 3", "/ 2"))
    assert other.returncode == 2
    assert "my_loads.py has changed" in other.stderr


@pytest.mark.fem
@pytest.mark.mpi
@pytest.mark.slow
def test_an_item_that_is_no_form(folder, tmp_path):
    """A cable through a body: a number of it is random, two ranks share the body, and what it cannot have is said."""
    for path in folder.glob("*.py"):
        shutil.copy(path, tmp_path)
    shutil.copy(ROOT / "tests" / "items.py", tmp_path / "my_items.py")
    study, out = (folder / "wound.toml").read_text(), tmp_path / "out"
    cable = 'kind = "my_items.Cable", name = "cable", start = [0, 0, 0], end = [0.04, 0.02, 0.02], stiffness = 0.05'
    study = study.replace("loads = [", f"loads = [\n    {{ {cable} }},").split("[method]", maxsplit=1)[0]
    study += '"loads.cable.stiffness" = { kind = "uniform", lower = 0.02, upper = 0.1 }\n'
    study += '[method]\nkind = "local-sensitivity"\n'
    (tmp_path / "cable.toml").write_text(study + "[parallel]\nranks_per_model = 2\n")
    done = run(2, TISSUQ, "run", tmp_path / "cable.toml", "--out", out, "--no-report")
    assert done.returncode == 0, done.stderr
    said = [one["text"] for one in json.loads((out / "summary.json").read_text())["findings"]]
    assert "The error of the mesh is not estimated with 'cable': compare with a finer mesh." in said
    (tmp_path / "small.toml").write_text(study.replace("local-sensitivity", "reduce"))
    refused = run(None, TISSUQ, "run", tmp_path / "small.toml", "--out", tmp_path / "small")
    assert refused.returncode != 0
    assert "the load 'cable' is no form and cannot be reduced" in refused.stderr
    assert "Traceback" not in refused.stderr


@pytest.mark.mpi
def test_a_model_with_numbers_of_its_own(folder, schema):
    study = folder / "beam.toml"
    schema.validate(tomllib.loads(study.read_text()))
    done = tissuq_on_two_ranks("run", study, "--out", folder / "beam", "--no-report")
    assert done.returncode == 0, done.stderr
    data = xr.load_dataset(folder / "beam" / "results.nc")
    cube = (0.12**4 - 0.08**4) / (4 * 0.04)
    expected = 0.5 * cube / 3 / 2.0 * (1 + 0.1**2)  # the mean of 1/x of a log-normal x of coefficient of variation v
    assert data["mean"].item() == pytest.approx(expected, abs=4 * data["mean_error"].item())
    assert np.isfinite(data["std"]).all()


STRIP = """
[model]
kind = "material-tests"
material = { kind = "neo-hookean", C1 = 1e4 }
tests = [{ mode = "uniaxial", at = [1.1, 1.2, 1.3] }]

[parameters]
"material.C1" = { kind = "log-normal", mean = 1e4, std = 5e3 }

[data]
files = "strip.dat"
reader = { kind = "my_readers.Machine", length = 0.02, area = 1e-5 }
noise = { relative = 0.03 }

[method]
kind = "invert"
samples = 32
starts = 1
"""


def test_a_reader_of_data(folder, schema):
    """Against a table of the same numbers; what a file lacks is said in one line."""
    study, machine = folder / "strip.toml", folder / "strip.dat"
    study.write_text(STRIP)
    schema.validate(tomllib.loads(STRIP))
    machine.write_text("elongation;force\n2,0;0,055\n4,0;0,101\n6,0;0,142\n")
    done = in_process("run", study, "--out", folder / "strip", "--no-report")
    assert done.returncode == 0, done.stderr
    rows = zip((1.1, 1.2, 1.3), (5500, 10100, 14200), strict=True)
    (folder / "same.csv").write_text("stretch,uniaxial\n" + "".join(f"{x},{y}\n" for x, y in rows))
    same = re.sub(r"reader = .*\n", "", STRIP).replace("strip.dat", "same.csv")
    (folder / "same.toml").write_text(same)
    assert in_process("run", folder / "same.toml", "--out", folder / "same", "--no-report").returncode == 0
    found, other = (xr.load_dataset(folder / name / "results.nc") for name in ("strip", "same"))
    np.testing.assert_allclose(found["mode"], other["mode"], rtol=1e-12)
    np.testing.assert_allclose(found["measured"], other["measured"], rtol=1e-15)
    assert "my_readers" in json.loads((folder / "strip" / "sources.json").read_text())["files"]
    machine.write_text("elongation;force\n2,0\n")
    refused = in_process("check", study)
    assert refused.returncode == 2
    assert refused.stderr.startswith("data: strip.dat: cannot be read by Machine: ValueError: not enough values")


def test_a_kind_of_study(folder, schema):
    study, out = folder / "scan.toml", folder / "scan"
    schema.validate(tomllib.loads(study.read_text()))
    checked = in_process("check", study)
    assert checked.returncode == 0, checked.stderr
    assert "3 values of length" in checked.stdout
    done = tissuq_on_two_ranks("run", study, "--out", out)
    assert done.returncode == 0, done.stderr
    found = xr.load_dataset(out / "results.nc")
    assert found["scanned"].to_numpy().ravel() == pytest.approx(0.5 * np.array([0.08, 0.1, 0.12]) ** 3 / 3 / 2.0)
    assert "my_studies" in json.loads((out / "sources.json").read_text())["files"]
    assert "A number of the model that is varied" in (out / "report.html").read_text()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("my_tissue.fung", "my_tissue.fang", "did you mean 'fung'"),
        ("my_loads.Springs", "my_load.Springs", "cannot be imported"),
        ("k = 2e4", "k = -1", "greater than or equal to 0"),
        ("c = 2e3, ", "", "material.c: missing"),
    ],
)
def test_mistakes_have_their_places(folder, tmp_path, old, new, said):
    for path in folder.glob("*.py"):
        (tmp_path / path.name).write_text(path.read_text())
    (tmp_path / "bad.toml").write_text((folder / "wound.toml").read_text().replace(old, new))
    done = in_process("check", tmp_path / "bad.toml")
    assert done.returncode == 2
    assert said in done.stderr
    assert "Traceback" not in done.stderr
