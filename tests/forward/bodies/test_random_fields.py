"""Random fields: Matérn's closed forms, Karhunen–Loève modes, derivatives, ranks, and studies of them."""

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from forward.bodies.geometry import Block, Box
from forward.bodies.random_fields import ROBIN, Matern, RandomField
from forward.conformance import check_derivatives
from forward.model import Stability
from tests.bodies import loaded_body
from tests.launch import on_kept_ranks
from tests.matern import correlation, inflation, precision
from uq.evaluation.ensemble import Ensemble
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Request
from uq.findings import findings
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import random_points
from uq.methods.monte_carlo import MonteCarlo, SensitivityMonteCarlo, _JointMoments
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo
from uq.surrogates import linearisation
from uq.surrogates.linearisation import linearise
from workflows.config.mistakes import StudyError
from workflows.config.study import document, load, parse
from workflows.report.scene.scene import forward_scene
from workflows.results.directory import read_dataset
from workflows.run.run import run

FIELDS = (
    {"of": "stiffness", "length": 0.6, "std": 0.3, "modes": 6},
    {"of": "density", "length": 0.5, "std": 0.4, "basis": "noise"},
)
NUMBERS = ("material.C1", "displacements.y-max.y", "loads.gravity.density")


def cube(n):
    return Box(size=(1.0, 1.0, 1.0), cells=(n, n, n), degree=1)


def vertices(body):
    x = np.stack(np.meshgrid(*(np.linspace(0, 1, n + 1) for n in body.cells), indexing="ij"), axis=-1).reshape(-1, 3)
    return body.place(x * body.meshed)


def at(body, *place):
    return int(np.abs(vertices(body) - place).sum(axis=1).argmin())


# --- the Matérn field ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("smoothness", "inside", "off"), [(2, 0.07, 0.02), (4, 0.05, 0.025)])
def test_point_variance_and_correlation_are_those_of_matern_inside(smoothness, inside, off):
    body = cube(12)
    matern = Matern.on(body, 0.4, smoothness)
    centre = at(body, 0.5, 0.5, 0.5)
    assert inflation(matern, 0.4, smoothness)[centre] == pytest.approx(1, abs=inside)  # before it is set to one
    row = matern.covariance(np.eye(len(matern.mass))[centre])
    assert row[centre] == pytest.approx(1, abs=1e-12)
    distance = np.linalg.norm(vertices(body) - 0.5, axis=1)
    near = distance <= 0.4
    assert near.sum() > 300
    assert np.abs(row - correlation(distance, 0.4, smoothness))[near].max() <= off


def test_the_boundary_condition_keeps_the_variance_near_faces():
    body = cube(8)
    robin, neumann = (inflation(Matern.on(body, 0.4, 2, beta), 0.4) for beta in (ROBIN, 0.0))
    face, corner = at(body, 0, 0.5, 0.5), at(body, 0, 0, 0)
    assert neumann[face] > 2  # the images: 2 and, in a corner, 8 times the variance inside
    assert neumann[corner] > 8
    assert robin[face] < 1.3
    assert robin[corner] < 2.6


def test_the_mesh_does_not_matter():
    coarse, fine = cube(6), cube(12)
    rows = []
    for body in (coarse, fine):
        matern = Matern.on(body, 0.5)
        row = matern.covariance(np.eye(len(matern.mass))[at(body, 0.5, 0.5, 0)])
        rows.append([row[at(body, *place)] for place in vertices(coarse)])
    assert np.abs(np.subtract(*rows)).max() < 0.05


@pytest.mark.parametrize("smoothness", [2, 4])
def test_a_root_of_the_covariance_makes_samples(smoothness):
    corners = [(x, y, z + 0.2 * x * y) for z in (0.0, 0.7) for y in (0.0, 1.0) for x in (0.0, 1.3)]
    matern = Matern.on(Block(corners=corners, cells=(3, 4, 3)), 0.5, smoothness)
    identity = np.eye(len(matern.mass))
    root = matern.root(identity)
    np.testing.assert_allclose(root @ root.T, matern.covariance(identity), atol=1e-12)
    np.testing.assert_allclose(root.T, matern.root_transposed(identity), atol=1e-12)
    np.testing.assert_allclose(np.diag(root @ root.T), 1, rtol=1e-12)
    np.testing.assert_allclose(precision(matern, root @ root.T, smoothness), identity, atol=1e-9)


