"""Model selection: what is recovered, what is criticised, and the studies from the command line."""

import json
import re
import tomllib
from functools import partial

import numpy as np
import pytest
import xarray as xr
from scipy.stats import multivariate_normal

from forward.materials.material_point import HomogeneousModel, MaterialTest
from inverse.criticism.assessment import weighted
from inverse.criticism.comparison import Candidate, criticise, probabilities
from inverse.criticism.weights import FEWEST, RULE, trustworthy
from inverse.data.measurements import Measurements
from inverse.data.noise import Noise
from inverse.low_dimensional.evidence import evidence
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.methods.infer import Problem
from inverse.methods.invert import Invert
from inverse.methods.invert_few import invert_few
from inverse.methods.selection import Select, StatedNoise, posterior
from tests.launch import in_process, run_script, tissuq_on_two_ranks
from tests.problems import bananas
from tests.rubber import CONFIGS, FACTOR, treloar
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.hdf5 import stored_dataset
from uq.inputs.distributions import LogNormal, LogUniform, Normal, Uniform
from uq.inputs.random_parameters import Inputs
from workflows.__main__ import main
from workflows.config.mistakes import StudyError
from workflows.config.study import dump, load, parse
from workflows.data.material_tests import MeasuredTest
from workflows.results.comparison import doubts_of_selection, findings, grade, untrusted
from workflows.run.plan import plan
from workflows.starter import starter

STRETCHES = (1.2, 1.5, 1.9, 2.4, 2.9, 3.3)
MODES = ("uniaxial", "equibiaxial", "pure-shear")
TESTS = [MaterialTest(mode=mode, at=STRETCHES) for mode in MODES]
FIVE = {
    "neo-hookean": {"C1": LogNormal(mean=2e5, std=1e5)},
    "mooney-rivlin": {"C1": LogNormal(mean=2e5, std=1e5), "C2": Uniform(lower=0.0, upper=5e4)},
    "yeoh": {
        "C10": LogNormal(mean=2e5, std=1e5),
        "C20": Normal(mean=0.0, std=5e3),
        "C30": LogUniform(lower=1.0, upper=1e3),
    },
    "gent": {"mu": LogNormal(mean=4e5, std=2e5), "Jm": LogUniform(lower=30.0, upper=300.0)},
    "demiray": {"a": LogNormal(mean=4e5, std=2e5), "b": LogUniform(lower=0.002, upper=0.05)},
}


def model(kind, tests=TESTS):
    return HomogeneousModel(kind, {}, tests, tuple(FIVE[kind]))


def compare(values, kinds=tuple(FIVE), tests=TESTS, noise=None, **settings):
    labels = tuple(test.label for test in tests for _ in test.at)
    data = Measurements.of_tests(
        values, np.full(len(values), np.nan), labels, np.concatenate([test.at for test in tests])
    )
    candidates = {kind: Candidate(Inputs(FIVE[kind])) for kind in kinds}
    method = Select(
        samples=settings.pop("samples", 32), noise=noise or StatedNoise(relative=0.1, absolute=5e3), **settings
    )
    return method.run(candidates, {"all": data}, lambda kind, _: SerialEvaluate(model(kind, tests)))


def measured(kind, rng, noise=0.1, tests=TESTS):
    """Data from constants that are drawn from the prior."""
    x = rng.standard_normal((1, len(FIVE[kind])))
    stress = model(kind, tests).stresses(Inputs(FIVE[kind]).from_normals(x)[0])[0]
    return stress + np.maximum(noise * np.abs(stress), 5e3) * rng.standard_normal(stress.size)


def test_probabilities():
    np.testing.assert_allclose(
        probabilities(np.array([-700.0, -701.0]), np.ones(2)), [1 / (1 + np.exp(-1)), 0.268941], 1e-5
    )
    np.testing.assert_allclose(probabilities(np.zeros(2), np.array([3.0, 1.0])), [0.75, 0.25])
    assert [grade(x) for x in (0.5, 2.0, 4.0, 6.0)][1:] == ["positive", "strong", "very strong"]


def test_a_parameter_that_is_not_needed_loses():
    """Data of neo-Hookean rubber: Mooney–Rivlin and Yeoh fit them as well, and are less probable."""
    stress = model("neo-hookean").stresses(np.array([[2e5]]))[0]
    found = compare(stress, ("neo-hookean", "mooney-rivlin", "yeoh"))
    P = found["probability"].to_numpy()
    assert P[0] > 0.5
    assert P[0] > P[1]
    assert P[0] > P[2]
    assert P.sum() == pytest.approx(1)


def test_variance_of_averages_is_that_of_the_mixture():
    stress = model("gent").stresses(np.array([[4e5, 60.0]]))[0] * 1.02
    found = compare(stress, ("yeoh", "gent", "demiray"))
    P = found["probability"].to_numpy()[:, None]
    mean, std = found["prediction_mean"].to_numpy(), found["prediction_std"].to_numpy()
    second = (P * (std**2 + mean**2)).sum(axis=0)
    total = found["average_within"] + found["average_between"]
    np.testing.assert_allclose(total, second - (P * mean).sum(axis=0) ** 2, rtol=1e-6, atol=1e-3)


def texts(found):
    return [finding.text for finding in findings(found)]


