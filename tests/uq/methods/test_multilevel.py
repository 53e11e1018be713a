"""Multilevel Monte Carlo on hierarchies of known bias, and on the finite-element beam."""

import json
import tomllib
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from pydantic import ValidationError
from scipy import stats

from forward.model import SolveError
from forward.pointwise import FunctionModel
from tests.functions import AtOnce
from tests.launch import (
    ROOT,
    assert_same_bits,
    in_process,
    run_script,
    tissuq_on_two_ranks,
    without_pictures,
)
from uq.estimators.blue import Problem, alone
from uq.estimators.moments import combine, estimate, monomials, term
from uq.evaluation.evaluate import Recorder, SerialEvaluate
from uq.evaluation.request import Evaluations, Request
from uq.findings import findings
from uq.inputs.distributions import Normal, Uniform
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import random_points
from uq.methods.multilevel import MultilevelMonteCarlo
from uq.methods.multilevel_meshes import bias, rate
from workflows.config.mistakes import StudyError
from workflows.config.study import load, parse
from workflows.report import plots
from workflows.report.plots.accuracy import _sampling
from workflows.run.plan import plan

INPUTS = Inputs({"a": Uniform(lower=0.5, upper=1.5), "b": Uniform(lower=0.0, upper=1.0)})
ALPHA = 1.5
CONTROLS = ("none", "tangent")


def on_mesh(level, alpha=ALPHA):
    """A model on a mesh: its error falls by 2^alpha from one to the next; the second output is scaled."""
    h = 0.3 * 2.0 ** (-alpha * level)

    def value(p):
        f = p[0] * np.exp(p[1]) + h * (1 + p[0] ** 2 * np.sin(p[1]))
        return [f, 10 * f + 1]

    def jacobian(p):
        slope = np.array(
            [np.exp(p[1]) + 2 * h * p[0] * np.sin(p[1]), p[0] * np.exp(p[1]) + h * p[0] ** 2 * np.cos(p[1])]
        )
        return [slope, 10 * slope]

    return FunctionModel(value, ("a", "b"), ("f", "g"), jacobian)


def meshes(*finer):
    return {f"mesh {level}": model for level, model in enumerate(finer, 1)}


def hierarchy(count, alpha=ALPHA):
    first, *others = (on_mesh(level, alpha) for level in range(count))
    return AtOnce(first, others=meshes(*others))


def exact(level):
    """Mean and variance of the first output by Gauss quadrature; on no mesh at all where the level is infinite."""
    x, w = np.polynomial.legendre.leggauss(12)
    a, b, weights = 1 + x[:, None] / 2, 0.5 + x[None, :] / 2, w[:, None] * w[None, :] / 4
    values = on_mesh(level).function(np.array([a + 0 * b, b + 0 * a]))[0]
    mean = (weights * values).sum()
    return mean, (weights * values**2).sum() - mean**2


# --- estimators ----------------------------------------------------------------------------------------------------


def test_a_single_term_is_the_estimate_from_sums():
    rng = np.random.default_rng(0)
    control = rng.normal(size=(40, 3))
    w = control + 0.1 * control**2 + 0.02 * rng.normal(size=(40, 3))
    reference, variance = np.array([1.0, 2.0, 3.0]), np.full(3, 1.1)
    sums = estimate(monomials(w, control).sum(axis=1), 40, reference, variance)
    one = term(w, w**2, (control, control**2 - variance))
    found = combine(reference, [one])
    for name in ("mean", "mean_error", "std", "std_error"):
        np.testing.assert_allclose(getattr(found, name), getattr(sums, name), rtol=1e-10)


REPEATS = 60


@cache
def repeats(control, count=REPEATS):
    """Deviations of mean and variance on the finest mesh, with the claimed errors, each (count,)."""
    rows = []
    mean, variance = exact(2)
    evaluate = hierarchy(3)
    for seed in range(count):
        method = MultilevelMonteCarlo(seed=seed, samples=64, pilot=16, levels=3, control=control)
        data = method.run(INPUTS, evaluate)
        assert data.sizes["level"] == 3
        m, e, s, es = (data[name].values[0] for name in ("mean", "mean_error", "std", "std_error"))
        rows.append((m - mean, e, s**2 - variance, 2 * s * es))
    return np.array(rows).T