@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron"])
def test_cells_of_the_body_do_not_matter(cell):
    body = Box(size=(1.0, 0.5, 0.5), cells=(4, 2, 2), cell=cell, degree=2)
    expected = Matern.on(body.model_copy(update={"degree": 1, "cell": "hexahedron"}), 0.5).modes(5)
    np.testing.assert_array_equal(Matern.on(body, 0.5).modes(5), expected)


def test_modes_are_the_leading_eigenfunctions():
    body = cube(6)
    matern = Matern.on(body, 0.5)
    modes = matern.modes(12)  # by Lanczos
    everything = matern.modes(len(matern.mass))  # by a dense solver
    np.testing.assert_allclose(modes, everything[:, :12], atol=1e-8)  # of a cube: many eigenvalues are equal
    np.testing.assert_allclose(everything @ everything.T, matern.covariance(np.eye(len(matern.mass))), atol=1e-10)
    products = modes.T @ (matern.mass[:, None] * modes)
    assert np.abs(products - np.diag(np.diag(products))).max() < 1e-10
    assert (np.diff(np.diag(products)) < 1e-10).all()
    assert (matern.mass @ everything**2).sum() == pytest.approx(matern.mass.sum())


@pytest.mark.parametrize("basis", [{"modes": 9}, {"basis": "noise"}])
def test_the_expected_factor_and_its_spread_are_as_asked(basis):
    field = RandomField(of="stiffness", length=0.4, std=0.5, mean=2.0, **basis)
    body = cube(4)
    expansion = field.on(body)
    count = len(field.paths(body))
    values = np.array([expansion.values(row) for row in np.eye(count)])
    variance = (values**2).sum(axis=0)
    np.testing.assert_allclose(np.exp(expansion.offset + variance / 2), 2.0, rtol=1e-12)  # the mean of a log-normal
    assert (variance <= field.log_std**2 * (1 + 1e-12)).all()
    slopes = np.random.default_rng(0).standard_normal(body.vertex_count)
    np.testing.assert_allclose(expansion.vjp(slopes), values @ slopes, atol=1e-12)
    if count == body.vertex_count:
        np.testing.assert_allclose(2.0 * np.sqrt(np.expm1(variance)), 0.5, rtol=1e-10)
        assert expansion.kept == 1
    else:
        assert 0.3 < expansion.kept < 0.9


# --- the body --------------------------------------------------------------------------------------------------------


def build(fields=FIELDS, material="mooney-rivlin", numbers=NUMBERS, comm=MPI.COMM_SELF, **changes):
    spec = loaded_body(material, fields=fields, **changes)
    names = numbers + spec.coefficients
    point = np.array([spec.scalars[name].value if name in spec.scalars else 0.0 for name in names])
    scale = np.where(point == 0, 0.3, 0.03 * point)
    point = point + np.where(point == 0, np.random.default_rng(1).standard_normal(len(point)), 0)
    return spec.build(comm, names), point, scale


def check(model, point, scale):
    directions = np.vstack([np.eye(len(point))[[0, 2, 3, -1]], np.random.default_rng(2).uniform(-1, 1, len(point))])
    check_derivatives(
        model, point, scale, directions=directions, steps=(1 / 32, 1 / 64, 1 / 128), accuracy=1e-12
    ).require()
    solution = model.solve(point)
    tangents, gradients = solution.tangent(np.eye(len(point))).T, solution.adjoint(np.eye(len(model.outputs)))
    np.testing.assert_allclose(gradients, tangents, atol=1e-8 * np.abs(tangents).max(axis=1, keepdims=True).min())


def test_derivatives():
    check(*build())


def test_derivatives_by_values_at_the_vertices():
    check(*build(({**FIELDS[0], "modes": None, "basis": "nodes"}, FIELDS[1])))


@pytest.mark.slow
def test_derivatives_in_the_mixed_form():
    check(*build(material="mooney-rivlin mixed"))


def test_a_constant_field_is_a_constant_factor():
    spec = loaded_body("mooney-rivlin", fields=({**FIELDS[0], "modes": None, "basis": "nodes"}, FIELDS[1]))
    names = spec.fields[0].paths(spec.body)
    model = spec.build(MPI.COMM_SELF, names)
    offset = np.log(1.7) + spec.fields[0].log_std ** 2 / 2
    stiffer = model.solve(np.full(len(names), offset))
    density = 600.0 * np.exp(-(spec.fields[1].log_std ** 2) / 2)  # the median of the factor on the density
    numbers = ("material.C1", "material.C2", "material.D1", "loads.gravity.density")
    values = [1.7 * spec.scalars[name].value for name in numbers[:3]]
    plain = loaded_body("mooney-rivlin").build(MPI.COMM_SELF, numbers).solve(np.array([*values, density]))
    np.testing.assert_allclose(stiffer.outputs, plain.outputs, rtol=1e-9)


