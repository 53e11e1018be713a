"""Residual tests of posteriors, against closed forms."""

import numpy as np
import pytest
from scipy import stats

from forward.pointwise import FunctionModel
from inverse.criticism.verdict import (
    examine,
)
from inverse.data.neighbours import neighbours
from inverse.data.noise import Noise
from inverse.fields.field_posterior import FieldPosterior
from inverse.fields.low_rank import LowRankPosterior
from inverse.fields.newton_cg import find_mode
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior
from tests.problems import DATA, PLACES, G, Linear, N, examine_few, few
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Normal
from uq.inputs.random_parameters import Inputs


@pytest.mark.slow
def test_residuals_of_a_right_model_pass_as_often_as_they_should():
    """The moments of |r|² are exact, its probability is uniform, and so is that of neighbours."""
    squares, probabilities, agreements = [], [], []
    which = neighbours(np.column_stack([np.arange(DATA)] * 3).astype(float), np.zeros(DATA, dtype=np.int64))
    problem = Linear()
    for seed in range(60):
        rng = np.random.default_rng(1000 + seed)
        truth = problem.m_0 + problem.posterior.prior.root(rng.standard_normal(N))
        data = problem.G @ truth + problem.sigma * rng.standard_normal(DATA)
        posterior = FieldPosterior(
            problem.posterior.model, data, Noise(problem.sigma), problem.posterior.prior, problem.m_0
        )
        mode = find_mode(posterior, tolerance=1e-4).point
        if seed == 0:
            found = LowRankPosterior.at(mode, cutoff=1e-9)
            expected = (1 / (1 + problem.values[:DATA])).sum()
        test = examine(mode.residual, found.spectrum, which)
        assert test.degrees == pytest.approx(expected, rel=1e-6)
        assert test.degrees == pytest.approx(DATA - found.spectrum.determined, rel=1e-9)
        squares.append(test.square)
        probabilities.append(test.probability)
        agreements.append(test.agreement_probability)
    assert np.mean(squares) == pytest.approx(expected, abs=3 * np.std(squares) / np.sqrt(60))
    for values in (probabilities, agreements):
        assert stats.kstest(values, "uniform").pvalue > 0.01


def test_residuals_tell_a_wrong_model():
    where = neighbours(PLACES, np.zeros(30, dtype=np.int64))
    right = examine_few(few(), laplace(few()), where)
    assert right.probability > 0.01
    assert right.agreement_probability > 0.01
    assert right.degrees == pytest.approx(30 - np.trace(G @ np.linalg.solve(np.eye(3) * 0.25 + G.T @ G, G.T)))
    wrong = examine_few(few(wave=2.0), laplace(few(wave=2.0)), where)
    assert min(wrong.probability, wrong.agreement_probability) < 0.01
    scaled = few(wave=2.0, noise=Normal(mean=3.0, std=0.5))
    found = examine_few(scaled, laplace(scaled), where)
    # What was inferred of the noise explains the size of the residuals, not that neighbours agree.
    assert found.probability > 0.01
    assert found.agreement_probability < 0.02


@pytest.mark.unit
def test_few_data_of_many_parameters():
    model = FunctionModel(lambda p: [p.sum()], ("a", "b", "c"), ("y",), lambda p: [[1.0, 1.0, 1.0]])
    inputs = Inputs({name: Normal(mean=0.0, std=1.0) for name in "abc"})
    posterior = Posterior(inputs, SerialEvaluate(model), np.array([2.0]), Noise(np.array([1.0])))
    found = examine_few(posterior, laplace(posterior))
    assert found.degrees == pytest.approx(1 / 4)  # y ~ N(0, 1 + 3), and r = −y/4
    assert found.probability == pytest.approx(stats.chi2(1).sf(4 / 4), rel=1e-8)
    assert np.isnan(found.agreement_probability)


@pytest.mark.unit
def test_neighbours_are_of_the_same_group():
    places = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [0, 0, 0], [0.1, 0, 0], [0.1, 0, 0]])
    groups = np.array([0, 0, 0, 1, 1, 1])
    first, second = neighbours(places, groups)
    assert list(zip(first, second, strict=True)) == [(0, 1), (1, 2), (3, 4), (3, 5), (4, 5)]


def test_neighbours_depend_on_distances_only():
    """No third place is nearer to both: by all pairs of 60 places, turned and in another order, with repeated ones."""
    rng = np.random.default_rng(0)
    for dimension in (1, 2, 3):
        places = rng.uniform(size=(50, dimension))
        places = np.concatenate([places, places[:10]])
        far = np.linalg.norm(places[:, None] - places[None], axis=2)
        larger = np.maximum(far[:, None, :], far[None, :, :])  # of the distances from i and from j to k
        related = (larger >= far[:, :, None] * (1 - 1e-9)).all(axis=2)
        expected = {(i, j) for i, j in np.argwhere(related).tolist() if i < j}
        turn = np.linalg.qr(rng.standard_normal((dimension, dimension)))[0]
        order = rng.permutation(60)
        for moved, back in ((places, np.arange(60)), (places @ turn, np.arange(60)), (places[order], order)):
            first, second = neighbours(moved, np.zeros(60, dtype=np.int64))
            pairs = zip(back[first].tolist(), back[second].tolist(), strict=True)
            assert {(min(i, j), max(i, j)) for i, j in pairs} == expected


@pytest.mark.unit
def test_neighbours_on_a_grid_stand_along_its_axes():
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 7), np.linspace(0, 0.3, 4)), axis=-1).reshape(-1, 2)
    first, second = neighbours(grid, np.zeros(28, dtype=np.int64))
    differ = np.abs(grid[first] - grid[second]) > 1e-9
    assert (differ.sum(axis=1) == 1).all()
