"""Populations: closed forms of normal specimens, coverage, and correlation matrices."""

import re

import numpy as np
import pytest

from inverse.low_dimensional.population import Fit, Hyperprior, Specimen, _log_kernels, _roots, fitted
from inverse.methods.population import LEAST, Columns, Population, Scale
from uq.findings import findings
from uq.inputs.distributions import Normal, Uniform
from uq.inputs.draws import Draws
from uq.inputs.random_parameters import Inputs


@pytest.mark.unit
def test_kernels_are_exact_for_normal_posteriors_under_normal_priors():
    """p/π_0 of N(1, 0.5) under N(0, 1) is the likelihood N(2 | z, 1); few draws of a density that has wide kernels."""
    from scipy.stats import norm

    u = norm.ppf((np.arange(200) + 0.5) / 200)
    z = (1 + np.sqrt(0.5) * u / u.std())[:, None]
    one = Specimen(z, np.full(200, 1 / 200), -(z[:, 0] ** 2) / 2, 20.0)
    assert one.width > 0.5
    means, variances = np.array([[1.0], [2.0], [2.5]]), np.array([[[0.2]], [[0.5]], [[0.1]]])
    found = np.log(np.exp(_log_kernels(one, means, variances)).sum(axis=1))
    exact = norm.logpdf(2, means[:, 0], np.sqrt(1 + variances[:, 0, 0]))
    np.testing.assert_allclose(found - found[0], exact - exact[0], atol=0.02)  # 0.17 with π_0 constant in a kernel


@pytest.mark.unit
def test_kernels_end_where_a_prior_does():
    """The likelihood N(1.9 | z, 0.25) under a uniform prior on [0, 2] against a sum over a grid; draws stay inside."""
    from scipy.stats import norm

    z = np.linspace(0, 2, 2001)
    likelihood = norm.pdf(z, 1.9, 0.5)
    u = (np.arange(200) + 0.5) / 200
    values = np.interp(u, np.cumsum(likelihood) / likelihood.sum(), z)[:, None]
    prior = Inputs({"a": Uniform(lower=0.0, upper=2.0)})
    one = Scale(False, np.ones(1)).specimen(Draws(("a",), values, np.full(200, 1 / 200), 200.0), prior)
    means, std = np.array([[1.5], [1.7], [1.9]]), 0.05
    found = np.log(np.exp(_log_kernels(one, means, np.full((3, 1, 1), std**2))).sum(axis=1))
    exact = np.log(norm.pdf(z, means, std) @ likelihood)
    np.testing.assert_allclose(found - found[1], exact - exact[1], atol=0.1)  # 0.3 with kernels beyond the ends
    draws, _ = Fit(means[2:3].repeat(500, 0), np.full((500, 1, 1), std**2), 500.0, (one,)).estimates(0, 0)
    assert draws.max() <= 2


def of_normal(y, sigma, prior, rng, count=400):
    """Draws of the posterior of a number that was measured once, under a normal prior."""
    variance = 1 / (1 / sigma**2 + 1 / prior.std**2)
    z = rng.standard_normal(count)
    mean = variance * (y / sigma**2 + prior.mean / prior.std**2)
    values = mean + np.sqrt(variance) * (z - z.mean()) / z.std()
    return Draws(("a",), values[:, None], np.full(count, 1 / count), float(count))


def closed_form(y, sigma, prior):
    """Mean and deviation of a population's mean, and of each specimen the mean, by a sum over a grid."""
    m, logs = np.linspace(-2, 12, 701)[:, None], np.linspace(np.log(1e-3), np.log(20), 400)[None, :]
    s = np.exp(logs)
    found = -(((m - prior.mean) / (2 * prior.std)) ** 2) / 2 + logs - 2 * np.log1p((s / prior.std) ** 2 / 3)
    for one in y:
        found = found - (one - m) ** 2 / (2 * (s**2 + sigma**2)) - np.log(s**2 + sigma**2) / 2
    w = np.exp(found - found.max())
    w /= w.sum()
    mean = float((w * m).sum())
    each = [float((w * (one * s**2 + m * sigma**2) / (s**2 + sigma**2)).sum()) for one in y]
    return mean, float(np.sqrt((w * (m - mean) ** 2).sum())), each


