"""Quantiles from groups of models: no bias, intervals that hold, and closer than samples of the model alone."""

import numpy as np
import pytest
from scipy import stats

from uq.estimators.blue import subsets
from uq.estimators.fidelities import Samples
from uq.estimators.quantiles import below, quantiles, quantiles_of_groups

P = (0.05, 0.5, 0.95)
GROUPS = subsets(2)  # both, the model alone, the cheap one alone


def drawn(seed, counts):
    """A log-normal output and a cheap one that follows it, a little off and bent."""
    found = []
    for g, n in enumerate(counts):
        if not n:
            continue
        x = np.random.default_rng((seed, g)).standard_normal((n, 2))
        y = np.exp(0.5 * x[:, 0] + 0.03 * x[:, 1])
        values = np.stack([y, 0.3 + 1.05 * np.exp(0.48 * x[:, 0])], axis=1) - np.array([1.0, 1.35])
        inside = np.isin([0, 1], GROUPS[g])
        found.append(Samples(GROUPS[g], np.where(inside, values, 0.0)[:, :, None], np.zeros((n, 1))))
    return found


@pytest.mark.slow
def test_intervals_hold_and_are_closer_than_those_of_the_model_alone():
    exact = np.exp(np.hypot(0.5, 0.03) * stats.norm.ppf(P))
    held, errors, alone = [], [], []
    for seed in range(60):
        found = quantiles_of_groups(drawn(seed, (60, 0, 1500)), np.ones(1), P)
        held.append((found.lower[:, 0] <= exact) & (exact <= found.upper[:, 0]))
        errors.append(found.central[:, 0] - exact)
        plain = 1.0 + drawn(seed, (60, 0, 1500))[0].deviations[:, 0]
        alone.append(quantiles(plain, P).central[:, 0] - exact)
    assert (np.mean(held, axis=0) > 0.9).all(), np.mean(held, axis=0)
    rms, rms_alone = (np.sqrt(np.mean(np.square(one), axis=0)) for one in (errors, alone))
    assert (rms < rms_alone / [1.5, 2, 1.5]).all(), rms / rms_alone
    assert (np.abs(np.mean(errors, axis=0)) < 0.35 * rms).all()


@pytest.mark.unit
def test_shares_are_those_of_the_model_where_it_is_alone():
    one = Samples((0, 1), np.random.default_rng(0).standard_normal((50, 2, 1)), np.zeros((50, 1)))
    t = np.array([-1.0, 0.0, 0.7])
    share, error = below([one], 0, t)
    plain = (one.deviations[:, 0, 0, None] <= t).mean(axis=0)
    np.testing.assert_allclose(share, plain, atol=1e-12)
    np.testing.assert_allclose(error, np.sqrt(plain * (1 - plain) / 49 + 0.5 / 50**2), rtol=1e-9)


@pytest.mark.unit
def test_samples_apart_tell_weights_only():
    apart, *others = drawn(1, (40, 0, 0)) + drawn(2, (60, 0, 2000))
    t = np.array([0.0])
    share, _ = below(others, 0, t, apart)
    again, _ = below(others, 0, t, drawn(3, (500, 0, 0))[0])
    exact = stats.norm.cdf(0.0)
    assert abs(share[0] - exact) < 0.1
    assert abs(again[0] - share[0]) < 0.05
