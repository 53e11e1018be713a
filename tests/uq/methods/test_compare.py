"""Comparisons of methods on analytic models: errors, rates, coverage, charges, restarts."""

import json
import sys
import tomllib
from dataclasses import replace

import numpy as np
import pytest

from forward.model import SolveError
from forward.pointwise import FunctionModel
from tests.functions import AtOnce
from tests.launch import ROOT, run
from uq.estimators.scores import gains, plain_samples
from uq.evaluation.checkpoint import Checkpoint
from uq.evaluation.ensemble import Ensemble
from uq.evaluation.evaluate import Recorder, SerialEvaluate
from uq.evaluation.hdf5 import stored_dataset
from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods.compare import TIMES, Compare
from uq.methods.monte_carlo import MonteCarlo
from workflows.config.mistakes import StudyError
from workflows.config.study import document, dump, parse
from workflows.report import plots
from workflows.report.page import write_report
from workflows.results.directory import label, write_dataset
from workflows.results.summary import summarise
from workflows.run.plan import plan

CONFIGS = ROOT / "configs"
UNIT = Uniform(lower=0.0, upper=1.0)
INPUTS = Inputs({"a": UNIT, "b": UNIT})
GROWTH = np.array([0.5, 0.8])


def function(p):
    """Two outputs; the second is linear."""
    return np.array([np.exp(GROWTH @ p), p[0] - p[1]])


def jacobian(p):
    return np.array([function(p)[0] * GROWTH, [1.0, -1.0]])


MODEL = FunctionModel(function, ("a", "b"), ("f", "g"), jacobian)
MEAN = float(np.prod(np.expm1(GROWTH) / GROWTH))
STD = float(np.sqrt(np.prod(np.expm1(2 * GROWTH) / (2 * GROWTH)) - MEAN**2))
KNOWN = {
    "kind": "given",
    "values": {"f": {"mean": MEAN, "std": STD}, "g": {"mean": 0.0, "std": float(np.sqrt(1 / 6))}},
}
PLAIN = {"kind": "monte-carlo", "budgets": (32, 256)}
CONTROLLED = {"kind": "sensitivity-monte-carlo", "budgets": (32, 256)}
SOBOL = {"kind": "quasi-monte-carlo", "control": "none", "budgets": (32, 512)}


def comparison(*methods, **settings):
    return Compare.model_validate({"reference": KNOWN, "textbook": 0, "seed": 3} | settings | {"methods": methods})


def others(*models):
    return dict(zip(("tight", "textbook", "refined"), models, strict=True))


def serial(model=MODEL):
    return SerialEvaluate(model, others=others(MODEL, MODEL, MODEL))


def of(dataset, name, output="f"):
    return dataset.isel(row=np.flatnonzero(dataset["row_method"].to_numpy() == name)).sel(output=output)


def at_once():
    return AtOnce(MODEL, others=others(MODEL, MODEL, MODEL))


@pytest.fixture(scope="module")
def compared():
    return comparison(PLAIN, CONTROLLED, SOBOL, repeats=40).run(INPUTS, at_once())


@pytest.mark.slow
def test_plain_monte_carlo_errs_as_theory_says(compared):
    plain = of(compared, "monte-carlo")
    exact = STD / np.sqrt(plain["budget"])
    assert (np.abs(plain["mean_rmse"] - exact) < 3 * plain["mean_rmse_error"]).all()
    np.testing.assert_allclose(plain["mean_rmse_error"] / plain["mean_rmse"], 1 / np.sqrt(80), rtol=0.5)
    np.testing.assert_allclose(plain["mean_claimed"], exact, rtol=0.05)
    np.testing.assert_allclose(plain_samples(plain, "mean") / plain["budget"], 1.0, atol=0.6)
    assert (np.abs(plain_samples(plain, "std") / plain["budget"] - 1) < 0.6).all()


@pytest.mark.slow
def test_rates(compared):
    rates = {name: compared.sel(estimator=name, output="f") for name in compared["estimator"].to_numpy()}
    for estimated in ("mean", "std"):
        plain = rates["monte-carlo"]
        assert abs(float(plain[f"{estimated}_rate"]) + 0.5) < 3 * float(plain[f"{estimated}_rate_error"]) < 0.3
        quasi = rates["quasi-monte-carlo"]
        assert float(quasi[f"{estimated}_rate"]) + 3 * float(quasi[f"{estimated}_rate_error"]) < -0.7


