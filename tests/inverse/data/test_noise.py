"""Student's errors are the likelihood wherever it counts: derivatives, mode, evidence and posterior by quadrature."""

import numpy as np
import pytest
from scipy import stats

from forward.pointwise import FunctionModel
from inverse.criticism.field_samples import weigh_field
from inverse.data.measurements import Measurements
from inverse.data.noise import Noise, NormalErrors, StudentErrors
from inverse.fields.field_posterior import FieldPosterior
from inverse.fields.low_rank import LowRankPosterior
from inverse.fields.newton_cg import find_mode
from inverse.low_dimensional.evidence import evidence
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.methods.infer import Problem
from inverse.methods.invert import Invert
from inverse.methods.invert_few import invert_few
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import LogNormal, Normal
from uq.inputs.random_parameters import Inputs

RNG = np.random.default_rng(4)
SLOPES = RNG.standard_normal(15)
VALUES = 1.5 * SLOPES + 0.2 * RNG.standard_normal(15)
VALUES[[3, 11]] += [3.0, -4.0]  # two that do not belong
SIGMA = np.full(15, 0.2)
PRIOR = Normal(mean=0.0, std=2.0)
MODEL = FunctionModel(lambda p: SLOPES * p[0], ("a",), tuple(map(str, range(15))), lambda p: SLOPES[:, None])
HEAVY = StudentErrors(degrees=3)
NOISE = LogNormal(mean=1.2, std=0.6)


def posterior(errors, noise=None):
    return Posterior(Inputs({"a": PRIOR}), SerialEvaluate(MODEL), VALUES, Noise(SIGMA, errors.dof, noise))


@pytest.mark.parametrize("errors", [NormalErrors(), HEAVY, StudentErrors(degrees=1)])
def test_densities_scores_and_normal_scores(errors):
    r, noise = np.linspace(-6, 6, 25), Noise(np.ones(25), errors.dof)
    density = stats.norm() if errors.kind == "normal" else stats.t(errors.degrees)
    np.testing.assert_allclose(noise.minus_log(r), -density.logpdf(r), rtol=1e-12)
    h = 1e-5
    np.testing.assert_allclose(noise.score(r), (noise.minus_log(r + h) - noise.minus_log(r - h)) / (2 * h), atol=1e-9)
    turned = [(r + k * h) * noise.score(r + k * h) for k in (-1, 1)]
    np.testing.assert_allclose(noise.turn(r), (turned[1] - turned[0]) / (2 * h), atol=1e-8)
    np.testing.assert_allclose(stats.norm.cdf(noise.normal_scores(r)), density.cdf(r), rtol=1e-9)
    assert np.isfinite(noise.normal_scores(np.array([1e6, -1e6]))).all()
    # Fisher's information is the mean of what stands for the second derivative.
    mean = density.expect(lambda x: float(noise.information(np.array(x))))
    assert mean == pytest.approx(density.expect(lambda x: float(noise.score(np.array(x))) ** 2), rel=1e-6)


@pytest.mark.unit
@pytest.mark.parametrize("noise", [None, NOISE])
def test_gradients_are_those_of_the_density(noise):
    here = posterior(HEAVY, noise)
    x = RNG.standard_normal((4, len(here.names)))
    found = here.at(x, derivatives=True)
    h = 1e-5
    for k in range(x.shape[1]):
        step = h * np.eye(x.shape[1])[k]
        slope = -(here.at(x + step).log_posterior - here.at(x - step).log_posterior) / (2 * h)
        np.testing.assert_allclose(found.gradient[:, k], slope, rtol=1e-6, atol=1e-6)


def quadrature(noise=None):
    """Evidence, mean and standard deviation of a, on a grid."""
    a = np.linspace(-3, 5, 4001)
    s, weight = np.ones(1), np.ones(1)
    if noise is not None:
        z = np.linspace(-6, 6, 61)
        s, weight = noise.from_normal(z)[0], stats.norm.pdf(z) * (z[1] - z[0])
    r = (a[:, None, None] * SLOPES - VALUES) / (SIGMA * s[:, None])
    log = (stats.t(HEAVY.degrees).logpdf(r) - np.log(SIGMA * s[:, None])).sum(axis=2)
    density = (np.exp(log) @ weight) * stats.norm(PRIOR.mean, PRIOR.std).pdf(a) * (a[1] - a[0])
    Z = density.sum()
    mean = density @ a / Z
    return np.log(Z), mean, np.sqrt(density @ (a - mean) ** 2 / Z), a[density.argmax()]


