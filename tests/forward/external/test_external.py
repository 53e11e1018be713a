"""Models of other programs: Python functions in every method that needs no field."""

import shutil
import sys
import tomllib

import numpy as np
import pytest
import xarray as xr

from forward.conformance import check_derivatives
from forward.external.models import PythonModel
from forward.external.own_modules import sources
from forward.model import ModelError, SolveError
from tests import functions
from tests.launch import ROOT
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Request
from workflows.config.mistakes import StudyError
from workflows.config.study import load, parse
from workflows.results.directory import read_summary
from workflows.run.plan import plan
from workflows.run.run import run

STUDY = """
[model]
kind = "python"
function = "tests.functions.beam"
jacobian = "tests.functions.slopes"
parameters = { E = 1e6, load = 1.0, length = 0.1 }
outputs = [{ name = "tip", unit = "m" }, "weight"]

[parameters]
load = { kind = "truncated-normal", mean = 1.0, std = 0.1, lower = 0.5, upper = 1.5 }
E = { kind = "uniform", lower = 0.9e6, upper = 1.1e6 }

[method]
kind = "monte-carlo"
samples = 64
"""
MEAN = 0.1**4 / (8 * 0.02 * 0.01**3 / 12) * np.log(1.1 / 0.9) / 0.2e6


def study(*changes):
    return parse(tomllib.loads(STUDY), changes)


def model(**changes):
    blocks = {
        "function": "tests.functions.beam",
        "jacobian": "tests.functions.slopes",
        "parameters": {"E": 1e6, "load": 1.0, "length": 0.1},
        "outputs": ("tip", "weight"),
    }
    return PythonModel.model_validate(blocks | changes)


def test_a_function_is_a_model_of_some_of_its_parameters():
    built = model().build(None, ("length", "E"))
    point = np.array([0.2, 2e6])
    assert np.array_equal(built.solve(point).outputs, functions.beam([2e6, 1.0, 0.2]))
    check_derivatives(built, point, 0.1 * point).require()


@pytest.mark.parametrize(
    "method",
    [
        "{kind='monte-carlo', samples=256}",
        "{kind='sensitivity-monte-carlo', samples=32}",
        "{kind='quasi-monte-carlo', samples=64, control='quadratic'}",
        "{kind='chaos', samples=10}",
        "{kind='sobol', samples=10}",
    ],
)
def test_every_method_finds_the_mean(method):
    case = study(f"method={method}")
    data = case.method.run(case.inputs, SerialEvaluate(case.model.build(None, case.inputs.names)))
    mean = data.sel(output="tip")
    assert abs(float(mean["mean"]) - MEAN) < 4 * float(mean["mean_error"]) + 1e-12


@pytest.mark.parametrize("kind", ["local-sensitivity", "derivative-based"])
def test_methods_of_derivatives(kind):
    case = study(f"method={{kind='{kind}'{', samples=64' if kind != 'local-sensitivity' else ''}}}")
    built = case.model.build(None, case.inputs.names)
    data = case.method.run(case.inputs, SerialEvaluate(built))
    np.testing.assert_allclose(data["derivative"].sel(output="tip"), [MEAN, -MEAN / 1e6], rtol=0.01)
    bare = case.model.model_copy(update={"jacobian": None}).build(None, case.inputs.names)
    with pytest.raises(ModelError, match="the model has no derivatives"):
        case.method.run(case.inputs, SerialEvaluate(bare))


def test_a_run_leaves_results_and_a_report_without_a_body(tmp_path, undrawn):
    assert run(study("method={kind='chaos', samples=12}"), "beam", tmp_path / "out", quiet=True) == 0
    data = xr.load_dataset(tmp_path / "out" / "results.nc")
    assert dict(zip(data.output.values, data.unit.values, strict=True)) == {"tip": "m", "weight": "1"}
    assert "node" not in data.dims
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "tests.functions.beam" in report
    assert "displacement" not in report
    assert not (tmp_path / "out" / "fields").exists()


