"""Sums of products against dense solutions, singular values, and the rod of the literature."""

import subprocess
import sys

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from benchmarks.pgd import beam_mesh, elasticity, rod, tip
from docs.examples.separated import (
    Operator,
    Separated,
    alternating,
    cubic_stencil,
    from_snapshots,
    linear_stencil,
)

N, S, Z = 40, 25, 7
K = sp.diags([-np.ones(N - 1), 2.05 * np.ones(N), -np.ones(N - 1)], [-1, 0, 1]).tocsc()
F = np.exp(-((np.linspace(0, 1, N)[:, None] - np.linspace(0, 1, S)) ** 2) / 0.02)
W = np.full(S, 1 / S)
OMEGA = np.linspace(0.5, 2, Z)


def relative(found, exact):
    return np.linalg.norm(found - exact) / np.linalg.norm(exact)


def of_parameter():
    """Responses (N, S, Z) to the loads at all places for all values of a stiffness."""
    return np.array([spsolve((o * K + 0.1 * sp.eye(N)).tocsc(), F) for o in OMEGA]).transpose(1, 2, 0)


@pytest.mark.unit
def test_snapshots_are_separated_to_a_tolerance():
    exact = of_parameter()
    for tolerance in (1e-1, 1e-3, 1e-6):
        found = from_snapshots(exact, tolerance)
        assert relative(found.whole(), exact) <= tolerance
        assert len(found.fields) <= found.pairs
    few, many = (from_snapshots(exact, t).pairs for t in (1e-1, 1e-6))
    assert few < many
    u, v, w = (np.random.default_rng(i).normal(size=n) for i, n in enumerate((N, S, Z)))
    product = from_snapshots(np.einsum("u,v,w->uvw", u, v, w), 1e-9)
    assert product.pairs == 1
    # with one further coordinate it is the best there is
    flat = exact[:, :, 0]
    sigma = np.linalg.svd(flat)[1]
    one = from_snapshots(flat, 1e-12).first(3)
    left = np.linalg.norm(sigma[3:]) / np.linalg.norm(sigma)
    assert relative(one.whole(), flat) == pytest.approx(left, rel=1e-6)


@pytest.mark.unit
def test_weights_say_what_counts():
    exact, weights = of_parameter()[:, :, 0], np.where(np.arange(N) < 5, 1e6, 1.0)
    plain, weighted = (from_snapshots(exact, 1e-9, w).first(3).whole() for w in (None, weights))
    assert relative(weighted[:5], exact[:5]) < 0.3 * relative(plain[:5], exact[:5])


@pytest.mark.unit
def test_alternating_directions_find_the_solution_without_one():
    exact = spsolve(K, F)
    load = Separated(np.ascontiguousarray(F.T), np.arange(S), (np.eye(S),))
    found = alternating([Operator(K, (np.ones(S),))], load, [W], 1e-6)
    assert relative(found.whole(), exact) < 1e-5
    assert relative((K @ found.whole()), F) < 1e-4
    # pair by pair close to the best in the energy norm
    root = np.linalg.cholesky(K.toarray()).T
    sigma = np.linalg.svd(root @ exact)[1]
    for count in (1, 3, 6):
        best = np.linalg.norm(sigma[count:]) / np.linalg.norm(sigma)
        assert best * 0.999 <= relative(root @ found.first(count).whole(), root @ exact) <= 1.1 * best


def test_alternating_directions_with_a_stiffness_as_a_coordinate():
    load = Separated(np.ascontiguousarray(F.T), np.arange(S), (np.eye(S), np.ones((S, Z))))
    operators = [
        Operator(K, (np.ones(S), OMEGA)),
        Operator(sp.csc_matrix(0.1 * sp.eye(N)), (np.ones(S), np.ones(Z))),
    ]
    found = alternating(operators, load, [W, np.full(Z, 1 / Z)], 1e-4)
    assert relative(found.whole(), of_parameter()) < 3e-4


@pytest.mark.unit
def test_a_point_between_those_of_the_grids():
    exact = of_parameter()
    found = from_snapshots(exact, 1e-10)
    s = np.linspace(0, 1, S)
    at = found.at(linear_stencil(s, s[3]), linear_stencil(OMEGA, OMEGA[-1]))
    np.testing.assert_allclose(at, exact[:, 3, -1], atol=1e-8)
    middle = found.at(linear_stencil(s, (s[3] + s[4]) / 2), linear_stencil(OMEGA, OMEGA[2]))
    np.testing.assert_allclose(middle, exact[:, 3:5, 2].mean(axis=1), atol=1e-8)
    np.testing.assert_allclose(
        found.within(np.array([5, 1])).at(([3], [1.0]), ([2], [1.0])), exact[[5, 1], 3, 2], atol=1e-8
    )
    grid = np.array([0.0, 0.5, 1.2, 2.0, 3.0])
    for value in (-1.0, 0.1, 1.2, 2.9, 5.0):
        places, weights = cubic_stencil(grid, value)
        inside = np.clip(value, 0, 3)
        assert weights @ grid[places] ** 3 == pytest.approx(inside**3, abs=1e-12)
        places, weights = linear_stencil(grid, value)
        assert weights @ grid[places] == pytest.approx(inside)


def test_the_rod_of_the_literature():
    stretch = 1 + tip() / 400
    assert stretch**3 - stretch == pytest.approx(2 * 320 / 1600, rel=1e-12)  # E = 1 MPa, A = 1600 mm²
    errors = [rod(steps, cells=8)[0][-1, -1] / tip() - 1 for steps in (3, 6)]
    assert 0 < errors[1] < errors[0] / 3, "second order in the steps"
    assert errors[1] < 5e-3
    # pulled elsewhere: what is beyond moves along, unstretched
    u = rod(6, cells=8)[0]
    np.testing.assert_allclose(u[4:, 3], u[4, 3], rtol=1e-5)
    assert u[4, 3] == pytest.approx(u[8, 7] / 2, rel=1e-5)


@pytest.mark.unit
def test_the_beam_of_the_literature_stretches_as_elasticity_says():
    points, cells = beam_mesh((4, 2, 2))
    matrix = elasticity(points, cells, 1.0, 0.25)
    field = points * np.array([1e-3, -0.25e-3, -0.25e-3])  # uniaxial stress of 1e-3 E
    energy = field.ravel() @ matrix @ field.ravel()
    assert energy == pytest.approx(1e-6 * 400 * 40 * 40, rel=1e-9)
    assert np.abs(matrix @ np.tile([1.0, 0, 0], len(points))).max() < 1e-10
    turn = np.cross(points, [0.0, 0, 1]).ravel()
    assert np.abs(matrix @ turn).max() < 1e-9


def test_no_finite_elements_are_needed():
    code = "import sys, docs.examples.separated; print([m for m in sys.modules if m in ('dolfinx', 'ufl', 'mpi4py')])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
