"""Draws as inputs: of posteriors that `select` and `invert` have left, and of tables of other programs."""

import json
import math
import shutil
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr

from forward.pointwise import FunctionModel
from tests.launch import TISSUQ, environment, in_process, tissuq_on_two_ranks
from uq.estimators.averaged import average
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.hdf5 import netcdf
from uq.inputs.draws import Draws, effective
from uq.inputs.random_parameters import Inputs
from uq.methods.monte_carlo import MonteCarlo
from workflows.config.mistakes import StudyError
from workflows.config.study import document, load, parse, schema
from workflows.report.page import write_report
from workflows.run.run import run

MODULE = """
import math
def value(p):
    a, b, c = p
    return [a + 2 * b + c, a * math.exp(b)]
def slopes(p):
    a, b, c = p
    return [[1.0, 2.0, 1.0], [math.exp(b), a * math.exp(b), 0.0]]
"""
STUDY = """
[model]
kind = "python"
function = "drawn_model.value"
jacobian = "drawn_model.slopes"
parameters = {{ a = 1.0, b = 0.5, c = 0.0 }}
outputs = [{{ name = "sum", unit = "m" }}, {{ name = "other", unit = "m" }}]

[parameters]
{parameters}

[method]
{method}
"""
NUMBERS = np.column_stack(
    [1 + 0.1 * np.random.default_rng(0).standard_normal(300), 0.5 + 0.1 * np.random.default_rng(1).standard_normal(300)]
)
NUMBERS[:, 1] += 0.8 * (NUMBERS[:, 0] - 1)


def table(path, values=NUMBERS, head="a,b", **more):
    columns = [*values.T, *more.values()]
    rows = [",".join(repr(float(x)) for x in row) for row in zip(*columns, strict=True)]
    path.write_text("\n".join([",".join([head, *more]), *rows]) + "\n")
    return path


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "drawn_model", raising=False)
    (tmp_path / "drawn_model.py").write_text(MODULE)
    table(tmp_path / "draws.csv")
    return tmp_path


def study(folder, parameters='from = "draws.csv"', method='kind = "monte-carlo"\nsamples = 300'):
    path = folder / "study.toml"
    path.write_text(STUDY.format(parameters=parameters, method=method))
    return path


def mistake(path):
    with pytest.raises(StudyError) as error:
        load(path)
    assert len(error.value.args) == 1, error.value.args
    return error.value.args[0]


def test_draws_give_the_moments_of_a_loop_over_them_with_any_ranks(folder):
    path = study(folder, 'from = "draws.csv"\nc = { kind = "normal", mean = 0, std = 0.1 }')
    files = []
    for ranks, tissuq in ((1, in_process), (2, tissuq_on_two_ranks)):
        out = folder / f"out-{ranks}"
        done = tissuq("run", path, "--out", out, "--no-report", "--quiet")
        assert done.returncode == 0, done.stderr
        files.append((out / "results.nc").read_bytes())
    assert files[0] == files[1]
    found = xr.load_dataset(folder / "out-1" / "results.nc")
    assert found.parameter.values.tolist() == ["c", "a", "b"]
    points = found["points"].to_numpy()
    assert np.array_equal(points[np.argsort(points[:, 1]), 1:], NUMBERS[np.argsort(NUMBERS[:, 0])])  # each once
    inputs = Inputs(dict(load(path).parameters), draws=Draws(("a", "b"), NUMBERS, np.full(300, 1 / 300), 300.0))
    model = FunctionModel(lambda p: [p[1] + 2 * p[2] + p[0], p[1] * math.exp(p[2])], ("c", "a", "b"), ("sum", "other"))
    alone = MonteCarlo(samples=300).run(inputs, SerialEvaluate(model))
    for name in ("mean", "std", "mean_error", "quantiles"):
        assert np.array_equal(found[name], alone[name]), name
    a, b, c = points[:, 1], points[:, 2], points[:, 0]
    np.testing.assert_allclose(found["mean"], [np.mean(a + 2 * b + c), np.mean(a * np.exp(b))], rtol=1e-14)


@pytest.mark.slow
def test_a_study_reads_itself_without_its_source(folder, looked_at):
    path = study(folder)
    made = load(path)
    blocks = document(made)
    assert blocks["parameters"]["from"]["digest"] == made.source.digest
    assert parse(blocks) == made
    assert run(made, "study", folder / "out", quiet=True) == 0
    (folder / "draws.csv").unlink()
    again = load(folder / "out" / "study.toml")
    assert np.array_equal(again.draws.values, NUMBERS)
    assert run(again, "study", folder / "out", quiet=True) == 0
    (folder / "out" / "report.html").unlink()
    write_report(folder / "out")
    page = (folder / "out" / "report.html").read_text()
    looked_at(folder / "out")
    assert "draws" in page
    assert made.source.digest in page


