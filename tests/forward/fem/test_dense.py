"""Tangents and adjoints of solutions, and of paths with memory, of dense equations of which both are known."""

from types import SimpleNamespace

import numpy as np
import pytest

from forward.fem.enriched import EnrichedState
from forward.fem.history import HistorySolution, Increment, Passed
from forward.fem.linearisation import LinearisationPoint
from forward.fem.solution import FiniteElementSolution
from forward.model import Stability, Work

pytestmark = pytest.mark.unit
SIZE, SCALARS, FIELD, OUTPUTS, KEPT = 6, 2, 3, 2, 3
LEFT = SIZE + KEPT
RNG = np.random.default_rng(8)


class Equations:
    """F(u_i, l_{i−1}, ω) = K_i u_i + C_i l_{i−1} − R_i ω_s + P_i ω_f, with two outputs g_i·u_i + h_i·l_{i−1} + p_i·ω.

    An increment leaves l_i = (u_i, A_i u_i + B_i l_{i−1} + D_i ω), where B_i meets what was kept alone. One unknown is
    prescribed: its row is the identity, and nothing else moves it.
    """

    def __init__(self, increments):
        self.size, self.size_before, self.fixed, self.scalars = SIZE, LEFT, np.array([0]), np.arange(SCALARS)
        self.parameters = tuple(f"p{i}" for i in range(SCALARS + FIELD))
        self.fields = (SimpleNamespace(),)
        n = (increments,)
        self.K = RNG.normal(size=(*n, SIZE, SIZE)) + 6 * np.eye(SIZE)
        self.C = RNG.normal(size=(*n, SIZE, LEFT))
        self.A, self.B = RNG.normal(size=(*n, KEPT, SIZE)), RNG.normal(size=(*n, KEPT, LEFT))
        self.B[:, :, :SIZE] = 0
        self.D = RNG.normal(size=(*n, KEPT, SCALARS + FIELD))
        self.R = RNG.normal(size=(*n, SCALARS, SIZE))
        self.P = RNG.normal(size=(*n, FIELD, SIZE))
        self.g, self.h = RNG.normal(size=(*n, OUTPUTS, SIZE)), RNG.normal(size=(*n, OUTPUTS, LEFT))
        self.p = RNG.normal(size=(*n, OUTPUTS, SCALARS + FIELD))
        self.K[:, 0, :], self.K[:, :, 0] = 0, 0
        self.K[:, 0, 0] = 1
        self.P[:, :, 0] = 0
        self.at, self.linearisation_point, self.symmetric = 0, LinearisationPoint(), False

    def set_to(self, parameters, state, stiffer):
        pass

    def total(self, values):
        return values

    def right_sides(self):
        return self.R[self.at]

    def right_sides_along(self, directions):
        fields = -directions[:, SCALARS:] @ self.P[self.at]
        return directions[:, :SCALARS] @ self.R[self.at] + fields

    def field_right_sides(self, directions):
        return -directions[:, SCALARS:] @ self.P[self.at]

    def field_products(self, multiplier):
        """λᵀ∂F/∂ω of the coefficients of fields."""
        return np.concatenate([np.zeros(SCALARS), self.P[self.at] @ multiplier])

    def rubbed(self, row, *, transpose=True):
        """C times a row, or Cᵀ."""
        C = self.C[self.at]
        return C.T @ row if transpose else C @ row

    def left(self, states, before, directions):
        i = self.at
        return np.hstack([states, states @ self.A[i].T + before @ self.B[i].T + directions @ self.D[i].T])

    def left_adjoint(self, weights):
        i, kept = self.at, weights[:, SIZE:]
        return weights[:, :SIZE] + kept @ self.A[i], kept @ self.B[i], kept @ self.D[i]

    def back_substitute(self, right, *, transpose=False):
        K = self.K[self.at]
        return np.linalg.solve(K.T if transpose else K, right.T).T

    def factorise(self, state):
        pass

    def set_state(self, state):
        pass


def functionals(equations):
    def one(k):
        return SimpleNamespace(
            value=lambda: 0.0,
            gradient=lambda: equations.g[equations.at, k],
            gradient_before=lambda: equations.h[equations.at, k],
            partial=lambda: equations.p[equations.at, k],
        )

    return [one(k) for k in range(OUTPUTS)]