@pytest.mark.slow
def test_uniaxial_data_alone_mislead():
    """Up to fourfold stretch Mooney–Rivlin fits tension, and Yeoh all three modes: what is said in the report."""
    study = load(CONFIGS / "treloar.toml", ["data.between=[1, 4]", "method.samples=64", "method.other_noises={}"])
    names = ("neo-hookean", "mooney-rivlin", "yeoh", "gent")
    models = {pair: study.build(*pair) for pair in study.pairs}
    chosen = {name: study.models[name] for name in names}
    found = study.method.run(chosen, study.data_groups, lambda *pair: SerialEvaluate(models[pair]))
    assert "It depends: the most probable is mooney-rivlin with uniaxial tension alone." in texts(found)
    assert texts(found)[0].startswith("yeoh is the most probable")


@pytest.mark.slow
def test_discrepancy_is_found_when_no_candidate_is_right():
    """Stiffening rubber and two models that cannot stiffen, with known and with inferred errors; not where one can."""
    rng = np.random.default_rng(2)
    tests = [MaterialTest(mode=mode, at=tuple(np.linspace(1.2, 4.5, 15))) for mode in MODES]
    point = np.array([[1.5e5, -1e3, 200.0]])
    stress = model("yeoh", tests).stresses(point)[0]
    values = stress * (1 + 0.05 * rng.standard_normal(stress.size))
    for factor in (None, FACTOR):
        noise = StatedNoise(relative=0.05, absolute=1e3, factor=factor)
        wrong = compare(values, ("neo-hookean", "mooney-rivlin"), tests, noise)
        assert any(line.startswith("Best of bad models") for line in texts(wrong))
        right = compare(values, ("neo-hookean", "yeoh"), tests, noise)
        assert not any(line.startswith("Best of bad models") for line in texts(right))


def doubts(values, kind, noise=None, **priors):
    inputs = Inputs(FIVE[kind] | priors)
    labels = tuple(test.label for test in TESTS for _ in test.at)
    data = Measurements.of_tests(
        values, np.full(len(values), np.nan), labels, np.concatenate([test.at for test in TESTS])
    )
    noise = noise or StatedNoise(relative=0.05, absolute=5e3)
    method = Select(samples=32, noise=noise)
    found = method.run({kind: Candidate(inputs)}, {"all": data}, lambda name, _: SerialEvaluate(model(name)))
    return doubts_of_selection(found, {kind: inputs}, noise.factor, {kind: dict.fromkeys(inputs.names, "Pa")})


def test_what_is_doubtful_of_the_most_probable_candidate_is_said():
    """Nothing of data of its own; else noise, data that do not belong, and constants far off or at an end, by name."""
    rng = np.random.default_rng(6)
    stress = model("mooney-rivlin").stresses(np.array([[2e5, 2e4]]))[0]
    values = stress + np.maximum(0.05 * np.abs(stress), 5e3) * rng.standard_normal(stress.size)
    assert not doubts(values, "mooney-rivlin")
    strange = np.where(np.arange(18) == 4, 2 * values, values)
    (doubt,) = doubts(strange, "mooney-rivlin")
    assert "not belong to the other 1" in doubt.text
    assert "by residuals in standard deviations: uniaxial at 2.9: −10" in doubt.text  # the largest is listed first
    doubt, *_ = doubts(values, "neo-hookean", C1=Normal(mean=1e5, std=1e4))
    assert re.match(r"neo-hookean: the posterior of C1 .* prior deviations from the prior \(100 kPa\)", doubt.text)
    assert doubt.severity == "error"
    doubt, *_ = doubts(values, "mooney-rivlin", C2=Uniform(lower=0.0, upper=1e3))
    assert "C2 is at the upper end of its range (1 kPa)" in doubt.text
    noise = StatedNoise(relative=1e-3, absolute=100, factor=LogUniform(lower=0.1, upper=1e3))
    found = doubts(values, "mooney-rivlin", noise)
    assert any(re.search(r"the inferred errors are [3-6]\d(\.\d)? times the stated ones", one.text) for one in found)
    noise = StatedNoise(absolute=5e5, factor=LogUniform(lower=0.1, upper=10.0))
    found = doubts(1e6 * rng.standard_normal(18), "neo-hookean", noise)
    assert any("the model does not explain these data" in one.text and one.severity == "error" for one in found)


@pytest.mark.slow
def test_left_out_scores_of_a_linear_model():
    """A normal posterior has normal predictions of each left-out datum: closed forms."""
    priors = {"C1": Normal(mean=2e5, std=1e5), "C2": Normal(mean=0.0, std=1e5)}
    tests = tuple(TESTS)
    it = HomogeneousModel("mooney-rivlin", {}, tests, ("C1", "C2"))
    rng = np.random.default_rng(0)
    stress = it.stresses(np.array([[1.8e5, 1e4]]))[0]
    values = stress * (1 + 0.1 * rng.standard_normal(stress.size))
    labels = tuple(test.label for test in tests for _ in test.at)
    data = Measurements.of_tests(
        values, np.full(len(values), np.nan), labels, np.concatenate([test.at for test in tests])
    )
    inputs = Inputs(priors)
    whole = posterior(Candidate(inputs), data, StatedNoise(relative=0.1), SerialEvaluate(it))
    found = criticise(weighted(whole, evidence(whole, laplace(whole), 2048)), whole, data)
    A = it.stresses_and_derivatives(inputs.mean[None])[1][0] * inputs.std
    r, sigma = values - it.stresses(inputs.mean[None])[0], 0.1 * np.abs(values)
    for j in (0, 7, 17):
        rest = np.arange(values.size) != j
        H = np.eye(2) + (A[rest] / sigma[rest, None] ** 2).T @ A[rest]
        mean = A[j] @ np.linalg.solve(H, A[rest].T @ (r[rest] / sigma[rest] ** 2))
        variance = sigma[j] ** 2 + A[j] @ np.linalg.solve(H, A[j])
        exact = -((r[j] - mean) ** 2) / (2 * variance) - np.log(2 * np.pi * variance) / 2
        assert found.scores[j] == pytest.approx(exact, abs=0.02)