@pytest.mark.slow
def test_the_error_of_a_rate_is_its_scatter():
    slopes, claims = [], []
    for seed in range(8):
        found = comparison(PLAIN, repeats=12, seed=seed).run(INPUTS, at_once())
        slopes.append(float(found["mean_rate"][0, 0]))
        claims.append(float(found["mean_rate_error"][0, 0]))
    assert 0.45 < np.std(slopes, ddof=1) / np.sqrt(np.mean(np.square(claims))) < 1.7  # 99 %


@pytest.mark.slow
def test_honest_claims_cover(compared):
    shares = [of(compared, name)["mean_coverage"].to_numpy() for name in ("monte-carlo", "sensitivity-monte-carlo")]
    assert np.mean(shares) > 0.91
    # 16 scrambles: with the quantile of the normal distribution it would be 93 %.
    assert of(compared, "quasi-monte-carlo")["mean_coverage"].mean() > 0.9
    assert not compared["mean_understated"].any()


def test_understated_errors_are_found_out(monkeypatch):
    honest = MonteCarlo.run

    def proud(self, inputs, evaluate):
        found = honest(self, inputs, evaluate)
        return found.assign(mean_error=found["mean_error"] / 3)

    monkeypatch.setattr(MonteCarlo, "run", proud)
    found = of(comparison(PLAIN, repeats=40).run(INPUTS, at_once()), "monte-carlo")
    assert found["mean_understated"].all()
    assert not found["std_understated"].any()
    assert (found["mean_coverage"] < 0.7).all()


@pytest.mark.slow
def test_errors_that_are_rounding_are_not_resolved(compared):
    exact = of(compared, "sensitivity-monte-carlo", "g")
    assert not exact["mean_resolved"].any()
    assert np.isnan(exact["mean_coverage"]).all()
    assert np.isnan(compared.sel(estimator="sensitivity-monte-carlo", output="g")["mean_rate"])


def test_the_error_of_the_reference_counts():
    rough = {name: dict(known) for name, known in KNOWN["values"].items()}
    rough["f"]["mean"] += 0.01
    rough["f"]["mean_error"] = 0.01
    found = comparison(PLAIN, CONTROLLED, reference={"kind": "given", "values": rough}).run(INPUTS, at_once())
    assert of(found, "monte-carlo")["mean_resolved"].to_numpy()[0]
    assert not of(found, "sensitivity-monte-carlo")["mean_resolved"].to_numpy()[-1]
    assert not found["mean_understated"].any()


def test_a_method_makes_the_reference():
    found = comparison(PLAIN, repeats=2, reference={"kind": "chaos", "samples": 60, "max_order": 9}).run(
        INPUTS, serial()
    )
    assert abs(float(found["mean"][0]) - MEAN) < 1e-9
    assert abs(float(found["std"][0]) - STD) < 1e-9


def test_every_sampling_method_can_be_compared():
    method = comparison(
        {**SOBOL, "name": "with chaos", "control": "chaos", "budgets": (32, 64)},
        {"kind": "chaos", "gradients": False, "budgets": (10, 20)},
        {"kind": "multilevel-chaos", "order": 4, "budgets": (32, 64)},
        repeats=2,
    )
    recorder = Recorder(serial())
    found = method.run(INPUTS, recorder)
    assert recorder.solves <= method.planned(2)
    assert (found["mean_rmse"].sel(output="f") < 0.05).all()
    assert set(found["estimator"].to_numpy()) == {"with chaos", "chaos", "multilevel-chaos"}


