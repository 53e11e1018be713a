"""What the solver promises: load steps where they are needed, exact reasons where it fails, and no memory of either."""

import numpy as np
import pytest
from mpi4py import MPI

from forward.fem.dolfinx import linear
from forward.hyperelastic import Hyperelastic
from forward.model import Guess, SolveError
from forward.solvers import corrections
from tests.bodies import FORMS, OUTPUTS, loaded_body, unloaded_body
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs
from uq.surrogates.linearisation import linearise

pytestmark = pytest.mark.fem
INTEGRALS = OUTPUTS[6:]
CUBE = {"size": (1.0, 1.0, 1.0), "cells": (2, 2, 2)}
DENSITY, TRACTION, PRESSURE = "loads.gravity.density", "loads.traction.size", "loads.pressure.size"
PARAMETERS = ("material.C1", "material.D1", DENSITY, TRACTION, PRESSURE, "displacements.y-max.y")
POINT = np.array([1e4, 2e5, 600.0, 1e3, 2e3, 0.05])


def check(model, solution):
    """An equilibrium to tolerance, with J > 0 everywhere; whatever the solution claims."""
    body = solution.visit()
    body.at_load(1.0)
    residual = body.residual(solution.state)
    assert residual.gap == 0
    assert residual.size <= max(
        model.spec.solver.tolerance * residual.scale, body.rounding(solution.state, residual.scale)
    )
    assert body.smallest_jacobian(solution.state) > 0
    assert np.isfinite(solution.outputs).all()
    solution.visit()


@pytest.fixture(scope="module")
def model():
    return loaded_body("mooney-rivlin").build(MPI.COMM_SELF, PARAMETERS)


@pytest.fixture(scope="module")
def heavy():
    """A clamped cube whose weight is the parameter."""
    spec = unloaded_body("mooney-rivlin", body=CUBE, displacements=(), outputs=INTEGRALS)
    return spec.build(MPI.COMM_SELF, (DENSITY,))


def test_load_steps_succeed_where_newton_from_zero_fails(heavy):
    light, loaded = heavy.solve(np.array([1e3])), heavy.solve(np.array([1e4]))
    assert light.work.load_steps == 0
    assert loaded.work.load_steps >= 2
    check(heavy, light)
    check(heavy, loaded)
    # A state found by load steps is found directly from its neighbour.
    near = heavy.solve(np.array([1e4]), Guess(heavy.solve(np.array([9.9e3])).state))
    assert near.work.load_steps == 0
    np.testing.assert_allclose(near.state, loaded.state, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("axis", "distance"), [("x", -0.6), ("x", 2.0), ("y", -1.5), ("y", 4.0)])
def test_large_prescribed_displacements(axis, distance):
    grip = {"on": "x-max", "x": 0.0, "y": 0.0, "z": 0.0}
    # Pulled to three times its length, this coarse cube has an eigenvalue below zero.
    solver = {"tolerance": 1e-12, "accept_unstable": (axis, distance) == ("x", 2.0)}
    spec = unloaded_body("mooney-rivlin", body=CUBE, displacements=(grip,), outputs=INTEGRALS, solver=solver)
    model = spec.build(MPI.COMM_SELF, (f"displacements.x-max.{axis}",))
    check(model, model.solve(np.array([distance])))


def test_failures_say_where_and_why(heavy):
    with pytest.raises(SolveError, match=r"^stopped at [\d.e-]+ % of the load: \w+") as failure:
        heavy.solve(np.array([1e7]))
    error = failure.value
    assert len(error.history) > 20
    assert any(line.startswith("load 1 iteration 0: relative residual 1.000e+00") for line in error.history)
    assert error.work.factorisations > 20
    assert error.work.load_steps >= 0

    # Turned inside out: no state at all.
    spec = unloaded_body("mooney-rivlin", displacements=({"on": "x-max", "x": 0.0},), outputs=INTEGRALS)
    crushed = spec.build(MPI.COMM_SELF, ("displacements.x-max.x",))
    with pytest.raises(SolveError, match=r"^stopped at \d+[\d.]* % of the load: ") as failure:
        crushed.solve(np.array([-1.0]))
    reached = float(str(failure.value).split()[2])
    assert 50 < reached < 100
    check(crushed, crushed.solve(np.array([-0.01 * reached * 0.95])))