def test_a_function_that_raises_is_a_failed_solve():
    built = model(function="tests.functions.brittle").build(None, ("load",))
    found = SerialEvaluate(built)(Request(np.array([[0.9], [1.1]])))
    assert found.ok.tolist() == [True, False]
    assert found.failures[0].reason == "tests.functions.brittle raised RuntimeError: the beam broke"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"function": "nowhere.beam"}, r"model.function: 'nowhere' cannot be imported: ModuleNotFoundError"),
        ({"function": "tests.functions.beem"}, r"'tests.functions' has no 'beem'; did you mean 'beam'"),
        ({"function": "tests.functions.NUMBER"}, r"'tests.functions.NUMBER' is float, expected a function"),
        ({"function": "tests.functions.short"}, r"returned shape \(1,\), expected \(2,\)"),
        ({"jacobian": "tests.functions.flat"}, r"model.jacobian: returned shape \(2, 2\), expected \(2, 3\)"),
    ],
)
def test_one_line_for_a_model_that_cannot_be_used(changes, message):
    with pytest.raises(ModelError, match=message) as caught:
        model(**changes).build(None, ("E", "load")).solve(np.ones(2)).tangent(np.ones(2))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "returned", ["text", ["1", "2"], [1j, 2], np.array([1j, 2]), [[1], [1, 2]], {"a": 1}, b"12", [object(), 1], 10**400]
)
@pytest.mark.parametrize("what", ["function", "jacobian"])
def test_one_line_for_what_is_no_number(monkeypatch, returned, what):
    monkeypatch.setattr(functions, "flat", lambda p: returned)
    with pytest.raises(ModelError, match=f"the model's {what} returned .*, expected real numbers") as caught:
        model(**{what: "tests.functions.flat"}).build(None, ("E", "load")).solve(np.ones(2)).tangent(np.ones(2))
    assert "\n" not in str(caught.value)


def test_one_output_may_be_a_number():
    built = model(function="tests.functions.product", jacobian=None, outputs=("p",)).build(None, ("E",))
    assert built.solve(np.array([3.0])).outputs == pytest.approx([0.3])
    assert not built.differentiable


def test_a_value_that_is_not_finite_is_no_answer():
    with pytest.raises(SolveError, match="not finite"):
        model(jacobian=None).build(None, ("E",)).solve(np.array([np.nan]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("method={kind='multilevel-chaos', samples=64}", "method.kind: a model of kind 'python' has no iterations"),
        ("method={kind='multilevel-monte-carlo', samples=8}", "method.kind: a model of kind 'python' has no meshes"),
        ("parallel.ranks_per_model=2", "parallel.ranks_per_model: a model of kind 'python' is not shared by ranks"),
        ("parameters.lod={kind='uniform', lower=0, upper=1}", "parameters: not a number of the model; did you mean"),
        ("model.function=beam", "model.function: expected MODULE.FUNCTION; given 'beam'"),
        ("model.outputs=['a', 'a']", "model: 2 outputs have the name 'a'"),
        ("model.kind=pyton", "model.kind: unknown kind; did you mean 'python'?; given 'pyton'"),
    ],
)
def test_mistakes(change, message):
    with pytest.raises(StudyError) as caught:
        study(change)
    assert len(caught.value.args) == 1, caught.value.args
    assert caught.value.args[0].startswith(message)


def test_the_plan_finds_the_model():
    assert "with derivatives" in plan(study())[1]
    with pytest.raises(ModelError, match="cannot be imported"):
        plan(study("model.function=nowhere.beam"))