def test_other_draws_do_not_continue_a_study(folder, capsys):
    path = study(folder)
    assert run(load(path), "study", folder / "out", quiet=True, report=False) == 0
    (folder / "out" / "summary.json").unlink()  # as if it had been interrupted
    shutil.copy(folder / "draws.csv", folder / "moved.csv")
    study(folder, 'from = "moved.csv"')
    assert run(load(path), "study", folder / "out", quiet=True, report=False) == 0
    (folder / "out" / "summary.json").unlink()
    table(folder / "draws.csv", NUMBERS + 1e-9)
    with pytest.raises(StudyError, match=r"holds another study \(parameters\.from\.digest: "):
        run(load(study(folder)), "study", folder / "out", quiet=True, report=False)
    blocks = document(load(path))
    table(folder / "draws.csv", NUMBERS + 1e-8)
    with pytest.raises(StudyError, match=r"^parameters\.from: .*draws\.csv has changed since the study was begun"):
        parse(blocks)


def test_a_killed_study_goes_on(folder, monkeypatch):
    path = study(folder, method='kind = "chaos"\nsamples = 40')
    whole, cut = folder / "whole", folder / "cut"
    arguments = ["run", path, "--no-report", "--quiet", "--out"]
    assert in_process(*arguments, whole).returncode == 0
    monkeypatch.delitem(sys.modules, "drawn_model")
    (folder / "drawn_model.py").write_text(
        MODULE + "import os, itertools\ncount, known = itertools.count(), value\n"
        "def value(p):\n    if next(count) > 20 and os.environ.get('KILL'): os._exit(9)\n    return known(p)\n"
    )
    command = list(map(str, [TISSUQ, *arguments, cut]))
    killed = subprocess.run(command, env=environment() | {"KILL": "1"}, capture_output=True, check=False)
    assert killed.returncode == 9
    assert not (cut / "results.nc").exists()
    done = in_process(*arguments, cut)
    assert done.returncode == 0, done.stderr
    assert (cut / "results.nc").read_bytes() == (whole / "results.nc").read_bytes()


@pytest.mark.parametrize("kind", ["arviz", "plain netCDF", "classic netCDF", "weights", "log weights", "Stan"])
def test_tables_of_other_programs(folder, kind):
    a, b = NUMBERS.T
    weights = np.random.default_rng(2).random(300)
    name = "t.nc" if "CDF" in kind or kind == "arviz" else "t.csv"
    if kind == "arviz":
        dims = ("chain", "draw")
        columns = {"a": (dims, a.reshape(3, 100)), "b": (dims, b.reshape(3, 100))}
        posterior = xr.Dataset(columns, {"chain": np.arange(3), "draw": np.arange(100)})
        (folder / name).write_bytes(netcdf(xr.Dataset(), {"posterior": posterior, "sample_stats": posterior * 2}))
    elif kind == "plain netCDF":
        (folder / name).write_bytes(netcdf(xr.Dataset({"a": ("draw", a), "b": ("draw", b)})))
    elif kind == "classic netCDF":
        xr.Dataset({"a": ("draw", a), "b": ("draw", b)}).to_netcdf(folder / name, engine="scipy")
    elif kind == "Stan":
        table(folder / name, head="a,b", lp__=a, accept_stat__=b)
    else:
        log = kind == "log weights"
        table(folder / name, head="a,b", **{"log_weight" if log else "weight": np.log(weights) + 7 if log else weights})
    found = load(study(folder, f'from = "{name}"')).draws
    assert found.names == ("a", "b")
    assert np.array_equal(found.values, NUMBERS)
    right = weights / weights.sum() if "weights" in kind else np.full(300, 1 / 300)
    np.testing.assert_allclose(found.weights, right, rtol=1e-12)
    assert found.effective == pytest.approx(1 / (right**2).sum(), rel=0.5 if kind == "Stan" else 1e-9)


def test_names_are_mapped(folder):
    table(folder / "t.csv", head="first,second", third=NUMBERS[:, 0] ** 2)
    path = study(folder, 'from = { file = "t.csv", names = { b = "first", c = "third" } }')
    found = load(path)
    assert found.draws.names == ("b", "c")
    assert np.array_equal(found.draws.values, np.column_stack([NUMBERS[:, 0], NUMBERS[:, 0] ** 2]))


def test_names_are_the_ends_of_paths(folder):
    table(folder / "t.csv", NUMBERS * [1000, 1000], head="C1,C2")
    blocks = BODY | {"parameters": {"from": str(folder / "t.csv")}}
    assert parse(blocks).draws.names == ("material.C1", "material.C2")


