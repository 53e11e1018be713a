"""Linear solvers against dense algebra, and in each other's place."""

import numpy as np
import pytest
from mpi4py import MPI

from forward.fem.dolfinx import linear
from forward.model import Stability
from tests.bodies import cantilever, loaded_body

pytestmark = pytest.mark.fem


SPECS = {
    "definite": cantilever(),
    "indefinite": cantilever(formulation="mixed"),
    "not symmetric": loaded_body("mooney-rivlin"),
}


def memory(solver):
    """Bytes of a factor with its working memory, by MUMPS, which knows them once there is one."""
    return 10**6 * solver._ksp.pc.getFactorMatrix().getMumpsInfog(22)


@pytest.mark.parametrize("kind", SPECS)
def test_a_direct_solver_agrees_with_dense_algebra(kind):
    model = SPECS[kind].build(MPI.COMM_SELF, ())
    state = np.array(model.solve(np.empty(0)).state)
    equations = model.equations
    equations.set_state(state)
    solver = equations.new_factor()
    solver.factorise()
    K = equations.free_stiffness_times(np.eye(equations.size)).T
    K[equations.fixed] = 0  # columns are zero already; rows of prescribed unknowns are identities
    K[equations.fixed, equations.fixed] = 1
    rows = np.random.default_rng(0).standard_normal((3, equations.size))
    rows[:, equations.fixed] = 0
    for transpose in (False, True):
        expected = np.linalg.solve(K.T if transpose else K, rows.T).T
        found = solver.solve(rows, transpose=transpose)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
        one = solver.solve(rows[1], transpose=transpose)
        np.testing.assert_allclose(one, found[1], rtol=0, atol=1e-12 * np.abs(found).max())
    negative = solver.negative_eigenvalues()
    if kind == "not symmetric":
        assert negative is None
    else:
        assert negative == (np.linalg.eigvalsh((K + K.T) / 2) < 0).sum() == equations.unknowns.pressures
    assert (10**6 if equations.size > 100 else 0) <= memory(solver) < 10**9


class ConjugateGradients:
    """A linear solver that iterates, knows no inertia, and factorises nothing."""

    def __init__(self, stiffness):
        self._stiffness = stiffness

    def factorise(self):
        self._matrix = self._stiffness.sparse()
        self._scale = 1 / self._matrix.diagonal()

    def solve(self, right, *, transpose=False, tolerance=1e-13):
        if right.ndim == 2:
            return np.array([self.solve(row) for row in right]).reshape(right.shape)
        x, r = np.zeros_like(right), np.array(right)
        p = z = self._scale * r
        for _ in range(10 * len(right)):
            if np.linalg.norm(r) <= 1e-13 * np.linalg.norm(right):
                break
            q = self._matrix @ p
            step = (r @ z) / (p @ q)
            before = r @ z
            x, r = x + step * p, r - step * q
            z = self._scale * r
            p = z + (r @ z) / before * p
        return x

    def negative_eigenvalues(self):
        return None


def test_another_linear_solver_gives_the_same_solutions(monkeypatch):
    names = ("material.C1", "loads.traction.size")
    point = np.array([5e3, 60.0])
    expected = SPECS["definite"].build(MPI.COMM_SELF, names).solve(point)
    monkeypatch.setattr(linear, "DirectSolver", ConjugateGradients)
    found = SPECS["definite"].build(MPI.COMM_SELF, names).solve(point)
    assert found.converged
    assert expected.stability == Stability.COUNTED
    assert found.stability == Stability.NOT_TESTED  # it has nothing to count with
    np.testing.assert_allclose(found.state, expected.state, rtol=0, atol=1e-7 * np.abs(expected.state).max())
    tangents, gradient = found.tangent(np.eye(2))[:, 0], found.adjoint(np.ones(1))
    np.testing.assert_allclose(tangents, expected.tangent(np.eye(2))[:, 0], rtol=1e-6)
    np.testing.assert_allclose(gradient, tangents, rtol=1e-9)
