"""What a finer mesh does to unknowns and evidence: against closed forms and quadrature, for models that are linear."""

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from forward.model import SolveError
from forward.pointwise import FunctionModel
from inverse.criticism.doubts import certain, meshes_not_alike, meshes_too_coarse
from inverse.criticism.finer import Finer
from inverse.data.measurements import Measurements
from inverse.data.noise import Noise
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.methods.mesh_correction import corrected_few
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import LogNormal, Normal
from uq.inputs.random_parameters import Inputs

RNG = np.random.default_rng(5)
B, OFFSET = RNG.standard_normal((7, 2)), RNG.standard_normal(7)
GAP = 0.4 * RNG.standard_normal(7)
SIGMA = 0.3 + 0.2 * RNG.uniform(size=7)
DATA = B @ [1.4, -0.3] + OFFSET + SIGMA * RNG.standard_normal(7)
INPUTS = Inputs({"a": Normal(mean=1.0, std=0.5), "b": Normal(mean=0.0, std=2.0)})
PRIOR = np.diag([0.25, 4.0])


def posterior(noise=None):
    model = FunctionModel(lambda p: B @ p + OFFSET, ("a", "b"), tuple("tuvwxyz"), lambda p: B)
    return Posterior(INPUTS, SerialEvaluate(model), DATA, Noise(SIGMA, factor=noise))


def solve(point, tangents):
    """On finer meshes, between which there is nothing."""
    return np.concatenate([B @ point + OFFSET + GAP, np.zeros(7)]), np.concatenate([B, np.zeros((7, 2))])


def reported(given, gaussian, finer):
    data = Measurements.of(DATA, SIGMA, [0] * 7, [0] * 7)
    return corrected_few(given, gaussian, finer, data, "report")[2]


def exact(gap, scale=1.0):
    spread = B @ PRIOR @ B.T + np.diag((scale * SIGMA) ** 2)
    return multivariate_normal(B @ [1.0, 0.0] + OFFSET + gap, spread).logpdf(DATA)


@pytest.mark.unit
def test_known_errors():
    """The exact change of ln Z and of the mode."""
    given = posterior()
    gaussian = laplace(given, starts=1)
    found = reported(given, gaussian, Finer(solve))
    assert found.log_evidence == pytest.approx(exact(GAP) - exact(0.0), rel=1e-9)
    assert abs(found.log_evidence) > 0.5
    precision = np.linalg.inv(PRIOR) + B.T @ (B / SIGMA[:, None] ** 2)
    deviations = np.sqrt(np.diag(np.linalg.inv(precision)))
    moves = -np.linalg.solve(precision, B.T @ (GAP / SIGMA**2)) / deviations
    np.testing.assert_allclose(found.shift, moves, rtol=1e-7)
    assert not found.corrected
    np.testing.assert_allclose(found.error, GAP / SIGMA, rtol=1e-12)


def test_errors_of_unknown_size():
    """By quadrature over the factor, of closed forms for each."""
    noise = LogNormal(mean=1.0, std=0.8)
    given = posterior(noise)
    gaussian = laplace(given, starts=1)
    found = reported(given, gaussian, Finer(solve))
    x = np.linspace(-6, 6, 601)
    logs = [[exact(gap, s) for s in noise.from_normal(x)[0]] for gap in (GAP, 0.0)]
    there, here = (logsumexp(np.array(each) - x**2 / 2) for each in logs)
    assert found.log_evidence == pytest.approx(there - here, rel=1e-6)
    factor = given.physical(gaussian.mode[None])[0, -1]
    np.testing.assert_allclose(found.error, GAP / (factor * SIGMA), rtol=1e-12)


@pytest.mark.unit
def test_what_is_not_known_is_said():
    given = posterior()

    def fails(point, tangents):
        message = "no equilibrium"
        raise SolveError(message)

    for finer, why in ((Finer(None, "no mesh"), "no mesh"), (Finer(fails), "the solve on a finer mesh failed: no eq")):
        found = reported(given, laplace(given, starts=1), finer)
        assert found.why.startswith(why)
        assert np.isnan(found.log_evidence)
        assert np.isnan(found.shift).all()


@pytest.mark.unit
def test_meshes_that_decide_are_an_error():
    values, near = {"soft": -10.0, "stiff": -14.0}, {"soft": 0.4, "stiff": 1.9}
    (note,) = meshes_too_coarse(values, {"soft": -0.3, "stiff": 0.9}, near)
    assert note.severity == "note"
    (doubt,) = meshes_too_coarse(values, {"soft": -3.0, "stiff": -4.0}, near)
    assert doubt.severity == "warning"
    assert "soft about -3, stiff about -4; soft stays the most probable" in doubt.text
    (doubt,) = meshes_too_coarse(values, {"soft": -3.0, "stiff": 2.0}, near)
    assert doubt.severity == "error"
    assert "stiff is the most probable, and not soft" in doubt.text
    (note,) = meshes_too_coarse(values, {"soft": np.nan, "stiff": 0.5}, near)
    assert note.severity == "note"
    assert not meshes_too_coarse(values, {"soft": np.nan, "stiff": np.nan}, near)


@pytest.mark.unit
def test_candidates_of_which_only_some_are_corrected_do_not_compare():
    assert not meshes_not_alike(["soft"], [])
    assert not meshes_not_alike([], ["stiff"])
    (doubt,) = meshes_not_alike(["soft"], ["stiff", "other"])
    assert doubt.severity == "warning"
    assert "The meshes of soft are corrected, and those of stiff, other could not be looked at" in doubt.text


@pytest.mark.unit
def test_beyond_two_deviations_only_that_it_is_large():
    """To first order an evidence may seem to stay where it moves by more than one."""
    values = {"soft": -10.0, "stiff": -14.0}
    (doubt,) = meshes_too_coarse(values, {"soft": -0.3, "stiff": -0.2}, {"soft": 0.4, "stiff": 3.1})
    assert doubt.severity == "warning"
    assert (
        "soft about -0.3, stiff a lot (-0.2 to first order, which does not hold where unknowns move by 3.1"
        in doubt.text
    )
    assert certain(np.array([0.5, 0.5, 1.5]), np.array([1.0, 3.0, 1.0])).tolist() == [True, False, False]
    assert not certain(np.nan, np.nan)
