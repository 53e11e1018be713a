"""Errors of a cheap model that are learnt from pairs of solves: against closed forms, and in studies."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal, t

from forward.model import SolveError
from forward.pointwise import FunctionModel
from inverse.criticism.assessment import answer
from inverse.data.measurements import Measurements
from inverse.data.noise import ModelError, Noise, Trend
from inverse.low_dimensional.posterior import Posterior
from inverse.methods.infer import Problem, infer
from inverse.methods.invert import Invert
from inverse.methods.model_error import Truth
from tests.launch import in_process
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.hdf5 import stored_dataset
from uq.inputs.distributions import Normal
from uq.inputs.random_parameters import Inputs
from workflows.config.mistakes import StudyError
from workflows.config.study import document, load, parse

RNG = np.random.default_rng(5)
M, PAIRS = 9, 16
A, SHIFT, SIGMA = RNG.standard_normal((M, 2)), RNG.standard_normal(M), 0.3 + 0.2 * RNG.uniform(size=M)
WILD = RNG.standard_normal((M, 3))  # of errors that follow no parameter
MEAN, PRIOR = np.array([1.0, 0.0]), np.diag([0.25, 4.0])
INPUTS = Inputs({"a": Normal(mean=1.0, std=0.5), "b": Normal(mean=0.0, std=2.0)})
NAMES = tuple("qrstuvwxy")


def wild(p):
    """Numbers of mean 0 and variance 1 that look random."""
    return np.sqrt(2) * np.sin(1e4 * np.arange(1, 4) * (p[0] + 0.7 * p[1]))


def true(p):
    return A @ p + SHIFT + WILD @ wild(p)


def cheap(p):
    return A @ p


def posterior(data, names=NAMES, sigma=SIGMA):
    return Posterior(INPUTS, SerialEvaluate(FunctionModel(cheap, ("a", "b"), names, lambda p: A)), data, Noise(sigma))


def truth(function=true, solves=PAIRS, seed=0, names=NAMES):
    return Truth(SerialEvaluate(FunctionModel(function, ("a", "b"), names)), solves, seed)


def inferred(data, other, **kwargs):
    given, method = (
        Measurements.of(data, np.ones(len(data)), [0] * len(data), range(len(data))),
        Invert(samples=64, starts=1),
    )
    return infer(posterior(data, **kwargs), Problem(given, method, finer=None, start=lambda point: None, truth=other))


# --- what pairs tell -------------------------------------------------------------------------------------------------


@pytest.mark.unit
@pytest.mark.parametrize("N", [8, 16, 40])
def test_a_single_datum_has_the_variance_of_students_distribution(N):
    errors = RNG.normal(0.7, 2.0, size=(N, 1))
    found = ModelError.of_pairs(errors, np.ones(1))
    scale = errors.std(ddof=1) * np.sqrt(1 + 1 / N)
    assert found.error[0] == pytest.approx(errors.mean())
    assert found.std[0] == pytest.approx(t(N - 1, scale=scale).std())
    assert found.apart[0] == pytest.approx(0.0, abs=1e-12)  # others span what there is


def test_the_next_error_is_as_large_as_is_said():
    """Over draws of nine pairs of 30 data: squares of the next error over its variance, of errors of falling size."""
    root, squares = RNG.standard_normal((30, 30)) * 2 * 0.5 ** np.arange(30), []
    for _ in range(400):
        *errors, one = RNG.standard_normal((9, 30)) @ root.T
        found = ModelError.of_pairs(np.array(errors), np.ones(30))
        squares.append(((one - found.error) / found.std) ** 2)
    assert 0.3 < np.mean(squares) < 1.0  # wider than a datum alone needs: several directions are told by few pairs


@pytest.mark.unit
def test_the_order_of_pairs_and_units_do_not_count():
    errors = RNG.standard_normal((10, M))
    one = ModelError.of_pairs(errors, SIGMA)
    other = ModelError.of_pairs(1e3 * errors[::-1], 1e3 * SIGMA)
    np.testing.assert_allclose(other.apart, 1e3 * one.apart, rtol=1e-9)
    np.testing.assert_allclose(other.root.T @ other.root, 1e6 * one.root.T @ one.root, rtol=1e-9, atol=1e-3)
    with pytest.raises(ValueError, match="3 errors of a model, expected at least 4"):
        ModelError.of_pairs(errors[:3], SIGMA)


# --- posteriors ------------------------------------------------------------------------------------------------------


@pytest.mark.unit
def test_posterior_and_evidence_are_those_of_data_with_these_errors():
    data = true(np.array([1.3, -0.8])) + SIGMA * RNG.standard_normal(M)
    one = inferred(data, truth())
    known = one.posterior.noise.model
    gamma = np.diag(SIGMA**2 + known.apart**2) + known.root.T @ known.root
    precision = np.linalg.inv(PRIOR) + A.T @ np.linalg.solve(gamma, A)
    mode = MEAN + np.linalg.solve(precision, A.T @ np.linalg.solve(gamma, data - known.error - A @ MEAN))
    found = answer(one.posterior, one.assessment)
    np.testing.assert_allclose(found.mean, mode, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(precision), rtol=1e-5, atol=1e-9)
    law = multivariate_normal(A @ MEAN + known.error, gamma + A @ PRIOR @ A.T)
    assert one.assessment.log_evidence[0] == pytest.approx(law.logpdf(data), rel=1e-6)


def test_many_pairs_find_the_known_gaussian_error():
    known = inferred(cheap(MEAN), truth(solves=600)).posterior.noise.model
    covariance = np.diag(known.apart**2) + known.root.T @ known.root
    size = np.sqrt(np.diag(WILD @ WILD.T))
    assert np.abs((known.error - SHIFT) / size).max() < 0.15
    assert np.abs((covariance - WILD @ WILD.T) / np.outer(size, size)).max() < 0.2


@pytest.mark.slow
@pytest.mark.unit
def test_intervals_hold_and_without_they_do_not():
    def share(other):
        held = []
        for seed in range(40):
            rng = np.random.default_rng(seed)
            point = INPUTS.drawn(rng, 1)[0]
            data = true(point) + SIGMA * rng.standard_normal(M)
            one = inferred(data, None if other is None else truth(solves=other, seed=seed))
            low, high = answer(one.posterior, one.assessment).quantiles((0.025, 0.975)).T
            held.append((low <= point) & (point <= high))
        return np.mean(held)

    assert share(None) < 0.6
    assert 0.9 <= share(16) <= 1.0


@pytest.mark.unit
def test_errors_are_those_over_the_posterior():
    """Of an error that follows a parameter: its mean is that where the data say it is."""
    slope = np.outer(np.linspace(0.2, 1.0, M), [1.0, 0.0])
    data = (A + slope) @ [2.0, 1.0]
    one = inferred(data, truth(lambda p: (A + slope) @ p), sigma=np.full(M, 1e-2))
    known = one.posterior.noise.model
    at = known.error / slope[:, 0]
    assert np.ptp(at) < 1e-9
    assert abs(at[0] - 2.0) < 0.25  # the prior is at 1 ± 0.5
    assert known.std.max() < 0.2


def bent(function, tangent, data, solves=PAIRS):
    """A model that saturates, with another that stands for the truth."""
    model = FunctionModel(lambda p: np.tanh(A @ p / 4), ("a", "b"), NAMES, lambda p: A / 4 / cosh(p)[:, None])
    own = Posterior(INPUTS, SerialEvaluate(model), data, Noise(np.full(M, 0.02)))
    other = FunctionModel(function, ("a", "b"), NAMES, tangent)
    given = Measurements.of(data, np.ones(M), [0] * M, range(M))
    problem = Problem(given, Invert(samples=64, starts=1), finer=None, start=lambda point: None)
    alone = infer(replace(own, evaluate=SerialEvaluate(other)), problem) if tangent else None
    return infer(own, replace(problem, truth=Truth(SerialEvaluate(other), solves))), alone


def cosh(p):
    return np.cosh(A @ p / 4) ** 2


@pytest.mark.unit
def test_errors_that_follow_predictions_leave_little_out():
    """A truth in proportion to the model, which saturates: mean, covariance and evidence are its own."""

    def function(p):
        return 1.4 * np.tanh(A @ p / 4) + SHIFT / 9

    learnt, alone = bent(function, lambda p: 1.4 * A / 4 / cosh(p)[:, None], function(np.array([1.4, 2.5])))
    assert learnt.posterior.noise.model.std.max() < 0.01 * 0.02
    assert np.abs(learnt.posterior.noise.model.error).max() > 10 * 0.02
    a, b = (one.found.gaussian for one in (learnt, alone))
    np.testing.assert_allclose(a.mode, b.mode, atol=0.01 * np.sqrt(np.diag(b.covariance)).min())
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=0.02, atol=1e-6)
    assert learnt.assessment.log_evidence[0] == pytest.approx(alone.assessment.log_evidence[0], abs=0.01)


@pytest.mark.unit
def test_a_parameter_that_the_model_does_not_feel_is_felt():
    blind = A * [1.0, 0.0]
    data = true(np.array([1.3, -0.8]))
    model = FunctionModel(lambda p: blind @ p, ("a", "b"), NAMES, lambda p: blind)
    other = FunctionModel(lambda p: A @ p, ("a", "b"), NAMES, lambda p: A)
    own = replace(posterior(data), evaluate=SerialEvaluate(model))
    error = Truth(SerialEvaluate(other), PAIRS).error(own, INPUTS.drawn(np.random.default_rng(0), PAIRS))
    assert error.std.max() < 1e-9
    knowing = replace(own, noise=replace(own.noise, model=error))
    found = knowing.at(RNG.standard_normal((3, 2)), derivatives=True)
    np.testing.assert_allclose(found.outputs, found.parameters @ A.T, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(knowing.output_slopes(found), np.tile(A * INPUTS.std, (3, 1, 1)), rtol=1e-9, atol=1e-9)


@pytest.mark.unit
def test_derivatives_of_what_follows_predictions():
    """Of the potential along a chain, against differences, with a trend that has a part of both."""
    data = RNG.standard_normal(M) / 4
    learnt, _ = bent(lambda p: np.tanh(A @ p / 4) + 0.1 * A @ p * p[1], None, data)
    slopes = RNG.standard_normal((M, 2))
    point = np.array([1.2, 0.3])
    trend = Trend(point, np.tanh(A @ point / 4), A / 4 / cosh(point)[:, None], slopes, np.full(M, 4.0), INPUTS.std)
    own = learnt.posterior
    assert own.noise.model.trend is None  # the truth has no derivatives
    own = replace(own, noise=replace(own.noise, model=replace(own.noise.model, trend=trend)))
    x, model = np.array([0.4, -0.2]), own.evaluate.model
    _, gradient = own.potential(x, model)
    for k in range(2):
        step = 1e-5 * np.eye(2)[k]
        ahead, behind = (own.potential(there, model)[0] for there in (x + step, x - step))
        assert gradient[k] == pytest.approx((ahead - behind) / 2e-5, rel=1e-6)
    np.testing.assert_allclose(own.at(x[None], derivatives=True).gradient[0], gradient, rtol=1e-9)


@pytest.mark.unit
def test_tangents_that_explain_nothing_are_left_out():
    """An error that waves about its mean over the posterior, with a slope at the middle that holds nowhere else."""
    wave = np.linspace(0.2, 1.0, M)

    def function(p):
        return A @ p + 0.3 * wave * np.sin(40 * p[0])

    def tangent(p):
        return A + np.outer(wave, [12 * np.cos(40 * p[0]), 0.0])

    other = Truth(SerialEvaluate(FunctionModel(function, ("a", "b"), NAMES, tangent)), PAIRS)
    error = other.error(posterior(A @ MEAN), INPUTS.drawn(np.random.default_rng(0), PAIRS))
    assert error.trend is None
    assert error.std.max() < 0.4


@pytest.mark.unit
def test_outputs_are_paired_by_name():
    data = true(MEAN)
    turned = truth(lambda p: np.append(true(p)[::-1], 7.0), names=(*NAMES[::-1], "z"))
    ours, theirs = (inferred(data, other).posterior.noise.model for other in (truth(), turned))
    np.testing.assert_allclose(theirs.error, ours.error, rtol=1e-12)
    np.testing.assert_allclose(theirs.root, ours.root, rtol=1e-9, atol=1e-12)


@pytest.mark.unit
def test_too_few_answers_are_said():
    def fails(p):
        if p[0] > 0.6:
            message = "no equilibrium"
            raise SolveError(message)
        return true(p)

    with pytest.raises(SolveError, match=r"model_error: \d of 16 pairs have an answer, expected at least 8"):
        inferred(true(MEAN), truth(fails))


# --- studies ---------------------------------------------------------------------------------------------------------

LINES = """
import numpy as np

