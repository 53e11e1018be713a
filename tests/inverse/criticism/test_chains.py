"""Chains and weights: exact moments of linear models, curved posteriors against weighted points, what they say."""

from dataclasses import replace

import numpy as np
import pytest

from forward.model import SolveError
from forward.pointwise import FunctionModel
from inverse.criticism import assessment
from inverse.criticism.assessment import assess, only_needed
from inverse.criticism.chains import FEW, FIELD, Lengths, chains_of_few, ensemble
from inverse.criticism.field_samples import bent, chains_of_field, weigh_field
from inverse.criticism.verdict import examine, verdict_on_few, verdict_on_field
from inverse.criticism.weights import enough
from inverse.data.noise import Noise
from inverse.fields.field_posterior import FieldPosterior
from inverse.fields.low_rank import LowRankPosterior
from inverse.fields.newton_cg import find_mode
from inverse.low_dimensional.evidence import evidence
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.low_dimensional.surrogate import fit
from tests.problems import DensePrior, Linear, N, curved, examine_few, few, ridge, solved, summary
from uq.evaluation.evaluate import SerialEvaluate


def agrees(chains, mean, std, *, z=4.5):
    """Means and standard deviations within their Monte-Carlo errors."""
    found = chains.flat
    error = std / np.sqrt(chains.ess_bulk)
    assert (np.abs(found.mean(axis=0) - mean) < z * error).all()
    assert (np.abs(found.std(axis=0) / std - 1) < z / np.sqrt(2 * np.minimum(chains.ess_bulk, chains.ess_tail))).all()


def quick(posterior):
    """The same posterior of a polynomial model, evaluated for many points at once."""
    x = np.random.default_rng(1).normal(size=(64, len(posterior.names)))
    fitted = fit(posterior, posterior.at(x, derivatives=True))
    everywhere = np.full(x.shape[1], np.inf)
    return replace(fitted, evaluate=replace(fitted.evaluate, lower=-everywhere, upper=everywhere))


# --- few parameters --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("run", [chains_of_few, pytest.param(ensemble, marks=pytest.mark.slow)])
def test_linear_models(run):
    posterior = quick(few())
    gaussian = laplace(posterior)
    lengths = Lengths(32, 150, 100, 8) if run is ensemble else replace(FEW, draws=500)
    found = run(posterior, gaussian, seed=2, lengths=lengths)
    assert (found.rhat < 1.06).all()
    agrees(found, gaussian.mode, np.sqrt(np.diag(gaussian.covariance)))
    again = run(posterior, gaussian, seed=2, lengths=lengths)
    np.testing.assert_array_equal(found.draws, again.draws)
    assert not np.array_equal(found.draws, run(posterior, gaussian, seed=3, lengths=lengths).draws)
    if run is chains_of_few:  # the proposals are reversible with respect to the posterior itself
        assert (found.accepted == 1).all()
        assert found.step > 0.9
        assert found.mixed


@pytest.mark.slow
@pytest.mark.parametrize("run", [chains_of_few, pytest.param(ensemble, marks=pytest.mark.slow)])
def test_a_curved_ridge_has_the_moments_of_weighted_points(run):
    posterior = quick(ridge(0.1))
    gaussian = laplace(posterior)
    points = evidence(posterior, gaussian, 512)
    expected = summary(posterior.physical(points.density.x), points.weights)
    if run is ensemble:
        found = ensemble(posterior, gaussian, Lengths(32, 200, 100, 8))
    else:
        found = chains_of_few(posterior, gaussian, points, lengths=replace(FEW, chains=8, draws=600, thin=2))
        assert found.mixed
        # In Laplace's Gaussian, which is too narrow along the ridge, they have not mixed, and say so.
        assert not chains_of_few(posterior, gaussian, lengths=replace(FEW, chains=8, draws=600)).mixed
    assert found.rhat.max() < 1.06
    got = summary(found.flat)
    error = expected.std * np.sqrt(1 / found.ess_bulk + 1 / points.ess)
    assert (np.abs(got.mean - expected.mean) < 4 * error).all()
    np.testing.assert_allclose(got.std, expected.std, rtol=0.15)