def test_points_are_solved_once_and_charged_to_all():
    points = []

    def counted(p):
        points.append(tuple(p))
        return function(p)

    method = comparison(PLAIN, CONTROLLED, {**SOBOL, "control": "quadratic"}, repeats=3)
    recorder = Recorder(serial(FunctionModel(counted, ("a", "b"), ("f", "g"), jacobian)))
    found = method.run(INPUTS, recorder)
    assert len(points) == len(set(points)) == recorder.solves == 1 + 3 * (256 + 512) + 4
    assert recorder.solves <= method.planned(2)
    assert of(found, "monte-carlo")["solves"].to_numpy().tolist() == [33, 257]
    assert of(found, "sensitivity-monte-carlo")["solves"].to_numpy().tolist() == [33, 257]
    assert of(found, "quasi-monte-carlo")["solves"].to_numpy().tolist() == [37, 517]
    assert (found["cpu_seconds"] >= found["own_seconds"]).all()
    alone = comparison(CONTROLLED, repeats=3).run(INPUTS, serial())
    for name in ("mean_estimate", "std_estimate_error"):
        both = of(found, "sensitivity-monte-carlo")[name].to_numpy()
        assert (both == of(alone, "sensitivity-monte-carlo")[name].to_numpy()).all()


def test_what_the_textbook_costs_and_finds():
    off = FunctionModel(lambda p: function(p) + 1e-3, ("a", "b"), ("f", "g"), jacobian)
    fine = FunctionModel(lambda p: function(p) + 0.5, ("a", "b"), ("f", "g"), jacobian)
    evaluate = SerialEvaluate(MODEL, others=others(MODEL, off, fine))
    found = comparison(PLAIN, CONTROLLED, textbook=5, mesh_error=True, repeats=2).run(INPUTS, evaluate)
    np.testing.assert_allclose(found["solver_error"], 1e-3)
    np.testing.assert_allclose(found["mesh_error"], 0.5)
    derived = of(found, "monte-carlo, textbook solver")
    assert derived["derived"].all()
    np.testing.assert_allclose(derived["cpu_seconds"], derived["solves"] * found["textbook_seconds"])
    np.testing.assert_array_equal(derived["mean_rmse"], of(found, "monte-carlo")["mean_rmse"])
    gained = gains(found, "mean")
    np.testing.assert_allclose(
        gained["textbook"] * found["cpu_seconds"] / found["textbook_seconds"], gained["solves"] * found["solves"]
    )


def test_repeats_without_an_answer_are_left_out():
    def fragile(p):
        if p[0] > 0.4:
            raise SolveError("too far")
        return function(p)

    model = replace(MODEL, function=lambda p: function(p) if tuple(p) == (0.5, 0.5) else fragile(p))
    found = comparison({"kind": "monte-carlo", "budgets": (4, 64)}, repeats=12).run(INPUTS, serial(model))
    few = of(found, "monte-carlo").isel(row=0)
    assert "repeats gave no estimate and are left out: " in found.attrs["note"]
    assert np.isnan(few["mean_estimate"]).any()
    assert np.isfinite(few["mean_estimate"]).any()
    assert np.isfinite(few["mean_rmse"])


class StoppedError(Exception):
    """A study that was killed."""


def test_a_restart_finds_its_blocks_and_gives_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr("uq.evaluation.ensemble.CHEAP", 0.0)  # solves of this function are cheaper than files
    from mpi4py import MPI

    method = comparison(PLAIN | {"budgets": (8, 16)}, SOBOL | {"budgets": (8, 32), "scrambles": 4}, repeats=3)
    solved = []

    def attempt(most):
        def limited(p):
            if len(solved) >= most:
                raise StoppedError
            solved.append(tuple(p))
            return function(p)

        model = FunctionModel(limited, ("a", "b"), ("f", "g"), jacobian)
        checkpoint = Checkpoint(tmp_path, "test")
        return Ensemble.split(MPI.COMM_SELF).run(
            model, lambda evaluate: method.run(INPUTS, evaluate), checkpoint=checkpoint
        )

    for most in (30, 120):
        with pytest.raises(StoppedError):
            attempt(most)
    found, whole = attempt(10**6), method.run(INPUTS, serial())
    assert len(solved) < 1.1 * (1 + 3 * (16 + 32))
    for name in found.variables:
        if name not in TIMES:
            assert found[name].to_numpy().tobytes() == whole[name].to_numpy().tobytes(), name


# --- studies ---------------------------------------------------------------------------------------------------------