A = np.array([[1.0, 2.0], [0.5, -1.0], [3.0, 0.2]])


def linear(p):
    return A @ p


def slopes(p):
    return A


def bent(p):
    return A @ p + 0.3 * np.array([p[0] ** 2, np.cos(p[1]), 1.0])


def tangents(p):
    return A + 0.3 * np.array([[2 * p[0], 0.0], [0.0, -np.sin(p[1])], [0.0, 0.0]])


def less(p):
    return bent(p)[:2]


def flat(p):
    return 3.0 * p
"""
MODEL = """
kind = "python"
function = "bent_lines.linear"
jacobian = "bent_lines.slopes"
parameters = { a = 1.0, b = -1.0 }
outputs = [{ name = "u", unit = "m" }, "v", "w"]
"""
PRIORS = {"a": "{ kind = 'normal', mean = 1.0, std = 0.5 }", "b": "{ kind = 'normal', mean = -1.0, std = 2.0 }"}
INVERT = f"""
[model]
{MODEL}
[parameters]
a = {PRIORS["a"]}
b = {PRIORS["b"]}

[data]
outputs = {{ u = 0.4, w = [3.1, 2.9] }}
noise = {{ absolute = 0.2, relative = 0.1 }}
sigma = {{ u = 0.05 }}

[method]
kind = "invert"
samples = 32
starts = 1
draws = 50