def test_diagnostics_are_those_of_arviz():
    arviz = pytest.importorskip("arviz")
    posterior = few()
    found = chains_of_few(posterior, laplace(posterior), lengths=replace(FEW, draws=100, burn=50))
    draws = {name: found.draws[:, :, k] for k, name in enumerate(posterior.names)}
    table = arviz.summary(arviz.from_dict(posterior=draws), round_to="none")
    assert list(table.index) == ["a", "b", "c"]
    np.testing.assert_allclose(table["r_hat"], found.rhat)
    np.testing.assert_allclose(table["ess_bulk"], found.ess_bulk)
    np.testing.assert_allclose(table["ess_tail"], found.ess_tail)


def test_where_there_is_no_answer():
    """Half of the space has no answer: chains never go there, and start where there is one."""
    posterior = few()
    gaussian = laplace(posterior)
    bound = gaussian.mode[0]

    def ends(p):
        if p[0] < bound:
            raise SolveError("ends")
        return posterior.evaluate.model.function(p)

    model = replace(posterior.evaluate.model, function=ends)
    half = replace(posterior, evaluate=SerialEvaluate(model))
    found = chains_of_few(half, gaussian, lengths=replace(FEW, draws=300, burn=100))
    assert found.flat[:, 0].min() >= bound
    width = np.sqrt(gaussian.covariance[0, 0])
    assert found.flat[:, 0].mean() == pytest.approx(bound + width * np.sqrt(2 / np.pi), abs=0.3 * width)

    def refuse(p):
        raise SolveError("never")

    never = replace(posterior, evaluate=SerialEvaluate(replace(model, function=refuse)))
    with pytest.raises(SolveError, match="where a chain starts"):
        chains_of_few(never, gaussian, lengths=replace(FEW, draws=10, burn=3))


# --- fields ----------------------------------------------------------------------------------------------------------


def test_chains_of_linear_models_of_fields():
    problem = Linear()
    mode, found = solved(problem, cutoff=0.1)
    g = np.random.default_rng(1).standard_normal((N, 3)) / N
    chains = chains_of_field(
        mode.point, found, keep=lambda m: m @ g, lengths=replace(FIELD, chains=4, draws=400, burn=100)
    )
    assert (chains.accepted > 0.6).all()  # the pairs that are left out
    assert (chains.rhat < 1.03).all()
    agrees(chains, problem.mean @ g, np.sqrt(np.diag(g.T @ problem.covariance @ g)))
    everything = chains_of_field(mode.point, found, lengths=replace(FIELD, draws=5, burn=2))
    assert everything.draws.shape == (2, 5, N)


def test_weights_of_linear_models_are_equal_and_their_mean_is_the_evidence():
    problem = Linear(holes=7)
    mode, exact = solved(problem, cutoff=1e-12)
    found = weigh_field(mode.point, exact, 32)
    np.testing.assert_allclose(found.log_weights, exact.log_evidence, rtol=1e-9)
    assert found.ess == pytest.approx(32)
    assert found.trusted
    _, truncated = solved(problem, rank=25)
    found = weigh_field(mode.point, truncated, 1500)
    assert abs(found.log_evidence - exact.log_evidence) < 4 * found.error
    assert 0.01 < found.error < 0.3
    got = summary(found.values, found.weights)
    error = np.sqrt(np.diag(problem.covariance) / found.ess)
    assert (np.abs(got.mean - problem.mean) < 4.5 * error).all()


def test_curved_fields_by_weights_and_by_chains():
    posterior = curved()
    mode = find_mode(posterior, tolerance=1e-8).point
    gaussian = LowRankPosterior.at(mode)
    weighted = weigh_field(mode, gaussian, 1500)
    expected = summary(weighted.values, weighted.weights)
    chains = chains_of_field(mode, gaussian, lengths=replace(FIELD, chains=4, draws=600))
    assert chains.rhat.max() < 1.03
    got = summary(chains.flat)
    error = expected.std * np.sqrt(1 / chains.ess_bulk + 1 / weighted.ess)
    assert (np.abs(got.mean - expected.mean) < 4.5 * error).all()
    np.testing.assert_allclose(got.std, expected.std, rtol=0.15)


