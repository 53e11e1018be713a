"""Conjugate gradients with two levels against dense algebra, factors and inertia."""

import numpy as np
import pytest
from mpi4py import MPI

from forward.hyperelastic import Hyperelastic
from forward.model import Guess, SolveError, Stability
from forward.solvers import multigrid
from forward.solvers.lanczos import negative_eigenvalues
from forward.solvers.multigrid import Levels
from forward.solvers.steps import finish
from tests.launch import on_kept_ranks

pytestmark = pytest.mark.fem
NAMES = ("material.D1", "loads.traction.size")
POINT = np.array([4e4, 40.0])


def block(linear, cell="tetrahedron", **changes):
    """A block that bends a little, with one boundary that is moved."""
    blocks = {
        "formulation": "displacement",
        "body": {"kind": "box", "size": (0.1, 0.03, 0.02), "cells": (4, 2, 2), "cell": cell},
        "material": {"kind": "neo-hookean", "C1": 5e3, "D1": 5e4},
        "clamp": ("x-min",),
        "displacements": ({"on": "z-min", "z": -0.001},),
        "loads": ({"kind": "traction", "on": "x-max", "direction": (0.0, -1.0, 0.0), "size": 60.0},),
        "outputs": ({"kind": "mean-displacement", "name": "tip", "on": "x-max", "component": "y"},),
        "solver": {"linear": linear},
    }
    return Hyperelastic.model_validate(blocks | changes)


def column(load, linear):
    """A slender column under a dead axial load, which buckles sideways at about 62.3 N/m²."""
    blocks = {
        "formulation": "displacement",
        "body": {"kind": "box", "size": (0.2, 0.02, 0.02), "cells": (8, 1, 1), "cell": "hexahedron"},
        "material": {"kind": "neo-hookean", "C1": 5e3, "D1": 5e4},
        "clamp": ("x-min",),
        "loads": ({"kind": "traction", "on": "x-max", "direction": (-1.0, 0.0, 0.0), "size": load},),
        "outputs": ({"kind": "mean-displacement", "name": "tip", "on": "x-max", "component": "x"},),
        "solver": {"linear": linear, "accept_unstable": True},
    }
    return Hyperelastic.model_validate(blocks)


@pytest.mark.parametrize("cell", ["tetrahedron", "hexahedron"])
def test_solutions_and_derivatives_are_those_with_factors(cell):
    """Also where a boundary is moved, whose reactions are not unknowns."""
    names = (*NAMES, "displacements.z-min.z")
    point = np.append(POINT, -5e-4)
    expected = block("factor", cell).build(MPI.COMM_SELF, names).solve(point)
    model = block("multigrid", cell).build(MPI.COMM_SELF, names)
    found = model.solve(point)
    assert found.stability == expected.stability == Stability.COUNTED
    atol = 1e-7 * np.abs(expected.state).max()
    np.testing.assert_allclose(found.state, expected.state, rtol=0, atol=atol)
    tangents, gradient = found.tangent(np.eye(3))[:, 0], found.adjoint(np.ones(1))
    np.testing.assert_allclose(tangents, expected.tangent(np.eye(3))[:, 0], rtol=1e-6)
    np.testing.assert_allclose(gradient, tangents, rtol=1e-7)


def test_a_prediction_is_corrected_by_steps_of_newton():
    model = block("multigrid").build(MPI.COMM_SELF, NAMES)
    first = model.solve(POINT)
    point = POINT * np.array([1.05, 0.95])
    guess = Guess(first.state + first.state_tangent(point - POINT), reference=None)
    found = model.solve(point, guess)
    exact = block("factor").build(MPI.COMM_SELF, NAMES).solve(point)
    assert found.converged
    assert found.work.factorisations < first.work.factorisations
    np.testing.assert_allclose(found.outputs, exact.outputs, rtol=1e-7)