BODY = {
    "model": {
        "body": {"kind": "box", "size": [0.1, 0.1, 0.1], "cells": [1, 1, 1], "cell": "hexahedron", "degree": 2},
        "material": {"kind": "mooney-rivlin", "C1": 1000.0, "C2": 500.0, "D1": 1e4},
        "clamp": ["z-min"],
        "loads": [{"kind": "traction", "on": "z-max", "direction": [0, 0, 1], "size": 10.0}],
        "outputs": [{"name": "up", "kind": "max-displacement", "component": "z"}],
    },
    "method": {"kind": "monte-carlo", "samples": 4},
}


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ('from = "nowhere"', "parameters.from: FOLDER/nowhere: is not there, expected a results directory"),
        ("from = 3", "parameters.from: "),
        ('from = { file = "draws.csv", colour = 1 }', "parameters.from.colour: unknown key"),
        ('from = { file = "draws.csv", group = "x" }', "which has no groups"),
        (
            'from = { file = "draws.csv", names = { z = "a" } }',
            "parameters.from.names: 'z' is not a number of the model",
        ),
        ('from = { file = "draws.csv", names = { a = "z" } }', "parameters.from.names: 'z' is not in "),
        (
            'from = "draws.csv"\na = { kind = "normal", mean = 0, std = 1 }',
            "parameters.a: has a distribution, and is in",
        ),
        ('from = "empty.csv"', "empty.csv: empty"),
        ('from = "words.csv"', "words.csv: line 3: 'x' in column 'b', expected a number"),
        ('from = "nan.csv"', "nan.csv: draw 2 of 'b' is nan"),
        ('from = "other.csv"', "'alpha' of FOLDER/other.csv is not a number of the model; "),
        ('from = "constant.csv"', "'b' is 2 in all draws, expected a fixed number in the model"),
        ('from = "few.csv"', "holds 2 different draws of 2 parameters"),
        ('from = "dependent.csv"', "depend linearly on each other"),
        ('from = "weights.csv"', "weights.csv: weights are negative"),
        ('from = "no.nc"', "no.nc: is no netCDF file"),
        ('from = "unfinished"', "unfinished: holds an unfinished study"),
        ('from = "forward"', "forward: is a study of kind 'monte-carlo', which has no posterior"),
    ],
)
def test_sources_that_cannot_be_used(folder, parameters, said):
    a = NUMBERS[:, 0]
    (folder / "empty.csv").write_text("")
    (folder / "words.csv").write_text("a,b\n1,2\n2,x\n")
    (folder / "nan.csv").write_text("a,b\n1,2\n2,nan\n3,4\n5,5\n")
    table(folder / "other.csv", head="alpha,b")
    table(folder / "constant.csv", np.column_stack([a, 2 + 0 * a]))
    table(folder / "few.csv", np.repeat(NUMBERS[:2], 5, axis=0))
    table(folder / "dependent.csv", np.column_stack([a, 3 - a]))
    table(folder / "weights.csv", weight=-np.ones(300))
    (folder / "no.nc").write_bytes(b"not a netCDF file")
    for name in ("unfinished", "forward"):
        (folder / name).mkdir()
        (folder / name / "study.toml").write_text("")
    (folder / "forward" / "summary.json").write_text('{"method": "monte-carlo"}')
    line = mistake(study(folder, parameters))
    assert said.replace("FOLDER", str(folder)) in line
    assert line.startswith("parameters.")


def test_correlations_with_draws_are_refused(folder):
    path = study(folder, 'from = "draws.csv"\nc = { kind = "normal", mean = 0, std = 0.1 }')
    path.write_text('correlations = [{ between = ["a", "c"], value = 0.5 }]\n' + path.read_text())
    assert "of which there are draws" in mistake(path)


def test_what_draws_are_worth_is_said(folder):
    weights = np.where(np.arange(300) < 20, 1.0, 1e-6)
    table(folder / "draws.csv", weight=weights)
    texts = [finding.text for finding in load(study(folder)).findings]
    assert len(texts) == 1
    assert "The 300 draws of a, b are worth 20 independent ones" in texts[0]


def test_autocorrelated_draws_are_worth_less():
    rng = np.random.default_rng(3)
    x = np.zeros(20_000)
    for i in range(1, x.size):
        x[i] = 0.9 * x[i - 1] + rng.standard_normal()
    assert effective(x) == pytest.approx(x.size * 0.1 / 1.9, rel=0.2)
    assert effective(x[rng.permutation(x.size)]) == pytest.approx(x.size, rel=0.05)
    chains = np.repeat(np.arange(4), 5000)
    assert effective(x, chains) == pytest.approx(x.size * 0.1 / 1.9, rel=0.2)


def test_draws_outside_the_admissible_range(folder):
    values = NUMBERS * [1000, 1000]
    values[:30] *= -1
    table(folder / "t.csv", values, head="C1,C2")
    blocks = BODY | {"parameters": {"from": str(folder / "t.csv")}}
    texts = [finding.text for finding in parse(blocks).findings]
    assert any("10 % of the samples are of materials that are not stable at rest" in text for text in texts), texts
    table(folder / "t.csv", -values, head="C1,C2")
    with pytest.raises(StudyError, match="90 % of the values are impossible"):
        parse(blocks)
    sizes = np.abs(NUMBERS[:, :1]) * 10
    sizes[:3] = -1
    table(folder / "s.csv", sizes, head="nu")
    blocks = json.loads(json.dumps(BODY)) | {"parameters": {"from": str(folder / "s.csv")}}
    blocks["parameters"]["from"] = {"file": str(folder / "s.csv"), "names": {"loads.traction.size": "nu"}}
    assert parse(blocks).draws.names == ("loads.traction.size",)


