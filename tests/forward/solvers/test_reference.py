"""Corrections with a reference factor: another path to the same equilibrium, and to its derivatives."""

import numpy as np
import pytest
from mpi4py import MPI

from forward.model import Guess, ReferenceSolution
from tests.bodies import OUTPUTS, loaded_body, unloaded_body

pytestmark = pytest.mark.fem
CASES = ("mooney-rivlin", "neo-hookean")  # follower pressures make the stiffness unsymmetric
TOLERANCE = 1e-10


def built(material, derivatives=TOLERANCE):
    # The path alone: what is done about stability is in test_equilibria.py.
    solver = {"tolerance": TOLERANCE, "derivative_tolerance": derivatives, "accept_unstable": True}
    spec = loaded_body(material, solver=solver)
    parameters = tuple(spec.scalars)
    values = np.array([scalar.value for scalar in spec.scalars.values()])
    return spec.build(MPI.COMM_SELF, parameters), values


@pytest.fixture(scope="module", params=CASES)
def case(request):
    model, values = built(request.param)
    base = model.solve(values)
    slopes = base.state_tangent(np.eye(len(values)))
    return model, values, base, slopes


def points(values, spread, count=6):
    rng = np.random.default_rng(1)
    return values * rng.uniform(1 - spread, 1 + spread, (count, len(values)))


def test_the_answer_is_that_of_newton_without_a_stiffness(case):
    model, values, base, slopes = case
    reference = ReferenceSolution(values, base.state)
    for point in points(values, 0.3):
        expected = model.solve(point)
        found = model.solve(point, Guess(base.state + (point - values) @ slopes, reference))
        assert found.work.factorisations == found.work.assemblies == 0
        assert found.work.back_substitutions == found.work.residuals - 1
        size = np.abs(expected.state).max()
        np.testing.assert_allclose(found.state, expected.state, rtol=0, atol=1e-8 * size)
        np.testing.assert_allclose(found.outputs, expected.outputs, rtol=1e-7)


@pytest.mark.parametrize("material", CASES)
def test_derivatives_are_as_good_as_asked_and_no_dearer(material):
    products = []
    for tolerance in (1e-3, 1e-6, 1e-9):
        model, values = built(material, tolerance)
        base = model.solve(values)
        point, few = points(values, 0.3)[0], np.diag(values)[:3]
        start = base.state + base.state_tangent(point - values)
        found = model.solve(point, Guess(start, ReferenceSolution(values, base.state)))
        before = found.work.residuals
        tangents = found.state_tangent(few)
        products.append(found.work.residuals - before)
        exact = model.solve(point).state_tangent(few)
        errors = np.linalg.norm(tangents - exact, axis=1) / np.linalg.norm(exact, axis=1)
        assert errors.max() <= tolerance
    assert products[0] < products[1] < products[2]


def test_derivatives_follow_to_the_tolerance_of_the_solver(case):
    model, values, base, slopes = case
    point = points(values, 0.3)[0]
    found = model.solve(point, Guess(base.state + (point - values) @ slopes, ReferenceSolution(values, base.state)))
    exact = model.solve(point)
    directions, weights = np.diag(values)[:3], np.eye(len(OUTPUTS))[:3]
    for name, rows in (("state_tangent", directions), ("tangent", directions), ("adjoint", weights)):
        expected = getattr(exact, name)(rows)
        size = np.abs(expected).max(axis=0) + 1e-3 * np.abs(expected).max()
        np.testing.assert_allclose(getattr(found, name)(rows) / size, expected / size, rtol=0, atol=1e-7, err_msg=name)
    assert found.work.factorisations == 0
    # Many are cheaper with a factor of their own.
    many = found.tangent(np.diag(values))
    assert found.work.factorisations == 1
    np.testing.assert_allclose(many, exact.tangent(np.diag(values)), rtol=1e-6, atol=1e-9 * np.abs(many).max())


def test_rows_of_directions_are_one_direction_after_the_other(case):
    _, values, base, _ = case
    directions, weights = np.diag(values), np.eye(len(OUTPUTS))
    for name, rows in (("state_tangent", directions), ("tangent", directions), ("adjoint", weights)):
        derivative = getattr(base, name)
        one_by_one = np.array([derivative(row) for row in rows])
        size = np.abs(one_by_one).max(axis=0)
        size[size == 0] = 1
        np.testing.assert_allclose(derivative(rows) / size, one_by_one / size, rtol=0, atol=1e-12, err_msg=name)


def test_what_was_solved_before_changes_nothing(case):
    model, values, base, slopes = case
    reference, elsewhere = (
        ReferenceSolution(values, base.state),
        ReferenceSolution(1.1 * values, model.solve(1.1 * values).state),
    )
    point = points(values, 0.2)[0]
    start = base.state + (point - values) @ slopes
    direction = np.eye(len(values))[0]
    first = model.solve(point, Guess(start, reference))
    tangent = first.tangent(direction)
    model.solve(points(values, 0.3)[1], None).tangent(direction)
    model.solve(point, Guess(start, elsewhere)).tangent(direction)
    again = model.solve(point, Guess(start, ReferenceSolution(values.copy(), base.state.copy())))
    np.testing.assert_array_equal(again.state, first.state)
    np.testing.assert_array_equal(again.tangent(direction), tangent)
    model.solve(point, Guess(start, elsewhere))
    np.testing.assert_array_equal(first.tangent(direction), tangent)


