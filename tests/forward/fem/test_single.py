"""Factors of references in single precision: the same answers, and a factor in double precision where they are not."""

import numpy as np
import pytest
from mpi4py import MPI

from forward.fem.dolfinx import single
from forward.model import Guess, ReferenceSolution, Stability
from tests.bodies import cantilever, loaded_body

pytestmark = pytest.mark.fem


def single_cantilever(precision="single", **changes):
    return cantilever(**({"solver": {"precision": precision}} | changes))


SPECS = {
    "definite": single_cantilever(),
    "indefinite": single_cantilever(formulation="mixed"),
    "not symmetric": loaded_body("mooney-rivlin").model_copy(update={"solver": single_cantilever().solver}),
}
THERE = pytest.mark.skipif(single.library() is None, reason="MUMPS is not there in single precision")


def memory(solver):
    """Bytes of a factor in single precision with its working memory; 0 where there is none."""
    return 10**6 * solver._library.told(solver._factor, 22) if solver._factor else 0


def factorised(kind):
    """A solver at a state, and what it should invert as a dense matrix."""
    model = SPECS[kind].build(MPI.COMM_SELF, ())
    state = np.array(model.solve(np.empty(0)).state)
    equations = model.equations
    equations.set_state(state)
    solver = equations.new_factor()
    assert isinstance(solver, single.SingleSolver)
    assert memory(solver) == 0
    solver.factorise()
    K = equations.free_stiffness_times(np.eye(equations.size)).T
    K[equations.fixed] = 0
    K[equations.fixed, equations.fixed] = 1
    return solver, K, equations


@THERE
@pytest.mark.parametrize("kind", SPECS)
def test_rough_solutions_have_some_digits_and_tight_ones_all(kind):
    solver, K, equations = factorised(kind)
    assert solver.in_single
    rows = np.random.default_rng(0).standard_normal((3, equations.size))
    rows[:, equations.fixed] = 0
    rows[1] *= 1e60  # beyond what single precision can hold
    rows[2] = 0
    for transpose in (False, True):
        expected = np.linalg.solve(K.T if transpose else K, rows.T).T
        sizes = np.abs(expected).max(axis=1, keepdims=True) + (rows[:, :1] == 0)
        rough = (solver.solve(rows, transpose=transpose, tolerance=1e-2) - expected) / sizes
        tight = (solver.solve(rows, transpose=transpose) - expected) / sizes
        assert np.abs(tight).max() < 1e-9
        assert 1e-9 < np.abs(rough).max() < 1e-2
        one = solver.solve(rows[0], transpose=transpose)
        np.testing.assert_allclose(one, expected[0], rtol=0, atol=1e-9 * sizes[0, 0])
    negative = solver.negative_eigenvalues()
    if kind == "not symmetric":
        assert negative is None
    else:
        assert negative == (np.linalg.eigvalsh((K + K.T) / 2) < 0).sum()
    assert 0 < memory(solver) < 10**9 or equations.size < 200
    solver.release()
    assert memory(solver) == 0
    solver.factorise()
    np.testing.assert_allclose(solver.solve(rows[0]), np.linalg.solve(K, rows[0]), rtol=0, atol=1e-9 * sizes[0, 0])


@THERE
def test_negative_eigenvalues_are_counted_beyond_buckling():
    """A column under a dead load that is below and above the critical one, in its straight state."""
    column = {
        "body": {"size": (0.1, 0.01, 0.01), "cells": (6, 1, 1), "cell": "hexahedron"},
        "loads": ({"kind": "traction", "on": "x-max", "direction": (-1.0, 0.0, 0.0), "size": 1.0},),
        "solver": {"precision": "single", "accept_unstable": True},
    }
    model = single_cantilever(**column).build(MPI.COMM_SELF, ("loads.traction.size",))
    counted = []
    for load in (20.0, 120.0, 900.0):
        equations = model.equations
        equations.set_state(np.array(model.solve(np.array([load])).state))
        solver = equations.new_factor()
        solver.factorise()
        K = equations.free_stiffness_times(np.eye(equations.size)).T
        K[equations.fixed, equations.fixed] = 1
        assert solver.in_single
        counted.append(solver.negative_eigenvalues())
        assert counted[-1] == (np.linalg.eigvalsh((K + K.T) / 2) < 0).sum()
    assert counted[0] == 0
    assert counted[-1] > 0


def test_what_single_precision_cannot_tell_is_factorised_in_double():
    """A thread, of which a factor in single precision has negative eigenvalues."""
    thread = single_cantilever(body={"size": (1.0, 0.02, 0.02), "cells": (40, 1, 1), "cell": "hexahedron"})
    equations = thread.build(MPI.COMM_SELF, ()).equations
    equations.set_state(np.zeros(equations.size))
    solver = equations.new_factor()
    solver.factorise()
    assert not solver.in_single
    assert solver.negative_eigenvalues() == 0
    right = np.random.default_rng(0).standard_normal(equations.size)
    right[equations.fixed] = 0
    left = equations.free_stiffness_times(solver.solve(right)[None])[0]
    assert np.linalg.norm(left - right) < 1e-7 * np.linalg.norm(right)


PARAMETERS = ("material.C1", "loads.traction.size")
MEAN, POINTS = np.array([5e3, 60.0]), np.array([[4.5e3, 50.0], [5.5e3, 70.0], [5e3, 64.0], [4.2e3, 66.0]])


def solved(precision, **changes):
    """States, tangents and what was done at points that are predicted from the mean."""
    model = single_cantilever(precision, **changes).build(MPI.COMM_SELF, PARAMETERS)
    mean = model.solve(MEAN)
    state, slopes = np.array(mean.state), mean.state_tangent(np.eye(2))
    reference = ReferenceSolution(MEAN, state, 0.1 * MEAN)
    guesses = [Guess(state + (point - MEAN) @ slopes, reference) for point in POINTS]
    found = list(model.solve_many(POINTS, guesses))
    assert all(one.stability in {Stability.COUNTED, Stability.SCREENED} for one in found)
    return (
        np.array([one.state for one in found]),
        np.array([one.tangent(np.eye(2)) for one in found]),
        np.array([one.adjoint(np.ones(1)) for one in found]),
        [one.work.factorisations for one in found],
    )


@pytest.mark.parametrize("formulation", ["displacement", "mixed"])
def test_samples_are_the_same(formulation):
    single_, double = (solved(precision, formulation=formulation) for precision in ("single", "double"))
    for one, other in zip(single_[:3], double[:3], strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-7 * np.abs(other).max())
    assert single_[3] == double[3]


def test_without_the_library_all_is_in_double_precision(monkeypatch):
    monkeypatch.setattr(single, "library", lambda: None)
    for one, other in zip(solved("single"), solved("double"), strict=True):
        np.testing.assert_array_equal(one, other)


def test_where_it_cannot_be_compiled_there_is_no_library(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("CC", "false")
    assert single.library.__wrapped__() is None
    assert not [one for one in tmp_path.rglob("*") if one.is_file()]


def test_only_large_factors_are_in_single_precision_of_themselves():
    small = single_cantilever("auto")
    large = single_cantilever("auto", body={"size": (0.1, 0.1, 0.1), "cells": (12, 12, 12), "cell": "hexahedron"})
    assert (small.single, large.single) == (False, True)
    words = dict(large.described({}))["linear"]
    assert words.endswith("; that of the reference in single precision")
    assert "single" not in dict(small.described({}))["linear"]