def test_samples_without_an_answer_have_no_weight():
    mode = find_mode(curved(), tolerance=1e-8).point
    posterior = curved(np.abs(mode.values).max() + 0.02)
    mode = find_mode(posterior, tolerance=1e-8).point
    found = weigh_field(mode, LowRankPosterior.at(mode), 200)
    lost = ~np.isfinite(found.log_weights)
    assert 0 < lost.sum() < 200
    assert found.ess > 1
    assert bent(mode, LowRankPosterior.at(mode))(np.full((1, 12), 1e3))[1][0] == -np.inf


def test_the_strong_directions_follow_the_weak_ones():
    """What the data see well is the mean of eᵐ: a field that varies must be lower in the mean than a constant one."""
    size = 40
    names = tuple(map(str, range(size)))
    model = FunctionModel(lambda m: [np.exp(m).mean()], names, ("y",), lambda m: [np.exp(m) / size])
    posterior = FieldPosterior(model, np.ones(1), Noise(np.array([3e-3])), DensePrior(0.25 * np.eye(size)))
    mode = find_mode(posterior, tolerance=1e-8).point
    gaussian = LowRankPosterior.at(mode)
    found = weigh_field(mode, gaussian, 400)
    assert found.ess > 300
    straight = gaussian.samples(np.random.default_rng(0).standard_normal((400, size)))
    misfits = [(np.exp(m).mean(axis=1) - 1) / 3e-3 for m in (found.values, straight)]
    assert np.abs(misfits[0]).mean() < 3
    assert np.abs(misfits[1]).mean() > 8
    # ln p(y) by brute force over the prior, of which the mean of eᵐ is nearly normal.
    drawn = np.exp(0.25 * np.random.default_rng(1).standard_normal((200_000, size))).mean(axis=1)
    likelihood = np.exp(-(((drawn - 1) / 3e-3) ** 2) / 2) / (3e-3 * np.sqrt(2 * np.pi))
    error = np.hypot(found.error, likelihood.std() / likelihood.mean() / np.sqrt(len(drawn)))
    assert abs(found.log_evidence - np.log(likelihood.mean())) < 4 * error
    assert abs(gaussian.log_evidence - found.log_evidence) > 0.2
    assert found.values.mean() == pytest.approx(-(0.25**2) / 2, abs=0.003)  # of m, where the mean of eᵐ is 1
    chains = chains_of_field(mode, gaussian, keep=lambda m: m.mean(axis=1)[:, None], lengths=replace(FIELD, draws=600))
    assert chains.accepted.min() > 0.25
    assert chains.flat.mean() == pytest.approx(found.weights @ found.values.mean(axis=1), abs=0.002)


# --- what they say ---------------------------------------------------------------------------------------------------


def judged(posterior, samples=256, **settings):
    gaussian = laplace(posterior)
    return verdict_on_few(
        gaussian, evidence(posterior, gaussian, samples), examine_few(posterior, gaussian), **settings
    )


