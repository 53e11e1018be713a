"""Solving with the factor of another matrix, against direct solves; rotations against singular values."""

import numpy as np
import pytest

from forward.solvers.anderson import AndersonMixing, block_galerkin
from forward.solvers.rotations import Turned, rotations

pytestmark = [pytest.mark.unit, pytest.mark.flags]

RNG = np.random.default_rng(3)
N = 40


def same(values):
    """The sum over one rank."""
    return values


def sizes(rows):
    return np.linalg.norm(rows, axis=1)


def matrices(spread):
    """A well-conditioned matrix without symmetry, and the inverse of one that resembles it."""
    A = np.eye(N) + 0.3 * RNG.standard_normal((N, N)) / np.sqrt(N)
    P = A + spread * RNG.standard_normal((N, N)) / np.sqrt(N)
    return A, np.linalg.inv(P)


def by(A):
    """The product with a matrix."""
    return lambda v: v @ A.T


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("spread", [0.1, 0.2, 0.3])
def test_block_galerkin_solves_to_its_tolerance(k, spread):
    for _ in range(4):
        A, inverse = matrices(spread)
        right = RNG.standard_normal((k, N)) * np.logspace(0, 6, k)[:, None]
        exact = np.linalg.solve(A, right.T).T
        for tolerance in (1e-4, 1e-9):
            x = block_galerkin(by(A), by(inverse), right, same, sizes, tolerance, 30)
            assert (sizes(x - exact) <= tolerance * sizes(exact)).all()


def test_block_galerkin_shares_what_it_learns_and_says_when_it_fails():
    A, inverse = matrices(0.2)
    products = []

    def multiply(v):
        products.append(len(v))
        return v @ A.T

    def iterations(right):
        products.clear()
        assert block_galerkin(multiply, lambda v: v @ inverse.T, right, same, sizes, 1e-10, 30) is not None
        return len(products)

    right = RNG.standard_normal((4, N))
    alone = iterations(right[:1])
    assert iterations(right) < alone
    # Dependent right-hand sides, and one that is zero.
    assert iterations(np.array([right[0], 2 * right[0], 0 * right[0]])) <= alone + 1
    assert block_galerkin(multiply, lambda v: v @ inverse.T, right, same, sizes, 1e-10, 2) is None
    assert block_galerkin(multiply, lambda v: np.nan * v, right, same, sizes, 1e-10, 9) is None
    assert block_galerkin(lambda v: np.nan * v, lambda v: v, right, same, sizes, 1e-10, 9) is None


def test_mixing_finds_the_fixed_point_that_plain_corrections_miss():
    A, _ = matrices(0.0)
    b = RNG.standard_normal(N)
    inverse = np.eye(N) * 2.5  # plain corrections with it grow
    mixing, u = AndersonMixing(N, N, same), np.zeros(N)
    plain = np.zeros(N)
    for _ in range(25):
        f = A @ u - b
        u = mixing.next(u, f, f @ inverse)
        plain = plain - (A @ plain - b) @ inverse
    assert np.linalg.norm(A @ u - b) < 1e-8 * np.linalg.norm(b)
    assert np.linalg.norm(A @ plain - b) > np.linalg.norm(b)


def test_mixing_keeps_no_more_than_its_window():
    A, inverse = matrices(0.3)
    b = RNG.standard_normal(N)
    counts = []
    for window in (1, 3, 12):
        mixing, u = AndersonMixing(window, N, same), np.zeros(N)
        count = 0
        while np.linalg.norm(A @ u - b) > 1e-10:
            f = A @ u - b
            u = mixing.next(u, f, inverse @ f)
            count += 1
        counts.append(count)
    assert counts[0] > counts[1] > counts[2]


def test_rotations_are_those_of_the_polar_decomposition():
    F = np.eye(3) + RNG.uniform(-0.6, 0.6, (200, 3, 3))
    F = F[np.linalg.det(F) > 0.05]
    U, _, V = np.linalg.svd(F)
    np.testing.assert_allclose(rotations(np.moveaxis(F, 0, 2)), np.moveaxis(U @ V, 0, 2), atol=1e-9)
    since = np.moveaxis(U, 0, 2)  # from rotations of an earlier state, in any order in memory
    np.testing.assert_allclose(
        rotations(np.moveaxis(F, 0, 2), since), np.moveaxis(U @ V @ U.transpose(0, 2, 1), 0, 2), atol=1e-9
    )


def test_space_that_is_turned_over_is_not_turned():
    F = np.stack([np.diag([1.0, 1.0, -1.0]), 1.3 * np.eye(3)], axis=2)
    np.testing.assert_allclose(rotations(F), np.stack([np.eye(3)] * 2, axis=2), atol=1e-12)


def test_a_turned_inverse_leaves_prescribed_and_further_unknowns_alone():
    U, _, V = np.linalg.svd(RNG.standard_normal((4, 3, 3)))
    R = np.moveaxis(U @ V, 0, 2)
    K = np.diag(RNG.uniform(1, 2, 14))
    fixed = np.array([0, 1, 2])
    block = np.eye(14)
    for n in range(1, 4):
        block[3 * n : 3 * n + 3, 3 * n : 3 * n + 3] = R[:, :, n]
    expected = block @ np.linalg.inv(K) @ block.T
    expected[fixed] = np.eye(14)[fixed]
    rows = RNG.standard_normal((2, 14))
    inverse = Turned(R, fixed).by(lambda x: x @ np.linalg.inv(K))
    np.testing.assert_allclose(inverse(rows), rows @ expected.T, atol=1e-14)
    np.testing.assert_allclose(inverse(rows[0]), expected @ rows[0], atol=1e-14)


def test_good_first_directions_save_an_iteration_and_bad_ones_do_no_harm():
    A, inverse = matrices(0.2)
    right = RNG.standard_normal((2, N))
    exact = np.linalg.solve(A, right.T).T
    solved = []

    def iterations(first):
        solved.clear()

        def precondition(r):
            solved.append(len(r))
            return r @ inverse.T

        x = block_galerkin(lambda v: v @ A.T, precondition, right, same, sizes, 1e-9, 30, first)
        assert (sizes(x - exact) <= 1e-9 * sizes(exact)).all()
        return len(solved)

    plain = iterations(None)
    assert iterations(right @ inverse.T) == plain - 1
    assert iterations(exact) == 1
    assert iterations(np.zeros((2, N))) == plain
    assert iterations(RNG.standard_normal((3, N))) <= plain + 1


def test_errors_of_a_symmetric_system_are_those_of_conjugate_gradients():
    """After j products with one right-hand side the error is the smallest in energy over a Krylov space."""
    B = 0.2 * RNG.standard_normal((N, N)) / np.sqrt(N)
    A, b = np.eye(N) + B + B.T, RNG.standard_normal(N)
    exact = np.linalg.solve(A, b)
    seen = []

    def multiply(v):
        seen.append(v[0] / np.linalg.norm(v))
        return v @ A

    assert block_galerkin(multiply, lambda v: v, b[None], same, sizes, 1e-6, 30) is not None
    for j in range(2, len(seen) + 1):
        V = np.array(seen[:j])
        krylov = np.linalg.qr(np.array([np.linalg.matrix_power(A, i) @ b for i in range(j)]).T)[0]
        best = krylov @ np.linalg.solve(krylov.T @ A @ krylov, krylov.T @ b)
        found = V.T @ np.linalg.solve(V @ A @ V.T, V @ b)
        assert np.linalg.norm(found - best) < 1e-3 * np.linalg.norm(best - exact)