def test_whole_tests_are_held_out():
    """Of a linear model with normal parameters ln p(y_t | others) is normal: a closed form."""
    priors = {"C1": Normal(mean=2e5, std=1e5), "C2": Normal(mean=0.0, std=1e5)}
    it = HomogeneousModel("mooney-rivlin", {}, tuple(TESTS), ("C1", "C2"))
    inputs = Inputs(priors)
    stress = it.stresses(np.array([[1.8e5, 1e4]]))[0]
    values = stress * (1 + 0.1 * np.random.default_rng(0).standard_normal(stress.size))
    labels = tuple(test.label for test in TESTS for _ in test.at)
    data = Measurements.of_tests(
        values, np.full(len(values), np.nan), labels, np.concatenate([test.at for test in TESTS])
    )
    method = Select(samples=32, noise=StatedNoise(relative=0.1), held_out=True)
    found = method.run({"one": Candidate(inputs)}, {"all": data}, lambda *pair: SerialEvaluate(it))
    A = it.stresses_and_derivatives(inputs.mean[None])[1][0] * inputs.std
    r, sigma = values - it.stresses(inputs.mean[None])[0], 0.1 * np.abs(values)
    assert found.left_out.values.tolist() == list(MODES)
    for k in range(3):
        held = np.arange(values.size) // len(STRETCHES) == k
        H = np.eye(2) + (A[~held] / sigma[~held, None] ** 2).T @ A[~held]
        mean = A[held] @ np.linalg.solve(H, A[~held].T @ (r[~held] / sigma[~held] ** 2))
        exact = multivariate_normal(mean, np.diag(sigma[held] ** 2) + A[held] @ np.linalg.solve(H, A[held].T))
        assert found["held_out_score"].values[k, 0] == pytest.approx(exact.logpdf(r[held]), abs=1e-6)
        assert found["held_out_score_error"].values[k, 0] < 1e-6
    assert found["point_weight"].sum().item() == pytest.approx(1)


def test_least_squares_are_modes_with_wide_priors():
    """Yeoh on all of Treloar's tests: the mode is the solution of the normal equations."""
    study = treloar()
    data = study.data_groups["all"]
    it = HomogeneousModel("yeoh", {}, study.data.tests, ("C10", "C20", "C30"))
    sigma = np.full(data.values.size, 5e4)
    A = it.stresses_and_derivatives(np.zeros((1, 3)))[1][0]
    fitted = np.linalg.lstsq(A, data.values, rcond=None)[0]
    wide = {"C10": Normal(mean=0.0, std=1e8), "C20": Normal(mean=0.0, std=1e6), "C30": Normal(mean=0.0, std=1e5)}
    found = Posterior(Inputs(wide), SerialEvaluate(it), data.values, Noise(sigma))
    mode = found.physical(laplace(found).mode[None, :])[0]
    np.testing.assert_allclose(mode, fitted, rtol=1e-5)
    assert fitted[0] > 0 > fitted[1]
    assert fitted[2] > 0


def test_brain_cortex_is_in_the_second_invariant():
    """Non-negative Mooney–Rivlin puts all of the stiffness of cortex into C2."""
    from scipy.optimize import nnls

    study = load(CONFIGS / "brain.toml")
    assert study.data.data_groups == ("basal_ganglia", "corona_radiata", "corpus_callosum", "cortex")
    data = study.data_groups["cortex"]
    A = study.build("mooney-rivlin", "cortex").stresses_and_derivatives(np.full((1, 2), 100.0))[1][0]
    (C1, C2), _ = nnls(A, data.values)
    assert C1 < 1e-6 * C2
    assert 200 < C2 < 2000


def test_shipped_studies_say_where_their_data_are_from():
    for name, first, count in (("treloar", "Treloar", 53), ("brain", "Budday", 288)):
        study = load(CONFIGS / f"{name}.toml")
        assert first in study.data.source[0]
        assert any("licence" in line for line in study.data.source)
        assert sum(len(test.at) for test in study.data.tests) == count
        assert parse(tomllib.loads(dump(study))) == study


SMALL = """
[data]
file = "table.csv"
unit = 1e3

[candidates.neo-hookean]
material = { kind = "neo-hookean" }
parameters.C1 = { kind = "log-normal", mean = 500, std = 300 }

[candidates.mooney-rivlin]
material = { kind = "mooney-rivlin", C2 = 10 }
parameters.C1 = { kind = "log-normal", mean = 500, std = 300 }
weight = 2

[method]
kind = "select"
samples = 32
held_out = true
noise = { relative = 0.1, absolute = 20 }
"""
TABLE = "# measured by hand\nmode,stretch,stress\nuniaxial,1.1,0.3\nuniaxial,1.2,0.55\nsimple-shear,0.1,0.1\n"