def test_verdicts_on_few_parameters():
    assert judged(few()).trust == "laplace"
    assert str(judged(few())).startswith("Laplace's Gaussian can be trusted: the posterior is Gaussian")
    wrong = judged(few(wave=3.0))
    assert wrong.trust == "neither"
    assert "does not explain the data" in wrong.why
    posterior = quick(ridge(0.1))
    gaussian = laplace(posterior)
    found, test = evidence(posterior, gaussian, 256), examine_few(posterior, gaussian)
    assert verdict_on_few(gaussian, found, test).trust == "corrected"
    lost = verdict_on_few(replace(gaussian, converged=False), found, test)
    assert (lost.trust, lost.why) == ("neither", "the search for the mode did not converge")
    uneven = replace(found, pareto_k=0.9, ess=30.0, many=None)
    assert "take method.samples = 1024, or run chains" in verdict_on_few(gaussian, uneven, test).why
    assert [enough(6, 64), enough(1.2, 64), enough(19, 40)] == [256, 1088, 160]
    short = chains_of_few(posterior, gaussian, lengths=replace(FEW, draws=10, burn=5))
    assert "have not mixed" in verdict_on_few(gaussian, uneven, test, short).why
    long = chains_of_few(posterior, gaussian, found, lengths=replace(FEW, draws=600, thin=2, chains=8))
    assert "but chains agree" in verdict_on_few(gaussian, uneven, test, long).why
    agreeing = replace(test, agreement_probability=0.001)
    assert "residuals of neighbours" in verdict_on_few(gaussian, found, agreeing).why


def test_chains_run_where_they_are_needed(monkeypatch):
    """Not where weighted points may stand for the posterior; else they take over."""
    posterior = quick(ridge(0.1))
    gaussian = laplace(posterior)
    told = assess(posterior, gaussian, 256, chains="pcn", when="needed")
    assert (told.source, told.chains) == ("points", None)
    poor = replace(told.evidence, pareto_k=0.9, ess=10.0, many=None)
    monkeypatch.setattr(assessment, "evidence", lambda *given, **more: poor)
    over = assess(posterior, gaussian, 256, chains="pcn", when="needed")
    assert over.chains is not None
    assert over.source == ("chains" if over.chains.mixed else "laplace")
    (line,) = only_needed("pcn", "needed", 5204)
    assert line.endswith("cannot be trusted: at most 5,204 more solves")
    assert only_needed("pcn", "always", 5204) == []


def test_verdicts_on_fields():
    mode, found = solved(Linear())
    test = examine(mode.point.residual, found.spectrum)
    weights = weigh_field(mode.point, found, 64)
    assert verdict_on_field(mode, found, weights, test).trust == "laplace"
    assert "not checked" in verdict_on_field(mode, found, None, test).why
    assert verdict_on_field(replace(mode, converged=False), found, weights, test).trust == "neither"
    moved = replace(weights, values=weights.values + 0.5 * found.std)
    assert verdict_on_field(mode, found, moved, test).trust == "corrected"
    wider = replace(weights, values=found.mean + 1.6 * (weights.values - found.mean))
    assert verdict_on_field(mode, found, wider, test).trust == "corrected"
    g = np.full((N, 1), 1 / N)
    drawn = chains_of_field(
        mode.point, found, keep=lambda m: np.column_stack([m @ g, m]), lengths=replace(FIELD, draws=1500)
    )
    chains, values = replace(drawn, draws=drawn.draws[:, :, :1]), drawn.flat[:, 1:]
    assert chains.mixed
    assert verdict_on_field(mode, found, None, test, chains, values).trust == "laplace"
    far = verdict_on_field(mode, found, None, test, chains, values + 0.5 * found.std)
    assert far.trust == "corrected"
    assert "R̂" in far.why
    short = replace(chains, draws=chains.draws[:, :50])
    assert verdict_on_field(mode, found, None, test, short, values).trust == "neither"
    uneven = replace(weights, log_weights=5 * np.random.default_rng(0).standard_normal(64))
    assert verdict_on_field(mode, found, uneven, test).trust == "neither"


def test_a_posterior_of_one_parameter():
    model = FunctionModel(lambda p: [p[0]], ("a",), ("u",), lambda p: [[1.0]])
    base = few()
    inputs = replace(base.inputs, own={"a": base.inputs.marginals["a"]})
    posterior = Posterior(inputs, SerialEvaluate(model), np.array([1.0]), Noise(np.array([1.0])))
    found = chains_of_few(posterior, laplace(posterior), lengths=replace(FEW, draws=500))
    agrees(found, np.array([0.5]), np.array([np.sqrt(0.5)]))