[model_error]
against = {{ function = "bent_lines.bent" }}
"""
OTHER = "kind = 'python', function = 'bent_lines.flat', parameters = { a = 1.0 }, outputs = ['u', 'v', 'w']"
SAME = "function = 'bent_lines.linear', jacobian = 'bent_lines.slopes'"
SELECT = f"""
[model]
{MODEL.replace("linear", "bent").replace("slopes", "tangents")}
[data]
outputs = {{ w = [3.1, 2.9], u = 0.4 }}
sigma = {{ u = 0.05, w = 0.3 }}

[candidates.known]
model = {{ function = "bent_lines.linear", jacobian = "bent_lines.slopes" }}
model_error = {{ against = {{}}, solves = 8 }}
parameters.a = {PRIORS["a"]}
parameters.b = {PRIORS["b"]}

[candidates.unknown]
model = {{ function = "bent_lines.linear", jacobian = "bent_lines.slopes" }}
parameters.a = {PRIORS["a"]}
parameters.b = {PRIORS["b"]}

[method]
kind = "select"
noise = {{}}
samples = 64
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "bent_lines.py").write_text(LINES)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_an_inversion_learns_the_errors_of_its_model(folder):
    (folder / "study.toml").write_text(INVERT)
    done = in_process("run", folder / "study.toml", "--out", folder / "out", "--no-report")
    assert "errors of the model, learnt from 32 solves of another one" in done.stdout
    assert "taken to be the same whatever the unknowns are" in done.stdout  # the better model has no derivatives
    data = stored_dataset(folder / "out" / "results.nc").isel(data_set=0)
    study = load(folder / "study.toml")
    assert document(load(folder / "out" / "study.toml")) == document(study)
    (found,) = study.measurements
    point = data["mean"].to_numpy()
    names = {"u": 0.3 * point[0] ** 2, "w": 0.3}
    expected = np.array([names[name] for name in found.names]) / found.sigma
    np.testing.assert_allclose(data["model_error"], expected, rtol=0.3)
    assert float(data["model_error_solves"]) == 32
    assert (data["model_error_std"][found.names == "w"] < 1e-9).all()  # a shift is known