@pytest.fixture
def small(tmp_path):
    (tmp_path / "small.toml").write_text(SMALL)
    (tmp_path / "table.csv").write_text(TABLE)
    return tmp_path / "small.toml"


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("table.csv", "tabel.csv", "data.file: .*tabel.csv: cannot be read: No such file"),
        ("unit = 1e3", 'measured = "stres"', "has no column 'stres'; did you mean 'stress'"),
        ("unit = 1e3", "units = 1e3", "data.units: unknown key; did you mean 'unit'"),
        ("unit = 1e3", 'where = { mode = "torsion" }', "no row is left"),
        ('"neo-hookean" }', '"neo-hokean" }', "candidates.neo-hookean: material.kind: 'neo-hokean'; did you mean"),
        ("parameters.C1", "parameters.C3", "'C3' is no constant of 'neo-hookean'"),
        ("mean = 500", 'mean = "soft"', "candidates.neo-hookean.parameters.C1.mean"),
        ("C2 = 10", "C1 = 10", "is given in material and in parameters"),
        (", C2 = 10", "", "missing: C2"),
        ("weight = 2", 'model.kind = "specimen"', "candidates.mooney-rivlin.model: there is no model that it changes"),
        (
            '"log-normal", mean = 500',
            '"normal", mean = -500',
            r"hookean.parameters: 95.2 % of the values are impossible; at the medians, .* μ = 2 C1 = -1000 Pa.*'C1'",
        ),
        ("samples = 32", "samples = 32\nmesh_error = false", "method.mesh_error: tests of materials have no mesh"),
        ("samples = 32", "samples = 8", "method.samples: input should be greater than or equal to 32"),
        ("{ relative = 0.1, absolute = 20 }", "{}", "no sigma with the data"),
        ("weight = 2", "weight = 0", "candidates.mooney-rivlin.weight"),
        ("samples = 32", "samples = 32\nsubsets = { none = [] }", "method.subsets.none: .* at least 1 item"),
        (
            "absolute = 20 }",
            'absolute = 20, factor = { kind = "uniform", lower = -1, upper = 2 } }',
            "method.noise.factor: reaches -1, expected a factor on standard deviations",
        ),
    ],
)
def test_one_line_for_a_mistake(small, old, new, told):
    small.write_text(SMALL.replace(old, new, 1))
    with pytest.raises(StudyError, match=told) as caught:
        load(small)
    assert len(caught.value.args) == 1


@pytest.mark.parametrize(
    ("row", "told"),
    [
        ("torsion,1.1,2", "line 6: unknown mode 'torsion'"),
        ("uniaxial,1.1,much", "line 6: stress is 'much', expected a number"),
        ("uniaxial,1.1", "table.csv: line 6: 2 cells, expected 3"),
        ("uniaxial,1.1,2,3", "table.csv: line 6: 4 cells, expected 3"),
        ("uniaxial,nan,1", "line 6: stretch is 'nan', expected a number"),
        ("uniaxial,-1,1", "line 6: stretch is '-1', expected a number more than 0"),
        ("uniaxial,150,1", "line 6: stretch is '150', expected a stretch"),
        ("uniaxial,1.1,2\nuniaxial,1.1,2", "lines 6 and 7 are the same, expected each measurement once"),
    ],
)
def test_one_line_for_a_bad_row(small, row, told):
    (small.parent / "table.csv").write_text(TABLE + row + "\n")
    with pytest.raises(StudyError, match=told) as caught:
        load(small)
    assert len(caught.value.args) == 1


def test_second_stretches_and_errors_in_a_table(small):
    """The column of second stretches is of biaxial tests alone; errors of the data are more than nothing."""
    rows = ["mode,stretch,other,stress,error", "uniaxial,1.1,,0.3,0.1", "biaxial,1.1,1.2,0.4,0.1"]
    columns = ["data.across='other'", "data.sigma='error'"]
    (small.parent / "table.csv").write_text("\ufeff" + "\n".join(rows))
    tests = load(small, columns).data.tests
    assert [test.across for test in tests] == [None, (1.2,)]
    (small.parent / "table.csv").write_text("\n".join([*rows, "biaxial,1.2,1.2,0.4,0"]))
    with pytest.raises(StudyError, match="line 4: error is '0', expected a number more than 0"):
        load(small, columns)


def test_both_stresses_in_a_table(small):
    """As columns beside each other, or as rows that say which stress they hold."""
    wide = ["mode,l1,l2,s1,s2", "uniaxial,1.1,,0.3,", "biaxial,1.1,1.2,0.4,0.6", "biaxial,1.3,1.2,,0.7"]
    named = ["data.at='l1'", "data.across='l2'"]
    columns = [*named, "data.measured={P1='s1', P2='s2'}"]
    table = small.parent / "table.csv"
    table.write_text("\n".join(wide))
    study = load(small, columns)
    tests = [(t.label, t.component, t.at, t.across, t.measured) for t in study.data.tests]
    assert tests == [
        ("uniaxial", "P1", (1.1,), None, (300.0,)),
        ("biaxial", "P1", (1.1,), (1.2,), (400.0,)),
        ("biaxial P2", "P2", (1.1, 1.3), (1.2, 1.2), (600.0, 700.0)),
    ]
    assert parse(tomllib.loads(dump(study))) == study
    table.write_text("mode,l1,l2,which,stress\nbiaxial,1.1,1.2,P1-P2,0.4\nbiaxial,1.1,1.2,,0.5\n")
    tests = load(small, [*named, "data.component='which'"]).data.tests
    assert [(t.label, t.measured) for t in tests] == [("biaxial P1-P2", (400.0,)), ("biaxial", (500.0,))]
    for row, told in (
        ("uniaxial,1.1,,0.3,0.2", "line 5, s2: a stress across, expected an empty cell"),
        ("biaxial,1.1,1.2,,", "line 5: no stress, expected one in s1 or s2"),
        ("biaxial,1.1,1.2,x,", "line 5: s1 is 'x', expected a number"),
    ):
        table.write_text("\n".join([*wide, row]))
        with pytest.raises(StudyError, match=told):
            load(small, columns)
    with pytest.raises(StudyError, match="sigma: no column for P2"):
        load(small, [*columns, "data.sigma={P1='s1'}"])
    with pytest.raises(StudyError, match="no column 's3'; did you mean"):
        load(small, [*named, "data.measured={P1='s3'}"])


