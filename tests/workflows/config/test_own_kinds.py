"""Models and methods from beside a study: found, run, listed, and refused where they are wrong or have changed."""

import json
import subprocess
import sys

import pytest
import xarray as xr

from forward.model import ModelError
from tests.launch import environment, in_process
from workflows.config.mistakes import StudyError
from workflows.config.study import load, schema
from workflows.run.plan import plan
from workflows.run.run import run

MODULE = '''
from typing import Literal

import numpy as np

from forward.pointwise import FunctionModel
from forward.external.models import Value
from forward.scalars import Scalar
from forward.settings import Settings
from forward.spec import ModelSpec
from uq.evaluation.request import Request
from uq.methods.method import Amount
from uq.methods.monte_carlo import MonteCarlo


class Spring(ModelSpec):
    """Elongation of a spring."""

    kind: str
    stiffness: float
    force: float

    @property
    def scalars(self):
        return {name: Scalar(getattr(self, name), Spring, name) for name in ("stiffness", "force")}

    @property
    def outputs(self):
        return (Value(name="elongation", unit="m"),)

    def described(self, ranges):
        yield "model", "a spring"

    def build(self, comm, parameters):
        def elongation(point):
            numbers = {"stiffness": self.stiffness, "force": self.force} | dict(zip(parameters, point))
            return [numbers["force"] / numbers["stiffness"]]

        return FunctionModel(elongation, parameters, ("elongation",))


class Grid(Amount):
    """Points along the diagonal of the unit cube."""

    kind: str

    def planned(self, dimension):
        return self.samples

    def run(self, inputs, evaluate):
        import xarray as xr

        cube = (np.arange(self.samples) + 0.5)[:, None] / self.samples * np.ones(len(inputs.names))
        found = evaluate(Request(inputs.points(cube)))
        return xr.Dataset(
            {"mean": ("output", found.outputs.mean(axis=0)), "mean_error": ("output", [np.nan]),
             "std": ("output", found.outputs.std(axis=0)), "std_error": ("output", [np.nan])},
            {"output": list(evaluate.outputs)},
        )


class Strange:
    pass
'''
STUDY = """
[model]
kind = "NAME.Spring"
stiffness = 100.0
force = 1.0

[parameters]
stiffness = { kind = "uniform", lower = 50, upper = 150 }

[method]
kind = "NAME.Grid"
samples = 64
"""


@pytest.fixture
def beside(tmp_path, request):
    """A folder with a module of a name of its own, and a study that names it."""
    name = f"own_kinds_{abs(hash(request.node.name)) % 10**8}"
    (tmp_path / f"{name}.py").write_text(MODULE)
    (tmp_path / "study.toml").write_text(STUDY.replace("NAME", name))
    before = [*sys.path]
    yield tmp_path, name
    sys.path[:] = before
    sys.modules.pop(name, None)


def test_a_model_and_a_method_from_beside_the_study(beside, undrawn):
    folder, name = beside
    study = load(folder / "study.toml")
    assert f"own code    {name} ({folder / name}.py)" in plan(study)
    assert run(study, "spring", folder / "out", quiet=True) == 0
    found = xr.load_dataset(folder / "out" / "results.nc")
    assert float(found["mean"][0]) == pytest.approx(0.010986, rel=1e-3)  # ln 3 / 100
    assert found.unit.values.tolist() == ["m"]
    assert name in json.loads((folder / "out" / "sources.json").read_text())["files"]
    assert (folder / "out" / "report.html").exists()
    (folder / f"{name}.py").write_text(MODULE.replace("+ 0.5", "+ 0.25"))
    with pytest.raises(StudyError, match=rf"{name}\.py has changed; choose another --out"):
        run(load(folder / "study.toml"), "spring", folder / "out", quiet=True)
    again = load(folder / "study.toml")
    assert run(again, "spring", folder / "other", quiet=True, report=False) == 0
    assert float(xr.load_dataset(folder / "other" / "results.nc")["mean"][0]) != float(found["mean"][0])


def test_the_command_line_finds_them_and_a_report_is_made_from_elsewhere(
    beside, tmp_path_factory, monkeypatch, undrawn
):
    folder, name = beside
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    words = ["run", folder / "study.toml", "--out", folder / "out", "--no-report"]
    done = subprocess.run(
        [sys.executable, "-m", "workflows", *words],
        cwd=elsewhere,
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert not (folder / "out" / "report.html").exists()
    monkeypatch.chdir(elsewhere)
    done = in_process("report", folder / "out")
    assert done.returncode == 0, done.stderr
    # Its model is code from beside the study, which no report runs unless it is told to.
    assert f"code that is not installed ({name}): header; --code runs it" in done.stderr
    plain = (folder / "out" / "report.html").read_text()
    assert '<section id="answer">' in plain
    assert '<section id="header">' not in plain
    done = in_process("report", "--code", folder / "out")
    assert done.returncode == 0
    assert not done.stderr
    assert '<section id="header">' in (folder / "out" / "report.html").read_text()


def test_installed_kinds_of_the_same_name_as_a_module_beside_the_study(beside):
    folder, _ = beside
    (folder / "json.py").write_text(MODULE)
    (folder / "study.toml").write_text(STUDY.replace("NAME", "json"))
    with pytest.raises(ModelError, match=r"^kind: 'json' is both .*json\.py and a module of Python's standard library"):
        load(folder / "study.toml")


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("model.kind=NAME.Sprng", r"^model\.kind: the module 'NAME' has no model 'Sprng'; did you mean 'Spring'"),
        (
            "model.kind=NAME.Strange",
            r"^model\.kind: 'NAME\.Strange' cannot be used as model: expected a subclass of ModelSpec",
        ),
        (
            "method.kind=NAME.Spring",
            r"^method\.kind: 'NAME\.Spring' cannot be used as method: expected a subclass of Method",
        ),
        ("method.kind=nowhere.Grid", r"^method\.kind: the method 'nowhere\.Grid' cannot be imported: No module"),
        ("model.stifness=1.0", r"^model\.stifness: unknown key; did you mean 'stiffness'\?"),
        ("method.samples=1", r"^method\.samples: input should be greater than or equal to 2; given 1"),
    ],
)
def test_mistakes_have_their_places(beside, override, said):
    folder, name = beside
    with pytest.raises(StudyError, match=said.replace("NAME", name)):
        load(folder / "study.toml", [override.replace("NAME", name)])


def test_a_module_that_cannot_be_imported_is_one_line(beside):
    folder, name = beside
    (folder / f"{name}.py").write_text("x = 1 / 0")
    with pytest.raises(StudyError, match=rf"the model '{name}\.Spring' cannot be imported: ZeroDivisionError"):
        load(folder / "study.toml")


def test_the_schema_allows_them(beside):
    jsonschema = pytest.importorskip("jsonschema")
    import tomllib

    folder, _ = beside
    validator = jsonschema.Draft202012Validator(schema())  # which is one: tests/workflows/config/test_config.py
    validator.validate(tomllib.loads((folder / "study.toml").read_text()))