@pytest.mark.parametrize(
    ("place", "value", "reason"),
    [
        (0, -1e6, r"material: not stable at rest: μ = 2 \(C1 \+ C2\) = -.* Pa, expected more than 0"),
        (1, 0.0, "material: not stable at rest: κ = 2 D1 = 0 Pa, expected more than 0"),
        (1, np.nan, "material: not stable at rest: κ = 2 D1 = nan Pa"),
        (2, -1.0, "loads.gravity.density = -1 is not admissible"),
        (3, np.nan, "no finite residual"),
        (4, np.inf, "no finite residual"),
        (5, np.nan, "Newton steps grow"),
    ],
)
def test_impossible_parameters_are_refused(model, place, value, reason):
    point = POINT.copy()
    point[place] = value
    with pytest.raises(SolveError, match=reason):
        model.solve(point)


def test_a_failure_leaves_no_trace(model):
    before = model.solve(POINT)
    for place, value in ((4, np.inf), (0, -1e6), (2, 1e9), (2, 1e6), (5, np.nan)):
        point = 1.1 * POINT
        point[place] = value
        with pytest.raises(SolveError):
            model.solve(point)
        after = model.solve(POINT)
        np.testing.assert_array_equal(after.state, before.state)
        np.testing.assert_array_equal(after.outputs, before.outputs)
        np.testing.assert_array_equal(after.tangent(POINT), before.tangent(POINT))


@pytest.mark.parametrize("material", FORMS)
def test_a_solution_does_not_depend_on_what_was_solved_before(material):
    spec = loaded_body(material)
    parameters = tuple(spec.scalars)
    values = np.array([scalar.value for scalar in spec.scalars.values()])
    fresh, used = (spec.build(MPI.COMM_SELF, parameters) for _ in range(2))
    constants = np.array([path.startswith("material.") for path in parameters])
    used.solve(values * np.where(constants, 1e3, 1)).tangent(values)
    used.solve(values * 1.2)
    expected, found = fresh.solve(values), used.solve(values)
    np.testing.assert_array_equal(found.state, expected.state)
    np.testing.assert_array_equal(found.outputs, expected.outputs)
    np.testing.assert_array_equal(found.tangent(values), expected.tangent(values))
    weights = np.ones(len(spec.outputs))
    np.testing.assert_array_equal(found.adjoint(weights), expected.adjoint(weights))


def test_a_prediction_changes_the_cost_and_not_the_answer(model):
    base = model.solve(POINT)
    change = 0.1 * POINT
    from_zero = model.solve(POINT + change)
    predicted = model.solve(POINT + change, Guess(base.state + base.state_tangent(change)))
    np.testing.assert_allclose(predicted.state, from_zero.state, rtol=0, atol=1e-12)
    np.testing.assert_allclose(predicted.outputs, from_zero.outputs, rtol=1e-9)
    assert predicted.work.back_substitutions < from_zero.work.back_substitutions
    check(model, predicted)
    again = model.solve(POINT + change, Guess(from_zero.state))
    assert again.work.factorisations == 1  # that which counts the negative eigenvalues there


def test_newton_starts_where_corrections_came_close(heavy, monkeypatch):
    inputs, point = Inputs({DENSITY: Uniform(lower=0.0, upper=1.2e4)}), np.array([1.15e4])
    spec = Hyperelastic.model_validate(heavy.spec.model_dump() | {"solver": {"corrections": 3}})
    model = spec.build(MPI.COMM_SELF, (DENSITY,))
    guess = linearise(inputs, SerialEvaluate(model)).prediction.on(model)
    close = model.solve(point, guess(point))
    check(model, close)
    monkeypatch.setattr(corrections, "CLOSE", 0.0)  # from the prediction, from zero, by load steps
    far = model.solve(point, guess(point))
    np.testing.assert_allclose(close.state, far.state, rtol=0, atol=1e-8)
    assert close.work.load_steps == 0
    assert close.work.factorisations < far.work.factorisations / 2