@pytest.mark.parametrize("symmetric", [True, False])
def test_a_solver_agrees_with_dense_algebra(symmetric):
    changes = {} if symmetric else {"loads": ({"kind": "pressure", "on": "x-max", "size": 2e3},)}
    equations = block("multigrid", **changes).build(MPI.COMM_SELF, ()).equations
    random = np.random.default_rng(0)
    equations.set_state(1e-4 * random.standard_normal(equations.size) * equations.free_displacements)
    K = equations.free_stiffness_times(np.eye(equations.size)).T
    K[equations.fixed] = 0
    K[equations.fixed, equations.fixed] = 1
    equations.factorise(equations.state())
    rows = random.standard_normal((2, equations.size))
    for transpose in (False, True):
        expected = np.linalg.solve(K.T if transpose else K, rows.T).T
        found = equations.back_substitute(rows, transpose=transpose)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7 * np.abs(expected).max())
    negative = int((np.linalg.eigvalsh(K) < 0).sum())
    assert equations.inertia() == (negative if symmetric else None)


@pytest.mark.parametrize("load", [20.0, 55.0, 62.0, 63.0, 100.0, 500.0])
def test_stability_is_that_of_inertia(load):
    """Of the straight column, whose buckling is orthogonal to its path, from far below to far above the load."""
    counts = {}
    for linear in ("factor", "multigrid"):
        model = column(load, linear).build(MPI.COMM_SELF, ())
        state = model.solve(np.empty(0)).state
        counts[linear] = model.equations.negative_eigenvalues(state)
    assert (counts["factor"] > 0) == (counts["multigrid"] > 0)
    assert counts["multigrid"] <= counts["factor"]


def test_the_column_buckles_between_these_loads():
    """So that the loads above are on both sides."""
    model = column(63.0, "factor").build(MPI.COMM_SELF, ())
    assert model.equations.negative_eigenvalues(model.solve(np.empty(0)).state) > 0
    model = column(62.0, "factor").build(MPI.COMM_SELF, ())
    assert model.equations.negative_eigenvalues(model.solve(np.empty(0)).state) == 0


def levels(K, P, largest=None):
    D = np.diag(1 / np.diag(K))
    A = P.T @ K @ P
    bound = 1.1 * np.abs(np.linalg.eigvals(D @ K)).max() if largest is None else largest
    return Levels(
        lambda x: K @ x, lambda x: D @ x, lambda x: P @ np.linalg.solve(A, P.T @ x), lambda values: values, bound
    )


def chain(n=65, shift=0.0):
    """A chain of springs, from whose stiffness a multiple of the mass is taken, and interpolation from every other."""
    K = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1) - shift * np.eye(n)
    P = np.zeros((n, n // 2))
    for j in range(n // 2):
        P[2 * j : 2 * j + 3, j] = 0.5, 1, 0.5
    return K, P


@pytest.mark.parametrize("shift", [0.0, 0.0022, 0.0023, 0.00335, 0.02])
def test_the_cycle_is_positive_for_every_stiffness(shift):
    """The lowest eigenvalue of the chain is 0.00227; that of the coarse level becomes negative at about 0.0023."""
    K, P = chain(shift=shift)
    one = levels(K, P)
    M = np.array([one.cycle(e) for e in np.eye(len(K))])
    np.testing.assert_allclose(M, M.T, atol=1e-9 * np.abs(M).max())
    coarse = np.linalg.eigvalsh(P.T @ K @ P)[0] > 0
    assert (np.linalg.eigvalsh(M)[0] > 0) == coarse
    if coarse:
        start = np.random.default_rng(1).standard_normal(len(K))
        found = finish(negative_eigenvalues(one.multiply, start, lambda values: values, len(K)), one.cycle)
        assert found == (np.linalg.eigvalsh(K) < 0).sum()


def test_a_single_negative_eigenvalue_is_found_from_any_start():
    rng = np.random.default_rng(0)
    n = 300
    vectors, _ = np.linalg.qr(rng.standard_normal((n, n)))
    for lowest in (-1e-3, -0.3, -5.0):
        values = np.concatenate([[lowest], np.linspace(0.3, 1, n - 1)])
        K = (vectors * values) @ vectors.T
        for _ in range(5):
            start = rng.standard_normal(n)
            assert finish(negative_eigenvalues(lambda x, K=K: K @ x, start, lambda v: v, n), lambda x: x) == 1


def test_what_is_nearly_singular_is_not_called_stable():
    n = 400
    values = np.logspace(-9, 0, n)
    start = np.random.default_rng(0).standard_normal(n)
    assert finish(negative_eigenvalues(lambda x: values * x, start, lambda v: v, n), lambda x: x) is None


def test_a_preconditioner_that_is_not_positive_is_refused():
    with pytest.raises(SolveError, match="not positive"):
        finish(negative_eigenvalues(lambda x: x, np.ones(5), lambda v: v, 5), lambda x: -x)


def test_conjugate_gradients_report_a_direction_of_negative_energy():
    values = np.array([-1.0, 1, 2, 3])
    _, *found = multigrid.conjugate_gradients(lambda x: values * x, lambda x: x, np.ones(4), lambda v: v, 1e-8, 10)
    assert found == [False, False]  # neither converged nor definite
    x, *found = multigrid.conjugate_gradients(
        lambda x: abs(values) * x, lambda x: x, np.ones(4), lambda v: v, 1e-12, 10
    )
    assert found == [True, True]
    np.testing.assert_allclose(x, 1 / abs(values), rtol=1e-11)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"body": {"kind": "box", "size": (0.1, 0.03, 0.02), "cells": (2, 1, 1), "degree": 1}}, "degree 2"),
        ({"formulation": "mixed"}, "the form is mixed"),
        ({"solver": {"linear": "both", "kind": "newton"}}, "textbook"),
    ],
)
def test_bodies_for_which_there_is_none_are_refused(changes, words):
    with pytest.raises(ValueError, match=words):
        block("multigrid", **changes)


