"""The posterior density in standard normal coordinates: derivatives, mode, Laplace's Gaussian."""

import numpy as np
import pytest

from forward.model import SolveError
from forward.pointwise import FunctionModel
from inverse.data.noise import Noise
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Density, Posterior
from tests.rubber import CURVED, FACTOR, LINEAR, on_treloar
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import LogNormal, Normal, Uniform
from uq.inputs.random_parameters import Inputs


def ridge(noise=None):
    """Two outputs of three parameters, one pair of them correlated."""
    model = FunctionModel(
        lambda p: [p[0] * p[1], p[0] + p[2] ** 2],
        ("a", "b", "c"),
        ("u", "v"),
        lambda p: [[p[1], p[0], 0.0], [1.0, 0.0, 2 * p[2]]],
    )
    marginals = {
        "a": LogNormal(mean=1.0, std=0.4),
        "b": Uniform(lower=0.5, upper=2.0),
        "c": Normal(mean=1.0, std=0.3),
    }
    inputs = Inputs(marginals, (("a", "b", 0.4),))
    return Posterior(inputs, SerialEvaluate(model), np.array([1.2, 1.9]), Noise(np.array([0.1, 0.2]), factor=noise))


@pytest.mark.unit
@pytest.mark.parametrize("noise", [None, FACTOR], ids=["known", "inferred"])
def test_gradient(noise):
    """Taylor remainders fall by four when the step is halved."""
    posterior = ridge(noise)
    c = len(posterior.names)
    x = np.array([0.3, -0.4, 0.2, 0.5])[:c]
    here = posterior.at(x[None, :], derivatives=True)
    for direction in np.eye(c):
        steps = np.array([[1e-3], [5e-4]]) * direction
        change = -posterior.at(x + steps).log_posterior + here.log_posterior
        remainder = np.abs(change - steps @ here.gradient[0])
        assert remainder[0] / remainder[1] == pytest.approx(4, abs=0.1)


@pytest.mark.unit
def test_curvature_of_linear_models_is_exact():
    posterior = on_treloar("yeoh", LINEAR["yeoh"], FACTOR)
    x = np.array([[0.1, -0.2, 0.3, 0.4]])
    h = 1e-4
    moved = posterior.at(np.vstack([x + h * e for e in np.eye(4)] + [x - h * e for e in np.eye(4)]), derivatives=True)
    differences = (moved.gradient[:4] - moved.gradient[4:]) / (2 * h)
    found = posterior.at(x, derivatives=True)
    # The factor's own curvature leaves out the second derivative of ln s, which Gauss-Newton does not have.
    np.testing.assert_allclose(found.curvature[0][:3, :], differences[:3, :], rtol=1e-5, atol=1e-4)


def test_evidence_of_linear_models_is_laplace():
    """ln Z = −½ rᵀC⁻¹r − ½ ln det 2πC with C = Γ + A Aᵀ, by the small matrix H = I + AᵀΓ⁻¹A.

    The dense form loses digits with the condition of C; priors that are ten times wider lose ten times as many.
    """
    for kind, priors in LINEAR.items():
        posterior = on_treloar(kind, priors)
        here = posterior.at(np.zeros((1, len(priors))), derivatives=True)
        A = (here.tangents[0] * posterior.inputs.std) / posterior.noise.sigma[:, None]
        r = (posterior.data - here.outputs[0]) / posterior.noise.sigma
        H = np.eye(len(priors)) + A.T @ A
        constant = np.log(posterior.noise.sigma).sum() + r.size / 2 * np.log(2 * np.pi)
        rest = r - A @ np.linalg.solve(H, A.T @ r)
        exact = -(r @ rest) / 2 - np.linalg.slogdet(H)[1] / 2 - constant
        dense = np.eye(r.size) + A @ A.T
        also = -(r @ np.linalg.solve(dense, r)) / 2 - np.linalg.slogdet(dense)[1] / 2 - constant
        for differences in (True, False):
            found = laplace(posterior, exact=differences)
            assert found.converged
            assert found.log_evidence == pytest.approx(exact, abs=1e-9)
            assert found.log_evidence == pytest.approx(also, abs=1e-8)


def test_mode_is_stationary_from_every_start():
    for kind, priors in CURVED.items():
        found = laplace(on_treloar(kind, priors, FACTOR))
        assert found.converged
        assert found.ends.max() - np.median(found.ends) < 1e-6, kind
        posterior = on_treloar(kind, priors, FACTOR)
        gradient = posterior.at(found.mode[None, :], derivatives=True).gradient[0]
        step = np.linalg.solve(found.hessian, gradient)
        assert np.abs(step).max() < 1e-5


@pytest.mark.unit
def test_second_derivatives_by_differences():
    posterior = ridge()
    found = laplace(posterior)
    h = 1e-3
    c = len(found.mode)
    moves = np.vstack([h * np.eye(c), -h * np.eye(c)])
    gradients = posterior.at(found.mode + moves, derivatives=True).gradient
    np.testing.assert_allclose(found.hessian, (gradients[:c] - gradients[c:]) / (2 * h), rtol=2e-2, atol=0.1)


@pytest.mark.unit
def test_points_are_joined_in_an_order():
    posterior = ridge()
    x = np.random.default_rng(0).normal(size=(6, 3))
    whole = posterior.at(x, derivatives=True)
    parts = [posterior.at(x[:2], derivatives=True), posterior.at(x[2:], derivatives=True)]
    order = np.array([5, 1, 3, 0, 2, 4])
    joined = Density.joined(parts, order)
    np.testing.assert_array_equal(joined.x, x[order])
    np.testing.assert_array_equal(joined.gradient, whole.gradient[order])
    assert Density.joined([posterior.at(x[:2]), parts[1]]).tangents is None


@pytest.mark.unit
def test_where_there_is_no_answer():
    def refuse(p):
        raise SolveError("never")

    model = FunctionModel(refuse, ("a",), ("u",), lambda p: [[0.0]])
    inputs = Inputs({"a": Normal(mean=0.0, std=1.0)})
    posterior = Posterior(inputs, SerialEvaluate(model), np.zeros(1), Noise(np.ones(1)))
    assert posterior.at(np.zeros((1, 1))).log_likelihood[0] == -np.inf
    with pytest.raises(SolveError, match="no answer at any of the 4 starts"):
        laplace(posterior)


@pytest.mark.unit
def test_mistakes_are_named():
    posterior = ridge()
    for sigma, told in ((np.ones(3), "2 data with 3 standard deviations"), (np.array([1.0, 0.0]), "expected positive")):
        with pytest.raises(ValueError, match=told):
            Posterior(posterior.inputs, posterior.evaluate, posterior.data, Noise(sigma))
