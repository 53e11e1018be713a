"""Simulation-based calibration: of posteriors that are exact, of a Gaussian that is not, and of its correction."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from benchmarks.simulated import calibrate, rank_by_laplace, rank_by_weights
from forward.model import SolveError
from forward.pointwise import FunctionModel
from inverse.data.noise import Noise
from inverse.low_dimensional.evidence import evidence
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior
from tests.problems import few
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import LogNormal, Normal
from uq.inputs.random_parameters import Inputs


def bent():
    """One parameter of which an exponential is measured, with much noise: the posterior is skew."""

    model = FunctionModel(lambda p: [np.exp(1.5 * p[0])], ("a",), ("y",), lambda p: [[1.5 * np.exp(1.5 * p[0])]])
    inputs = Inputs({"a": Normal(mean=0.0, std=1.0)})
    return Posterior(inputs, SerialEvaluate(model), np.zeros(1), Noise(np.array([0.7])))


def test_exact_posteriors_have_uniform_ranks():
    found = calibrate(few(), 30, samples=32, starts=1)
    assert found.failures == {}
    for kind in ("laplace", "corrected"):
        assert found.probability(kind) > 0.01
        assert found.probabilities(kind).shape == (3,)
        assert (found.counts(kind).sum(axis=1) == 30).all()
        np.testing.assert_allclose(found.coverage(kind, 0.8), 0.8, atol=3 * 0.073)
    dataset = found.dataset(10)
    assert dataset["count"].dims == ("posterior", "parameter", "bin")
    np.testing.assert_array_equal(dataset["count"].sel(posterior="laplace"), found.counts("laplace", 10))
    np.testing.assert_allclose(found.probabilities("laplace")[0], stats.kstest(found.laplace[:, 0], "uniform").pvalue)


def test_a_wrong_noise_is_seen():
    honest = few()

    class Optimist(Posterior):
        """Believes that errors are a third of what they are."""

        def at(self, x, *, derivatives=False):
            noise = Noise(self.noise.sigma / 3)
            return replace(honest, data=self.data, noise=noise).at(x, derivatives=derivatives)

    found = calibrate(Optimist(honest.inputs, honest.evaluate, honest.data, honest.noise), 15, samples=32, starts=1)
    assert found.probability("laplace") < 1e-2


@pytest.mark.slow
def test_what_laplace_gets_wrong_is_repaired():
    found = calibrate(bent(), 300, samples=128, starts=1)
    assert found.probability("laplace") < 1e-3
    assert found.probability("corrected") > 0.05
    assert found.trusted.mean() > 0.8


@pytest.mark.slow
def test_noise_of_unknown_size():
    posterior = replace(few(), noise=LogNormal(mean=1.0, std=0.3))
    found = calibrate(posterior, 40, samples=32, starts=1)
    assert found.names == ("a", "b", "c", "noise")
    assert found.truths.shape == (40, 4)
    assert (found.truths[:, 3] > 0).all()
    assert found.probability("corrected") > 0.01


def test_specimens_without_a_posterior_are_counted():
    posterior = few()

    def ends(p):
        if p[0] > 1:
            raise SolveError("too far")
        return posterior.evaluate.model.function(p)

    model = replace(posterior.evaluate.model, function=ends)
    found = calibrate(replace(posterior, evaluate=SerialEvaluate(model)), 20, samples=32, starts=1)
    lost = found.truths[:, 0] > 1
    assert 0 < lost.sum() < 15
    assert set(found.failures) == set(np.flatnonzero(lost))
    assert len(found.found("corrected")) == 20 - lost.sum()
    assert np.isnan(found.laplace[lost]).all()


def test_ranks_are_the_probabilities_of_what_lies_below():
    """Against the exact distribution of a skew posterior."""
    posterior = replace(bent(), data=np.array([1.0]))
    x = np.linspace(-8, 8, 20001)
    density = np.exp(-(((np.exp(1.5 * x) - 1) / 0.7) ** 2) / 2 - x**2 / 2)
    at = np.array([-0.2])
    expected = density[x < at].sum() / density.sum()
    gaussian = laplace(posterior)
    found = evidence(posterior, gaussian, 512)
    ranks = [rank_by_weights(found, at, np.array([tie]))[0] for tie in (0.0, 1.0)]
    assert np.mean(ranks) == pytest.approx(expected, abs=0.02)
    assert ranks[1] - ranks[0] == pytest.approx(1 / (found.ess + 1))
    normal = stats.norm(gaussian.mode[0], np.sqrt(gaussian.covariance[0, 0]))
    assert rank_by_laplace(gaussian, at)[0] == pytest.approx(normal.cdf(at[0]))
    assert abs(normal.cdf(at[0]) - expected) > 0.05


def test_the_same_seed_gives_the_same_ranks():
    one, other = (calibrate(few(), 3, samples=32, seed=4) for _ in range(2))
    np.testing.assert_array_equal(one.corrected, other.corrected)
    assert not np.array_equal(one.corrected, calibrate(few(), 3, samples=32, seed=5).corrected)


@pytest.mark.slow
def test_ranks_of_an_inclusion():
    """What `python -m benchmarks calibration` measures, with fewer specimens."""
    from benchmarks.calibration import problem

    found = calibrate(problem(3), 40, samples=64, starts=1)
    assert found.failures == {}
    assert found.probability("corrected") > 0.01