@pytest.mark.parametrize("noise", [None, NOISE])
def test_evidence_and_posterior_by_quadrature(noise):
    here = posterior(HEAVY, noise)
    gaussian = laplace(here, starts=3)
    assert gaussian.converged
    found = evidence(here, gaussian, 512)
    log_evidence, mean, std, mode = quadrature(noise)
    assert found.log_evidence == pytest.approx(log_evidence, abs=max(4 * found.error, 0.01))
    values = here.physical(found.density.x)[:, 0]
    assert found.weights @ values == pytest.approx(mean, abs=0.15 * std)
    assert np.sqrt(found.weights @ (values - mean) ** 2) == pytest.approx(std, rel=0.1)
    if noise is None:
        assert here.physical(gaussian.mode[None])[0, 0] == pytest.approx(mode, abs=2e-3)
        h = 1e-3
        up, middle, down = here.at(gaussian.mode + h * np.array([[1.0], [0.0], [-1.0]])).log_posterior
        assert gaussian.hessian[0, 0] == pytest.approx(-(up - 2 * middle + down) / h**2, rel=2e-3)


def test_what_does_not_belong_does_not_decide():
    data = Measurements.of(VALUES, SIGMA, [0] * 15, [0] * 15, places=RNG.uniform(size=(15, 3)))
    method = Invert(samples=128, starts=2)
    plain, heavy = (
        invert_few(
            Inputs({"a": PRIOR}), SerialEvaluate(MODEL), Problem(data, method, errors), lambda p: p[:, :1]
        ).dataset
        for errors in (NormalErrors(), HEAVY)
    )
    _, mean, std, _ = quadrature()
    assert heavy["mean"][0] == pytest.approx(mean, abs=0.2 * std)
    assert heavy["lower"][0] < 1.5 < heavy["upper"][0]
    assert not plain["lower"][0] < 1.5 < plain["upper"][0]
    r = (heavy["draw"][0] * SLOPES - VALUES) / SIGMA
    np.testing.assert_allclose(heavy["draw_log_likelihood"][0], stats.t(3).logpdf(r) - np.log(SIGMA))
    assert heavy["residual_probability"] > 1e-4
    assert plain["residual_probability"] < 1e-40


class Line:
    """N(0, std²) of one value."""

    variance = np.array([PRIOR.std**2])

    def root(self, noise):
        return PRIOR.std * noise

    def root_transposed(self, g):
        return PRIOR.std * g


def test_fields_have_the_same_errors():
    """A field of one value is the parameter above: mode, weights and evidence by quadrature."""
    data = np.append(VALUES, np.nan)  # one that was not measured
    slopes = np.append(SLOPES, 1.0)
    model = FunctionModel(lambda p: slopes * p[0], ("a",), tuple(map(str, range(16))), lambda p: slopes[:, None])
    field = FieldPosterior(model, data, Noise(np.full(16, 0.2), HEAVY.dof), Line())
    x = np.array([0.3])
    h = 1e-6
    slope = (field.at(x + h).cost - field.at(x - h).cost) / (2 * h)
    assert field.at(x).gradient[0] == pytest.approx(slope, rel=1e-6)
    mode = find_mode(field, tolerance=1e-6)
    assert mode.converged
    log_evidence, mean, std, best = quadrature()
    assert mode.point.values[0] == pytest.approx(best, abs=2e-3)
    found = LowRankPosterior.at(mode.point)
    assert found.log_evidence == pytest.approx(log_evidence, abs=0.3)
    weighed = weigh_field(mode.point, found, 4096)
    assert weighed.log_evidence == pytest.approx(log_evidence, abs=max(4 * weighed.error, 0.01))
    assert weighed.mean[0] == pytest.approx(mean, abs=0.1 * std)
    assert weighed.std[0] == pytest.approx(std, rel=0.05)
