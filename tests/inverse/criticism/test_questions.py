"""Questions to the shape: closed forms of linear models, how often a right model is accused, what a body could have."""

from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI

from benchmarks import assumptions as bench
from forward.enlargements import QUARTICS, Fibres, Lump, asked_of, enlarged, enlargements, fitted, quartics
from forward.fem.layout import vertex_matrices
from forward.hyperelastic import Hyperelastic
from forward.model import SolveError
from forward.pointwise import FunctionModel
from inverse.criticism.questions import CALLED, Questions, answers, asked
from inverse.data.noise import Noise
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import LogUniform, Normal
from uq.inputs.random_parameters import Inputs
from workflows.data.measured import observing
from workflows.studies.inversion_job import asking

RNG = np.random.default_rng(7)
M, N = 30, 12  # data, and numbers behind the parameters
A, V = RNG.standard_normal((M, 2)), RNG.standard_normal((M, N))
INPUTS = Inputs({"a": Normal(mean=1.0, std=0.5), "b": Normal(mean=-1.0, std=2.0)})
NAMES, SIGMA = tuple(map(str, range(M))), 0.4
# One question with two patterns, and one that may take any of ten forms.
FORMS = {"two": {"both": np.eye(N)[:2]}, "one": {f"form {i}": 0.7 * np.eye(N)[i : i + 1] for i in range(2, N)}}


def linear(names, B):
    return FunctionModel(lambda p: B @ p, names, NAMES, lambda p: B)


def having(names, patterns):
    return SerialEvaluate(linear(tuple(names), np.hstack([A, V @ patterns.T])))


QUESTIONS = Questions(linear((*INPUTS.names, *map(str, range(N))), np.hstack([A, V])), lambda point: FORMS, having)


def found_of(values, ask=answers, noise=None, dof=None):
    model = linear(INPUTS.names, A)
    posterior = Posterior(INPUTS, SerialEvaluate(model), values, Noise(np.full(M, SIGMA), dof, noise))
    gaussian = laplace(posterior, starts=1)
    at = posterior.at(gaussian.mode[None], derivatives=True)
    return ask(posterior, gaussian, at, QUESTIONS, 0), gaussian


def drawn(seed, strengths=(), dof=None):
    rng = np.random.default_rng(seed)
    behind = np.zeros(N)
    behind[: len(strengths)] = strengths
    errors = rng.standard_normal(M) if dof is None else rng.standard_t(dof, M)
    return A @ INPUTS.drawn(rng, 1)[0] + V @ behind + SIGMA * errors


def log_evidence(values, B):
    """Of a linear model with normal parameters, and how they move: in closed form."""
    mean, std = np.append(INPUTS.mean, np.zeros(B.shape[1])), np.append(INPUTS.std, np.ones(B.shape[1]))
    whole = np.hstack([A, B])
    covariance = SIGMA**2 * np.eye(M) + (whole * std**2) @ whole.T
    gap = values - whole @ mean
    best = mean + std**2 * (whole.T @ np.linalg.solve(covariance, gap))
    return -(gap @ np.linalg.solve(covariance, gap) + np.linalg.slogdet(covariance)[1]) / 2, best[:2]


@pytest.mark.unit
@pytest.mark.parametrize("ask", [answers, asked])
def test_evidence_and_moves_in_closed_form(ask):
    """To first order, and solved with the enlargement, which of a linear model is the same."""
    values = drawn(0, [1.0, -1.5])
    (two, one), gaussian = found_of(values, ask)
    none, best = log_evidence(values, np.zeros((M, 0)))
    widths = np.sqrt(np.diag((INPUTS.std[:, None] * gaussian.covariance) * INPUTS.std))
    gain, there = log_evidence(values, V[:, :2])
    assert two.probability < CALLED
    assert two.log_evidence == pytest.approx(gain - none, rel=1e-6)
    np.testing.assert_allclose(two.move, (there - best) / widths, rtol=1e-5)
    each = [log_evidence(values, 0.7 * V[:, i : i + 1])[0] - none for i in range(2, N)]
    assert one.form == f"form {2 + int(np.argmax(each))}"
    if ask is answers or one.probability > CALLED:
        assert one.log_evidence == pytest.approx(np.log(np.mean(np.exp(each))), rel=1e-6)


@pytest.mark.unit
def test_what_data_leave_open_widens_the_answers():
    (two, _), gaussian = found_of(drawn(1))
    whole = np.hstack([A * INPUTS.std, V[:, :2]]) / SIGMA
    wider = np.linalg.inv(np.eye(4) + whole.T @ whole)[:2, :2]
    more = np.diag(wider) - np.diag(gaussian.covariance)
    np.testing.assert_allclose(two.left, np.sqrt(more / np.diag(gaussian.covariance)), rtol=1e-5)


