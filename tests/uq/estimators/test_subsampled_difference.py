"""Points chosen with probabilities: the numbers wanted, no bias, honest errors in tails, answers that are missing."""

from dataclasses import replace

import numpy as np
import pytest

from uq.estimators.subsampled_difference import Design, Pool, Pooled, choice, shares

MEAN, STD = np.exp(0.32), np.sqrt(np.exp(0.64) * (np.exp(0.64) - 1) + 0.25)
DESIGN = Design((1, 2), np.array([MEAN]), np.array([STD]), np.array([4 * STD**2]))


def models(t):
    """A peak with a log-normal tail, and what two models make of it that cut it off."""
    peak = np.exp(-0.8 * t[:, 0])
    return tuple(
        1 / (peak + cut) + 0.5 * t[:, 1] + bend * np.sin(4 * t[:, 1])
        for cut, bend in ((0, 0), (0.02, 0.02), (0.06, 0.04))
    )


def pools(seed, pilot=16, points=800, full=48, fails=None):
    """A pilot, and a pool of which some points are chosen."""
    random, found = np.random.default_rng(seed), []
    for count in (pilot, points):
        t = random.standard_normal((count, 2))
        own, *others = models(t)
        if fails is not None:
            own = np.where(fails(t), np.nan, own)
        cheap = np.column_stack(others)[:, :, None]
        if count == pilot:
            found.append(Pool(cheap, t, np.arange(pilot), own[:, None]))
            continue
        floor, intensity, places = choice(DESIGN, cheap, full, random.random())
        assert len(places) == full
        found.append(Pool(cheap, t, places, own[places, None], DESIGN, floor, intensity))
    return found


def test_so_many_are_chosen_with_probabilities_by_their_sizes():
    sizes = np.array([1.0, 2, 3, 4, 100, 50])
    found, intensity = shares(sizes, 4)
    assert found.sum() == pytest.approx(4)
    np.testing.assert_allclose(found, [0.2, 0.4, 0.6, 0.8, 1, 1])
    assert intensity == pytest.approx(0.2)
    assert shares(sizes, 6)[0].min() == 1
    cheap = np.random.default_rng(1).standard_normal((50, 2, 1))
    starts = (np.arange(2000) + 0.5) / 2000
    times = np.zeros(50)
    for start in starts:
        floor, intensity, places = choice(DESIGN, cheap, 10, start)
        assert len(places) == 10
        times[places] += 1
    expected = Pool(cheap, cheap[:, 0], places, cheap[:0, 0], DESIGN, floor, intensity).expected(cheap) / 50
    np.testing.assert_allclose(times / 2000, expected, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("known", [False, True])
def test_no_bias_and_honest_errors(known):
    rows = []
    for seed in range(150):
        e = Pooled(pools(seed), np.zeros((1, 2)), np.eye(2), known).estimated(np.zeros(1)).estimates
        rows.append([e.mean[0], e.mean_error[0], e.std[0], e.std_error[0]])
    mean, mean_error, std, std_error = np.array(rows).T
    errors = mean - MEAN
    assert abs(errors.mean()) < 3 * errors.std() / np.sqrt(len(errors))
    assert (np.abs(errors) < 1.96 * mean_error).mean() >= 0.9
    assert (np.abs(std - STD) < 1.96 * std_error).mean() >= 0.8  # without what tails beyond the pool add
    assert np.sqrt((mean_error**2).mean()) == pytest.approx(errors.std(), rel=0.25)
    # The pool is most of what is left: the chosen ones cost nothing of its accuracy.
    assert errors.std() < 1.6 * STD / np.sqrt(816)


def test_chosen_solves_tell_more_of_tails_than_even_ones():
    chosen, even = [], []
    for seed in range(60):
        pilot, pool = pools(seed)
        found = Pooled([pilot, pool], np.zeros((1, 2)), np.eye(2), known=False).estimated(np.zeros(1))
        chosen.append((found.rest[0] ** 2).sum())
        places = np.arange(len(pool.chosen))
        t = pool.coordinates[places]
        same = replace(pool, chosen=places, values=models(t)[0][:, None], floor=1e9, intensity=48 / 800 / 1e9)
        found = Pooled([pilot, same], np.zeros((1, 2)), np.eye(2), known=False).estimated(np.zeros(1))
        even.append((found.rest[0] ** 2).sum())
    assert np.mean(chosen) < 0.5 * np.mean(even)


def test_points_without_an_answer_count_as_the_others_do():
    """The estimate is that of the distribution without them: here the half with t_1 < 0, whose models are larger."""
    errors = []
    for seed in range(60):
        found = Pooled(pools(seed, full=200, fails=lambda t: t[:, 1] > 0), np.zeros((1, 2)), np.eye(2), known=False)
        errors.append(found.estimated(np.zeros(1)).estimates.mean[0] - (MEAN - 0.5 * np.sqrt(2 / np.pi)))
    assert abs(np.mean(errors)) < 4 * np.std(errors) / np.sqrt(60)
    assert np.std(errors) < 0.3