def test_a_schema_knows_draws():
    parameters = schema()["$defs"]["Study"]["properties"]["parameters"]
    assert "from" in parameters["properties"]
    assert "source" not in schema()["$defs"]["Study"]["properties"]


# --- of studies that have found a posterior ---------------------------------------------------------------------------

STRETCH = np.linspace(1.05, 1.5, 10)
SLOPE = 2 * (STRETCH - STRETCH**-2)  # of the nominal stress of an incompressible neo-Hookean material, by C1
PRIOR, NOISE, TRUTH = (1000.0, 400.0), 150.0, 1300.0
SELECT = """
[data]
file = "curve.csv"
at = "stretch"
measured = "stress"
group = "specimen"
[candidates.neo-hookean]
material = {{ kind = "neo-hookean" }}
parameters.C1 = {{ kind = "normal", mean = {0[0]}, std = {0[1]} }}
[candidates.mooney-rivlin]
material = {{ kind = "mooney-rivlin" }}
parameters.C1 = {{ kind = "normal", mean = {0[0]}, std = {0[1]} }}
parameters.C2 = {{ kind = "normal", mean = 0, std = {0[1]} }}
[method]
kind = "select"
samples = 64
starts = 1
noise = {{ absolute = {1} }}
"""


@pytest.fixture(scope="module")
def selected(tmp_path_factory):
    """Results of `select` for two specimens, whose posteriors are normal, and their data."""
    folder = tmp_path_factory.mktemp("selected")
    rng = np.random.default_rng(5)
    data = {name: SLOPE * TRUTH + NOISE * rng.standard_normal(SLOPE.size) for name in ("one", "two")}
    rows = [f"uniaxial,{name},{x},{y}" for name, stress in data.items() for x, y in zip(STRETCH, stress, strict=True)]
    (folder / "curve.csv").write_text("\n".join(["mode,specimen,stretch,stress", *rows]))
    (folder / "select.toml").write_text(SELECT.format(PRIOR, NOISE))
    assert run(load(folder / "select.toml"), "select", folder / "results", quiet=True, report=False) in (0, 3)
    return folder, data


def chain(folder, source, method):
    """The study that predicts with a posterior."""
    (folder / "drawn_model.py").write_text("def value(p):\n    return [3 * p[0] + 7, p[1] - p[0]]\n")
    text = f"""
[model]
kind = "python"
function = "drawn_model.value"
parameters = {{ C1 = 1.0, C2 = 0.0, other = 1.0 }}
outputs = [{{ name = "up", unit = "m" }}, {{ name = "between", unit = "m" }}]
[parameters]
from = {source}
[method]
{method}
"""
    (folder / "chain.toml").write_text(text)
    return load(folder / "chain.toml")


@pytest.mark.parametrize(
    "method", ['kind = "monte-carlo"\nsamples = 400', 'kind = "chaos"\nsamples = 20\nquantiles = []']
)
def test_a_linear_normal_chain_equals_the_closed_form(selected, tmp_path, monkeypatch, method):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "drawn_model", raising=False)
    folder, data = selected
    source = f'{{ file = "{folder / "results"}", group = "two", model = "neo-hookean" }}'
    study = chain(tmp_path, source, method)
    assert study.draws.names == ("C1",)
    precision = 1 / PRIOR[1] ** 2 + SLOPE @ SLOPE / NOISE**2
    mean = (PRIOR[0] / PRIOR[1] ** 2 + SLOPE @ data["two"] / NOISE**2) / precision
    found = study.run()
    for name, right in (("mean", 3 * mean + 7), ("std", 3 / np.sqrt(precision))):
        error = float(found[f"{name}_error"][0])
        assert abs(float(found[name][0]) - right) < 4 * error
        assert error < 0.3 * 3 / np.sqrt(precision)


def test_the_best_candidate_is_taken(selected, tmp_path):
    folder, _ = selected
    source = f'{{ file = "{folder / "results"}", group = "one", model = "best", names = {{ C1 = "C1" }} }}'
    with xr.open_dataset(folder / "results" / "results.nc") as found:
        best = str(found.model[int(found["probability"].argmax())].item())
        assert best == "neo-hookean"
        weights = found["point_weight"].sel(model=best, group="one").to_numpy()
        points = found["point"].sel(model=best, group="one", parameter="C1").to_numpy()
    draws = chain(tmp_path, source, 'kind = "monte-carlo"\nsamples = 4').draws
    assert float(draws.weights @ draws.values[:, 0]) == pytest.approx(np.nansum(weights * points) / np.nansum(weights))