@pytest.mark.few(1)
@pytest.mark.parametrize("dof", [None, 4.0])
def test_a_right_model_is_accused_once_in_twenty(dof):
    """Over all questions, whichever: the share of 200 data sets is binomial."""
    found = (found_of(drawn(seed, (), dof), dof=dof)[0] for seed in range(200))
    least = np.array([min(one.probability for one in each) for each in found])
    for level in (0.05, 0.2, 0.5):
        assert abs((least <= level).mean() - level) < 4 * np.sqrt(level * (1 - level) / 200)


@pytest.mark.few(1)
@pytest.mark.parametrize("dof", [None, 4.0])
def test_errors_that_are_understated_call_for_nothing(dof):
    """By a factor of three; what explains the residuals is called for all the same, and found where it is."""
    accused = []
    for seed in range(60):
        values = drawn(seed, (), dof)
        right = A @ INPUTS.drawn(np.random.default_rng(seed), 1)[0]
        found, _ = found_of(right + 3 * (values - right), dof=dof)
        accused.append(min(one.probability for one in found) <= CALLED)
    assert np.mean(accused) <= 0.12
    (two, one), _ = found_of(drawn(0, [8.0, -8.0], dof), dof=dof)
    assert two.probability < 0.01
    assert two.log_evidence > one.log_evidence


@pytest.mark.unit
def test_a_model_without_an_answer_says_nothing_and_stops_nothing(monkeypatch):
    def lost(*args):
        raise SolveError("no answer")

    monkeypatch.setattr(Questions, "changes", lost)
    found, _ = found_of(drawn(0), asked)
    assert [one.name for one in found] == ["two", "one"]
    assert all(np.isnan(one.probability) and np.isnan(one.left).all() for one in found)


@pytest.mark.unit
def test_the_size_of_the_errors_may_be_unknown():
    values = drawn(2, [2.0, -3.0])
    (two, _), _ = found_of(values, asked, LogUniform(lower=0.5, upper=2.0))
    assert two.probability < CALLED
    assert two.log_evidence > 5
    assert two.move.shape == (2,)


# --- bodies ----------------------------------------------------------------------------------------------------------

SPEC, NUMBERS = bench.cube_spec(2), ("material.mu", "inclusions.lump.x")


def patterns(point):
    return enlargements(SPEC, NUMBERS, point, vertex_matrices(SPEC.body)[3])