def test_the_better_model_predicts(folder):
    predict = "[predict]\nmodel = { outputs = [{ name = 'u', unit = 'm' }, 'v', 'w'] }\nsamples = 16\n[method]"
    (folder / "study.toml").write_text(INVERT.replace("[method]", predict))
    done = in_process("run", folder / "study.toml", "--out", folder / "out", "--no-report")
    assert done.returncode == 0, done.stderr
    data = stored_dataset(folder / "out" / "results.nc").isel(data_set=0)
    a, b = data["mean"].to_numpy()
    off = float(data["prediction_mean"].sel(goal="u") - (a + 2 * b))
    assert off == pytest.approx(0.3 * (a**2 + float(data["std"][0]) ** 2), rel=0.1)


def test_a_comparison_learns_the_errors_of_a_candidate(folder):
    (folder / "study.toml").write_text(SELECT)
    in_process("run", folder / "study.toml", "--out", folder / "out", "--no-report")
    data = stored_dataset(folder / "out" / "results.nc")
    assert data["model_error_solves"].to_numpy().tolist() == [16, 0]
    np.testing.assert_array_equal(data["model_error_follows"], [1, np.nan])
    assert np.isfinite(data["model_error"].sel(model="known")).all()
    assert np.isnan(data["model_error"].sel(model="unknown")).all()
    summary = json.loads((folder / "out" / "summary.json").read_text())
    (told,) = [one["text"] for one in summary["findings"] if one["code"] == "model-error-learnt"]
    assert told.startswith("Candidate 'known': errors of the model, learnt from 16 solves")
    assert told.endswith("they are among the errors of the data")
    first, second = data["log_evidence"].to_numpy()
    assert first != second


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("[model_error]", "[model_error]\nsolves = 7", r"model_error.solves: .*greater than or equal to 8"),
        ("bent_lines.bent", "bent_lines.linear", r"model_error.against: is the model itself, expected another one"),
        (
            '{ function = "bent_lines.bent" }',
            "{ outputs = ['u', 'v'] }",
            r"against.outputs: has no w, expected all that",
        ),
        ('{ function = "bent_lines.bent" }', f"{{ {OTHER} }}", r"against.parameters: has no b, expected all unknown"),
        ('function = "bent_lines.bent"', "functio = 'bent_lines.bent'", r"model_error.against.functio"),
        ("draws = 50", "draws = 50\nexpansion = 16", r"errors of a model are not learnt with method.expansion"),
    ],
)
def test_what_cannot_be_learnt_is_said(folder, before, after, message):
    (folder / "study.toml").write_text(INVERT.replace(before, after))
    with pytest.raises(StudyError, match=message):
        load(folder / "study.toml")


def test_a_comparison_says_what_cannot_be_learnt(folder):
    (folder / "study.toml").write_text(SELECT.replace("against = {}", f"against = {{ {SAME} }}"))
    with pytest.raises(StudyError, match=r"candidates.known.model_error.against: is the model itself"):
        load(folder / "study.toml")
    materials = {"tests": [{"mode": "uniaxial", "at": [1.1, 1.2], "measured": [1.0, 2.0]}]}
    one = {"material": {"kind": "neo-hookean"}, "parameters": {"C1": {"kind": "log-normal", "mean": 5, "std": 3}}}
    blocks = {"data": materials, "method": {"kind": "select", "noise": {"absolute": 1.0}}}
    with pytest.raises(StudyError, match="tests of materials have no model that it changes"):
        parse(blocks | {"candidates": {"one": one | {"model_error": {"against": {}}}}})