@pytest.mark.parametrize(
    ("block", "said"),
    [
        ('model = "best"', "has several groups, expected group = one of: one, two"),
        ('group = "one"', "has several models, expected model = one of: neo-hookean, mooney-rivlin"),
        ('group = "on", model = "best"', "group = 'on' is not in"),
        ('group = "one", model = "mooney"', "model = 'mooney' is not in"),
    ],
)
def test_what_a_comparison_does_not_hold(selected, tmp_path, block, said):
    folder, _ = selected
    with pytest.raises(StudyError) as error:
        chain(tmp_path, f'{{ file = "{folder / "results"}", {block} }}', 'kind = "monte-carlo"\nsamples = 4')
    assert len(error.value.args) == 1
    assert error.value.args[0].startswith("parameters.from: ")
    assert said in error.value.args[0]


def test_constants_of_another_material_are_refused(selected):
    folder, _ = selected
    source = {"file": str(folder / "results"), "group": "one", "model": "neo-hookean"}
    with pytest.raises(StudyError, match=r"^model\.material\.kind: constants are of the material 'neo-hookean' in"):
        parse(BODY | {"parameters": {"from": source}})
    named = source | {"names": {"material.C1": "C1"}}
    assert parse(BODY | {"parameters": {"from": named}}).draws.names == ("material.C1",)


INVERT = """
[model]
kind = "python"
function = "drawn_model.value"
jacobian = "drawn_model.slopes"
parameters = { a = 1.0, b = -1.0 }
outputs = [{ name = "u", unit = "m" }, "v"]
[parameters]
a = { kind = "normal", mean = 1.0, std = 0.5 }
b = { kind = "normal", mean = -1.0, std = 2.0 }
[data]
outputs = { u = 0.4, v = 0.3 }
noise = { absolute = 0.3 }
[method]
kind = "invert"
samples = 64
starts = 1
draws = 800
"""


def test_draws_of_an_inversion_keep_their_dependence(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "drawn_model", raising=False)
    (tmp_path / "drawn_model.py").write_text(
        "def value(p):\n    return [p[0] + 2 * p[1], p[0] / 2 - p[1]]\n"
        "def slopes(p):\n    return [[1.0, 2.0], [0.5, -1.0]]\n"
        "def other(p):\n    return [p[0] + p[1], p[0] - p[1]]\n"
    )
    (tmp_path / "invert.toml").write_text(INVERT)
    assert run(load(tmp_path / "invert.toml"), "invert", tmp_path / "posterior", quiet=True, report=False) == 0
    predict = INVERT.replace(".value", ".other").replace('jacobian = "drawn_model.slopes"', "").split("[parameters]")[0]
    (tmp_path / "predict.toml").write_text(
        predict
        + '[parameters]\nfrom = "posterior"\n[method]\nkind = "quasi-monte-carlo"\ncontrol = "none"\nsamples = 512\n'
    )
    study = load(tmp_path / "predict.toml")
    assert study.draws.names == ("a", "b")
    assert study.draws.effective <= 800
    found = study.run()
    A, C = np.array([[1, 2], [0.5, -1]]), np.array([[1, 1], [1, -1]])
    covariance = np.linalg.inv(np.diag([4.0, 0.25]) + A.T @ A / 0.09)
    mean = covariance @ (A.T @ [0.4, 0.3] / 0.09 + [4.0, -0.25])
    for name, right in (("mean", C @ mean), ("std", np.sqrt(np.diag(C @ covariance @ C.T)))):
        assert (np.abs(found[name] - right) < 4 * found[f"{name}_error"]).all(), (found[name], right)
        assert (found[f"{name}_error"] < 0.2 * np.sqrt(np.diag(C @ covariance @ C.T))).all()
    for block, said in (
        ('group = "x"', "group = 'x' is not in"),
        ('model = "best"', "is an inversion, which has one model"),
    ):
        text = (
            (tmp_path / "predict.toml")
            .read_text()
            .replace('from = "posterior"', f'from = {{ file = "posterior", {block} }}')
        )
        (tmp_path / "other.toml").write_text(text)
        assert said in mistake(tmp_path / "other.toml")