def test_the_order_of_rows_says_nothing_of_neighbours():
    """Residuals that follow each other in the plane of the stretches, whichever way the rows are written."""
    rng = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(np.linspace(1.1, 2, 6), np.linspace(1.1, 2, 5)), axis=-1).reshape(-1, 2)
    truth = HomogeneousModel("gent", {"mu": 4e5, "Jm": 8.0}, [_biaxial(grid)], ()).stresses(np.zeros((1, 0)))[0]
    values = truth + 2e3 * rng.standard_normal(truth.size)
    found = []
    for order in (np.arange(30), rng.permutation(30), np.lexsort(grid.T)):
        it = HomogeneousModel("neo-hookean", {}, [_biaxial(grid[order])], ("C1",))
        data = Measurements.of_tests(values[order], values * np.nan, ("biaxial",) * 30, grid[order, 0], grid[order])
        candidate = Candidate(Inputs({"C1": LogNormal(mean=2e5, std=1e5)}))
        one = posterior(candidate, data, StatedNoise(absolute=2e4, factor=FACTOR), SerialEvaluate(it))
        found.append(criticise(weighted(one, evidence(one, laplace(one), 64)), one, data).correlation)
    assert found[0] < 0.01
    np.testing.assert_allclose(found[1:], found[0], atol=1e-12)


def _biaxial(stretches):
    return MaterialTest(mode="biaxial", at=tuple(stretches[:, 0]), across=tuple(stretches[:, 1]))


def test_priors_with_inadmissible_tails_are_no_failures(small):
    """C2 may be negative, and what makes no material has no weight: said by `check` and the run, which exits with 0."""
    text = SMALL.replace('"mooney-rivlin", C2 = 10 }', '"mooney-rivlin" }').replace("held_out = true\n", "")
    text = text.replace('"log-normal", mean = 500', '"normal", mean = 250')
    text = text.replace("weight = 2", 'parameters.C2 = { kind = "normal", mean = -20, std = 100 }\nweight = 2')
    small.write_text(text)
    told = "note *mooney-rivlin: 23 % of the prior is of materials that are not stable at rest"
    assert re.search(told, "\n".join(plan(load(small))))
    out = small.parent / "out"
    done = in_process("run", small, "--out", out, "--no-report")
    assert done.returncode == 0, done.stderr
    summary = json.loads((out / "summary.json").read_text())
    assert summary["status"] == "complete"
    assert summary["failed"] == 0
    assert summary["failures"] == []
    assert summary["zero_likelihood"] > 0
    texts = [one["text"] for one in summary["findings"]]
    assert any("their likelihood is zero" in text for text in texts)
    assert any(text.startswith("mooney-rivlin: 23 % of the prior") for text in texts)


@pytest.mark.slow
def test_a_chain_that_ends_before_the_data_has_no_likelihood(small):
    """Gent's energy ends at I1 − 3 = Jm: points of the prior that do not reach the data are weighted by nothing."""
    text = SMALL.replace('"neo-hookean" }', '"gent" }').replace("parameters.C1", "parameters.mu", 1)
    text = text.replace("weight = 2", "").replace(
        "[candidates.mooney", 'parameters.Jm = { kind = "log-uniform", lower = 1e-3, upper = 1 }\n[candidates.mooney'
    )
    small.write_text(text)
    out = small.parent / "out"
    code = in_process("run", small, "--out", out, "--no-report").returncode
    summary = json.loads((out / "summary.json").read_text())
    assert summary["failed"] == 0 < summary["zero_likelihood"]
    assert summary["status"] == "complete"
    # Of these few points hardly one has a weight: that, and no failure, is why the exit code is 3.
    errors = [one["text"] for one in summary["findings"] if one["severity"] == "error"]
    assert [text.partition(":")[0] for text in errors] == ["Evidences not to be trusted"]
    assert code == 3
    assert any("no stress in the test" in one["text"] for one in summary["findings"])


def test_arviz_reads_results_as_they_are(small):
    """Groups `prior` and `log_likelihood`: leave-one-out scores and their comparison are those of the program."""
    arviz = pytest.importorskip("arviz")
    small.write_text(SMALL.replace("held_out = true", "").replace("samples = 32", "samples = 64"))
    rows = "".join(f"uniaxial,{x},{2 * 0.5 * (x - x**-2):.3f}\n" for x in (1.3, 1.5, 1.7, 1.9))
    (small.parent / "table.csv").write_text(TABLE + rows)
    out = small.parent / "out"
    assert in_process("run", small, "--out", out, "--no-report").returncode == 0
    found = stored_dataset(out / "results.nc")
    data = arviz.from_netcdf(out / "results.nc")
    assert {"posterior", "prior", "log_likelihood", "observed_data"} <= set(data.groups())
    assert set(data.prior.data_vars) == set(data.posterior.data_vars)
    names = [str(name) for name in found.model.values]
    scores = {name: arviz.loo(data, var_name=name, pointwise=True) for name in names}
    for name in names:
        assert scores[name].elpd_loo == pytest.approx(float(found["score"].sel(model=name)), abs=0.3)
    ranked = [str(found.model.values[i]) for i in np.argsort(-found["score"].to_numpy())]
    assert arviz.compare(scores).index.tolist() == ranked