@pytest.mark.parametrize("wrong", [np.nan, 1e6, 1.0, -0.7])
def test_a_useless_prediction_does_no_harm(model, wrong):
    base = model.solve(POINT)
    start = wrong * np.random.default_rng(0).random(len(base.state))
    np.testing.assert_allclose(model.solve(POINT, Guess(start)).state, base.state, rtol=0, atol=1e-12)


def test_a_solution_is_immutable(model):
    point = POINT.copy()
    solution = model.solve(point)
    for array in (solution.state, solution.outputs, solution.parameters):
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 0
    point[:] = 0
    np.testing.assert_array_equal(solution.parameters, POINT)
    start = np.array(solution.state)
    near = model.solve(POINT, Guess(start))
    start[:] = 0
    np.testing.assert_array_equal(near.state, solution.state)


def test_a_factorisation_that_fails_leaves_no_factor(model, monkeypatch):
    first, second = model.solve(POINT), model.solve(1.1 * POINT)
    expected = first.tangent(POINT)

    def fail(solver):
        factorise(solver)
        raise SolveError("the stiffness is singular")

    factorise = linear.DirectSolver.factorise
    monkeypatch.setattr(linear.DirectSolver, "factorise", fail)
    with pytest.raises(SolveError):
        second.tangent(POINT)
    monkeypatch.undo()
    np.testing.assert_array_equal(first.tangent(POINT), expected)


@pytest.mark.parametrize("material", FORMS)
def test_without_loads_nothing_moves(material):
    spec = unloaded_body(material, displacements=({"on": "y-max", "y": 0.0},))
    model = spec.build(MPI.COMM_SELF, (TRACTION, "displacements.y-max.y"))
    solution = model.solve(np.zeros(2))
    np.testing.assert_array_equal(solution.state, 0)
    # A load so small that its residual drowns in rounding.
    faint = model.solve(np.array([1e-7, 0.0]))
    np.testing.assert_allclose(faint.state, faint_expected(model), rtol=0, atol=1e-3 * np.abs(faint.state).max())


def faint_expected(model):
    """The answer of the linear model, from the tangent at zero."""
    return model.solve(np.zeros(2)).state_tangent(np.array([1e-7, 0.0]))


def test_a_rigid_motion_costs_no_energy():
    moved = ({"on": "x-min", "x": 0.1, "y": -0.2, "z": 0.3},)
    spec = unloaded_body("mooney-rivlin", clamp=(), displacements=moved, outputs=INTEGRALS)
    solution = spec.build(MPI.COMM_SELF, ()).solve(np.empty(0))
    np.testing.assert_allclose(solution.state.reshape(-1, 3), [[0.1, -0.2, 0.3]] * spec.body.nodes, atol=1e-14)


def test_parameters_keep_their_order_and_others_their_values():
    spec = loaded_body("mooney-rivlin")
    a = spec.build(MPI.COMM_SELF, PARAMETERS).solve(POINT)
    b = spec.build(MPI.COMM_SELF, PARAMETERS[::-1]).solve(POINT[::-1])
    c = spec.build(MPI.COMM_SELF, ()).solve(np.empty(0))
    np.testing.assert_array_equal(a.state, b.state)
    np.testing.assert_array_equal(a.state, c.state)
    np.testing.assert_allclose(a.adjoint(np.ones(9)), b.adjoint(np.ones(9))[::-1], rtol=1e-12)


def test_an_unknown_path_is_refused():
    with pytest.raises(ValueError, match=r"'material.C3' is not a number of the model, expected one of: material.C1"):
        loaded_body("mooney-rivlin").build(MPI.COMM_SELF, ("material.C3",))