@pytest.mark.slow
def test_specimens_far_from_their_prior_are_drawn_again():
    """Their own draws do not reach where the population is; without them it errs by four standard deviations."""
    rng, sigma, prior = np.random.default_rng(1), 1.0, Normal(mean=0.0, std=1.0)
    y = 6 + np.hypot(0.5, sigma) * rng.standard_normal(8)
    names = [f"s{k}" for k in range(8)]
    first = {name: of_normal(one, sigma, prior, rng) for name, one in zip(names, y, strict=True)}
    mean, std, each = closed_form(y, sigma, prior)
    population = Population(source="batch", distribution="normal", draws=1000)

    def again(name, under):
        return of_normal(y[names.index(name)], sigma, under.marginals["a"], rng), ""

    once = population.run(first, Inputs({"a": prior}))
    assert float(once["location_mean"][0]) < mean - 2 * std
    assert any("their estimates, and what they say of the population, are rough" in one.text for one in findings(once))
    found = population.run(first, Inputs({"a": prior}), again)
    assert float(found["location_mean"][0]) == pytest.approx(mean, abs=0.4 * std)
    assert float(found["location_std"][0]) == pytest.approx(std, rel=0.2)
    np.testing.assert_allclose(found["specimen_mean"][:, 0], each, atol=0.4 * std)
    assert (found["specimen_redrawn"] >= 1).all()
    assert (found["specimen_effective"] >= LEAST).all()
    assert [one.severity for one in findings(found)] == ["note"]
    np.testing.assert_array_equal(found["own_mean"], once["own_mean"])  # by themselves they are what they were
    text = "; ".join(
        one.text for one in findings(population.run(first, Inputs({"a": prior}), lambda *_: (None, "no data")))
    )
    assert "They cannot be drawn again: no data." in text


def test_errors_that_specimens_share_widen_the_mean_and_are_told():
    """Twelve specimens of 10 with errors of 0.5, all of which one device makes up to twice 1 larger."""
    rng, prior = np.random.default_rng(5), Normal(mean=8.0, std=10.0)
    posteriors = {f"s{k}": of_normal(11.5 + 0.1 * rng.standard_normal(), 1.0, prior, rng, 50) for k in range(12)}
    population, inputs = Population(source="batch", distribution="normal", draws=400), Inputs({"a": prior})
    shared = {"data.scale": np.array([0.98])}
    found, alone = (population.run(posteriors, inputs, shared=one) for one in (shared, {}))
    wide, narrow = (np.ptp(one["typical_quantiles"].values[:, 0]) / 3.92 for one in (found, alone))
    assert narrow < 0.4
    assert wide == pytest.approx(np.hypot(0.98, narrow), rel=0.15)
    assert np.ptp(found["new_quantiles"].values[:, 0]) > 3
    assert found["shared_shift"].values[0, 0] == pytest.approx(0.98, rel=0.05)
    assert [one.code for one in findings(found)] == ["population-shared"]
    assert "one deviation of data.scale moves a by 0.98 of" in findings(found)[0].text
    own = population.model_copy(update={"own": ["data.scale"]}).run(posteriors, inputs, shared=shared)
    np.testing.assert_array_equal(own["typical_quantiles"], alone["typical_quantiles"])


@pytest.mark.unit
@pytest.mark.parametrize("logarithmic", [False, True])
def test_priors_of_specimens_that_are_drawn_again_cover_the_population(logarithmic):
    rng = np.random.default_rng(3)
    scale = Scale(logarithmic, np.array([1.0, -1.0 if logarithmic else 1.0]))
    new = rng.multivariate_normal([1.0, 2.0], [[0.04, 0.03], [0.03, 0.09]], 20_000)
    prior = scale.inputs(("a", "b"), new, Hyperprior(np.zeros(2), np.ones(2)))
    z = scale.to(prior.points(rng.random((20_000, 2))))
    np.testing.assert_allclose(z.mean(axis=0), [1, 2], atol=0.05 if not logarithmic else 0.2)
    np.testing.assert_allclose(z.std(axis=0), 1.5 * np.array([0.2, 0.3]), rtol=0.05 if not logarithmic else 0.4)
    assert np.corrcoef(z.T)[0, 1] == pytest.approx(0.45, abs=0.06)


