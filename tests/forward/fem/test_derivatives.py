"""Tangents and adjoints of every material × parameter × load × output of the finite-element model."""

from dataclasses import dataclass

import numpy as np
import pytest
from mpi4py import MPI

from forward.conformance import EXACT, STATE, check_derivatives
from tests.bodies import MATERIALS, OUTPUTS, loaded_body

pytestmark = pytest.mark.fem
ACCURACY = 1e-13  # Newton's last step goes to rounding
LOADS = ("loads.gravity.density", "loads.traction.size", "loads.pressure.size", "displacements.y-max.y")


@pytest.fixture(scope="module", params=(*MATERIALS, "neo-hookean mixed"))
def conformance(request):
    spec = loaded_body(request.param)
    parameters = tuple(spec.scalars)
    values = np.array([scalar.value for scalar in spec.scalars.values()])
    model = spec.build(MPI.COMM_SELF, parameters)
    return model, values, check_derivatives(model, values, 0.3 * values, accuracy=ACCURACY)


def test_every_number_of_the_model_is_a_parameter(conformance):
    model, _, found = conformance
    constants = {path for path in model.parameters if path.startswith("material.")}
    assert constants == {f"material.{name}" for name in MATERIALS[model.spec.material.kind] if name != "kind"}
    assert set(model.parameters) - constants == set(LOADS)
    assert found.directions[:-1] == tuple(f"'{path}'" for path in model.parameters)
    assert found.outputs == (*(output["name"] for output in OUTPUTS), STATE)


def test_taylor_remainders_are_of_second_order(conformance):
    _, _, found = conformance
    assert found.mistakes() == ()
    assert np.nanmax(np.abs(found.orders - 2)) <= 0.1
    # Everything depends on everything, so every order was measured.
    assert not np.isnan(found.orders).any()


def test_the_adjoint_is_the_transpose_of_the_tangent(conformance):
    _, _, found = conformance
    assert found.adjoint.max() <= EXACT
    assert found.linearity <= EXACT
    assert found.stale <= EXACT


def test_entry_by_entry_the_adjoint_is_the_tangent(conformance):
    model, values, _ = conformance
    solution = model.solve(values)
    by_tangents = np.array([solution.tangent(direction) for direction in np.diag(values)]).T
    by_adjoints = np.array([solution.adjoint(weights) for weights in np.eye(len(model.outputs))]) * values
    np.testing.assert_allclose(by_adjoints, by_tangents, rtol=1e-10)


@dataclass(frozen=True)
class Faulty:
    """A model whose tangents are wrong by a factor."""

    inner: object
    factor: float

    def __getattr__(self, name):
        return getattr(self.inner, name)

    def solve(self, parameters, guess=None):
        return FaultySolution(self.inner.solve(parameters, guess), self.factor)


@dataclass(frozen=True)
class FaultySolution:
    inner: object
    factor: float

    def __getattr__(self, name):
        return getattr(self.inner, name)

    def tangent(self, direction):
        return self.factor * self.inner.tangent(direction)


def test_a_fault_of_a_thousandth_is_caught(conformance):
    model, values, _ = conformance
    found = check_derivatives(Faulty(model, 1.001), values, 0.3 * values, accuracy=ACCURACY)
    lines = found.mistakes()
    for output in model.outputs:
        for direction in found.directions:
            assert any(f"tangent of '{output}' along {direction}" in line for line in lines)
            assert any(f"adjoint of '{output}' along {direction}" in line for line in lines)


def test_many_derivatives_cost_one_factorisation(conformance):
    model, values, _ = conformance
    solution = model.solve(values)
    before = solution.work.factorisations
    for direction in np.eye(len(values)):
        solution.tangent(direction)
    solution.adjoint(np.ones(len(model.outputs)))
    assert solution.work.factorisations == before + 1