@pytest.mark.few(1)
@pytest.mark.parametrize("control", CONTROLS)
def test_unbiased_on_the_finest_mesh_with_honest_errors(control):
    mean, mean_error, variance, variance_error = repeats(control)
    for deviation, error in ((mean, mean_error), (variance, variance_error)):
        assert abs(deviation.mean()) < 3 * deviation.std() / np.sqrt(len(deviation))
        low, high = stats.binom.ppf([0.003, 0.97], REPEATS, 0.95)  # of 100, 88 and 99
        assert low <= (np.abs(deviation) < 1.96 * error).sum() <= high
        assert np.sqrt((error**2).mean()) == pytest.approx(deviation.std(), rel=2 / np.sqrt(REPEATS))


def test_controls_are_worth_what_they_say():
    plain, controlled = (repeats(control) for control in CONTROLS)
    assert plain[0].std() / controlled[0].std() > 4
    assert plain[2].std() / controlled[2].std() > 1.2


@pytest.mark.parametrize("control", CONTROLS)
def test_rates_are_recovered(control):
    data = MultilevelMonteCarlo(samples=3000, pilot=400, levels=4, control=control).run(INPUTS, hierarchy(4))
    assert data.sizes["level"] >= 3
    np.testing.assert_allclose(data["weak_rate"], ALPHA, atol=0.05)
    np.testing.assert_allclose(data["strong_rate"], 2 * ALPHA, atol=0.15)
    assert data["cost_rate"].item() == pytest.approx(3 * 1.2, abs=0.6)
    finest = data.sizes["level"] - 1
    actual = exact(finest)[0] - exact(np.inf)[0]
    assert data["bias_error"][0].item() == pytest.approx(actual, rel=0.1)
    assert data["std_bias_error"][0].item() == pytest.approx(
        abs(np.sqrt(exact(finest)[1]) - np.sqrt(exact(np.inf)[1])), rel=0.3
    )
    for level in range(finest + 1):
        assert data["mesh_mean"][level, 0].item() == pytest.approx(exact(level)[0], abs=0.02)
        assert data["mesh_variance"][level, 0].item() == pytest.approx(exact(level)[1], rel=0.15)
    assert (data["consistency"][1:] < 1).all()
    assert "note" not in data.attrs


@pytest.mark.unit
def test_bias_and_rates_of_known_sequences():
    differences = np.array([[1.0, -3.0], [0.5, 0.75]])
    np.testing.assert_allclose(rate(differences), [1, 2])
    np.testing.assert_allclose(bias(differences, np.array([1.0, 2.0])), [0.5, 0.25])
    # a difference that is small by chance does not count
    np.testing.assert_allclose(bias(np.array([[1.0], [2.0**-4]]), np.array([2.0])), (1 / 4) / 3)
    np.testing.assert_allclose(rate(differences[:1]), 1)
    np.testing.assert_allclose(bias(np.zeros((2, 1)), rate(np.zeros((2, 1))) + 1), 0)


def test_a_rate_that_is_too_good_is_not_relied_on():
    data = MultilevelMonteCarlo(samples=64).run(INPUTS, hierarchy(3, alpha=4))
    assert (data["weak_rate"] > 3.9).all()
    assert (data["bias_error"] >= abs(data["difference_mean"][-1]) / 3).all()


def test_numbers_of_samples_are_the_best():
    variances, costs = np.array([1.0, 0.04, 1e-3]), np.array([1.0, 10.0, 90.0])
    problem = Problem(alone(variances[None]), costs, np.zeros(3), np.ones(3))
    n = problem.best(1.0)
    n *= (variances / n).sum() / 1e-4
    assert problem.variances(n) == pytest.approx(1e-4)
    np.testing.assert_allclose(n, np.sqrt(variances / costs) * np.sqrt(variances * costs).sum() / 1e-4)
    for other in np.random.default_rng(0).uniform(0.8, 1.2, (50, 3)):
        m = n * other
        m *= (variances / m).sum() / 1e-4
        assert m @ costs >= n @ costs


# --- amounts -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("control", CONTROLS)
def test_a_tolerance_on_the_total_error_is_met(control):
    truth, tolerance = exact(np.inf)[0], 0.02
    evaluate = hierarchy(6)
    data = [
        MultilevelMonteCarlo(tolerance=tolerance, levels=6, control=control, seed=seed).run(INPUTS, evaluate)
        for seed in range(8)
    ]
    for found in data:
        assert (found["total_error"] <= tolerance * found["mean"]).all()
        np.testing.assert_allclose(found["total_error"], np.hypot(found["bias_error"], found["mean_error"]))
        assert found.stopped.startswith("tolerance 0.02 met: relative total error")
    errors = np.array([found["mean"][0].item() - truth for found in data])
    assert np.sqrt((errors**2).mean()) < 1.1 * tolerance * truth
    assert all(found.sizes["level"] in {4, 5} for found in data), "0.3 · 2^(−1.5 l) is below 1 % of 1.72 from l = 3 on"