@pytest.mark.slow
@pytest.mark.parametrize("width", [0.05, 0.4])  # of a population, over the errors of its specimens
def test_specimens_are_shrunken_as_the_closed_form_says(width):
    rng = np.random.default_rng(1)
    z = rng.standard_normal((4000, 1)) * 0.5 + 2
    z = 2 + 0.5 * (z - z.mean()) / z.std()
    one = Specimen(z, np.full(4000, 1 / 4000), np.zeros(4000), 4000.0)  # a flat prior
    fit = Fit(np.full((4000, 1), 1.5), np.full((4000, 1, 1), (0.5 * width) ** 2), 4000.0, (one,))
    draws, size = fit.estimates(0, 0)
    precision = 1 / 0.25 + 1 / (0.5 * width) ** 2
    assert draws.mean() == pytest.approx((2 / 0.25 + 1.5 / (0.5 * width) ** 2) / precision, abs=0.03)
    assert draws.std() == pytest.approx(precision**-0.5, rel=0.1)
    assert size < 4000


def test_the_mean_of_a_population_of_known_specimens_is_theirs():
    rng = np.random.default_rng(2)
    truth = rng.normal(1.0, 0.3, 40)
    specimens = []
    for one in truth:
        z = one + 1e-3 * rng.standard_normal((50, 1))
        specimens.append(Specimen(z, np.full(50, 0.02), np.zeros(50), 50.0))
    fit = fitted(specimens, Hyperprior(np.zeros(1), np.ones(1)), 1000, 0, steps=200)
    assert fit.mean.mean() == pytest.approx(truth.mean(), abs=0.01)
    assert fit.mean.std() == pytest.approx(truth.std() / np.sqrt(40), rel=0.15)
    assert fit.std.mean() == pytest.approx(truth.std(ddof=1), rel=0.1)


@pytest.mark.slow
def test_covariates_move_the_mean_as_a_regression_says():
    """Known specimens around a line in a grade: slope, its error, what is left, and a new specimen of a grade."""
    rng = np.random.default_rng(4)
    grade = np.repeat([1.0, 2.0, 3.0, 4.0], 10)
    truth = 1 + 0.5 * grade + rng.normal(0, 0.2, 40)
    specimens = []
    for one in truth:
        z = one + 1e-3 * rng.standard_normal((50, 1))
        specimens.append(Specimen(z, np.full(50, 0.02), np.zeros(50), 50.0))
    x = (grade - grade.mean())[:, None]
    fit = fitted(specimens, Hyperprior(np.zeros(1), np.full(1, 2.0)), 1000, 0, steps=300, covariates=x)
    line = np.polyfit(grade, truth, 1)
    left = float(np.std(truth - np.polyval(line, grade), ddof=2))
    assert fit.slopes.mean() == pytest.approx(line[0], abs=0.01)
    assert fit.slopes.std() == pytest.approx(left / np.linalg.norm(x), rel=0.2)
    assert fit.std.mean() == pytest.approx(left, rel=0.1)
    new = fit.predictive(0, np.array([5.0 - grade.mean()]))
    assert new.mean() == pytest.approx(np.polyval(line, 5.0), abs=0.05)
    without = fitted(specimens, Hyperprior(np.zeros(1), np.full(1, 2.0)), 1000, 0, steps=300)
    assert without.std.mean() > 2.5 * left  # the grade is then a part of how specimens vary


