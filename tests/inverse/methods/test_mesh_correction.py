"""Posteriors that are corrected for the error of a mesh: against closed forms of linear models and dense algebra."""

import numpy as np
import pytest
from scipy.stats import binom, multivariate_normal

from forward.fem.finer import WHOLE
from forward.model import SolveError
from forward.pointwise import FunctionModel
from inverse.criticism.finer import Finer, Look
from inverse.data.measurements import Measurements
from inverse.data.noise import ModelError, Noise, StudentErrors, Trend
from inverse.fields.field_posterior import FieldPosterior
from inverse.fields.low_rank import LowRankPosterior
from inverse.fields.newton_cg import find_mode
from inverse.low_dimensional.evidence import evidence
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.methods.mesh_correction import (
    OF_DATUM,
    OF_DIFFERENCE,
    OF_DIRECTION,
    OF_ERROR,
    along,
    along_curves,
    corrected_few,
    corrected_field,
    error_of,
    uncertain,
)
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import LogNormal, Normal
from uq.inputs.random_parameters import Inputs

pytestmark = pytest.mark.unit

RNG = np.random.default_rng(11)
M = 9
COARSE, FINE = RNG.standard_normal((2, M, 2))  # slopes on the mesh, and where meshes tend to
FINE = COARSE + 0.2 * FINE
SHIFT, BETWEEN = 0.8 * RNG.standard_normal((2, M))
SIGMA = 0.3 + 0.2 * RNG.uniform(size=M)
PRIOR_MEAN, PRIOR = np.array([1.0, 0.0]), np.diag([0.25, 4.0])
DATA = FINE @ [1.3, -0.8] + SHIFT + SIGMA * RNG.standard_normal(M)
INPUTS = Inputs({"a": Normal(mean=1.0, std=0.5), "b": Normal(mean=0.0, std=2.0)})
PLACES = Measurements.of(np.zeros(M), SIGMA, np.arange(M) % 2, [0] * M, places=RNG.uniform(size=(M, 3)))
APART = OF_DATUM * np.abs(BETWEEN)


def covariance_of(error, rows=slice(None)):
    """Covariance of what is uncertain of an error of the mesh, by its definition."""
    shapes = [np.ones(M), *(2 * (PLACES.places - PLACES.places.min(0)) / np.ptp(PLACES.places, axis=0) - 1).T]
    found = np.diag(APART**2)
    for pattern in (OF_DIFFERENCE * BETWEEN, OF_ERROR * error):
        for group in (0, 1):
            for shape in shapes:
                column = pattern * shape * (PLACES.cases == group)
                found = found + np.outer(column, column)
    return found[rows][:, rows]


def posterior(**kwargs):
    model = FunctionModel(lambda p: COARSE @ p, ("a", "b"), tuple("qrstuvwxy"), lambda p: COARSE)
    return Posterior(INPUTS, SerialEvaluate(model), DATA, Noise(SIGMA, **kwargs))


def finer(point, tangents):
    values = np.concatenate([FINE @ point + SHIFT, BETWEEN])
    return values, np.concatenate([FINE, np.zeros((M, 2))]) if tangents else None


def exact(gamma):
    """Mode, covariance and ln Z of the model that meshes tend to, with errors of a covariance."""
    precision = np.linalg.inv(PRIOR) + FINE.T @ np.linalg.solve(gamma, FINE)
    gap = DATA - SHIFT - FINE @ PRIOR_MEAN
    mode = PRIOR_MEAN + np.linalg.solve(precision, FINE.T @ np.linalg.solve(gamma, gap))
    log_evidence = multivariate_normal(FINE @ PRIOR_MEAN + SHIFT, gamma + FINE @ PRIOR @ FINE.T).logpdf(DATA)
    return mode, np.linalg.inv(precision), log_evidence