def test_one_rule_for_weights():
    """Few points, long tails, or nearly all of them equal: said by the same rule wherever weights are used."""
    assert trustworthy(0.5, 100.0, 256)
    assert not trustworthy(0.5, FEWEST - 1, 256)
    assert not trustworthy(0.75, 100.0, 256)
    assert trustworthy(0.75, 230.0, 256)
    assert not trustworthy(np.inf, 10.0, 10)
    assert "20 points" in RULE
    assert "0.7" in RULE
    assert "80 %" in RULE


def test_subsets_are_of_known_tests(small):
    with pytest.raises(StudyError, match=r"method\.subsets\.x: no test has this name; did you mean 'uniaxial'"):
        load(small, ['method.subsets={x = ["uniaxal"]}'])
    study = load(small, ['method.subsets={x = ["uniaxial"]}', "method.samples=64", "method.held_out=false"])
    assert "evidences   4" in plan(study)


def test_the_starter_is_valid():
    study = parse(tomllib.loads(starter("select")))
    assert study.method.kind == "select"


def test_candidates_with_fibres(small):
    """Fibres along the stretch stiffen it; those that a test would shear are a mistake."""
    fibres = "material = { kind = 'holzapfel-gasser-ogden', k1 = 200, k2 = 1, fibres = [[1, 0, 0]] }\nparameters.c"
    old = 'material = { kind = "neo-hookean" }\nparameters.C1'
    small.write_text(SMALL.replace(old, fibres, 1))
    study = load(small)
    assert parse(tomllib.loads(dump(study))) == study
    tension = study.build("neo-hookean", "all").stresses(np.array([[500.0]]))[0, :2]
    x = np.array([1.1, 1.2])
    I4 = x**2
    expected = 500 * (x - x**-2) + 400 * (I4 - 1) * np.exp((I4 - 1) ** 2) * x
    np.testing.assert_allclose(tension, expected, rtol=1e-12)
    small.write_text(SMALL.replace(old, fibres.replace("[1, 0, 0]", "[1, 1, 0]"), 1))
    with pytest.raises(StudyError, match=r"candidates.neo-hookean.material: fibres that a 'uniaxial' test would shear"):
        load(small)


def test_other_studies_do_not_import_inversion():
    """Nor does their report, which asks all sections whether they apply."""
    script = (
        "import sys, workflows.run.run; from workflows.report.section import sections; "
        "assert len(sections()) > 20; print('inverse' in sys.modules)"
    )
    assert run_script(None, script).stdout.strip() == "False"


def test_a_study_from_the_command_line(small, looked_at, capsys):
    """One rank or two: the same bytes; a report; nothing to do the second time."""
    done = in_process("run", small, "--out", small.parent / "one")
    assert done.returncode == 0, done.stderr
    assert re.search("^neo-hookean: .* %; ln Z ", done.stdout, re.MULTILINE)
    summary = json.loads((small.parent / "one" / "summary.json").read_text())
    assert set(summary["models"]) == {"neo-hookean", "mooney-rivlin"}
    for found in summary["models"].values():
        assert set(found) == {"log_evidence", "log_evidence_error", "probability", "stacking", "trusted"}
    assert sum(found["probability"] for found in summary["models"].values()) == pytest.approx(1)
    done = tissuq_on_two_ranks("run", small, "--out", small.parent / "two", "--no-report")
    assert done.returncode == 0, done.stderr
    assert (small.parent / "one/results.nc").read_bytes() == (small.parent / "two/results.nc").read_bytes()
    page = (small.parent / "one" / "report.html").read_text()
    looked_at(small.parent / "one")
    for words in (
        "Evidences and probabilities",
        "measured by hand",
        "Is the best one good?",
        "predicted from the others",
        "Posteriors of",
        "data:image/svg+xml",
    ):
        assert words in page
    # Curves are on the first screen, and stresses are no displacements of points.
    assert page.index('id="curves"') < page.index('id="evidences"')
    assert "measured stress is 1 % larger" in page
    assert "farther along" not in page
    capsys.readouterr()
    assert main(["run", str(small), "--out", str(small.parent / "one")]) == 0
    assert "nothing to do" in capsys.readouterr().out
    assert main(["report", str(small.parent / "one"), str(small.parent / "two")]) == 2
    assert "no estimates of outputs" in capsys.readouterr().err
    found = stored_dataset(small.parent / "one" / "results.nc")
    assert found["prior_probability"].to_numpy() == pytest.approx([1 / 3, 2 / 3])
    posterior = xr.load_dataset(small.parent / "one" / "results.nc", group="posterior")
    drawn = posterior["mooney-rivlin.C1"].mean(("chain", "draw"))
    expected = found["constant_mean"].sel(model="mooney-rivlin", parameter="C1")
    spread = found["constant_std"].sel(model="mooney-rivlin", parameter="C1")
    worth = found["effective"].sel(model="mooney-rivlin")
    assert (abs(drawn - expected) < 3 * spread / np.sqrt(worth)).all()  # draws are of the points that were solved