@pytest.mark.unit
def test_covariates_are_numbers_or_words():
    names = ["one", "two", "three", "four"]
    region = dict(zip(names, ("cortex", "thalamus", "cortex", "corona"), strict=True))
    found = Columns.of({"region": region}, names)
    assert found.names == ("region = cortex", "region = thalamus")
    assert (found.values + found.means).tolist() == [[1, 0], [0, 1], [1, 0], [0, 0]]
    assert (found.row({"region": "thalamus"}) + found.means).tolist() == [0, 1]
    assert found.row({}).tolist() == [0, 0]
    grade = Columns.of({"grade": {"one": 1.0, "two": 2.0, "three": 3.0, "four": 2.0}}, names)
    assert grade.row({"grade": 4.0}).tolist() == [2.0]
    for wrong, said in (
        ({"grade": {"one": 1.0, "tow": 2.0}}, "'tow' is not a specimen; did you mean 'two'?"),
        ({"grade": {"one": 1.0, "two": 2.0}}, "nothing is said of three, four"),
        ({"grade": dict.fromkeys(names, 1.0)}, "the same for all specimens"),
        ({"grade": region | {"one": 1.0}}, "numbers and words"),
        ({"a": region, "b": region}, "4 numbers to find for each parameter from 4 specimens"),
    ):
        with pytest.raises(ValueError, match=re.escape(said)):
            Columns.of(wrong, names)
    for new, said in (({"graed": 1.0}, "did you mean 'grade'?"), ({"grade": "high"}, "expected a number")):
        with pytest.raises(ValueError, match=re.escape(said)):
            grade.row(new)


@pytest.mark.slow
def test_intervals_hold_what_they_claim():
    """Some of the 200 populations of `python -m benchmarks population`."""
    from benchmarks.population import coverage

    found = coverage(range(12), steps=150, draws=400)
    assert found["specimens"].mean() == pytest.approx(0.95, abs=0.05)
    assert min(found["typical"].mean(), found["spread"].mean(), found["new specimen"].mean()) >= 0.8


@pytest.mark.parametrize("d", [2, 3])
def test_correlations_have_the_density_that_is_said(d):
    """Draws of y by their density are those of det R: for d = 2, p has the density 3/4 (1 − p²)."""
    y = np.random.default_rng(0).normal(0, 1.2, (200_000, d * (d - 1) // 2))
    roots, logs = _roots(y, d)
    matrices = roots @ np.swapaxes(roots, 1, 2)
    np.testing.assert_allclose(np.einsum("aii->ai", matrices), 1, atol=1e-12)
    weights = np.exp(logs + (y**2).sum(axis=1) / 2 / 1.44)
    weights /= weights.sum()
    second = np.einsum("a,aij->ij", weights, matrices**2)
    # Each correlation is beta(η + (d − 2)/2) on (−1, 1): variance 1/(2η + d − 1), η = 2.
    np.testing.assert_allclose(second[~np.eye(d, dtype=bool)], 1 / (3 + d), rtol=0.03)


@pytest.mark.unit
def test_densities_of_correlated_priors():
    from scipy.stats import multivariate_normal

    inputs = Inputs({"a": Normal(mean=1.0, std=2.0), "b": Normal(mean=0.0, std=0.5)}, (("a", "b", 0.6),))
    points = np.random.default_rng(0).standard_normal((5, 2))
    exact = multivariate_normal([1, 0], [[4, 0.6], [0.6, 0.25]]).logpdf(points)
    np.testing.assert_allclose(inputs.log_density(points), exact, rtol=1e-10)
    assert Inputs({"a": Uniform(lower=0.0, upper=2.0)}).log_density(np.array([[1.0], [3.0]])).tolist() == [
        pytest.approx(np.log(0.5)),
        -np.inf,
    ]


@pytest.mark.parametrize(("middle", "told"), [(5.0, False), (1.0, True)])
def test_a_population_at_the_end_of_a_prior_is_told(middle, told):
    """Twelve specimens of N(middle, 1), each known to 0.5 under a prior on [0, 10]: of N(1, 1) a sixth lies below."""
    from scipy.stats import truncnorm

    rng, u = np.random.default_rng(2), (np.arange(100) + 0.5) / 100
    y = middle + rng.standard_normal(12) + 0.5 * rng.standard_normal(12)
    values = [truncnorm.ppf(u, -2 * one, 2 * (10 - one), loc=one, scale=0.5)[:, None] for one in y]
    posteriors = {f"s{i}": Draws(("a",), one, np.full(100, 1 / 100), 100.0) for i, one in enumerate(values)}
    population = Population(source="batch", distribution="normal", draws=200)
    found = findings(population.run(posteriors, Inputs({"a": Uniform(lower=0.0, upper=10.0)})))
    assert [one.code for one in found] == ["population-beyond"] * told
    assert all(one.severity == "warning" and "beyond the ends of the prior of a (" in one.text for one in found)
