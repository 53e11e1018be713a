"""Whether specimens are of one material or of two: against sums over all assignments, and where the truth is known."""

from itertools import combinations, product
from math import comb

import numpy as np
import pytest

from inverse.criticism.mixtures import DISAGREE, mixture

pytestmark = pytest.mark.unit


def by_assignments(log_evidence, weights):
    """Sum over all ways to share specimens among the materials of a pair, each count of the first as probable."""
    count, specimens = log_evidence.shape
    Z = np.exp(log_evidence)
    mixed = []
    for i, j in combinations(range(count), 2):
        ways = product((0, 1), repeat=specimens)
        mixed.append(
            sum(
                np.prod([Z[i, g] if first else Z[j, g] for g, first in enumerate(way)])
                / (comb(specimens, sum(way)) * (specimens + 1))
                for way in ways
            )
        )
    return np.log(np.mean(mixed) / (weights @ Z.prod(axis=1))), list(combinations(range(count), 2))[np.argmax(mixed)]


@pytest.mark.parametrize(("count", "specimens"), [(2, 2), (2, 7), (3, 5), (4, 6)])
def test_it_is_the_sum_over_all_assignments(count, specimens):
    rng = np.random.default_rng(specimens)
    weights = rng.dirichlet(np.ones(count))
    evidence = 2 * rng.standard_normal((count, specimens))
    found = mixture(evidence, weights)
    expected, pair = by_assignments(evidence, weights)
    assert found.log_bayes_factor == pytest.approx(expected, abs=1e-12)
    assert found.pair == pair
    far = mixture(evidence - 1e4, weights)  # of much data
    assert far.log_bayes_factor == pytest.approx(expected, abs=1e-8)


def of_normals(seconds, apart, rng, specimens=40):
    """ln Z of N(0, 1) and N(apart, 1) for specimens with one datum each, some of which are of the second."""
    y = rng.standard_normal(specimens)
    y[:seconds] += apart
    return np.array([-(y**2) / 2, -((y - apart) ** 2) / 2])


def test_mixtures_are_said_and_single_materials_are_not():
    rng, halves = np.random.default_rng(0), np.array([0.5, 0.5])
    for apart, seconds in ((3.0, 20), (4.0, 10), (5.0, 36)):
        found = [mixture(of_normals(seconds, apart, rng), halves) for _ in range(20)]
        assert all(one.log_bayes_factor > DISAGREE for one in found)
        assert np.mean([one.first[:seconds].mean() for one in found]) < 0.1
        assert np.mean([one.first[seconds:].mean() for one in found]) > 0.9
    for apart in (0.01, 0.1, 0.5, 1.0, 2.0, 5.0):
        alarms = sum(mixture(of_normals(0, apart, rng), halves).log_bayes_factor > DISAGREE for _ in range(200))
        assert alarms <= 200 * np.exp(-DISAGREE)