def test_draws_know_how_what_was_uncertain_errs_with_them(tmp_path, monkeypatch):
    """By name: else they are of the parameters alone, which is said. A linear chain, as if all were unknown."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "drawn_model", raising=False)
    (tmp_path / "drawn_model.py").write_text(
        "def value(p):\n    return [p[0] + 2 * p[1] + p[2], p[0] / 2 - p[1] + p[3]]\n"
        "def slopes(p):\n    return [[1.0, 2.0, 1.0, 0.0], [0.5, -1.0, 0.0, 1.0]]\n"
        "def other(p):\n    return [p[0] + p[1] + p[2] + p[3]]\n"
    )
    more = INVERT.replace("b = -1.0 }", "b = -1.0, s = 1.0, t = 2.0 }")
    stated = '[uncertain]\ns = { std = 0.5, group = "both" }\nt = { relative = 0.1, group = "both" }\n'
    (tmp_path / "invert.toml").write_text(more + stated)
    assert run(load(tmp_path / "invert.toml"), "invert", tmp_path / "posterior", quiet=True, report=False) in (0, 3)
    predict = more.replace(".value", ".other").replace('jacobian = "drawn_model.slopes"', "").split("[parameters]")[0]
    predict = predict.replace('outputs = [{ name = "u", unit = "m" }, "v"]', 'outputs = ["w"]')
    method = '[method]\nkind = "quasi-monte-carlo"\ncontrol = "none"\nsamples = 512\n'
    block = '[parameters]\nfrom = { file = "posterior", names = { a = "a", b = "b", s = "uncertain.s" } }\n'
    (tmp_path / "predict.toml").write_text(predict + block + method)
    study = load(tmp_path / "predict.toml")
    assert study.draws.names == ("a", "b", "s")
    assert study.draws.effective <= 800
    found = study.run()
    rows, prior = np.array([[1, 2, 0.5], [0.5, -1, 0.2]]), np.diag([0.25, 4.0, 1.0])
    gain = prior @ rows.T @ np.linalg.inv(rows @ prior @ rows.T + 0.09 * np.eye(2))
    covariance, goal = prior - gain @ rows @ prior, np.array([1, 1, 0.5])
    mean = np.array([1, -1, 0]) + gain @ (np.array([0.4, 0.3]) - rows @ [1, -1, 0] - [1, 2])
    std = np.sqrt(goal @ covariance @ goal)
    assert abs(float(found["std"][0]) - std) < 4 * float(found["std_error"][0]) < 0.4 * std
    assert abs(float(found["mean"][0]) - (goal @ mean + 3)) < 4 * float(found["mean_error"][0])
    plain = load_with(tmp_path, predict + '[parameters]\nfrom = "posterior"\n' + method)
    assert plain.draws.names == ("a", "b")
    (said,) = (one for one in plain.findings if one.code == "uncertain-in-source")
    assert "what was uncertain beside them, s, t, is as stated here" in said.text


def load_with(folder, text):
    (folder / "changed.toml").write_text(text)
    return load(folder / "changed.toml")


# --- populations ------------------------------------------------------------------------------------------------------


def population(folder, source, more=""):
    path = folder / "population.toml"
    path.write_text(f'[method]\nkind = "population"\nsource = "{source}"\ndraws = 2000\n{more}\n')
    return path


def test_a_population_is_an_input_too(selected, tmp_path, monkeypatch, undrawn):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "drawn_model", raising=False)
    folder, _ = selected
    study = load(population(tmp_path, folder / "results", 'model = "neo-hookean"'))
    assert parse(document(study)) == study
    assert run(study, "population", tmp_path / "population", quiet=True) == 0
    found = xr.load_dataset(tmp_path / "population" / "results.nc")
    assert found["specimen"].values.tolist() == ["one", "two"]
    assert (found["specimen_std"] <= 1.1 * found["own_std"]).all()
    summary = json.loads((tmp_path / "population" / "summary.json").read_text())
    assert summary["specimens"] == ["one", "two"]
    assert any("2 specimens say little on how wide" in one["text"] for one in summary["findings"])
    assert "new specimen" in (tmp_path / "population" / "report.html").read_text()
    for block, name in (("", "population_draw"), (', group = "two"', "specimen_draw")):
        draws = chain(tmp_path, f'{{ file = "population"{block} }}', 'kind = "monte-carlo"\nsamples = 4').draws
        assert draws.names == ("C1",)
        right = found[name] if not block else found[name].sel(specimen="two")
        assert np.array_equal(draws.values, right.to_numpy())
    again = run(study, "population", tmp_path / "again", quiet=True, report=False)
    assert again == 0
    files = [(tmp_path / name / "results.nc").read_bytes() for name in ("population", "again")]
    assert files[0] == files[1]


@pytest.mark.slow
def test_a_batch_of_inversions_is_a_population(tmp_path, monkeypatch, undrawn):
    """Five specimens, whose grade moves one of their numbers; mistakes in covariates are one line each."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "drawn_model", raising=False)
    (tmp_path / "drawn_model.py").write_text(
        "def value(p):\n    return [p[0] + 2 * p[1], p[0] / 2 - p[1]]\n"
        "def slopes(p):\n    return [[1.0, 2.0], [0.5, -1.0]]\n"
    )
    (tmp_path / "data").mkdir()
    truth = {f"s{k}": (1 + 0.2 * k, -1.0 + 0.01 * k) for k in range(5)}
    for name, (a, b) in truth.items():
        text = f"output,value,sigma\nu,{a + 2 * b},0.02\nv,{a / 2 - b},0.02\n"
        (tmp_path / "data" / f"{name}.csv").write_text(text)
    stated = "outputs = { u = 0.4, v = 0.3 }\nnoise = { absolute = 0.3 }"
    (tmp_path / "invert.toml").write_text(INVERT.replace(stated, 'files = ["data"]'))
    assert run(load(tmp_path / "invert.toml"), "invert", tmp_path / "batch", quiet=True, report=False) == 0
    grades = ", ".join(f"s{k} = {k + 1}" for k in range(5))
    more = f'distribution = "normal"\ncovariates.grade = {{ {grades} }}\nnew = {{ grade = 7 }}'
    study = load(population(tmp_path, tmp_path / "batch", more))
    assert parse(document(study)) == study
    assert run(study, "population", tmp_path / "population", quiet=True) == 0
    found = xr.load_dataset(tmp_path / "population" / "results.nc")
    assert found["specimen"].values.tolist() == list(truth)
    np.testing.assert_allclose(found["own_mean"], list(truth.values()), atol=0.02)
    slope = found["slope"].sel(covariate="grade", parameter="a").to_numpy()
    assert slope.mean() == pytest.approx(0.2, abs=0.03)
    assert float(found["typical_quantiles"].sel(parameter="a")[1]) == pytest.approx(2.2, abs=0.15)
    assert "How means change" in (tmp_path / "population" / "report.html").read_text()
    for wrong, said in (
        ("covariates.grade = { s0 = 1 }", "nothing is said of s1, s2, s3, s4"),
        (f"covariates.grade = {{ {grades}, s7 = 1 }}", "'s7' is not a specimen"),
        ("new = { grade = 1 }", "'grade' is not a covariate"),
    ):
        line = mistake(population(tmp_path, tmp_path / "batch", f'distribution = "normal"\n{wrong}'))
        assert said in line