def test_specimens_that_disagree(small, capsys):
    """Half of the specimens stiffen and half do not: that is said before the probability of one material for all."""
    at = (1.1, 1.4, 1.8, 2.2, 2.6)
    test = (MaterialTest(mode="uniaxial", at=at),)
    soft = HomogeneousModel("neo-hookean", {}, test, ("C1",))
    stiffening = HomogeneousModel("demiray", {"b": 0.3}, test, ("a",))
    rng, rows = np.random.default_rng(1), ["specimen,mode,stretch,stress"]
    for k in range(6):
        stress = (soft, stiffening)[k % 2].stresses(np.array([[500.0 + 50 * k]]))[0]
        values = stress * (1 + 0.1 * rng.standard_normal(len(at))) / 1e3
        rows += [f"s{k},uniaxial,{x},{value}" for x, value in zip(at, values, strict=True)]
    (small.parent / "table.csv").write_text("\n".join(rows))
    text = SMALL
    for old, new in (
        ("unit = 1e3", 'unit = 1e3\ngroup = "specimen"'),
        ('"mooney-rivlin", C2 = 10 }\nparameters.C1', '"demiray", b = 0.3 }\nparameters.a'),
        ("candidates.mooney-rivlin", "candidates.demiray"),
        ("held_out = true\n", ""),
    ):
        assert old in text
        text = text.replace(old, new)
    small.write_text(text)
    assert main(["run", str(small), "--out", str(small.parent / "out"), "--no-report"]) == 0
    lines = capsys.readouterr().out.splitlines()
    said = next(k for k, line in enumerate(lines) if "Specimens disagree: of 6, 3 are rather" in line)
    assert "s0, s2, s4" in lines[said] or "s1, s3, s5" in lines[said]
    assert said < next(k for k, line in enumerate(lines) if "; ln Z" in line)


@pytest.mark.unit
def test_evidences_that_cannot_be_trusted_are_an_error():
    by = ("model", "group")
    found = xr.Dataset(
        {
            "log_evidence": ("model", [-3.0, -4.0]),
            "prior_probability": ("model", [0.5, 0.5]),
            "trusted": (by, [[True], [True]]),
            "trust": (by, [["laplace"], ["neither"]]),
            "verdict": (by, [["worth 500"], ["worth 3; run chains"]]),
        },
        {"model": ["one", "other"], "group": ["all"]},
    )
    (warning,) = untrusted(found, found, ())
    assert warning.severity == "warning"
    assert warning.text == "Constants are Laplace's, and not to be trusted: other (worth 3; run chains)."
    assert not list(untrusted(found.isel(model=[0]), found.isel(model=[0]), ()))
    few = found.assign(trusted=(by, [[True], [False]]))
    (error,) = untrusted(few, few, ())
    assert error.severity == "error"
    assert error.text == "Evidences not to be trusted: other (worth 3; run chains)."
    found = found.assign(trust=(by, [["laplace"], ["corrected"]]))
    (error,) = untrusted(found, few, ())  # its mesh was looked at afterwards
    assert str(error) == "error: Evidences not to be trusted for what meshes do to them: other."
    assert not list(untrusted(found, few, ("other",)))


@pytest.mark.slow
def test_probabilities_are_calibrated():
    """Constants drawn from the prior of each model in turn: of events with probability P, a share P happens."""
    rng = np.random.default_rng(7)
    said, happened = [], []
    for _ in range(20):
        for k, kind in enumerate(FIVE):
            noise = StatedNoise(relative=0.15, absolute=5e3)
            found = compare(measured(kind, rng, noise=0.15), noise=noise, samples=64)
            said.append(found["probability"].to_numpy())
            happened.append(np.arange(len(FIVE)) == k)
    P, true = np.concatenate(said), np.concatenate(happened)
    assert np.concatenate([p[h] for p, h in zip(said, happened, strict=True)]).mean() > 0.35
    for low, high in ((0.0, 0.05), (0.05, 0.3), (0.3, 0.7), (0.7, 0.95), (0.95, 1.0)):
        members = (low <= P) & (high >= P)
        spread = np.sqrt((P[members] * (1 - P[members])).sum()) + 0.5
        assert abs(true[members].sum() - P[members].sum()) < 3 * spread, (low, high)


def strains(mode, at, across=(), sign=1):
    """Stresses of rubber in a table whose column of stretches holds strains."""
    stretches = 1 + np.array(at)
    other = {"across": tuple(1 + np.array(across))} if len(across) else {}
    stress = model("neo-hookean", [MaterialTest(mode=mode, at=tuple(stretches), **other)]).stresses([[2e5]])[0]
    return {"mode": mode, "at": at, **({"across": across} if len(across) else {}), "measured": tuple(sign * stress)}


@pytest.mark.unit
@pytest.mark.parametrize("mode", ["uniaxial", "equibiaxial", "pure-shear"])
def test_strains_are_not_read_as_stretches(mode):
    for at in ((0.05, 0.1, 0.2), (0.5, 1.0, 2.0, 4.0)):
        with pytest.raises(ValueError, match="is it a strain"):
            MeasuredTest(**strains(mode, at))
    with pytest.raises(ValueError, match="is it a strain"):  # of a compression, both without their sign
        MeasuredTest(**strains(mode, (-0.1, -0.2), sign=-1) | {"at": (0.1, 0.2)})
    tested = np.array([0.6, 0.8, 0.95, 1.3, 2.0])  # what is right stays right
    stress = model("neo-hookean", [MaterialTest(mode=mode, at=tuple(tested))]).stresses([[2e5]])[0]
    noisy = np.where(tested == 0.95, 1e3, stress)  # nearly at rest an error may have the other sign
    MeasuredTest(mode=mode, at=tuple(tested), measured=tuple(noisy))


