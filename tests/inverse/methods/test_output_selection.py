"""Models compared by measured outputs: linear ones with evidences in closed form, bodies on finer meshes, mistakes."""

import json
import tomllib

import numpy as np
import pytest

from forward.combine import selected
from forward.conformance import check_derivatives
from forward.pointwise import FunctionModel
from tests.rubber import CONFIGS
from uq.evaluation.hdf5 import stored_dataset
from workflows.__main__ import main
from workflows.config.study import StudyError, document, load, parse

LINES = """
import numpy as np

ONE = np.array([[1.0, 2.0], [0.5, -1.0], [3.0, 0.2]])
OTHER = np.array([[1.0, 0.0], [0.5, 0.3], [3.0, -2.0]])


def one(p):
    return ONE @ p


def one_slopes(p):
    return ONE


def other(p):
    return OTHER @ p


def other_slopes(p):
    return OTHER
"""
STUDY = """
[model]
kind = "python"
function = "rival_lines.one"
jacobian = "rival_lines.one_slopes"
parameters = { a = 1.0, b = -1.0 }
outputs = ["u", "v", "w"]

[data]
outputs = { w = [3.1, 2.9], u = 0.4 }
sigma = { u = 0.05, w = 0.3 }

[candidates.one]
parameters.a = { kind = "normal", mean = 1.0, std = 0.5 }
parameters.b = { kind = "normal", mean = -1.0, std = 2.0 }

[candidates.one-alone]
parameters.a = { kind = "normal", mean = 1.0, std = 0.5 }

[candidates.other]
model = { function = "rival_lines.other", jacobian = "rival_lines.other_slopes" }
parameters.a = { kind = "normal", mean = 1.0, std = 0.5 }
parameters.b = { kind = "normal", mean = -1.0, std = 2.0 }

[method]
kind = "select"
samples = 32
starts = 1
noise = {}
"""
ONE = np.array([[1.0, 2.0], [0.5, -1.0], [3.0, 0.2]])
OTHER = np.array([[1.0, 0.0], [0.5, 0.3], [3.0, -2.0]])
MEAN, STD = np.array([1.0, -1.0]), np.array([0.5, 2.0])


def log_evidence(A, std):
    """Of the measured values, for independent normal priors; b is at its mean where its deviation is zero."""
    B, sigma = A[[2, 2, 0]], np.array([0.3, 0.3, 0.05])
    S = np.diag(sigma**2) + (B * std**2) @ B.T
    gap = np.array([3.1, 2.9, 0.4]) - B @ MEAN
    return -(gap @ np.linalg.solve(S, gap) + np.linalg.slogdet(2 * np.pi * S)[1]) / 2


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "rival_lines.py").write_text(LINES)
    (tmp_path / "rivals.toml").write_text(STUDY)
    (tmp_path / "table.csv").write_text("# by hand\noutput,value,sigma\nw,3.1,0.3\nw,2.9,\nu,0.4,0.05\n")
    return tmp_path


def test_linear_models_have_their_exact_evidences(folder, looked_at):
    """Stated in the study or in a table; the report and summary.json name them; nothing is said of meshes."""
    out = folder / "out"
    assert main(["run", str(folder / "rivals.toml"), "--out", str(out), "--quiet"]) == 0
    expected = [log_evidence(ONE, STD), log_evidence(ONE, STD * [1, 0]), log_evidence(OTHER, STD)]
    with stored_dataset(out / "results.nc") as found:
        np.testing.assert_allclose(found["log_evidence"], expected, rtol=1e-9)
        odds = np.exp(np.array(expected) - max(expected))
        np.testing.assert_allclose(found["probability"], odds / odds.sum(), rtol=1e-8)
        assert "mesh_checked" not in found
        assert found["output_test"].values.tolist() == ["w", "w", "u"]
        assert found.attrs["quantity"] == "output"
        # What a candidate takes for granted: one of them holds b = −1, of which 1 % moves a as in closed form.
        alone = found.sel(model="one-alone").isel(group=0)
        B, sigma = ONE[[2, 2, 0]], np.array([0.3, 0.3, 0.05])
        variance = 1 / (STD[0] ** -2 + ((B[:, 0] / sigma) ** 2).sum())
        change = -0.01 * B[:, 1] / sigma**2
        std = float(alone["constant_std"].sel(parameter="a"))
        moved = alone["assumption_shift"].sel(assumption="b", parameter="a")
        np.testing.assert_allclose(moved, -variance * (B[:, 0] @ change) / std, rtol=1e-5)
        residual = B @ [float(alone["constant_mode"].sel(parameter="a")), -1.0] - [3.1, 2.9, 0.4]
        np.testing.assert_allclose(alone["assumption_log_evidence"].sel(assumption="b"), -residual @ change, rtol=1e-5)
        assert np.isnan(found["assumption_shift"].sel(model="one", assumption="b")).all()
    assert set(json.loads((out / "summary.json").read_text())["models"]) == {"one", "one-alone", "other"}
    page = (out / "report.html").read_text()
    assert "one-alone" in page
    assert "b is 1 % larger" in page
    looked_at(out)
    study, table = load(folder / "rivals.toml"), 'data={file="table.csv", sigma={w=0.3}}'
    assert (
        load(folder / "rivals.toml", [table]).data_groups["all"].sigma.tolist()
        == study.data_groups["all"].sigma.tolist()
    )
    assert parse(document(study)) == study
    assert main(["check", str(folder / "rivals.toml")]) == 0