def study(**settings):
    blocks = tomllib.loads((CONFIGS / "tiny.toml").read_text())
    methods = [{"kind": "monte-carlo", "budgets": [16, 32]}, {"name": "q", **SOBOL, "budgets": [32]}]
    return parse(blocks | {"method": {"kind": "compare", "methods": methods} | settings})


def test_a_study_survives_its_own_dump():
    given = {"kind": "given", "values": {name: {"mean": 1.0, "std": 0.1} for name in ("uy_max", "ux_max")}}
    case = study(reference=given, mesh_error=True)
    assert parse(tomllib.loads(dump(case))) == case
    assert document(case)["method"]["methods"][0] == {"name": "", "kind": "monte-carlo", "budgets": [16, 32]}
    assert case.planned == 2 + 20 * (32 + 32) + 2 * 8
    assert "solves      up to 1,298" in plan(case)
    kinds = {name: model.solver.kind for name, model in case.models.items()}
    assert kinds == {"tight": "predict-correct", "textbook": "newton", "refined": "predict-correct"}
    assert case.models["tight"].solver.tolerance == pytest.approx(1e-11)
    assert case.models["refined"].body.cells == (8, 2, 4)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"methods": [{"kind": "monte-carlo"}]}, "method.methods[0]: gives no budgets, expected different numbers"),
        ({"methods": [{"kind": "monte-carlo", "budgets": 16}]}, "method.methods[0]: budgets = 16, expected different"),
        ({"methods": [{"kind": "monte-carlo", "budgets": [1]}]}, "method.methods[0]: budgets = [1], expected"),
        ({"methods": [{"kind": "monte-carlo", "budgets": [16], "seed": 1}]}, "method.methods[0]: gives seed, expected"),
        (
            {"methods": [{"kind": "quasi-monte-carlo", "budgets": [16, 48]}]},
            "method.methods[0]: budget 48: samples = 48, expected scrambles = 16 times a power of two",
        ),
        ({"methods": [{"kind": "chaos", "budgets": [16], "ordr": 3}]}, "method.methods[0].ordr: unknown key"),
        ({"methods": [{"kind": "chas", "budgets": [16]}]}, "method.methods[0].kind: unknown kind; did you mean"),
        ({"methods": [{"kind": "chaos", "fit": "projection", "budgets": [9]}]}, "expected none: a projection takes"),
        (
            {"methods": [{"kind": "multilevel-chaos", "order": 4, "budgets": [8, 32]}]},
            "method.methods[0].budgets: an expansion of order 4 in 2 parameters has 15 terms, expected more samples",
        ),
        ({"methods": []}, "method: gives no methods, expected at least one"),
        ({"methods": [PLAIN, PLAIN]}, "method: 2 methods are called 'monte-carlo', expected different names"),
        (
            {"reference": {"kind": "given", "values": {"uy_max": {"mean": 1.0, "std": 1.0}}}},
            "method.reference.values: expected values of every output: uy_max, ux_max",
        ),
        ({"reference": {"kind": "local-sensitivity"}}, "method.reference.kind: unknown kind; did you mean"),
    ],
)
def test_one_line_for_a_mistake(settings, expected):
    with pytest.raises(StudyError) as caught:
        study(**settings)
    assert len(caught.value.args) == 1, caught.value.args
    assert expected in caught.value.args[0]


def test_chaos_needs_independent_parameters():
    case = study()
    pair = {"between": list(case.parameters), "value": 0.3}
    with pytest.raises(StudyError, match="correlations: polynomial chaos needs independent parameters"):
        parse(document(case) | {"correlations": [pair]})