def exact(equations, steps):
    """Derivatives (m, d) of all outputs: the equations of all increments as one dense system."""
    n = len(equations.K)
    whole = np.zeros((n * LEFT, n * LEFT))
    right = np.zeros((n * LEFT, SCALARS + FIELD))
    for i in range(n):
        here, kept = slice(i * LEFT, i * LEFT + SIZE), slice(i * LEFT + SIZE, (i + 1) * LEFT)
        whole[here, here], whole[kept, here], whole[kept, kept] = equations.K[i], -equations.A[i], np.eye(KEPT)
        if i:
            free = equations.C[i].copy()
            free[0] = 0
            before = slice((i - 1) * LEFT, i * LEFT)
            whole[here, before], whole[kept, before] = free, -equations.B[i]
        right[here], right[kept] = np.column_stack([equations.R[i].T, -equations.P[i].T]), equations.D[i]
    left = np.linalg.solve(whole, right).reshape(n, LEFT, -1)
    rows = []
    for i in steps:
        before = equations.h[i] @ left[i - 1] if i else 0.0
        rows.append(equations.g[i] @ left[i, :SIZE] + before + equations.p[i])
    return np.concatenate(rows)


def test_tangent_and_adjoint_of_a_solution():
    equations = Equations(1)
    model = SimpleNamespace(
        equations=equations,
        functionals=functionals(equations),
        rows=None,
    )
    found = SimpleNamespace(state=np.zeros(SIZE), residual=0.0, converged=True, stability=Stability.COUNTED)
    solution = FiniteElementSolution(model, np.zeros(SCALARS + FIELD), found, None, None)
    jacobian = exact(equations, [0])
    np.testing.assert_allclose(solution.tangent(np.eye(SCALARS + FIELD)).T, jacobian, rtol=1e-10)
    np.testing.assert_allclose(solution.adjoint(np.eye(OUTPUTS)), jacobian, rtol=1e-10)
    weights, direction = RNG.normal(size=OUTPUTS), RNG.normal(size=SCALARS + FIELD)
    assert solution.adjoint(weights) @ direction == pytest.approx(weights @ solution.tangent(direction))


def test_errors_of_the_mesh_are_what_richer_elements_add():
    equations = Equations(1)
    change, enriched_outputs = RNG.normal(size=SIZE), np.array([3.0, -2.0])
    richer = EnrichedState(change, change, 2.0, 8.0, 0.1, Work(), np.zeros(SIZE), change, np.zeros(SIZE))
    enriched = SimpleNamespace(
        state=lambda _: richer, values=lambda *_: enriched_outputs, down=lambda x: 2 * x, equations=None
    )
    outputs = [SimpleNamespace(value=lambda: 1.0), SimpleNamespace(value=lambda: 0.5)]
    model = SimpleNamespace(functionals=outputs, enriched=enriched, rows=None, equations=equations)
    found = SimpleNamespace(state=np.zeros(SIZE), residual=0.0, converged=True, stability=Stability.COUNTED)
    error = FiniteElementSolution(model, np.zeros(2), found, Work(), None).mesh_error()
    np.testing.assert_allclose(error.outputs, [2.0, -2.5])  # exact minus computed
    np.testing.assert_allclose(error.state, 2 * change)
    assert error.relative == 0.5  # √(2/8)
    assert error.nonlinearity == 0.1


@pytest.mark.parametrize("steps", [(3,), (1, 3)], ids=["one load", "a path"])
def test_tangent_and_adjoint_of_a_path_with_memory(steps):
    """Friction remembers where the body was: adjoints go back through the increments, with Cᵀ and its sign."""
    equations = Equations(4)
    passed, time = [], 0.0
    for i in range(4):
        time = float(steps.index(i) + 1) if i in steps else time + 0.25 * (1 if time % 1 < 0.7 else 0)
        passed.append(Passed(Increment(time, 1.0, np.zeros(0)), np.full(SIZE, float(i)), 0.0, Stability.COUNTED))
    assert [i for i, one in enumerate(passed) if one.at.returned] == list(steps)

    def set_increment(parameters, at, before, stiffer):
        equations.at = 0 if before is None else int(before.state[0]) + 1

    d = SCALARS + FIELD
    model = SimpleNamespace(
        equations=equations,
        values=np.zeros((len(steps), 0)),
        parameters=equations.parameters,
        functionals=functionals(equations),
        last=lambda passed: passed[-1] if passed else None,
        set_increment=set_increment,
        along=lambda directions: directions,
    )
    solution = HistorySolution(model, np.zeros(d), tuple(passed), None, 1.0)
    jacobian = exact(equations, steps)
    np.testing.assert_allclose(solution.tangent(np.eye(d)).T, jacobian, rtol=1e-9)
    np.testing.assert_allclose(solution.adjoint(np.eye(len(jacobian))), jacobian, rtol=1e-9)
