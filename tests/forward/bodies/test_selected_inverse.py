"""The diagonal of an inverse against dense algebra."""

import numpy as np
import pytest
from scipy.sparse import csr_matrix, random

from forward.bodies.geometry import Box
from forward.bodies.random_fields import Matern
from forward.bodies.selected_inverse import SMALLEST, Dissection


def problem(n, density, seed=0):
    """Symmetric matrices with the same pattern, both positive definite, at random places."""
    rng = np.random.default_rng(seed)
    half = random(n, n, density, random_state=rng)
    pattern = (half + half.T).tocsr()
    A = (pattern + (2 + abs(pattern).sum(axis=1).max()) * csr_matrix(np.eye(n))).tocsr()
    M = A.copy()
    M.data = M.data * 0.3 + 0.01
    M = ((M + M.T) / 2).tocsr()
    return A, M, rng.uniform(size=(n, 3))


@pytest.mark.parametrize(("n", "density"), [(1, 1.0), (SMALLEST, 0.1), (150, 0.02), (400, 0.004), (300, 0.0)])
@pytest.mark.parametrize("order", [0, 1, 3])
def test_coefficients_are_those_of_dense_algebra(n, density, order):
    """Also of matrices that fall apart, whose separators are empty."""
    A, M, places = problem(n, density)
    found = Dissection(A, places).diagonal_of_inverse(A, M, order)
    inverse, dense = np.linalg.inv(A.toarray()), M.toarray()
    expected = np.diag(np.linalg.matrix_power(-inverse @ dense, order) @ inverse)
    np.testing.assert_allclose(found, expected, rtol=1e-11)


@pytest.mark.unit
def test_places_only_choose_the_order():
    A, M, places = problem(200, 0.02)
    one, other = (Dissection(A, p).diagonal_of_inverse(A, M, 1) for p in (places, np.zeros((200, 3))))
    np.testing.assert_allclose(one, other, rtol=1e-12)


def test_separators_of_a_lattice_are_layers():
    """So that work and memory are those of nested dissection."""
    n = 12
    places = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    near = np.abs(places[:, None] - places).max(axis=2) <= 1
    found = Dissection(csr_matrix(near.astype(float)), places.astype(float))
    assert sorted(np.concatenate([front.own for front in found._fronts])) == list(range(n**3))
    assert max(len(front.own) for front in found._fronts) <= 1.5 * n**2


@pytest.mark.unit
@pytest.mark.fem
@pytest.mark.parametrize("smoothness", [2, 4])
def test_fields_have_variance_one_at_every_vertex(smoothness):
    """By a solve for each vertex, which is what this saves."""
    matern = Matern.on(Box(size=(1.3, 0.4, 1.0), cells=(7, 3, 5), degree=1), 0.5, smoothness)
    np.testing.assert_allclose(np.diag(matern.covariance(np.eye(len(matern.mass)))), 1, rtol=1e-12)