def test_the_choice_follows_sizes_only():
    def large(*cells, **changes):
        body = {"kind": "box", "size": (0.28, 0.0215, 0.087), "cells": cells, "cell": "tetrahedron"}
        return block("auto", body=body, displacements=(), **changes).linear

    assert large(20, 4, 4) == "factor"
    assert large(60, 10, 20) == "multigrid"
    assert large(60, 10, 20, formulation="mixed") == "factor"
    assert large(60, 10, 20, solver={"kind": "newton"}) == "factor"


def test_a_linear_solver_that_does_not_converge_ends_an_attempt(monkeypatch):
    """Not the search: smaller load steps follow, and the history says why."""
    monkeypatch.setattr("forward.fem.dolfinx.linear.ITERATIONS", 1)
    with pytest.raises(SolveError, match="stopped at 0 % of the load") as stopped:
        block("multigrid").build(MPI.COMM_SELF, NAMES).solve(POINT)
    assert "the linear solver did not converge" in str(stopped.value)
    assert len(stopped.value.history) > 3


def test_an_unstable_state_is_refused():
    """The straight state beyond buckling, as with inertia."""
    for linear in ("factor", "multigrid"):
        spec = column(80.0, linear)
        spec = spec.model_copy(update={"solver": spec.solver.model_copy(update={"accept_unstable": False})})
        with pytest.raises(SolveError, match="negative eigenvalue"):
            spec.build(MPI.COMM_SELF, ()).solve(np.empty(0))


SHARED = """
import numpy as np
from mpi4py import MPI
from tests.forward.solvers.test_multigrid import NAMES, POINT, block, column

found = []
for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
    model = block("multigrid", body={"kind": "box", "size": (0.1, 0.03, 0.02), "cells": (5, 2, 2)}).build(comm, NAMES)
    solution = model.solve(POINT)
    state = comm.bcast(model.space.gather(solution.state[None]))
    found.append((solution.outputs, state, solution.tangent(np.eye(2)), solution.adjoint(np.ones(1))))
for shared, alone in zip(*found):
    np.testing.assert_allclose(shared, alone, rtol=0, atol=1e-7 * np.abs(alone).max())
for load in (55.0, 70.0):
    model = column(load, "multigrid").build(MPI.COMM_WORLD, ())
    count = model.equations.negative_eigenvalues(model.solve(np.empty(0)).state)
    assert (count > 0) == (load > 60), (load, count)
"""


@pytest.mark.slow
@pytest.mark.mpi
def test_ranks_that_share_a_body_agree_with_one():
    done = on_kept_ranks(2, SHARED)
    assert done.returncode == 0, done.stderr
