"""Invariants of a change of shape, where hardly any shape has changed."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import sympy as sp

from forward.materials import kinematics
from forward.solvers.acceptance import Search
from forward.solvers.newton import admissible_step

pytestmark = pytest.mark.unit

FLOATS = SimpleNamespace(
    tr=lambda A: float(A.trace()),
    det=lambda A: float(A.det()),
    sqrt=math.sqrt,  # raises for negative numbers
    atan2=math.atan2,
    cos=math.cos,
    positive=lambda x: max(x, 0.0),
)


def strains(deviator):
    """The eigenvalues of 3 dev C / tr C of a deviator of rounding errors, and what they become with their slopes."""
    at = kinematics.Deformation(None, 0.63, sp.Matrix(deviator), None, None)
    found = kinematics.shape(FLOATS, sp.diag(1.1, 1.1, 1.1), at, sp.eye(3))
    return kinematics.principal_strains(FLOATS, found.spread, found.angle), found.slopes


@pytest.mark.parametrize(
    "noise", [[1.0, 1.0, 1.0], [2.0, 2.0, -3.0], [-1.0, 2.0, -1.0], [0.0, 0.0, 0.0], [3.0, 0.0, 0.0]]
)
def test_rounding_errors_of_a_deviator_need_not_have_a_trace_of_zero(noise):
    values, slopes = strains(1e-17 * np.diag(noise))
    assert max(map(abs, values)) < 1e-16
    assert all(math.isfinite(x) for slope in slopes.values() for x in slope)


def test_principal_strains_are_eigenvalues():
    A = np.array([[0.1, 0.2, -0.1], [0.2, -0.3, 0.05], [-0.1, 0.05, 0.2]])
    values, _ = strains(A)
    assert sorted(values) == pytest.approx(np.linalg.eigvalsh(A / 1.21), rel=1e-10)


def test_a_full_step_leads_to_prescribed_displacements_exactly():
    """A target that is off by a rounding error is not reached, however small the imbalance is."""

    def on_target(u):
        return np.array([0.1, u[1]])

    system = SimpleNamespace(
        on_target=on_target, smallest_jacobian=lambda u: 1.0, residual=lambda u: SimpleNamespace(size=abs(u[0] - 0.1))
    )
    rounded = np.array([0.1 + 3e-17 - 0.7, 0.0])
    search = Search(system, SimpleNamespace(minimum_damping=0.1))
    state, residual = admissible_step(search, np.array([0.7, 1.0]), rounded)
    assert residual.size == 0
    assert state.tolist() == [0.1, 1.0]
