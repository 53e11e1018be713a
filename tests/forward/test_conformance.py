"""The derivative check that every model inherits: what is right passes, every planted fault is caught."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from forward.conformance import check_derivatives
from forward.model import DerivativeError
from forward.pointwise import FunctionModel, FunctionSolution
from tests.launch import run_script

POINT = np.array([0.7, 1.3])
SCALE = np.array([0.5, 0.4])


def values(x):
    return np.array([np.exp(x[0]) * x[1], 3 * x[0] - 2 * x[1] + 1, np.sin(x[0] * x[1]), 5.0])


def jacobian(x):
    c = np.cos(x[0] * x[1])
    return np.array([[np.exp(x[0]) * x[1], np.exp(x[0])], [3, -2], [x[1] * c, x[0] * c], [0, 0]])


MODEL = FunctionModel(values, ("a", "b"), ("product", "linear", "wave", "constant"), jacobian)


@dataclass(frozen=True)
class Wrapped:
    """A solution whose derivatives can be spoilt."""

    inner: object
    tangent_factor: object = 1.0
    adjoint_factor: object = 1.0
    bias: float = 0.0

    def __getattr__(self, name):
        return getattr(self.inner, name)

    def tangent(self, direction):
        return self.tangent_factor * self.inner.tangent(direction) + self.bias

    def adjoint(self, weights):
        return self.inner.adjoint(self.adjoint_factor * weights)


@dataclass(frozen=True)
class Faulty:
    """A model that plants faults into the derivatives of another."""

    inner: object
    faults: dict[str, object]

    def __getattr__(self, name):
        return getattr(self.inner, name)

    def solve(self, parameters, guess=None):
        return Wrapped(self.inner.solve(parameters, guess), **self.faults)


@pytest.mark.unit
def test_right_derivatives_pass():
    found = check_derivatives(MODEL, POINT, SCALE)
    assert found.mistakes() == ()
    found.require()
    assert np.abs(found.orders[:, [0, 2]] - 2)[~np.isnan(found.orders[:, [0, 2]])] == pytest.approx(0, abs=0.1)
    assert found.adjoint.max() <= 1e-15
    # A linear output leaves nothing but rounding, along every direction.
    assert np.isnan(found.orders[:, [1, 3]]).all()
    assert found.directions == ("'a'", "'b'", "a direction of 2 parameters")


@pytest.mark.unit
@pytest.mark.parametrize("output", [0, 1, 2])
@pytest.mark.parametrize("factor", [1.001, 0.999])
def test_a_fault_of_a_thousandth_in_a_tangent_is_caught(output, factor):
    factors = np.ones(4)
    factors[output] = factor
    faulty = Faulty(
        MODEL, {"tangent_factor": factors, "adjoint_factor": factors}
    )  # a consistent fault: only Taylor can see it
    found = check_derivatives(faulty, POINT, SCALE)
    for direction in ("'a'", "'b'"):
        assert any(f"tangent of '{MODEL.outputs[output]}' along {direction}" in line for line in found.mistakes())
    assert not any("adjoint of" in line for line in found.mistakes())
    with pytest.raises(AssertionError, match=r"off by 1\.0e-03 of itself \(Taylor remainder of order"):
        found.require()


@pytest.mark.unit
def test_a_fault_in_the_derivative_of_one_parameter_is_caught():
    wrong = replace(MODEL, jacobian=lambda x: jacobian(x) * np.array([1, 1.001]))
    lines = check_derivatives(wrong, POINT, SCALE).mistakes()
    assert any("along 'b'" in line for line in lines)
    assert not any("along 'a'" in line for line in lines)


@pytest.mark.unit
def test_an_adjoint_that_is_not_the_transpose_is_caught():
    found = check_derivatives(Faulty(MODEL, {"adjoint_factor": 1 + 1e-8}), POINT, SCALE)
    assert any(line.startswith("adjoint of 'wave' along 'a': off by") for line in found.mistakes())
    assert not any("tangent of" in line for line in found.mistakes())


@pytest.mark.unit
def test_a_tangent_that_is_not_linear_is_caught():
    found = check_derivatives(Faulty(MODEL, {"bias": 1e-7}), POINT, SCALE)
    assert any("not linear" in line for line in found.mistakes())


@pytest.mark.unit
def test_derivatives_that_are_not_finite_are_caught():
    found = check_derivatives(Faulty(MODEL, {"tangent_factor": np.nan}), POINT, SCALE)
    assert any("off by nan" in line for line in found.mistakes())


@pytest.mark.unit
def test_a_stale_linearisation_is_caught():
    class Stale(FunctionModel):
        """Differentiates where it was solved last."""

        def solve(self, parameters, guess=None):
            last.parameters = np.array(parameters)
            return Lazy(super().solve(parameters))

    class Last:
        parameters = POINT

    class Lazy:
        def __init__(self, solution: FunctionSolution):
            self.outputs, self.state, self.state_tangent = solution.outputs, solution.state, solution.state_tangent

        def tangent(self, direction):
            return jacobian(last.parameters) @ direction

        def adjoint(self, weights):
            return weights @ jacobian(last.parameters)

    last = Last()
    found = check_derivatives(Stale(values, MODEL.parameters, MODEL.outputs, jacobian), POINT, SCALE)
    assert any("after another solve" in line for line in found.mistakes())


@pytest.mark.unit
def test_a_solution_that_can_be_changed_is_caught():
    class Open(FunctionModel):
        def solve(self, parameters, guess=None):
            return FunctionSolution(
                self, parameters, values(parameters)
            )  # keeps the caller's vector, and can be written

    found = check_derivatives(Open(values, MODEL.parameters, MODEL.outputs, jacobian), POINT, SCALE)
    assert found.changed == ("outputs",)
    assert any("after another solve" in line for line in found.mistakes())
    assert any("outputs of a solution can change" in line for line in found.mistakes())


@pytest.mark.unit
def test_an_output_of_which_the_second_derivative_vanishes_passes():
    model = FunctionModel(np.sin, ("a",), ("sine",), np.cos)
    found = check_derivatives(model, [0.0], [1.0])
    assert found.mistakes() == ()
    assert found.orders[0, 0] == pytest.approx(3, abs=0.1)
    spoilt = Faulty(model, {"tangent_factor": 1.001, "adjoint_factor": 1.001})
    assert check_derivatives(spoilt, [0.0], [1.0]).mistakes()


@pytest.mark.unit
def test_a_wrong_shape_is_caught():
    class Column(FunctionSolution):
        def tangent(self, direction):
            return super().tangent(direction)[:, None]

    class Model(FunctionModel):
        def solve(self, parameters, guess=None):
            return Column(self, parameters, values(parameters))

    with pytest.raises(AssertionError, match=r"tangent returned shape \(4, 1\), expected \(4,\)"):
        check_derivatives(Model(values, MODEL.parameters, MODEL.outputs, jacobian), POINT, SCALE)


@pytest.mark.unit
def test_a_model_without_derivatives_is_refused():
    with pytest.raises(DerivativeError, match="no derivatives"):
        check_derivatives(replace(MODEL, jacobian=None), POINT, SCALE)


@pytest.mark.unit
def test_a_function_model_keeps_nothing_of_its_caller():
    buffer = np.zeros(4)

    def into_buffer(x):
        buffer[:] = values(x)
        return buffer

    model = replace(MODEL, function=into_buffer)
    x = POINT.copy()
    solution = model.solve(x)
    outputs, slope = solution.outputs.copy(), solution.tangent(SCALE)
    x += 1
    model.solve(x)
    np.testing.assert_array_equal(solution.outputs, outputs)
    np.testing.assert_array_equal(solution.tangent(SCALE), slope)


@pytest.mark.unit
def test_too_few_steps_are_refused():
    with pytest.raises(ValueError, match="2 steps given, expected at least 3"):
        check_derivatives(MODEL, POINT, SCALE, steps=(0.1, 0.05))


def test_the_check_needs_neither_fenicsx_nor_mpi():
    script = (
        "import sys, forward.conformance; sys.exit(bool({'dolfinx', 'petsc4py', 'mpi4py', 'ufl'} & set(sys.modules)))"
    )
    assert run_script(None, script).returncode == 0