@pytest.mark.parametrize(
    ("source", "more", "said"),
    [
        ("nowhere", "", "is not there, expected the directory of a finished study"),
        ("RESULTS", "", "has several models, expected model = one of"),
        (
            "RESULTS",
            'model = "mooney-rivlin"',
            "'C2' has draws of both signs, or zero: expected distribution = 'normal'",
        ),
        ("draws.csv", "", "expected the directory of a finished study"),
    ],
)
def test_populations_that_cannot_be(selected, tmp_path, source, more, said):
    folder, _ = selected
    table(tmp_path / "draws.csv")
    line = mistake(population(tmp_path, source.replace("RESULTS", str(folder / "results")), more))
    assert line.startswith("method.source: ")
    assert said in line


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda one: (one / "results.nc").write_bytes((one / "results.nc").read_bytes()[:9000]), "missing or damaged"),
        (
            lambda one: (one / "results.nc").unlink(),
            "results.nc: missing or damaged, expected that of a finished study",
        ),
        (lambda one: (one / "summary.json").write_text("[]"), "expected the directory of a finished study"),
        (lambda one: (one / "summary.json").unlink(), "holds an unfinished study"),
    ],
)
def test_damaged_sources_are_one_line(selected, tmp_path, damage, said):
    """Of a population, of draws, and of averages over candidates."""
    shutil.copytree(selected[0] / "results", tmp_path / "hurt")
    damage(tmp_path / "hurt")
    assert said in mistake(population(tmp_path, tmp_path / "hurt", 'model = "neo-hookean"'))
    for model in ("neo-hookean", "averaged"):
        source = {"file": str(tmp_path / "hurt"), "group": "one", "model": model}
        with pytest.raises(StudyError) as error:
            parse(BODY | {"parameters": {"from": source}})
        assert len(error.value.args) == 1
        assert said in error.value.args[0]


def test_a_source_may_be_named_by_its_file(selected, tmp_path):
    more = 'model = "neo-hookean"'
    one, other = (load(population(tmp_path, selected[0] / name, more)) for name in ("results", "results/results.nc"))
    assert one.method.digest == other.method.digest
    line = mistake(population(tmp_path, selected[0] / "results", f'{more}\nstudy = "nowhere.toml"'))
    assert line.startswith("method.study: is not there, expected the file of the study that the source is of; given")
    line = mistake(population(tmp_path, selected[0] / "results", 'model = "neo-hokean"'))
    assert "did you mean 'neo-hookean'?" in line


# --- averages over candidates -----------------------------------------------------------------------------------------


