"""Weights of stacking: against ArviZ, a grid and the condition of a maximum; their errors against repeats."""

import numpy as np
import pytest
import xarray as xr

from inverse.criticism.mixtures import best_mixture, stacking


def scores(seed, models, data, spread):
    rng = np.random.default_rng(seed)
    return rng.standard_normal((models, data)) * spread + 0.3 * rng.standard_normal((models, 1)) - 20


@pytest.mark.unit
@pytest.mark.parametrize("seed", range(20))
def test_no_weights_predict_better(seed):
    """The gradient at a maximum: 1 where a weight is positive, at most 1 elsewhere."""
    found = scores(seed, 1 + seed % 6, 5 + 13 * seed, (0.1, 1.0, 5.0)[seed % 3])
    shares = np.random.default_rng(seed).dirichlet(np.ones(found.shape[1]))
    w = best_mixture(found, shares)
    p = np.exp(found - found.max(axis=0))
    gradient = p @ (shares / (w @ p))
    assert w.min() >= 0
    assert w.sum() == pytest.approx(1)
    assert gradient.max() <= 1 + 1e-5
    np.testing.assert_allclose(gradient[w > 1e-3], 1, atol=1e-4)


@pytest.mark.unit
def test_two_models_by_a_grid():
    found = scores(3, 2, 40, 1.0)
    grid = np.linspace(0, 1, 100_001)
    p = np.exp(found)
    best = grid[np.log(grid[:, None] * p[0] + (1 - grid[:, None]) * p[1]).mean(axis=1).argmax()]
    assert best_mixture(found, np.full(40, 1 / 40))[0] == pytest.approx(best, abs=2e-5)


def test_arviz_finds_the_same():
    """From scores that are given to it as if of one draw."""
    import arviz as az

    found = scores(5, 3, 60, 1.0)
    told = {}
    for k, row in enumerate(found):
        elpd = az.ELPDData(
            data=[
                row.sum(),
                1.0,
                0.0,
                4,
                row.size,
                False,
                xr.DataArray(row),
                xr.DataArray(np.zeros(row.size)),
                "log",
                0.7,
            ],
            index=[
                "elpd_loo",
                "se",
                "p_loo",
                "n_samples",
                "n_data_points",
                "warning",
                "loo_i",
                "pareto_k",
                "scale",
                "good_k",
            ],
        )
        told[str(k)] = elpd
    weights = az.compare(told, method="stacking")["weight"].sort_index().to_numpy()
    np.testing.assert_allclose(stacking(found)[0], weights, atol=2e-3)


def test_errors_are_those_of_other_data():
    rng = np.random.default_rng(0)
    repeats = [best_mixture(rng.standard_normal((2, 80)), np.full(80, 1 / 80))[0] for _ in range(200)]
    stated = np.mean([stacking(rng.standard_normal((2, 80)), seed)[1][0] for seed in range(10)])
    assert 0.7 * np.std(repeats) < stated < 1.4 * np.std(repeats)