def test_corrected_posterior_and_evidence_are_exact():
    given = posterior()
    gaussian = laplace(given, starts=1)
    there, corrected, found = corrected_few(given, gaussian, Finer(finer), PLACES, "correct")
    plain = given.physical(gaussian.mode[None])[0]
    uncertainty = covariance_of((FINE - COARSE) @ plain + SHIFT)
    gamma = np.diag(SIGMA**2) + uncertainty
    mode, covariance, log_evidence = exact(gamma)
    slopes = INPUTS.from_normals(corrected.mode[None])[1][0]
    np.testing.assert_allclose(there.physical(corrected.mode[None])[0], mode, rtol=1e-8)
    np.testing.assert_allclose(slopes @ corrected.covariance @ slopes.T, covariance, rtol=1e-6)
    assert corrected.log_evidence == pytest.approx(log_evidence, rel=1e-9)
    assert evidence(there, corrected, 64).log_evidence == pytest.approx(log_evidence, rel=1e-6)
    assert found.corrected
    assert found.settled
    assert found.solves == 2
    np.testing.assert_allclose(found.shift, (mode - plain) / np.sqrt(np.diag(covariance)), rtol=1e-6)
    # What is uncertain of the correction: its share of the covariance of the estimate.
    gain = covariance @ FINE.T @ np.linalg.inv(gamma)
    left = np.sqrt(np.diag(gain @ uncertainty @ gain.T) / np.diag(covariance))
    np.testing.assert_allclose(found.left, left, rtol=1e-6)


def test_without_the_sign_it_would_be_found():
    """A correction that is subtracted is far from the posterior of the model that meshes tend to."""
    given = posterior()
    trend = Trend(np.zeros(2), np.zeros(M), COARSE, COARSE - FINE, np.zeros(M), INPUTS.std)
    wrong = ModelError(-SHIFT, uncertain(SHIFT, BETWEEN, PLACES), APART, trend)
    mode = posterior(model=wrong).physical(laplace(posterior(model=wrong), starts=1).mode[None])[0]
    right = exact(np.diag(SIGMA**2) + covariance_of(SHIFT))
    assert np.abs((mode - right[0]) / np.sqrt(np.diag(right[1]))).max() > 1
    assert given.noise.model is None


def test_what_is_small_is_left():
    given = posterior()
    gaussian = laplace(given, starts=1)

    def near(point, tangents):
        return np.concatenate([COARSE @ point + 1e-3 * SHIFT, BETWEEN]), np.concatenate([COARSE, np.zeros((M, 2))])

    there, same, found = corrected_few(given, gaussian, Finer(near), PLACES, "correct")
    assert there.noise.model is None
    assert same is gaussian
    assert not found.corrected
    assert found.settled
    np.testing.assert_allclose(found.error, 1e-3 * SHIFT / SIGMA, rtol=1e-9)


def test_what_correcting_adds_knows_errors_that_data_share():
    """ln Z of the linear model with the covariance σ² + SᵀS, with the error of the mesh and without."""
    shared = 2 * SIGMA * np.random.default_rng(5).normal(size=(2, M))
    given = posterior(shared=shared)
    gaussian = laplace(given, starts=1)
    _, _, found = corrected_few(given, gaussian, Finer(finer), PLACES, "report")
    error = (FINE - COARSE) @ given.physical(gaussian.mode[None])[0] + SHIFT
    law = multivariate_normal(np.zeros(M), np.diag(SIGMA**2) + shared.T @ shared + COARSE @ PRIOR @ COARSE.T)
    gap = DATA - COARSE @ PRIOR_MEAN
    assert found.log_evidence == pytest.approx(law.logpdf(gap - error) - law.logpdf(gap), rel=1e-9)


def test_failures_are_said():
    given = posterior()
    calls = []

    def fails(point, tangents):
        calls.append(point)
        if len(calls) > 1:
            message = "no equilibrium"
            raise SolveError(message)
        return finer(point, tangents)

    there, _, found = corrected_few(given, laplace(given, starts=1), Finer(fails), PLACES, "correct")
    assert there.noise.model is not None
    assert found.corrected
    assert not found.settled  # the mode that it was found at is not where it ended