def test_one_adjoint_gives_all_gradients_at_the_price_of_one_solve():
    model, point, _ = build()
    solution = model.solve(point)
    solution.adjoint(np.eye(len(model.outputs))[2])  # what the numbers of the model need is at hand
    before = solution.work.as_array()
    gradient = solution.adjoint(np.eye(len(model.outputs))[4])
    residuals, assemblies, factorisations, back_substitutions, *_ = solution.work.as_array() - before
    assert gradient.shape == (len(point),)
    assert (residuals, assemblies, factorisations, back_substitutions) == (2, 0, 0, 1)  # one for each of two fields


def test_parts_of_a_field_can_be_parameters():
    model, point, _ = build()
    some = (*NUMBERS, "fields.stiffness.4", "fields.stiffness.1")
    part, _, _ = build(numbers=some)
    spec = loaded_body("mooney-rivlin", fields=FIELDS)
    part = spec.build(MPI.COMM_SELF, some)
    values = np.zeros(len(point))
    values[:3] = point[:3]
    values[[7, 4]] = 0.3, -0.8
    whole = model.solve(values).adjoint(np.ones(len(model.outputs)))
    found = part.solve(np.array([*point[:3], 0.3, -0.8])).adjoint(np.ones(len(model.outputs)))
    np.testing.assert_allclose(found, whole[[0, 1, 2, 7, 4]], rtol=1e-9)


def test_factors_at_nodes():
    model, point, _ = build()
    factors = model.space.factors(np.stack([point, 0 * point]))
    assert set(factors) == {"stiffness", "density"}
    assert factors["stiffness"].shape == (2, model.space.coordinates.shape[0])
    spec = model.spec
    expansion = spec.fields[0].on(spec.body)
    expected = np.exp(expansion.offset + expansion.values(point[3:9]))
    np.testing.assert_allclose(factors["stiffness"][0], expected, rtol=1e-12)  # linear hexahedra: nodes are vertices


# --- ranks -----------------------------------------------------------------------------------------------------------

SCRIPT = """
import sys
import numpy as np
from mpi4py import MPI
from tests.forward.bodies.test_random_fields import shared
from uq.evaluation.ensemble import Ensemble

found = shared(Ensemble.split(MPI.COMM_WORLD, int(sys.argv[2])))
if found is not None:
    np.savez(sys.argv[1], **found)
"""


def shared(ensemble):
    """Outputs, tangents, fields and factors of a model that is shared by the ranks of each group; on rank 0."""
    model, point, _ = build(comm=ensemble.group, body={"cells": (4, 2, 2)})
    inputs = inputs_of(model)

    def task(evaluate):
        centre = linearise(inputs, evaluate)
        points = inputs.points(random_points(0, 0, 6, len(inputs.names)))
        fields = _JointMoments(inputs.coordinates, centre.state, centre.slopes)
        found = evaluate(Request(points, tangents=True, fields=fields, start=centre.prediction))
        assert found.ok.all(), found.failures
        return {"outputs": found.outputs, "tangents": found.tangents, "fields": found.fields}

    factors = model.space.factors(point[None])
    found = ensemble.run(model, task)
    return None if found is None else found | factors


def inputs_of(model):
    scalars = model.spec.scalars
    marginals = {}
    for name in model.parameters:
        block = {"kind": "normal", "mean": 0.0, "std": 1.0}
        if name in scalars:
            block = {"kind": "uniform", "lower": 0.9 * scalars[name].value, "upper": 1.1 * scalars[name].value}
        marginals[name] = block
    study = {
        "model": model.spec.model_dump(mode="json", exclude_none=True),
        "parameters": {name: block for name, block in marginals.items() if name in scalars},
        "method": {"kind": "local-sensitivity"},
    }
    return parse(study).inputs