@pytest.mark.unit
def test_strains_in_two_directions_and_in_shear():
    with pytest.raises(ValueError, match="is it a strain"):
        MeasuredTest(**strains("biaxial", (0.1, 0.2), (0.2, 0.1)))
    MeasuredTest(**strains("simple-shear", (0.0, 0.1)) | {"measured": (0.0, 2e3)})  # amounts of shear
    # Shortened along 1 by a load across, it still pulls.
    at, across = (0.85, 0.95), (2.0, 2.0)
    stress = model("neo-hookean", [MaterialTest(mode="biaxial", at=at, across=across)]).stresses([[2e5]])[0]
    assert stress.min() > 0
    MeasuredTest(mode="biaxial", at=at, across=across, measured=tuple(stress))


def test_a_table_of_strains_is_one_line(small, capsys):
    strained = TABLE.replace("1.1,", "0.1,").replace("1.2,", "0.2,")
    for table, told in ((strained, "is it a strain?"), (strained.replace("0.1,0.3", "0,0"), "1 + strain")):
        (small.parent / "table.csv").write_text(table)
        assert main(["check", str(small)]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1
        assert told in lines[0]


def of_bananas(pairs, bend=0.7, **settings):
    """What a comparison finds of a curved posterior; what makes an inversion of the same; and what is true."""
    model, curved, *truth = bananas(pairs, bend)
    d = 2 * pairs
    data = Measurements.of_tests(np.zeros(d), np.ones(d), ("all",) * d, np.arange(d, dtype=float))
    method = Select(noise=StatedNoise(), **settings)
    evaluate = SerialEvaluate(model)
    problem = Problem(data, method, finer=None, model=model)
    found = method.run({"it": Candidate(curved.inputs)}, {"all": data}, lambda *_: evaluate, lambda *_: problem)
    named = tuple(f"z{k}" for k in range(d))
    of_outputs = Measurements.of(np.zeros(d), np.ones(d), range(d), range(d), named, named, named, some=True)
    beside = Invert(samples=settings["samples"], chains=settings.get("chains"))
    asked = partial(invert_few, curved.inputs, evaluate, Problem(of_outputs, beside, finer=None, model=model))
    return found.sel(model="it", group="all"), lambda: asked().dataset, truth


def test_where_points_count_little_a_comparison_says_what_an_inversion_says():
    """40 unknowns, curved: few of the points count, and none of them stands for constants or predictions."""
    found, invert, _ = of_bananas(20, samples=64)
    inverted = invert()
    assert not found["trusted"]
    assert found["effective"] < 20
    assert str(found["trust"].item()) == "neither"
    assert str(inverted["why"].item()).endswith(str(found["verdict"].item()))
    np.testing.assert_allclose(found["constant_mean"], inverted["mean"], rtol=1e-9)
    np.testing.assert_allclose(found["constant_std"], inverted["std"], rtol=1e-9)
    weights = found["point_weight"].to_numpy()
    assert 1 / (weights**2).sum() == pytest.approx(64)
    spread = found["point"].to_numpy().std(axis=0)
    np.testing.assert_allclose(spread, found["constant_std"], rtol=0.25)  # 64 points of 40 unknowns
    assert (found["prediction_std"] > 0.7).all()  # of one point it would be nothing
    assert not found["score_trusted"]


@pytest.mark.slow
def test_chains_of_a_comparison():
    """6 unknowns, curved: constants, predictions and ln Z by gradients, against closed forms."""
    pytest.importorskip("mici")
    found, _, (mean, std, log_evidence) = of_bananas(3, 0.5, samples=64, chains="hmc")
    assert found["chains"] == 2
    assert found["trusted"]
    assert str(found["trust"].item()) == "corrected"
    assert np.abs((found["constant_mean"] - mean) / std).max() < 0.2
    assert np.abs(found["constant_std"] / std - 1).max() < 0.25
    log, error = float(found["group_log_evidence"]), float(found["group_log_evidence_error"])
    assert abs(log - log_evidence) < 3 * error < 3
    assert np.abs(found["prediction_mean"]).max() < 0.5  # z is standard normal
    # Priors half as wide: Z is the density of the prior there too.
    narrower = float(found["variant_log_evidence"].sel(variant="priors × 0.5"))
    assert narrower - log == pytest.approx(6 * np.log(2), abs=0.1)


def test_chains_that_a_comparison_cannot_run(small):
    small.write_text(SMALL.replace("samples = 32", 'samples = 32\nchains = "nuts"', 1))
    with pytest.raises(StudyError, match=r"method\.chains"):
        load(small)
    small.write_text(SMALL.replace("samples = 32", 'samples = 32\nchains = "pcn"', 1))
    assert load(small).planned - load(small, ["method.chains='emcee'"]).planned < 0
    with pytest.raises(StudyError, match=r"parallel\.ranks_per_model: .* follow gradients on one rank, expected 1"):
        load(small, ["method.chains='hmc'", "parallel.ranks_per_model=2"])
