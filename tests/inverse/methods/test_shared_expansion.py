"""Batches inverted with one expansion: against the model itself, on meshes, and where an expansion is not accurate."""

import json
import sys

import numpy as np
import pytest

from forward.model import SolveError
from forward.pointwise import FunctionModel
from inverse.methods.stand_ins import shared_expansion
from tests.launch import without_pictures
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.hdf5 import stored_dataset
from uq.inputs.distributions import LogNormal, Uniform
from uq.inputs.random_parameters import Inputs
from workflows.config.mistakes import StudyError
from workflows.config.study import load
from workflows.run.run import run as run_study

DEPTHS = np.linspace(0.2, 1.0, 4)
INPUTS = Inputs({"a": LogNormal(mean=2.0, std=1.0), "b": Uniform(lower=0.5, upper=2.0)})
NAMES = tuple(f"f{k}" for k in range(4))
MODEL = """
import numpy as np

DEPTHS = np.linspace(0.2, 1.0, 4)


def curve(p):
    a, b = p
    return a * (np.exp(b * DEPTHS) - 1) / b


def slopes(p):
    a, b = p
    grown = np.exp(b * DEPTHS)
    return np.column_stack([(grown - 1) / b, a * (DEPTHS * grown / b - (grown - 1) / b**2)])
"""
STUDY = """
[model]
kind = "python"
function = "shared_tissue.curve"
jacobian = "shared_tissue.slopes"
parameters = { a = 2.0, b = 1.0 }
outputs = [{ name = "f0", unit = "N" }, { name = "f1", unit = "N" }, { name = "f2", unit = "N" }, { name = "f3", unit = "N" }]

[parameters]
a = { kind = "log-normal", mean = 2, std = 1 }
b = { kind = "uniform", lower = 0.5, upper = 2 }

[data]
files = ["data"]

[method]
kind = "invert"
samples = 32
starts = 1
seed = 2
"""  # noqa: E501


def curve(p):
    a, b = p
    return a * np.expm1(b * DEPTHS) / b


def slopes(p):
    a, b = p
    grown = np.exp(b * DEPTHS)
    return np.column_stack([np.expm1(b * DEPTHS) / b, a * (DEPTHS * grown / b - np.expm1(b * DEPTHS) / b**2)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("shared")
    sys.path.append(str(place))
    (place / "shared_tissue.py").write_text(MODEL)
    (place / "batch.toml").write_text(STUDY)
    (place / "data").mkdir()
    rng = np.random.default_rng(4)
    for k, truth in enumerate(((1.2, 0.8), (4.0, 1.7), (0.6, 1.2))):
        clean = curve(truth)
        sigma = 0.03 * np.sqrt((clean**2).mean())
        rows = [f"f{i},{value + sigma * rng.standard_normal()},{sigma}" for i, value in enumerate(clean)]
        lines = [f"# truth.a = {truth[0]}", f"# truth.b = {truth[1]}", "output,value,sigma", *rows]
        (place / "data" / f"specimen-{k}.csv").write_text("\n".join(lines))
    yield place
    sys.path.remove(str(place))


def run(folder, name, *changes):
    shown = name == "expanded"
    with without_pictures():  # they are those of all batches
        code = run_study(load(folder / "batch.toml", changes), "batch", folder / name, quiet=True, report=shown)
    found = stored_dataset(folder / name / "results.nc")
    return code, found, json.loads((folder / name / "summary.json").read_text())


@pytest.mark.slow
def test_an_expansion_gives_the_posteriors_of_the_model(folder):
    _, direct, _ = run(folder, "direct")
    code, found, summary = run(folder, "expanded", "method.expansion=24")
    assert code == 0
    assert float((abs(found["mean"] - direct["mean"]) / direct["std"]).max()) < 0.1
    np.testing.assert_allclose(found["std"], direct["std"], rtol=0.05)
    np.testing.assert_allclose(found["log_evidence"], direct["log_evidence"], atol=0.02)
    assert float(found["expansion_error"].max()) < 0.05
    assert summary["solves"] == 24
    assert "which all data sets share" in (folder / "expanded" / "report.html").read_text()


def test_what_an_expansion_misses_widens_the_intervals_and_is_said(folder):
    code, found, summary = run(folder, "rough", "method.expansion=8", "parameters.b.upper=9")
    assert float(found["expansion_error"].max()) > 0.3
    assert any("misses a datum by" in finding["text"] for finding in summary["findings"])
    assert code == 3


def test_specimens_have_no_expansion(tmp_path):
    from tests.inverse.methods.test_inversion import FEW

    (tmp_path / "few.toml").write_text(FEW)
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "one.csv").write_text("x,y,z,ux,case,sigma\n0,0,1,1e-3,shear,1e-5\n0,0,1,1e-3,pull,1e-5\n")
    with pytest.raises(StudyError, match=r"method\.expansion: data sets of a specimen"):
        load(tmp_path / "few.toml", ["method.expansion=16"])


def test_finer_meshes_are_expanded_too():
    def there(p):  # what finer meshes tend to, and the difference between them
        return np.concatenate([curve(p) * (1 - 0.02 * p[1]), 0.01 * curve(p)])

    def derivatives(p):
        d = slopes(p)
        limit = d * (1 - 0.02 * p[1])
        limit[:, 1] -= 0.02 * curve(p)
        return np.concatenate([limit, 0.01 * d])

    model = FunctionModel(curve, INPUTS.names, NAMES, slopes)
    finer = FunctionModel(there, INPUTS.names, (*NAMES, *(f"{n} between" for n in NAMES)), derivatives)
    found = shared_expansion(INPUTS, SerialEvaluate(model), SerialEvaluate(finer), 32)
    assert (found.solves, found.finer_solves) == (32, 8)
    point = np.array([1.7, 1.3])
    look, why = found.finer.look(point, tangents=True)
    assert why == ""
    np.testing.assert_allclose(look.outputs, there(point)[:4], rtol=1e-3)
    np.testing.assert_allclose(look.between, there(point)[4:], rtol=0.05)
    np.testing.assert_allclose(look.tangents, derivatives(point)[:4], rtol=0.03, atol=1e-3)
    np.testing.assert_allclose(found.model.solve(point).tangent(np.eye(2)).T, slopes(point), rtol=5e-3)
    with pytest.raises(SolveError, match="beyond the points"):
        found.model.solve(np.array([1e3, 1.0]))
    assert found.finer.look(np.array([1e3, 1.0]))[0] is None