@pytest.fixture
def results(tmp_path):
    """The directory of a study whose model is a formula."""
    case = study(repeats=5, textbook=3)
    lower, width = (np.array([getattr(d, name) for d in case.parameters.values()]) for name in ("lower", "upper"))
    width = width - lower
    outputs = tuple(o.name for o in case.model.outputs)
    model = FunctionModel(
        lambda p: function((p - lower) / width),
        case.inputs.names,
        outputs,
        lambda p: jacobian((p - lower) / width) / width,
    )
    recorder = Recorder(SerialEvaluate(model, others=others(model, replace(model), model)))
    dataset = case.method.run(case.inputs, recorder)
    dataset = label(dataset, {o.name: o.unit for o in case.model.outputs}, np.zeros((0, 3)), np.zeros((0, 8)), 12)
    dataset.attrs |= {"study": "formula", "method": "compare", "config": dump(case)}
    write_dataset(tmp_path / "results.nc", dataset)
    summary = {
        "study": "formula",
        "method": "compare",
        "stopped": dataset.attrs["stopped"],
        "evaluations": recorder.solves,
        "status": "complete",
        "failed": 0,
        "failures": [],
        "wall_seconds": 1.0,
        "cpu_seconds": recorder.seconds,
        "work": {},
        **summarise(dataset),
        "provenance": {
            "date": "2024-02-03T04:05:06+00:00",
            "seed": 0,
            "ranks": 1,
            "groups": 1,
            "processor": "x86_64",
            "commit": None,
            "versions": {},
        },
    }
    (tmp_path / "summary.json").write_text(json.dumps(summary, allow_nan=False))
    return dataset, tmp_path


def test_summary_and_report(results, monkeypatch, looked_at):
    dataset, directory = results
    methods = json.loads((directory / "summary.json").read_text())["methods"]
    assert list(methods) == ["monte-carlo", "q", "monte-carlo, textbook solver"]
    for rows in methods.values():
        for row in rows:
            assert {type(row[name]) for name in ("cpu_seconds", "error")} == {float}
            assert type(row["cost"]) is int
            assert set(row["outputs"]) == {"uy_max", "ux_max"}
    assert [row["cost"] for row in methods["monte-carlo"]] == [17, 33]
    assert methods["monte-carlo"][0]["error"] == float(dataset["mean_rmse"][0, 0])
    drawn = []
    whole = plots.errors

    def kept(*arguments):
        drawn.append(whole(*arguments))
        return drawn[-1]

    monkeypatch.setattr(plots, "errors", kept)
    monkeypatch.setattr(plots, "png", lambda ax: b"\x89PNG")
    page = write_report(directory).read_text()
    for text in ("Error against cost", "monte-carlo, textbook solver", "gain over the textbook", "uy_max: mean"):
        assert text in page
    looked_at(directory)
    assert len(drawn) == 8
    against_solves, against_time = drawn[:2]
    labels = against_solves.get_legend_handles_labels()[1]
    assert len([name for name in labels if name.startswith(("monte-carlo", "q"))]) == 2
    assert any(name.startswith("monte-carlo (rate ") for name in labels)
    assert "monte-carlo, textbook solver" in against_time.get_legend_handles_labels()[1]
    assert against_time.get_xlabel() == "processor time (s), set-up charged"
    assert against_time.get_ylabel() == "RMSE of the mean of uy_max (m)"


@pytest.mark.fem
@pytest.mark.mpi
@pytest.mark.slow
def test_same_comparison_on_any_number_of_groups(tmp_path):
    methods = """[
        { kind = "monte-carlo", budgets = [8, 16] },
        { kind = "quasi-monte-carlo", control = "quadratic", scrambles = 4, budgets = [8, 16] },
        { kind = "chaos", max_order = 3, budgets = [4, 6] },
    ]"""
    reference = '{ kind = "chaos", fit = "projection", max_order = 2 }'
    text = (CONFIGS / "tiny.toml").read_text()
    numbers = "repeats = 3\ntextbook = 2\nmesh_error = true"
    method = f'kind = "compare"\n{numbers}\nreference = {reference}\nmethods = {methods}\n'
    path = tmp_path / "mini.toml"
    path.write_text(text[: text.index("[method]")] + f"[method]\n{method}")
    found = []
    for ranks in (None, 2):
        out = tmp_path / f"on-{ranks}"
        done = run(ranks, sys.executable, "-m", "workflows", "run", path, "--out", out, "--quiet", "--no-report")
        assert done.returncode == 0, done.stderr
        found.append(stored_dataset(out / "results.nc"))
    one, two = found
    for name in one.variables:
        if name not in TIMES:
            assert one[name].to_numpy().tobytes() == two[name].to_numpy().tobytes(), name
    assert (one["solver_error"] < 1e-7).all()
    assert (one["mesh_error"] > 1e-4).all()
    assert float(one["textbook_seconds"]) > float(one["plain_seconds"])