@pytest.fixture(scope="module")
def alone():
    return shared(Ensemble.split(MPI.COMM_SELF))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ranks", "share"), [(2, 2), pytest.param(4, 2, marks=pytest.mark.slow), pytest.param(4, 4, marks=pytest.mark.slow)]
)
def test_ranks_that_share_a_model_agree_with_one(alone, ranks, share, tmp_path):
    done = on_kept_ranks(ranks, SCRIPT, tmp_path / "found.npz", share)
    assert done.returncode == 0, done.stdout + done.stderr
    found = dict(np.load(tmp_path / "found.npz"))
    for name, values in alone.items():
        sizes = np.abs(values).max(axis=-1, keepdims=True)
        np.testing.assert_allclose(found[name] / sizes, values / sizes, rtol=0, atol=1e-8, err_msg=name)


# --- studies ---------------------------------------------------------------------------------------------------------

STUDY = {
    "model": {
        "body": {"size": [0.2, 0.05, 0.05], "cells": [4, 1, 1], "degree": 1},
        "material": {"kind": "mooney-rivlin", "C1": 1e4, "C2": 2e4, "D1": 2e5},
        "fields": [{"of": "stiffness", "length": 0.1, "std": 0.3, "modes": 5}],
        "clamp": ["x-min"],
        "loads": [{"kind": "gravity", "direction": [0, -1, 0], "density": 300}],
        "outputs": [{"kind": "mean-displacement", "name": "mean", "on": "x-max", "component": "y"}],
    },
    "method": {"kind": "sensitivity-monte-carlo", "samples": 40},
}


def changed(**field):
    given = {key: value for key, value in (STUDY["model"]["fields"][0] | field).items() if value is not None}
    return STUDY | {"model": STUDY["model"] | {"fields": [given]}}


@pytest.mark.unit
def test_coefficients_are_parameters_of_a_study():
    study = parse(STUDY | {"parameters": {"material.D1": {"kind": "uniform", "lower": 1e5, "upper": 3e5}}})
    assert parse(document(study)) == study
    assert study.inputs.names == ("material.D1", *(f"fields.stiffness.{i}" for i in range(5)))
    np.testing.assert_allclose(study.inputs.std[1:], 1)
    assert parse(STUDY, ["model.fields.stiffness.modes=7"]).inputs.names[-1] == "fields.stiffness.6"
    assert len(parse(changed(basis="noise", modes=None)).inputs.names) == 20


@pytest.mark.unit
@pytest.mark.parametrize(
    ("field", "words"),
    [
        ({"of": "density", "modes": 30}, "at most 20"),
        ({"modes": None}, "expected a number of modes"),
        ({"basis": "noise"}, "expected no modes"),
        ({"basis": "nodes", "modes": None}, "not independent"),
        ({"lenght": 0.1}, "length"),
        ({"std": 0.0}, "greater than 0"),
    ],
)
def test_mistakes(field, words):
    with pytest.raises(StudyError, match=words):
        parse(changed(**field))


@pytest.mark.unit
def test_mistakes_of_several_blocks():
    model = STUDY["model"]
    with pytest.raises(StudyError, match="2 of them are called 'stiffness'"):
        parse(STUDY | {"model": model | {"fields": 2 * model["fields"]}})
    weightless = {"fields": [model["fields"][0] | {"of": "density"}], "loads": []}
    with pytest.raises(StudyError, match="no load is gravity"):
        parse(STUDY | {"model": model | weightless})
    with pytest.raises(StudyError, match="no parameter is random"):
        parse(STUDY | {"model": {key: value for key, value in model.items() if key != "fields"}})


@pytest.fixture(scope="module")
def noisy():
    # Second derivatives are differences of first ones: their error is that of these over the step.
    study = parse(changed(basis="noise", modes=None), ["model.solver.derivative_tolerance=1e-10"])
    return study, study.model.build(MPI.COMM_SELF, study.inputs.names)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "method",
    [
        MonteCarlo(samples=16),
        SensitivityMonteCarlo(samples=16),
        QuasiMonteCarlo(samples=16, scrambles=4, control="tangent"),
        QuasiMonteCarlo(samples=16, scrambles=4, control="quadratic"),
    ],
    ids=["plain", "sensitivity", "tangent", "quadratic"],
)
def test_methods_do_without_slopes_of_the_state(noisy, method, monkeypatch):
    study, model = noisy
    known = method.run(study.inputs, SerialEvaluate(model))
    monkeypatch.setattr(linearisation, "MANY", 19)
    found = method.run(study.inputs, SerialEvaluate(model))
    assert "field_derivative" in known
    assert "field_derivative" not in found
    for name in ("mean", "mean_error", "std"):
        np.testing.assert_allclose(found[name], known[name], rtol=1e-6)
    # Fields have no control then.
    assert found["field_mean_error"].max() >= known["field_mean_error"].max() * (1 - 1e-6)
    difference = np.abs(found["field_mean"] - known["field_mean"])
    assert (difference <= 5 * found["field_mean_error"] + 1e-12).all()