def test_errors_of_unknown_size_and_subsets():
    """With a size that is all but known to be 1, the evidence is the one without; of some data it is theirs."""
    plain = posterior()
    gaussian = laplace(plain, starts=1)
    _, right, _ = corrected_few(plain, gaussian, Finer(finer), PLACES, "correct")
    given = posterior(factor=LogNormal(mean=1.0, std=1e-4))
    there, corrected, _ = corrected_few(given, laplace(given, starts=1), Finer(finer), PLACES, "correct")
    assert there.noise.model is not None
    assert corrected.log_evidence == pytest.approx(right.log_evidence, abs=1e-3)
    rows = np.array([0, 3, 4])
    some, mesh = there.noise.of(rows).model, there.noise.model
    whole = mesh.root.T @ mesh.root
    np.testing.assert_allclose(some.root.T @ some.root, whole[np.ix_(rows, rows)], atol=1e-14)
    at, outputs = np.ones((1, 2)), COARSE.sum(axis=1)[None]
    np.testing.assert_allclose(some.at(at, outputs[:, rows])[0], mesh.at(at, outputs)[0, rows])
    np.testing.assert_allclose(some.apart, APART[rows])


def test_whitening_is_the_root_of_the_inverse():
    mesh = ModelError(SHIFT, uncertain(SHIFT, BETWEEN, PLACES), APART)
    gamma = np.diag(SIGMA**2) + covariance_of(SHIFT)
    white = Noise(SIGMA, model=mesh)
    W = white.whitened(np.eye(M)) / white.scale
    np.testing.assert_allclose(W.T @ W, np.linalg.inv(gamma), rtol=1e-9, atol=1e-9)
    half_log_det = np.linalg.slogdet(gamma)[1] / 2
    assert white.log_determinant + np.log(white.scale).sum() == pytest.approx(half_log_det, rel=1e-9)
    heavy = Noise(SIGMA, StudentErrors().dof, model=mesh)
    np.testing.assert_allclose(heavy.scale**2, np.diag(gamma), rtol=1e-12)
    assert heavy.log_determinant == 0


def test_what_is_uncertain_is_of_each_load_case():
    """Parts of different groups are independent; patterns are those of the error and of what is between the meshes."""
    root = uncertain(SHIFT, BETWEEN, PLACES)
    covariance = root.T @ root
    np.testing.assert_allclose(covariance, covariance_of(SHIFT) - np.diag(APART**2), atol=1e-15)
    assert not covariance[np.ix_(PLACES.cases == 0, PLACES.cases == 1)].any()
    alone = uncertain(SHIFT, BETWEEN, Measurements.of(np.zeros(M), SIGMA, range(M), [0] * M))
    squares = (OF_DIFFERENCE * BETWEEN) ** 2 + (OF_ERROR * SHIFT) ** 2
    np.testing.assert_allclose(alone.T @ alone, np.diag(squares), atol=1e-15)
    assert len(uncertain(np.zeros(M), np.zeros(M), PLACES)) == 0


class Identity:
    variance = np.ones(6)

    def root(self, noise):
        return noise

    def root_transposed(self, g):
        return g


def covariance_along(A, sigma, between):
    """Covariance along the directions that the data determine, by its definition: singular vectors of Γ_n^(-1/2) A."""
    vectors = np.linalg.svd(A / sigma[:, None], full_matrices=False)[0] * sigma[:, None]
    return OF_DIRECTION**2 * (vectors * (vectors.T @ (between / sigma**2)) ** 2) @ vectors.T