@pytest.mark.fem
def test_what_a_body_could_have():
    point = np.array([900.0, 0.02])
    found = patterns(point)
    assert tuple(found) == asked_of(SPEC)
    assert tuple(found) == ("edge of lump", "shape of lump", "another lump", "a layer", "a field", "fibres")
    places = vertex_matrices(SPEC.body)[3]
    assert {rows.shape[1] for forms in found.values() for rows in forms.values()} == {len(places) + len(QUARTICS)}
    (wider,) = found["edge of lump"]["another width"]
    far = np.linalg.norm(places - (0.02, 0.025, 0.03), axis=1) - 0.014  # where the lump is at these parameters
    right = np.log(3) * np.log(2) * far / 8e-3 / np.cosh(far / 8e-3) ** 2 / 2
    np.testing.assert_allclose(wider[: len(places)], right, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(found["shape of lump"]["an ellipsoid"].shape, (5, len(wider)))
    layer = next(iter(found["a layer"].values()))[0, : len(places)]
    assert layer[places[:, 0] < 1e-6].min() > 0.5 * np.log(2) > layer[places[:, 0] > 0.04].max()


@pytest.mark.fem
def test_a_body_without_lumps_is_asked_for_one():
    plain = SPEC.model_copy(update={"inclusions": ()})
    assert asked_of(plain) == ("a lump", "a layer", "a field", "fibres")
    found = enlargements(plain, (), np.zeros(0), vertex_matrices(SPEC.body)[3])
    assert len(found["a lump"]) > 8


@pytest.mark.fem
def test_a_lump_is_moved_by_its_strengths():
    """Along derivatives by its place and radius, half a radius at most, within the body."""
    places = vertex_matrices(SPEC.body)[3]
    lump = Lump(0.03, 0.02, 0.02, 0.012, 8e-3)
    here, rows, means = fitted(SPEC, lump, np.array([1.5]), places)
    np.testing.assert_allclose(here, lump)
    np.testing.assert_allclose(rows[0, : len(places)], lump.pattern(places))
    step, width = 1e-6, 0.05 / np.sqrt(12)
    for k, name in enumerate("xyz"):
        ends = [lump._replace(**{name: getattr(lump, name) + h}).pattern(places) for h in (step, -step)]
        slope = 1.5 * width * (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(rows[1 + k, : len(places)], slope, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(means, [0, -0.005 / width, 0.005 / width, 0.005 / width, np.log(14 / 12) / 0.5])
    far, *_ = fitted(SPEC, lump, np.array([1.5, 0.1, -9.0, 9.0, 0.2]), places)
    np.testing.assert_allclose(far[:3], [0.03 + 0.1 * width, 0.014, 0.026])
    assert far.radius == pytest.approx(0.012 * np.exp(0.1))
    assert str(far) == "at 3.14, 1.4, 2.6\xa0cm, radius 1.3 cm"
    assert fitted(SPEC, "all over the body", np.ones(3), places) is None


@pytest.mark.unit
def test_fibres_are_those_of_a_material():
    """½ k (a·E a)² of a tensor that is symmetric in all its indices."""
    a, strain = np.array([0.6, 0.0, 0.8]), RNG.standard_normal((3, 3))
    strain = strain + strain.T
    whole = np.einsum("i,j,k,l,ij,kl", a, a, a, a, strain, strain)
    assert whole == pytest.approx((a @ strain @ a) ** 2)
    assert len(QUARTICS) == 15
    assert quartics(a)[QUARTICS.index("xxzz")] == pytest.approx(0.36 * 0.64)


@pytest.mark.fem
def test_fibres_pull_as_those_of_holzapfel_gasser_and_ogden():
    """W = 2 k1 (a·E a)² for small k2: so k = 4 k1."""
    hgo = {"kind": "holzapfel-gasser-ogden", "c": 1e3, "k1": 700.0, "k2": 1e-6, "D1": 1e4, "fibres": [[0, 0.6, 0.8]]}
    blocks = {
        "body": {"kind": "box", "size": [1, 1, 1], "cells": [1, 1, 1], "cell": "hexahedron", "degree": 1},
        "material": hgo,
        "clamp": ["z-min"],
        "loads": [{"kind": "traction", "on": "z-max", "direction": [0, 0, 1], "size": 600.0}],
        "outputs": [{"name": f"u{axis}", "kind": "displacement", "at": [1, 1, 1], "component": axis} for axis in "yz"],
    }
    right = Hyperelastic.model_validate(blocks).build(MPI.COMM_SELF, ()).solve(np.zeros(0)).outputs
    numbers = dict(zip(QUARTICS, 4 * 700.0 * quartics(np.array([0, 0.6, 0.8])), strict=True))
    plain = Hyperelastic.model_validate(blocks | {"material": hgo | {"k1": 0.0}})
    spec = plain.model_copy(update={"loads": (*plain.loads, Fibres(kind="fibres", name="more", **numbers))})
    np.testing.assert_allclose(spec.build(MPI.COMM_SELF, ()).solve(np.zeros(0)).outputs, right, rtol=1e-6)


@pytest.mark.fem
def test_a_body_with_what_it_could_have():
    """By tangents, by adjoints, and by differences of the model in which it is so; zero strengths are the body."""
    case = bench.cube(2)
    inputs = Inputs(dict.fromkeys(NUMBERS[:1], case.inputs.marginals["material.mu"]))
    questions = asking(SPEC, inputs.names, MPI.COMM_SELF)(case.data)
    own = observing(SPEC.build(MPI.COMM_SELF, inputs.names), case.data)
    posterior = Posterior(inputs, SerialEvaluate(own), case.data.values, Noise(case.data.sigma))
    point = np.array([900.0])
    forms = questions.forms(point)
    some = ("edge of lump", "a layer", "fibres")
    rows = np.concatenate([next(iter(forms[name].values())) for name in some])
    changes = questions.changes(posterior, point, rows)
    many = questions.changes(posterior, point, np.repeat(rows, len(case.data), axis=0))
    np.testing.assert_allclose(many[:: len(case.data)], changes, rtol=1e-6, atol=1e-9 * np.abs(changes).max())
    model = questions.having(("material.mu", "s"), rows.sum(axis=0)[None]).model
    ends = [np.asarray(model.solve(np.array([900.0, s])).outputs) for s in (1e-3, -1e-3, 0.0)]
    np.testing.assert_allclose(changes.sum(axis=0), (ends[0] - ends[1]) / 2e-3, atol=1e-4 * np.abs(changes).max())
    np.testing.assert_allclose(ends[2], own.solve(point).outputs, rtol=1e-7)
    assert enlarged(SPEC)[1][-1] == f"loads.asked.{QUARTICS[-1]}"
    wrong = replace(case.data, values=np.asarray(model.solve(np.array([900.0, 1.0])).outputs))
    posterior = replace(posterior, data=wrong.values)
    gaussian = laplace(posterior, starts=1)
    few = replace(questions, forms=lambda point: {name: questions.forms(point)[name] for name in some})
    found = asked(posterior, gaussian, posterior.at(gaussian.mode[None], derivatives=True), few, 0)
    assert min(one.probability for one in found) < CALLED