def test_samples_are_corrected_from_the_state_at_the_mean(noisy, monkeypatch):
    study, model = noisy
    monkeypatch.setattr(linearisation, "MANY", 19)
    evaluate = SerialEvaluate(model)
    prediction = linearise(study.inputs, evaluate).prediction
    assert len(prediction.slopes) == 0
    found = evaluate(Request(study.inputs.points(random_points(0, 0, 8, 20)), tangents=True, start=prediction))
    assert found.ok.all()
    assert (found.work[:, 2] == 0).all()  # nor for counting negative eigenvalues
    assert (found.stability >= Stability.SCREENED).all()
    assert (found.work[:, 2] == 0).any()
    plain = evaluate(Request(found.points, tangents=True))
    np.testing.assert_allclose(found.outputs, plain.outputs, rtol=1e-7)
    np.testing.assert_allclose(found.tangents, plain.tangents, atol=1e-5 * np.abs(plain.tangents).max())


@pytest.mark.unit
def test_many_parameters_of_one_distribution_are_quick():
    study = parse(changed(basis="noise", modes=None))
    normal = study.inputs.marginals["fields.stiffness.0"]
    inputs = Inputs({f"p{i}": normal for i in range(5000)})
    points = inputs.points(random_points(0, 0, 10, 5000))
    assert points.shape == (10, 5000)
    assert abs(points.std() - 1) < 0.02


@pytest.mark.slow
def test_the_mean_is_a_thousand_times_better_than_by_plain_sampling():
    study = load(Path(__file__).parent.parent.parent.parent / "configs" / "beam-field.toml", ["method.fields=false"])
    evaluate = SerialEvaluate(study.model.build(MPI.COMM_SELF, study.inputs.names))
    found = study.method.run(study.inputs, evaluate).sel(output="uy")
    # The variance of one sample, by as many samples as solves, over that of the estimate.
    gain = float(found["std"] ** 2 / study.planned / found["mean_error"] ** 2)
    assert gain > 1000
    other = study.method.model_copy(update={"seed": 2}).run(study.inputs, evaluate).sel(output="uy")
    error = np.hypot(found["mean_error"], other["mean_error"])
    assert abs(found["mean"] - other["mean"]) < 4 * error


def test_a_study_shows_its_fields(tmp_path):
    study = parse(STUDY, ["method.samples=8", "method.seed=5"])
    assert run(study, "field", tmp_path / "field", quiet=True) == 0
    dataset = read_dataset(tmp_path / "field")
    shown = [quantity.name for quantity in forward_scene(dataset, study).quantities]
    assert [name for name in shown if "factor" in name] == [
        f"Realisation {i} of the random factor 'stiffness'" for i in (1, 2, 3)
    ]
    expansion = study.model.fields[0].on(study.model.body)
    assert float(dataset["variance_kept"].sel(random_field="stiffness")) == pytest.approx(expansion.kept, rel=1e-12)
    assert ("field-truncated" in [one.code for one in findings(dataset)]) == (expansion.kept < 0.9)
    first = np.exp(expansion.offset + expansion.values(dataset["points"].to_numpy()[0]))  # the first sample
    np.testing.assert_allclose(dataset["factor"].sel(random_field="stiffness")[0], first, rtol=1e-12)
    report = (tmp_path / "field" / "report.html").read_text(encoding="utf-8")
    for words in ("fields.stiffness.0 to 4", "Matérn correlation of length 0.1 m", "of the variance of the field"):
        assert words in report


@pytest.mark.unit
def test_a_field_that_is_shorter_than_the_cells_says_so():
    body = Box(size=(0.08, 0.02, 0.02), cells=(8, 2, 2))
    assert [one.code for one in RandomField(of="stiffness", length=0.009, std=0.4, basis="noise").findings(body)] == [
        "field-short"
    ]
    assert not list(RandomField(of="stiffness", length=0.02, std=0.4, basis="noise").findings(body))