def test_what_is_uncertain_along_directions_knows_errors_that_data_share():
    """It is the same whether data or combinations of them have independent errors."""
    A = RNG.standard_normal((M, 3))
    shared = SIGMA * RNG.standard_normal((2, M))
    gamma = np.diag(SIGMA**2) + shared.T @ shared
    white = Noise(SIGMA, shared=shared)
    images = (np.linalg.svd(white.whitened((A / SIGMA[:, None]).T).T, full_matrices=False)[0] * [3.0, 2.0, 1.0]).T
    rows = along(images, BETWEEN, white)
    root = np.linalg.cholesky(gamma)
    mixed = covariance_along(np.linalg.solve(root, A), np.ones(M), np.linalg.solve(root, BETWEEN))
    np.testing.assert_allclose(rows.T @ rows, root @ mixed @ root.T, atol=1e-12)


def test_a_field_against_dense_algebra():
    A, b = RNG.standard_normal((M, 6)), 0.5 * RNG.standard_normal(M)
    names = tuple(f"m{i}" for i in range(6))
    model = FunctionModel(lambda p: A @ p, names, tuple("qrstuvwxy"), lambda p: A)
    data = A @ RNG.standard_normal(6) + b + SIGMA * RNG.standard_normal(M)
    data[4] = np.nan
    seen = np.flatnonzero(np.isfinite(data))

    def solve(given, start):
        mode = find_mode(given, start, tolerance=1e-8)
        return type("Solved", (), {"mode": mode, "found": LowRankPosterior.at(mode.point, cutoff=1e-12)})()

    tends = Finer(lambda point, tangents: (np.concatenate([A @ point + b, BETWEEN]), None))
    weights = np.full(6, 1 / 6)
    given = FieldPosterior(model, data, Noise(SIGMA), Identity())
    here, moved, found = corrected_field(given, solve, tends, PLACES, "correct", weights)
    uncertainty = covariance_of(b, seen) + covariance_along(A[seen], SIGMA[seen], BETWEEN[seen])
    gamma = np.diag(SIGMA[seen] ** 2) + uncertainty
    precision = np.eye(6) + A[seen].T @ np.linalg.solve(gamma, A[seen])
    mode = np.linalg.solve(precision, A[seen].T @ np.linalg.solve(gamma, data[seen] - b[seen]))
    np.testing.assert_allclose(here.found.mean, mode, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(here.found.std, np.sqrt(np.diag(np.linalg.inv(precision))), rtol=1e-6)
    exactly = multivariate_normal(b[seen], gamma + A[seen] @ A[seen].T).logpdf(data[seen])
    assert here.found.log_evidence == pytest.approx(exactly, rel=1e-8)
    assert found.corrected
    assert found.settled
    gain = np.linalg.solve(precision, A[seen].T @ np.linalg.inv(gamma))
    left = np.sqrt(weights @ gain @ uncertainty @ gain.T @ weights)
    width = np.sqrt(weights @ np.linalg.inv(precision) @ weights)
    np.testing.assert_allclose(found.left, left / width, rtol=1e-6)
    plain = np.linalg.solve(
        np.eye(6) + A[seen].T @ (A[seen] / SIGMA[seen, None] ** 2), A[seen].T @ (data[seen] / SIGMA[seen] ** 2)
    )
    np.testing.assert_allclose(moved, mode - plain, rtol=1e-5, atol=1e-7)


# Forces (mN) of a ball of 3 mm at nine depths, 0.3 to 1.5 mm: by `benchmarks.axisymmetric`, and on cells along an edge
# of a quarter of a block of 12 mm, by how many times edges are graded (`benchmarks.indentation.quarter`).
BY_OTHERS = np.array([2.3248, 4.3533, 6.8042, 9.6483, 12.8477, 16.3561, 20.1850, 24.3183, 28.7076])
FORCES = {
    (3, 3): (2.9539, 5.8460, 8.8663, 11.6091, 14.2823, 16.8763, 20.7161, 24.6032, 28.5139),
    (5, 3): (2.5239, 4.3447, 6.7958, 9.7958, 12.9052, 16.4302, 20.3774, 24.5928, 29.2723),
    (6, 3): (2.3260, 4.4049, 6.8387, 9.7352, 13.0164, 16.7188, 20.6096, 24.7533, 29.0255),
    (3, 10): (2.6402, 4.4514, 6.8247, 9.9999, 13.3215, 16.8592, 20.5807, 24.7546, 29.6469),
    (5, 10): (2.3253, 4.4387, 7.0289, 9.9202, 12.8890, 16.2939, 20.1463, 24.3458, 28.8457),
    (6, 10): (2.3823, 4.4574, 6.7772, 9.6396, 12.8741, 16.4401, 20.2796, 24.5539, 29.1043),
    (4, 3): (3.0272, 4.9035, 6.9598, 9.5980, 12.7446, 16.5331, 20.5299, 24.6280, 28.9365),
    (8, 3): (2.3421, 4.3754, 6.9322, 9.7553, 12.7663, 16.3177, 20.1704, 24.2791, 28.7828),
    (4, 6): (2.3817, 4.3002, 6.9568, 9.7866, 12.8489, 16.6427, 20.4252, 24.7917, 29.4996),
    (6, 6): (2.3393, 4.4066, 6.9835, 9.8343, 12.7980, 16.2949, 20.1570, 24.3188, 28.7307),
    (8, 6): (2.3750, 4.3269, 6.8010, 9.6741, 12.8863, 16.4945, 20.2973, 24.2344, 28.6379),
}


@pytest.mark.parametrize("depths", [slice(None), slice(0, None, 2)])
@pytest.mark.parametrize("noise", [0.01, 0.03])
@pytest.mark.parametrize(("cells", "grading"), [(3, 3), (3, 10), (4, 3), (4, 6)])
def test_a_stiffness_from_forces_in_contact(cells, grading, noise, depths):
    """Errors of forces change their sign along a curve, and their mean is no smaller for that.

    A stiffness of 1, of which forces are nearly the power 0.8, lies within 2.5 deviations in 19 of 20 draws at least:
    of nine forces along a curve as of five.
    """
    own, middle, fine = (np.array(FORCES[n, grading])[depths] for n in (cells, -(-3 * cells // 2), 2 * cells))
    m = len(own)
    sigma = np.full(m, noise * np.sqrt((BY_OTHERS[depths] ** 2).mean()))
    data = Measurements.of(np.zeros(m), sigma, range(m), range(m), [f"force.{k}" for k in range(m)], some=True)
    look = Look(fine, WHOLE * (fine - middle), 0.8 * fine[:, None])
    known = Noise(sigma, model=error_of(look, own, data))
    A = known.whitened(0.8 * fine / known.scale)
    measured = BY_OTHERS[depths] + sigma * np.random.default_rng(1).standard_normal((400, m))
    held = np.abs(known.whitened((measured - fine) / known.scale) @ A) <= 2.5 * np.sqrt(A @ A)
    assert held.sum() >= binom.ppf(1e-3, len(held), 0.95)
    assert np.sqrt((0.8 * fine / sigma) @ (0.8 * fine / sigma) / (A @ A)) < (3 if noise == 0.03 else 6)


def test_what_is_uncertain_of_outputs_is_a_factor_of_their_curve():
    """Of the size of differences over the noise, for each output by itself; none of displacements, or of one case."""
    names = ["force.1", "area", "force.2", "area", "force.3", "x"]
    outputs, between, sigma = np.array([1.0, 5, 2, 7, 4, 9]), np.array([0.1, 0, -0.2, 0, 0.1, 3]), np.arange(1.0, 7)
    places = np.full((6, 3), np.nan)
    places[5] = 0
    data = Measurements.of(outputs, sigma, [0, 1, 2, 1, 3, 4], [0, 1, 2, 1, 3, 4], names, places=places)
    (force,) = along_curves(Look(outputs, between, None), data)
    mine = data.curves == data.curves[0]
    size = np.sqrt(((between / sigma)[mine] ** 2).sum() / ((outputs / sigma)[mine] ** 2).sum())
    np.testing.assert_allclose(force, OF_DIFFERENCE * size * outputs * mine)
    assert data.curves.tolist() == [1, 0, 1, 0, 1, -1]