def test_coarse_meshes_get_the_samples():
    data = MultilevelMonteCarlo(tolerance=0.003, levels=4, control="none").run(INPUTS, hierarchy(4))
    counts = data["mesh_samples"].to_numpy()
    variances = data["difference_variance"].isel(output=0).to_numpy()
    costs = _sampling(data, "f")[1]
    best = np.sqrt(variances / costs)
    assert (np.diff(counts) < 0).all()
    assert counts[1] / counts[0] == pytest.approx(best[1] / best[0], rel=0.4)
    assert data["mesh_cost"].values @ counts < 0.2 * counts[0] * data["mesh_cost"].values[-1]


def test_amounts_other_than_a_tolerance():
    class OneSecond(Recorder):
        def __call__(self, request: Request) -> Evaluations:
            found = super().__call__(request)
            return replace(found, seconds=np.ones(len(found.points)))

        def on(self, model):
            return OneSecond(self._evaluate.on(model), self, model)

    asked = MultilevelMonteCarlo(samples=500, levels=3, control="none").run(INPUTS, hierarchy(3))
    assert asked["mesh_samples"][0] == 500
    assert "samples on 3 meshes, as asked: relative total error" in asked.stopped
    evaluate = OneSecond(hierarchy(6))
    paid = MultilevelMonteCarlo(budget_seconds=2000, levels=6).run(INPUTS, evaluate)
    assert 1000 < evaluate.solves < 2010
    assert "all that budget_seconds = 2000 pays for" in paid.stopped
    poor = MultilevelMonteCarlo(budget_seconds=60, levels=6).run(INPUTS, OneSecond(hierarchy(6)))
    assert poor.sizes["level"] == 2
    unmet = MultilevelMonteCarlo(tolerance=1e-3, levels=2).run(INPUTS, hierarchy(2))
    assert unmet.stopped.startswith("tolerance 0.001 not met")
    assert "levels = 2 allows no finer one" in unmet.stopped
    with pytest.raises(ValidationError, match="samples = 5, expected at least pilot = 8"):
        MultilevelMonteCarlo(samples=5)
    with pytest.raises(ValidationError, match="neither samples nor tolerance"):
        MultilevelMonteCarlo()


def test_planned_solves_and_their_points():
    evaluate = Recorder(hierarchy(3))
    method = MultilevelMonteCarlo(samples=8, pilot=8, levels=3, seed=4)
    data = method.run(INPUTS, evaluate)
    assert method.planned(2) == evaluate.solves == 3 + 8 * 5
    levels = [data["points"].to_numpy()[data["sample_level"] == level] for level in range(3)]
    for level, points in enumerate(levels):
        np.testing.assert_array_equal(points, INPUTS.points(random_points((4, level), 0, 8, 2)))
    assert len({p.tobytes() for p in levels}) == 3
    longer = MultilevelMonteCarlo(samples=50, pilot=8, levels=3, seed=4).run(INPUTS, hierarchy(3))
    np.testing.assert_array_equal(longer["points"][:8], data["points"][:8])


def test_a_model_without_derivatives_needs_no_control():
    bare = SerialEvaluate(replace(on_mesh(0), jacobian=None), others=meshes(replace(on_mesh(1), jacobian=None)))
    with pytest.raises(ValueError, match="no derivatives"):
        MultilevelMonteCarlo(samples=16, levels=2).run(INPUTS, bare)
    data = MultilevelMonteCarlo(samples=16, levels=2, control="none").run(INPUTS, bare)
    assert np.isfinite(data["mean"]).all()
    assert (data["weak_rate"] == 1).all(), "one difference shows no rate"


def test_a_control_that_is_exact_leaves_no_error():
    def linear(h):
        return FunctionModel(lambda p: (1 + h) * p[0] + h, ("a", "b"), ("f",), lambda p: [[1 + h, 0]])

    evaluate = SerialEvaluate(linear(0.4), others=meshes(linear(0.1), linear(0.025)))
    data = MultilevelMonteCarlo(tolerance=0.02, samples=100).run(INPUTS, evaluate)
    assert data["mean"].item() == pytest.approx(1.05, rel=1e-12)
    assert data["mean_error"].item() < 1e-12
    assert data["bias_error"].item() == pytest.approx(0.05, rel=1e-6)
    assert "not met" in data.stopped