def test_a_number_that_is_uncertain_counts_as_one_that_is_inferred(folder):
    """Marginalised, where the model is linear: a candidate that holds b has the evidence of the one that infers it."""
    (folder / "uncertain.toml").write_text(f"{STUDY}\n[uncertain]\nb = 2.0\n")
    assert main(["run", str(folder / "uncertain.toml"), "--out", str(folder / "out"), "--quiet", "--no-report"]) == 0
    with stored_dataset(folder / "out" / "results.nc") as found:
        by_name = found["log_evidence"]
        np.testing.assert_allclose(by_name.sel(model="one-alone"), log_evidence(ONE, STD), rtol=1e-8)
        np.testing.assert_allclose(by_name.sel(model="one"), log_evidence(ONE, STD), rtol=1e-8)
        modes = found["constant_mode"].isel(group=0).sel(parameter="a")
        np.testing.assert_allclose(modes.sel(model="one-alone"), modes.sel(model="one"), rtol=1e-6)


def test_what_is_too_uncertain_for_first_order_is_sampled(folder):
    """As if it were inferred: evidence, variants and constants are those of the candidate that infers it."""
    scaled = LINES.replace("ONE @ p", "ONE @ p[:2] * np.exp(p[2] - 2)").replace(
        "return ONE\n", "return np.column_stack([ONE, ONE @ p[:2]]) * np.exp(p[2] - 2)\n"
    )
    (folder / "rival_scaled.py").write_text(scaled)
    head, *_ = STUDY.replace("rival_lines", "rival_scaled").partition("[candidates.one-alone]")
    head = head.replace("b = -1.0 }", "b = -1.0, s = 2.0 }")
    one = "[candidates.one]" + head.partition("[candidates.one]")[2]
    known = one.replace("one]", "known]") + 'parameters.s = { kind = "normal", mean = 2.0, std = 0.4 }\n'
    method = STUDY[STUDY.index("[method]") :].replace("samples = 32", "samples = 64")
    more = "other_noises.larger = { absolute = 0.4 }\nsubsets.only = ['w']\n"
    (folder / "scaled.toml").write_text(f"{head}\n{known}\n{method}{more}\n[uncertain]\ns = 0.4\n")
    out = folder / "scaled"
    assert main(["run", str(folder / "scaled.toml"), "--out", str(out), "--quiet", "--no-report"]) == 0
    with stored_dataset(out / "results.nc") as found:
        one, known = (found.sel(model=name, parameter=["a", "b"]).isel(group=0) for name in ("one", "known"))
        close = np.testing.assert_allclose
        close(one["log_evidence"], known["log_evidence"], atol=1e-3)
        close(one["variant_log_evidence"][3:], known["variant_log_evidence"][3:], atol=0.02)  # searched again
        apart = (found["variant_log_evidence"] - found["log_evidence"]).sel(variant=["priors × 0.5", "priors × 2"])
        assert np.abs(apart.sel(model="one") - apart.sel(model="known")).min() > 0.01  # the deviation of s is stated
        for name in ("constant_mode", "constant_mean", "constant_std", "constant_quantiles"):
            close(one[name], known[name], rtol=2e-3, err_msg=name)
        assert "s" in found.parameter  # of the other candidate
        assert np.isnan(found["constant_mean"].sel(model="one", parameter="s")).all()
        assert found["uncertain_sampled"].sel(model="one").item() == 1
    summary = json.loads((out / "summary.json").read_text())
    assert not any(one["code"] == "uncertain-bent" for one in summary["findings"])


def test_a_candidate_with_a_wrong_jacobian_is_named(folder):
    wrong = LINES.replace("return OTHER\n", "return OTHER * np.array([1.0, 0.9])\n")
    (folder / "rival_wrong.py").write_text(wrong)
    (folder / "wrong.toml").write_text(STUDY.replace("rival_lines", "rival_wrong"))
    assert main(["run", str(folder / "wrong.toml"), "--out", str(folder / "wrong"), "--quiet", "--no-report"]) == 3
    summary = json.loads((folder / "wrong" / "summary.json").read_text())
    errors = [one["text"] for one in summary["findings"] if one["severity"] == "error"]
    assert [text for text in errors if text.startswith("Candidate 'other': ") and "by b 10 % off" in text]
    assert not any("Candidate 'one" in text for text in errors)
    assert [name for name, one in summary["models"].items() if not one["trusted"]] == ["other"]


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("outputs = { w", "outputs = { q = 1.0, w", "data: outputs.q: not an output of the model"),
        ("sigma = { u = 0.05, w = 0.3 }", "", "neither absolute nor relative noise, and no sigma"),
        ("parameters.b = {", "parameters.q = {", "not a number of the model"),
        ("outputs = { w = [3.1, 2.9], u = 0.4 }", "", "expected either a file or outputs"),
    ],
)
def test_mistakes_have_their_places(folder, old, new, told):
    (folder / "bad.toml").write_text(STUDY.replace(old, new, 1))
    with pytest.raises(StudyError) as error:
        load(folder / "bad.toml")
    assert told in str(error.value)


