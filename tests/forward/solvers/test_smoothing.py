"""A few steps of a Krylov method."""

import numpy as np
import pytest

from forward.solvers.multigrid import minimised, smoothed

pytestmark = pytest.mark.unit
N = 60


def system(skew=0.0):
    rng = np.random.default_rng(1)
    Q, _ = np.linalg.qr(rng.standard_normal((N, N)))
    A = (Q * np.geomspace(1, 30, N)) @ Q.T
    B = rng.standard_normal((N, N))
    return A + skew * (B - B.T), rng.standard_normal(N)


@pytest.mark.parametrize("skew", [0.0, 0.01])
def test_the_energy_that_is_missing_is_what_was_said(skew):
    A, b = system(skew)
    exact = np.linalg.solve(A, b)
    for tolerance in (0.1, 1e-2, 1e-4):
        x, r, settled = smoothed(lambda y: A @ y, lambda y: y / np.diag(A), b, lambda y: y, tolerance, 50)
        assert settled
        np.testing.assert_allclose(r, b - A @ x, atol=1e-12)
        assert abs(1 - x @ b / (exact @ b)) < tolerance


def test_steps_end():
    A, b = system()
    _, _, settled = smoothed(lambda y: A @ y, lambda y: y, b, lambda y: y, 1e-12, 8)
    assert not settled
    x, r, settled = smoothed(lambda y: A @ y, lambda y: y, np.zeros(N), lambda y: y, 1e-2, 8)
    assert settled
    assert not x.any()
    assert not r.any()


def test_residuals_of_indefinite_systems_are_the_smallest():
    A, b = system()
    A[N // 2 :] *= -1  # as those of pressures
    weights = np.linspace(1, 3, N)
    x, r, small = minimised(lambda y: A @ y, lambda y: y / np.diag(A), b, weights, lambda y: y, 1e-3, N)
    assert small
    np.testing.assert_allclose(r, b - A @ x, atol=1e-12)
    assert np.linalg.norm(weights * r) <= 1e-3 * np.linalg.norm(weights * b)
    x, r, small = minimised(lambda y: A @ y, lambda y: y / np.diag(A), b, weights, lambda y: y, 1e-3, 4)
    assert not small
    columns = [b / np.diag(A)]
    for _ in range(3):
        columns.append((A @ columns[-1]) / np.diag(A))
    space = weights[:, None] * (A @ np.array(columns).T)
    best, *_ = np.linalg.lstsq(space, weights * b, rcond=None)
    assert np.linalg.norm(weights * r) == pytest.approx(np.linalg.norm(weights * b - space @ best), rel=1e-6)
    x, r, small = minimised(lambda y: A @ y, lambda y: y, np.zeros(N), weights, lambda y: y, 1e-3, 4)
    assert small
    assert not x.any()