# --- checks and failures -------------------------------------------------------------------------------------------


class Faulty(Recorder):
    """The coarser mesh of every pair gets other inputs."""

    def __init__(self, evaluate, change, whole=None, model=0):
        super().__init__(evaluate, whole, model)
        self.change = change
        self.seen = [] if whole is None else whole.seen

    def __call__(self, request):
        if any(np.array_equal(request.points, points) for points in self.seen[-1:]):
            request = replace(request, points=self.change(request.points))
        self.seen.append(request.points)
        return super().__call__(request)

    def on(self, model):
        return Faulty(self._evaluate.on(model), self.change, self, model)


@pytest.mark.parametrize("control", CONTROLS)
def test_other_inputs_on_the_two_meshes_are_noticed(control):
    method = MultilevelMonteCarlo(samples=2000, pilot=100, control=control)
    right = method.run(INPUTS, Faulty(hierarchy(3), lambda points: points))
    assert (right["consistency"][1:] < 1).all()
    assert "note" not in right.attrs
    shifted = method.run(INPUTS, Faulty(hierarchy(3), lambda points: points + np.array([0.5, 0])))
    assert (shifted["consistency"][1:] > 1).all()
    assert "do not trust these results" in shifted.attrs["note"]
    independent = method.run(INPUTS, Faulty(hierarchy(3), lambda points: points[::-1]))
    assert "the two meshes do not follow each other for f, g" in independent.attrs["note"]


def test_a_few_samples_that_make_the_variance_are_noticed():
    def spiky(level):
        return FunctionModel(lambda p: p[0] + 2.0**-level * (p[1] > 0.995), ("a", "b"), ("f",))

    evaluate = SerialEvaluate(spiky(0), others=meshes(spiky(1), spiky(2)))
    data = MultilevelMonteCarlo(samples=1000, pilot=1000, control="none").run(INPUTS, evaluate)
    assert (data["difference_kurtosis"][1:] > 100).all()
    assert "a few samples make most of the variance" in data.attrs["note"]


def heavy(level):
    """Two log-normals, or a heavy-tailed difference of the meshes of a light-tailed quantity."""
    h = 0.5**level
    return FunctionModel(
        lambda p: [np.exp(p[0]) - np.exp(p[1]) + h * p[0], p[0] + h * np.exp(1.5 * p[1]), p[0] + h * p[1]],
        ("a", "b"),
        ("tails", "difference", "light"),
    )


def test_heavy_tails_on_a_mesh_or_between_two_are_told():
    inputs = Inputs(dict.fromkeys("ab", Normal(mean=0.0, std=1.0)))
    evaluate = SerialEvaluate(heavy(0), others=meshes(heavy(1), heavy(2)))
    told = {"tails": 0, "difference": 0, "light": 0}
    between, silent = 0, 0
    right = np.sqrt(2 * (np.e**2 - np.e) + 0.25**2 + 0.5 * np.exp(0.5))  # standard deviation of tails on mesh 2
    for seed in range(12):
        data = MultilevelMonteCarlo(samples=128, pilot=64, control="none", seed=seed).run(inputs, evaluate)
        texts = [found.text for found in findings(data)]
        for name in told:
            told[name] += any(name in text.replace("the difference between", "") for text in texts)
        between += any("difference between meshes 0 and 1" in text for text in texts)
        std, error = (float(data[name].sel(output="tails")) for name in ("std", "std_error"))
        silent += abs(std - right) > 1.96 * error and not any("tails" in text for text in texts)
    assert told["tails"] >= 8  # of 100 seeds 85 have a finding, and 6 miss without one
    assert silent <= 2
    assert told["difference"] >= 10
    assert between >= 8
    assert told["light"] <= 2


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("broken", [0, 1])
def test_pairs_with_a_failure_are_dropped_and_counted(control, broken):
    def fragile(p):
        if p[1] > 0.9:
            raise SolveError("gone")
        return on_mesh(broken).function(p)

    models = [on_mesh(level) for level in range(3)]
    models[broken] = replace(models[broken], function=fragile)
    evaluate = SerialEvaluate(models[0], others=meshes(*models[1:]))
    data = MultilevelMonteCarlo(samples=200, pilot=40, control=control).run(INPUTS, evaluate)
    touched = {0: [0, 1], 1: [1, 2]}[broken]
    assert [level for level in range(3) if data["mesh_failed"][level] > 0] == touched
    bad = data["points"][:, 1] > 0.9
    np.testing.assert_array_equal(~data["ok"], bad & data["sample_level"].isin(touched))
    assert f"{int((~data.ok).sum())} of {data.sizes['sample']} samples have no answer" in data.attrs["note"]
    assert np.isfinite(data["mean"]).all()
    assert np.isfinite(data["std_error"]).all()