def test_derivatives_of_what_is_measured():
    """Of some outputs, of one of them twice: those of the model."""
    A = np.arange(6.0).reshape(3, 2)
    model = selected(FunctionModel(lambda p: A @ p**2, ("a", "b"), ("u", "v", "w"), lambda p: 2 * A * p), (2, 0, 2))
    assert model.outputs == ("w.0", "u", "w.1")
    check_derivatives(model, np.array([0.5, 1.5]), np.ones(2))
    solution = model.solve(np.array([0.5, 1.5]))
    weights = np.array([[1.0, 2.0, 3.0], [0.0, 1.0, 0.0]])
    np.testing.assert_allclose(solution.adjoint(weights), weights @ (2 * A * [0.5, 1.5])[[2, 0, 2]])


BARS = """
[model]
body = { size = [1.0, 1.0, 1.0], cells = [2, 1, 1], degree = 1 }
material = { kind = "neo-hookean-coupled", mu = 1e4, lmbda = 4e4 }
clamp = ["x-min"]
loads = [{ kind = "traction", on = "x-max", direction = [1, 0, 0], size = 900 }]
outputs = [{ name = "ux", kind = "max-displacement", component = "x" }]

[data]
outputs = { ux = 0.03 }

[candidates.coarse]
parameters."material.mu" = { kind = "log-normal", mean = 1e4, std = 3e3 }

[candidates.long]
model.body = { cells = [3, 1, 1] }
parameters."material.mu" = { kind = "log-normal", mean = 1e4, std = 3e3 }

[method]
kind = "select"
samples = 32
starts = 1
noise = { relative = 0.05 }
"""


def test_a_material_is_short_for_that_of_the_model():
    material = 'material = { kind = "neo-hookean", C1 = 5e3, D1 = 2e4 }\nparameters."material.C1"'
    text = BARS.replace('parameters."material.mu"', material, 1)
    short, long = (parse(tomllib.loads(one)) for one in (text, text.replace(material, f"model.{material}")))
    assert short.of_candidates == long.of_candidates
    assert short.of_candidates["coarse"].energy == "neo-hookean"
    assert parse(document(short)) == short


def test_outputs_that_follow_single_cells_are_named(tmp_path):
    text = BARS.replace("outputs = [", 'outputs = [{ name = "peak", kind = "max-von-mises" }, ', 1)
    (tmp_path / "bars.toml").write_text(text)
    assert not any("peak" in one.text for one in load(tmp_path / "bars.toml").findings)
    (tmp_path / "bars.toml").write_text(text.replace("outputs = { ", "outputs = { peak = 2e3, "))
    (finding,) = (one for one in load(tmp_path / "bars.toml").findings if "peak" in one.text)
    assert finding.severity == "warning"
    assert finding.text.startswith("What the mesh does to peak is not known")


@pytest.mark.fem
@pytest.mark.slow
def test_bodies_are_looked_at_on_finer_meshes(tmp_path):
    (tmp_path / "bars.toml").write_text(BARS)
    assert main(["run", str(tmp_path / "bars.toml"), "--out", str(tmp_path / "out"), "--quiet", "--no-report"]) in (
        0,
        3,
    )
    with stored_dataset(tmp_path / "out" / "results.nc") as found:
        assert found["mesh_checked"].to_numpy().all()
        assert np.isfinite(found["mesh_log_evidence"]).all()
        np.testing.assert_allclose(found["prediction_mean"], 0.03, rtol=0.05)


@pytest.mark.slow
@pytest.mark.fem
def test_a_shipped_curve_of_force_compares_materials(tmp_path):
    """Two of the four: the error of their meshes is corrected, both explain the curve, and neither is ruled out."""
    text = (CONFIGS / "indentation-material.toml").read_text(encoding="utf-8")
    first, last = (text.index(f"[candidates.{name}]") for name in ("mooney-rivlin", "demiray"))
    text = (text[:first] + text[last:]).replace("data/", f"{CONFIGS}/data/")
    (tmp_path / "study.toml").write_text(text)
    assert main(["run", str(tmp_path / "study.toml"), "--out", str(tmp_path / "out"), "--quiet", "--no-report"]) == 0
    found = stored_dataset(tmp_path / "out" / "results.nc")
    assert found["trusted"].all()
    assert found["mesh_corrected"].any()
    assert (found["misfit_probability"] > 0.05).all()
    assert abs(float(np.diff(found["log_evidence"])[0])) < 3
    C1, a = (found["constant_mean"].sel(parameter=f"material.{name}").max() for name in ("C1", "a"))
    assert [2 * float(C1), float(a)] == pytest.approx([1600, 1600], rel=0.08)  # stiffness at rest