@pytest.mark.fem
def test_predictions_are_averaged_over_candidates(selected, tmp_path, undrawn):
    folder, _ = selected
    source = {"file": str(folder / "results"), "group": "one", "model": "averaged"}
    blocks = BODY | {"parameters": {"from": source}, "method": {"kind": "monte-carlo", "samples": 8}}
    study = parse(blocks)
    assert parse(document(study)) == study
    assert run(study, "average", tmp_path / "out", quiet=True) in (0, 3)
    found = xr.load_dataset(tmp_path / "out" / "results.nc")
    alone = []
    for name in found["candidate"].values:
        own = parse(
            blocks
            | {"parameters": {"from": source | {"model": name}}, "accuracy": {"mesh_error": False}}
            | {"model": blocks["model"] | {"material": study.parts[name].model.material.model_dump()}}
        )
        alone.append(own.run())
    with xr.open_dataset(folder / "results" / "results.nc") as compared:
        p = compared["probability"].sel(model=found["candidate"].to_numpy()).to_numpy()
    assert study.parts["neo-hookean"].model.material.D1 == 1e4  # of the model
    means = np.array([float(one["mean"][0]) for one in alone])
    stds = np.array([float(one["std"][0]) for one in alone])
    np.testing.assert_allclose(found["candidate_mean"][:, 0], means, rtol=1e-12)
    np.testing.assert_allclose(found["mean"], p @ means, rtol=1e-12)
    np.testing.assert_allclose(found["within"], p @ stds**2, rtol=1e-12)
    np.testing.assert_allclose(found["between"], p @ (means - p @ means) ** 2, rtol=1e-12)
    np.testing.assert_allclose(found["std"] ** 2, found["within"] + found["between"], rtol=1e-12)
    fields = np.array([one["field_mean"].to_numpy() for one in alone])
    np.testing.assert_allclose(found["field_mean"], np.tensordot(p, fields, axes=1), atol=1e-18)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["candidates"] == pytest.approx(
        dict(zip(found["candidate"].values.tolist(), p.tolist(), strict=True))
    )
    assert summary["outputs"]["up"]["between"] == pytest.approx(float(found["between"][0]))
    assert any(
        "Not to know which candidate is right makes up this share of the variance" in one["text"]
        for one in summary["findings"]
    )
    assert "Averaged over candidates" in (tmp_path / "out" / "report.html").read_text()


def test_stacking_gives_other_weights(selected):
    """Those of the comparison, without candidates that have none."""
    folder, _ = selected
    source = {"file": str(folder / "results"), "group": "one", "model": "stacked"}
    study = parse(BODY | {"parameters": {"from": source}, "method": {"kind": "monte-carlo", "samples": 8}})
    assert parse(document(study)) == study
    with xr.open_dataset(folder / "results" / "results.nc") as compared:
        weights = compared["stacking"].to_series()
    kept = {one.name: one.probability for one in study.candidates}
    assert kept == pytest.approx(weights[weights > 0].to_dict())
    summary = json.loads((folder / "results" / "summary.json").read_text())
    assert {name: one["stacking"] for name, one in summary["models"].items()} == pytest.approx(weights.to_dict())


def test_errors_of_averages_are_those_of_repeats():
    """Two models with Gaussian estimates of their moments, and of their probabilities."""
    rng = np.random.default_rng(0)
    p, mean, std = np.array([0.7, 0.3]), np.array([[1.0], [2.0]]), np.array([[0.3], [0.5]])
    errors = {"p": 0.02, "mean": np.array([[0.02], [0.05]]), "std": np.array([[0.01], [0.03]])}
    stated = average(p, np.full(2, errors["p"] / np.sqrt(2)), mean, errors["mean"], std, errors["std"])
    repeats = []
    for _ in range(4000):
        shift = errors["p"] * rng.standard_normal()
        moved = np.array([p[0] + shift, p[1] - shift])
        found = average(
            moved, np.zeros(2), rng.normal(mean, errors["mean"]), mean * 0, rng.normal(std, errors["std"]), std * 0
        )
        repeats.append([found["mean"][0], found["std"][0]])
    # Probabilities that move against each other move a mean by up to √2 as much as independent ones.
    for got, name in zip(np.std(repeats, axis=0), ("mean_error", "std_error"), strict=True):
        assert 0.75 * got < stated[name][0] < 1.3 * got


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"accuracy": {"tolerance": 0.1}}, "model = 'averaged' does not go with accuracy.tolerance"),
        ({"method": {"kind": "local-sensitivity"}}, "model = 'averaged' does not go with method.kind"),
        (
            {"parameters": {"material.C1": {"kind": "normal", "mean": 1.0, "std": 0.1}}},
            "material.C1: has a distribution",
        ),
    ],
)
def test_averages_that_cannot_be(selected, change, said):
    folder, _ = selected
    source = {"file": str(folder / "results"), "group": "one", "model": "averaged"}
    parameters = {"from": source} | change.get("parameters", {})
    with pytest.raises(StudyError, match=said):
        parse(BODY | change | {"parameters": parameters})


def test_only_comparisons_can_be_averaged(folder):
    line = mistake(study(folder, 'from = { file = "draws.csv", model = "averaged" }'))
    assert line.startswith("parameters.from: ")
    assert "expected the directory of a finished study" in line