def test_failures_that_leave_nothing_are_an_error():
    def gone(p):
        if abs(p[0] - 1) > 1e-9:
            raise SolveError("gone")
        return on_mesh(1).function(p)

    evaluate = SerialEvaluate(on_mesh(0), others=meshes(replace(on_mesh(1), function=gone)))
    with pytest.raises(SolveError, match="level 1: 0 of 8 samples have an answer, expected 2: gone"):
        MultilevelMonteCarlo(samples=16, levels=2).run(INPUTS, evaluate)


# --- groups, restart -----------------------------------------------------------------------------------------------

RANKS = """
import sys
from pathlib import Path
from mpi4py import MPI
from tests.uq.methods.test_multilevel import INPUTS, hierarchy, meshes, on_mesh
from uq.evaluation import ensemble as groups
from uq.evaluation.checkpoint import Checkpoint
from uq.evaluation.ensemble import Ensemble
from uq.methods.multilevel import MultilevelMonteCarlo

groups.SELDOM = 0.0  # every block is written at once, however short it takes
method = MultilevelMonteCarlo(tolerance=0.004, levels=5, seed=3)
made = []

def maker(level):
    return lambda: made.append(level) or on_mesh(level)

ensemble = Ensemble.split(MPI.COMM_WORLD)
data = ensemble.run(
    on_mesh(0), lambda evaluate: method.run(INPUTS, evaluate), others=meshes(*map(maker, range(1, 5))),
    checkpoint=Checkpoint(Path(sys.argv[1]), "a study"),
)
if data is not None:
    assert data.identical(method.run(INPUTS, hierarchy(5)))
    assert made == list(range(1, data.sizes["level"])), made
    print("same", data.sizes["level"])
"""


@pytest.mark.slow
@pytest.mark.mpi
def test_same_numbers_as_in_one_process_and_after_an_interruption(tmp_path):
    """On 1, 2 and 3 groups; between them, the last blocks are lost: all others are found again."""
    for ranks in (1, 2, 3):
        blocks = sorted((tmp_path / "evaluations").glob("*.block"), key=lambda path: path.stat().st_mtime_ns)
        for path in blocks[-30:]:
            path.unlink()
        kept = {path: path.stat().st_mtime_ns for path in blocks[:-30]}
        done = run_script(ranks, RANKS, tmp_path)
        assert done.returncode == 0, done.stderr
        assert "same" in done.stdout
        assert {path: path.stat().st_mtime_ns for path in kept} == kept
        assert not blocks or len(list((tmp_path / "evaluations").glob("*.block"))) == len(blocks)


# --- studies and reports -------------------------------------------------------------------------------------------


def test_the_plan_names_every_mesh():
    planned = load(ROOT / "configs" / "beam-multilevel.toml")
    assert [model.unknowns for model in planned.meshes] == [585, 3375, 22491]
    assert planned.meshes[1].body.cells == (12, 2, 4)
    text = "\n".join(plan(planned))
    assert "3,375 on mesh 1" in text
    assert "22,491 on mesh 2" in text
    assert "43 for linearisations and pilots" in text


def test_a_mesh_that_is_too_large_is_refused():
    blocks = tomllib.loads((ROOT / "configs" / "beam-multilevel.toml").read_text())
    blocks["method"] |= {"levels": 8}
    with pytest.raises(StudyError, match=r"method.levels: the finest mesh cannot be: .* expected at most 60 million"):
        parse(blocks)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("control", [pytest.param("none", marks=pytest.mark.slow), "tangent"])