def test_changed_source_is_another_model(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    path = tmp_path / "changing_model.py"
    path.write_text("def f(p):\n    return p[0]\n")
    blocks = 'parameters={a={kind="uniform", lower=0, upper=1}}', 'model.outputs=["f"]', "model.parameters={a=1.0}"
    changing = parse(tomllib.loads(STUDY.replace("jacobian", "# ")), ["model.function=changing_model.f", *blocks])
    before = sources(changing.model.modules)
    assert run(changing, "changing", tmp_path / "out", quiet=True, report=False) == 0
    assert run(changing, "changing", tmp_path / "out", quiet=True, report=False) == 0
    path.write_text("def f(p):\n    return 2 * p[0]\n")
    assert before != sources(changing.model.modules)
    with pytest.raises(StudyError, match=r"changing_model\.py has changed; choose another --out"):
        run(changing, "changing", tmp_path / "out", quiet=True, report=False)
    sys.modules.pop("changing_model")


@pytest.mark.slow
@pytest.mark.parametrize("text", [b"{}", b"[]", b"", b"nan", b"\xff", b"[" * 5000, b'{"failed": 0}'])
def test_a_damaged_summary_is_made_again(tmp_path, text):
    case = study("method.samples=8")
    assert run(case, "beam", tmp_path / "out", quiet=True, report=False) == 0
    before = (tmp_path / "out" / "results.nc").read_bytes()
    (tmp_path / "out" / "summary.json").write_bytes(text)
    assert run(case, "beam", tmp_path / "out", quiet=True, report=False) == 0
    assert (tmp_path / "out" / "results.nc").read_bytes() == before
    assert read_summary(tmp_path / "out")["failed"] == 0


def test_a_study_that_could_not_begin_leaves_no_directory(tmp_path):
    for changes in (["model.function=tests.functions.beem"], []):
        case = study("method.samples=8", *changes)
        if changes:
            with pytest.raises(ModelError):
                run(case, "beam", tmp_path / "out", quiet=True, report=False)
            assert not (tmp_path / "out").exists()
        else:
            assert run(case, "beam", tmp_path / "out", quiet=True, report=False) == 0


def test_modules_are_found_beside_the_study(tmp_path, monkeypatch, capsys):
    from workflows.__main__ import main

    monkeypatch.setattr(sys, "path", [*sys.path])
    shutil.copy(ROOT / "configs" / "own_model.py", tmp_path / "own_beam.py")
    (tmp_path / "study.toml").write_text(STUDY.replace("tests.functions", "own_beam"))
    assert main(["check", str(tmp_path / "study.toml")]) == 0
    assert main(["check", str(tmp_path / "study.toml"), "--set", "model.function=own_beam.bem"]) == 2
    assert capsys.readouterr().err == "model.function: 'own_beam' has no 'bem'; did you mean 'beam'?\n"


def test_the_function_is_that_of_the_file_as_it_is_now(tmp_path, monkeypatch):
    """In one process, as in a notebook: other folders with a file of the same name, and files that were edited."""
    model = PythonModel(function="my_own.f", parameters={"a": 2.0}, outputs=("b",))
    found = []
    for folder, factor in (("one", 1), ("two", 10), ("two", 200)):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / "my_own.py").write_text(f"def f(p):\n    return {factor} * p\n")
        monkeypatch.syspath_prepend(tmp_path / folder)
        found.append((model.build(None, ("a",)).solve(np.array([2.0])).outputs[0], sources(model.modules).digest))
    assert [value for value, _ in found] == [2, 20, 400]
    assert len({source for _, source in found}) == 3


def test_the_shipped_example(monkeypatch):
    from workflows.__main__ import main

    monkeypatch.setattr(sys, "path", [*sys.path])
    study = ROOT / "configs" / "own-model.toml"
    assert main(["check", str(study)]) == 0
    case = load(study)
    data = case.method.run(case.inputs, SerialEvaluate(case.model.build(None, case.inputs.names)))
    assert float(data["mean"].sel(output="tip")) == pytest.approx(MEAN, rel=1e-5)


@pytest.mark.parametrize(
    ("body", "jacobian", "method", "told"),
    [
        ("p[0] + 0.1 * rng.standard_normal()", "", "{kind='monte-carlo', samples=32}", "answers differently"),
        ("p[0] + 0.1 * rng.standard_normal()", "", "{kind='chaos', samples=32}", "answers differently"),
        ("p[0] ** 2", "[[2 * p[0]]]", "{kind='sensitivity-monte-carlo', samples=32}", ""),
        ("p[0] ** 2", "[[1.0]]", "{kind='sensitivity-monte-carlo', samples=32}", "away from the mean, at a = "),
    ],
)
def test_a_model_that_contradicts_itself(body, jacobian, method, told, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    lines = ["import numpy as np", "rng = np.random.default_rng(1)", "def f(p):", f"    return [{body}]"]
    lines += ["def slopes(p):", f"    return {jacobian}"] if jacobian else []
    (tmp_path / "contradicting.py").write_text("\n".join(lines))
    blocks = {
        "model": {"kind": "python", "function": "contradicting.f", "parameters": {"a": 0.5}, "outputs": ["y"]},
        "parameters": {"a": {"kind": "uniform", "lower": 0.0, "upper": 1.0}},
    }
    if jacobian:
        blocks["model"]["jacobian"] = "contradicting.slopes"
    case = parse(blocks, [f"method={method}"])
    assert run(case, "own", tmp_path / "out", quiet=True, report=False) == (3 if told else 0)
    errors = [one["text"] for one in read_summary(tmp_path / "out")["findings"] if one["severity"] == "error"]
    assert any(told in text for text in errors) if told else not errors
    sys.modules.pop("contradicting")