def test_a_reference_that_is_too_far_hands_over_to_newton(case):
    model, values, base, slopes = case
    far = np.array(values)
    for i, path in enumerate(model.parameters):
        far[i] *= 0.2 if path.startswith("material.") else 1.5 if path.startswith("loads.") else 1
    expected = model.solve(far)
    found = model.solve(far, Guess(base.state + (far - values) @ slopes, ReferenceSolution(values, base.state)))
    np.testing.assert_allclose(found.state, expected.state, rtol=0, atol=1e-7 * np.abs(expected.state).max())
    found.tangent(np.eye(len(values)))


@pytest.mark.parametrize("wrong", [np.nan, 1e6, 1.0, -0.7])
def test_a_useless_prediction_does_no_harm(case, wrong):
    model, values, base, _ = case
    start = wrong * np.random.default_rng(0).random(len(base.state))
    found = model.solve(values, Guess(start, ReferenceSolution(values, base.state)))
    np.testing.assert_allclose(found.state, base.state, rtol=0, atol=1e-8 * np.abs(base.state).max())


def test_the_textbook_path_takes_no_help():
    model, values = built("neo-hookean")
    textbook = model.spec.model_copy(update={"solver": model.spec.solver.model_copy(update={"kind": "newton"})})
    plain = textbook.build(MPI.COMM_SELF, model.parameters)
    base = plain.solve(values)
    again = plain.solve(values, Guess(base.state, ReferenceSolution(values, base.state)))
    assert again.work == base.work
    assert base.work.factorisations == base.work.back_substitutions
    np.testing.assert_array_equal(again.state, base.state)
    np.testing.assert_allclose(model.solve(values).state, base.state, rtol=0, atol=1e-8 * np.abs(base.state).max())


COLUMN = {"size": (1.0, 0.1, 0.1), "cells": (6, 1, 1), "cell": "hexahedron", "degree": 2}


def test_a_column_that_buckles_is_told_from_one_that_stands():
    """The stiffness of a perfect column loses its sign at Euler's load; the equilibrium itself is still there."""
    squeezed = {"on": "x-max", "x": 0.0, "y": 0.0, "z": 0.0}
    spec = unloaded_body("neo-hookean", body=COLUMN, displacements=(squeezed,), loads=(), outputs=OUTPUTS[6:7])
    path = "displacements.x-max.x"
    model = spec.build(MPI.COMM_SELF, (path,))
    euler = 4 * np.pi**2 / 12 * 0.1**2  # of the length, both ends held: 4π² I / (A L²)
    model.solve(np.array([-0.7 * euler]))
    with pytest.raises(Exception, match=r"^stopped at [\d.]+ % of the load: the equilibrium is unstable .* buckles"):
        model.solve(np.array([-1.5 * euler]))
    lenient = spec.model_copy(update={"solver": spec.solver.model_copy(update={"accept_unstable": True})})
    straight = lenient.build(MPI.COMM_SELF, (path,)).solve(np.array([-1.5 * euler])).state.reshape(-1, 3)
    assert np.abs(straight[:, 1:]).max() < 0.01


def test_a_few_corrections_say_how_far_they_are(case):
    model, values, base, slopes = case
    reference = ReferenceSolution(values, base.state)
    point = points(values, 0.3)[0]
    start = base.state + (point - values) @ slopes
    exact = model.solve(point)
    assert exact.converged
    assert exact.residual <= TOLERANCE
    errors, corrections = [], model.solve(point, Guess(start, reference)).work.back_substitutions
    for d in (1, 2, 4):
        found = model.solve(point, Guess(start, reference, d))
        assert not found.converged
        assert found.work.back_substitutions == d == found.work.residuals - 1
        assert found.work.factorisations == 0
        body = found.visit()
        assert body.residual(found.state).relative == pytest.approx(found.residual, rel=1e-6)
        errors.append(np.abs(found.state - exact.state).max())
    assert errors[2] < 0.1 * errors[1] < 0.1 * errors[0]
    # More than it takes: stopped by the tolerance, at the state of an unlimited solve.
    enough = model.solve(point, Guess(start, reference, corrections + 5))
    assert enough.converged
    assert enough.work.back_substitutions == corrections
    np.testing.assert_allclose(enough.state, exact.state, rtol=0, atol=1e-8 * np.abs(exact.state).max())


def test_a_few_newton_steps_go_from_the_start(case):
    model, values, base, slopes = case
    spec = model.spec
    newton = spec.model_copy(update={"solver": spec.solver.model_copy(update={"kind": "newton"})})
    textbook = newton.build(MPI.COMM_SELF, tuple(spec.scalars))
    point = points(values, 0.3)[0]
    start = base.state + (point - values) @ slopes
    exact = textbook.solve(point)
    for any_model in (textbook, model):  # without a reference, both make Newton steps
        errors = []
        for d in (1, 2):
            found = any_model.solve(point, Guess(start, None, d))
            assert found.work.factorisations == d
            errors.append(np.abs(found.state - exact.state).max() / np.abs(exact.state).max())
        assert errors[1] < 1e-2 * errors[0]
    at_once = textbook.solve(point, Guess(start, None, 1000))
    assert at_once.converged
    assert at_once.work.factorisations < exact.work.factorisations
    from_zero = textbook.solve(point, Guess(start))  # as the textbook
    assert from_zero.work.factorisations == exact.work.factorisations


@pytest.mark.parametrize("wrong", [np.nan, 1e6, -0.7])
def test_a_partial_state_that_is_not_admissible_is_solved_and_charged(case, wrong):
    model, values, base, _ = case
    start = wrong * np.random.default_rng(0).random(len(base.state))
    found = model.solve(values, Guess(start, ReferenceSolution(values, base.state), 2))
    assert found.converged
    np.testing.assert_allclose(found.state, base.state, rtol=0, atol=1e-8 * np.abs(base.state).max())
    assert found.work.residuals > model.solve(values).work.residuals