@pytest.mark.parametrize("levels", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_pictures_have_axes_with_units(control, levels):
    data = MultilevelMonteCarlo(samples=20, levels=levels, control=control).run(INPUTS, hierarchy(levels))
    data = data.assign_coords(unit=("output", ["m", "1"]))
    draw = (plots.mesh_variance, plots.mesh_mean, plots.mesh_samples, plots.mesh_cost)
    for ax in (of(data, "f") for of in draw):
        assert ax.get_xlabel()
        assert ax.get_ylabel()
        assert plots.png(ax).startswith(b"\x89PNG")
    labels = [line.get_label() for line in plots.mesh_cost(data, "f").lines]
    assert ("all meshes, no control" in labels) == (control == "tangent")


# --- the finite-element beam ---------------------------------------------------------------------------------------

SMALL = ["--set", "model.body.cells=[2,1,1]"]
METHOD = """
[method]
kind = "multilevel-monte-carlo"
samples = 12
pilot = 4
levels = 2
seed = 1
"""


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """The tiny study with two meshes, run in one process."""
    place = tmp_path_factory.mktemp("multilevel")
    text = (ROOT / "configs" / "tiny.toml").read_text()
    (place / "small.toml").write_text(text[: text.index("[method]")] + METHOD)
    with without_pictures():  # they are drawn in a test of their own
        done = in_process("run", place / "small.toml", *SMALL, "--out", place / "out")
    assert done.returncode == 0, done.stderr
    found = json.loads((place / "out" / "summary.json").read_text())["outputs"]["uy_max"]
    (line,) = (line for line in done.stdout.splitlines() if f" {found['mesh_error'] / 0.01:+.2g} " in line)  # in cm
    assert line.split()[0] == "mean"
    return place


@pytest.mark.fem
@pytest.mark.mpi
@pytest.mark.slow
def test_same_bits_on_any_number_of_groups(small, tmp_path):
    done = tissuq_on_two_ranks("run", small / "small.toml", *SMALL, "--out", tmp_path / "out", "--no-report")
    assert done.returncode == 0, done.stderr
    assert_same_bits(small / "out", tmp_path / "out")


@pytest.mark.fem
def test_report_of_a_study(small):
    page = (small / "out" / "report.html").read_text()
    for text in (
        "Meshes",
        "Total errors",
        "consistency",
        "2 × 1 × 1 cells",
        "on the coarsest mesh",
        "a solve, measured",
    ):
        assert text in page, text
    assert page.count("<figure>") == 2 + 2 * 4 + 2
    summary = json.loads((small / "out" / "summary.json").read_text())
    unknowns = [mesh["unknowns"] for mesh in summary["meshes"]]
    assert unknowns == [135, 675]
    assert sum(mesh["solves"] for mesh in summary["meshes"]) == summary["evaluations"]
    assert sum(mesh["cpu_seconds"] for mesh in summary["meshes"]) == pytest.approx(summary["cpu_seconds"])
    assert summary["outputs"]["uy_max"]["total_error"] > summary["outputs"]["uy_max"]["bias_error"] > 0


@pytest.mark.fem
def test_estimates_are_those_of_solves_on_both_meshes(small):
    from mpi4py import MPI

    from workflows.results.directory import read_dataset

    data = read_dataset(small / "out")
    case = load(small / "small.toml", ["model.body.cells=[2,1,1]"])
    coarse, fine = (model.build(MPI.COMM_SELF, case.inputs.names) for model in case.meshes)
    assert fine.spec.body.cells == (4, 2, 2)
    mean = case.inputs.mean
    at_mean = [model.solve(mean) for model in (coarse, fine)]
    for level in range(2):
        np.testing.assert_allclose(data["mesh_nominal"][level], at_mean[level].outputs, rtol=1e-6)
    pairs = data.isel(sample=(data["sample_level"] == 1).to_numpy())
    point = pairs["points"].to_numpy()[0]
    np.testing.assert_allclose(pairs["coarse"][0], coarse.solve(point).outputs, rtol=1e-6)
    np.testing.assert_allclose(pairs["fine"][0], fine.solve(point).outputs, rtol=1e-6)
    # the mean by its definition
    slopes = [solution.tangent(np.eye(2)).T for solution in at_mean]
    first = data.isel(sample=(data["sample_level"] == 0).to_numpy())
    below = first["fine"].to_numpy() - (first["points"].to_numpy() - mean) @ slopes[0].T
    points = pairs["points"].to_numpy() - mean
    above = (pairs["fine"] - pairs["coarse"]).to_numpy() - points @ (slopes[1] - slopes[0]).T
    np.testing.assert_allclose(data["mean"], below.mean(axis=0) + above.mean(axis=0), rtol=1e-6)
    assert (data["difference_variance_ratio"] > 10).all()
