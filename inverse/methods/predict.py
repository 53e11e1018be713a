"""What a posterior says on outputs that were not measured, beside what was known of them before the data.

Of few parameters there are draws before and after the data: an expansion that is orthonormal over the draws, fitted to
values and gradients, gives moments and quantiles of the outputs (`uq.methods.chaos`).

Of a field there is its normal distribution N(m̂, Γ). With the gradients g of the outputs at m̂ (an adjoint each),

    ψ(m) ≈ L(m) = ψ(m̂) + g·(m − m̂),   Var L = gᵀΓg,   Γ = Γ_pr or Γ_post (`inverse.fields.low_rank`),

which is exact for linear models. What L leaves out is seen in pairs m̂ ± δ of draws: half the sum of ψ at both is what
moves the mean, half the difference, squared, has the expected value Var L where ψ is linear.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from forward.model import FloatArray, ForwardModel, Guess, Solution, SolveError
from inverse.fields.field_posterior import Prior
from inverse.fields.low_rank import Beside, LowRankPosterior
from inverse.methods.record import ENDS, Record
from uq.estimators.estimate import BAND, part
from uq.evaluation.request import Evaluate, Request
from uq.findings import findings, once_for_outputs
from uq.inputs.draws import Draws
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.surrogates.expansion import Expansion
from uq.surrogates.linearisation import linearise

Z = 1.959963984540054  # standard normal quantile of the upper end
SPARE = 20.0  # solves that calibrating the error of the mesh may cost
POINTS = 4096  # that stand for a distribution
STREAM = 7  # of the normal numbers of pairs


@dataclass(frozen=True)
class Band:
    """What is known of k outputs.

    Attributes
    ----------
    mean, std
        (k,), with standard errors `mean_error` and `std_error`.
    lower, upper
        Ends (k,) of the central 95 % intervals.
    solves
        Number of solves that it took.
    said
        What is doubtful of it, in sentences.
    """

    mean: FloatArray
    mean_error: FloatArray
    std: FloatArray
    std_error: FloatArray
    lower: FloatArray
    upper: FloatArray
    solves: int = 0
    said: tuple[str, ...] = ()

    @classmethod
    def unknown(cls, count: int, why: str) -> Band:
        """Nothing is known of so many outputs."""
        nothing = np.full(count, np.nan)
        return cls(nothing, nothing, nothing, nothing, nothing, nothing, said=(why,))

    def plus(self, values: FloatArray, more: FloatArray, weights: FloatArray) -> Band:
        """Return the band with more (N, k) added at draws with weights (N,), by the values of the outputs there."""
        from inverse.criticism.assessment import quantiles

        def of(draws: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            mean = weights @ draws
            ends = np.array([quantiles(column, weights, ENDS) for column in draws.T]).T
            return mean, weights @ (draws - mean) ** 2, ends

        (mean, variance, ends), (first, least, inner) = of(values + more), of(values)
        std = np.sqrt(np.maximum(self.std**2 + variance - least, 0.0))
        lower, upper = np.array([self.lower, self.upper]) + ends - inner
        return replace(self, mean=self.mean + mean - first, std=std, lower=lower, upper=upper)

    def named(self, first: str) -> Record:
        """Return its numbers by their names in results."""
        return {f"{first}{name}": vars(self)[name] for name in BAND}


def record(before: Band, after: Band, mesh_error: FloatArray, share: FloatArray | None = None) -> Record:
    """Return what results hold of predictions, by the prior, and by the posterior.

    What the mesh takes away from the outputs (k,) is NaN where it is not estimated. The share of their variance by the
    prior (k,) that the data have removed is by default what both bands say.
    """
    if share is None:
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(before.std > 0, 1 - (after.std / before.std) ** 2, np.nan)
    said = [*after.said, *(f"of the prior: {line}" for line in before.said)]
    return {
        **after.named("prediction_"),
        **before.named("prediction_prior_"),
        "prediction_share": share,
        part("prediction_mean", "mesh"): mesh_error,
        "prediction_solves": np.array(float(before.solves + after.solves)),
        "prediction_why": "; ".join(line.rstrip(".") for line in said),
    }


# --- few parameters --------------------------------------------------------------------------------------------------


def with_beside(
    points: FloatArray, weights: FloatArray, means: FloatArray, root: FloatArray, seed: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Return points (N, c + g), with weights (N,), of parameters and what is uncertain beside them.

    Given each of n points (n, c) that is normal, with means (n, g) and a root (g, r) of the covariance.
    """
    from scipy.special import ndtri

    copies, c = max(POINTS // len(points), 1), points.shape[1]
    normals = ndtri(sobol_points(seed, 0, 0, copies * len(points), c + root.shape[1])[:, c:])
    both = np.hstack([np.repeat(points, copies, axis=0), np.repeat(means, copies, axis=0) + normals @ root.T])
    return both, np.repeat(weights / copies, copies)


def of_draws(
    draws: Draws, evaluate: Evaluate, samples: int, seed: int, more: FloatArray | None = None
) -> tuple[Band, Band | None]:
    """Return what draws of the parameters of a model, in their order, say on its outputs, with `samples` solves.

    And the same of outputs to which more (N, k) is added at each of the draws, if it is.
    """
    from uq.estimators.indices import moments
    from uq.estimators.input_sample_error import with_errors_of_draws
    from uq.methods.chaos import Chaos, expansion_dataset

    objection = draws.objection()
    if objection is not None:
        return Band.unknown(len(evaluate.outputs), objection), None
    inputs = Inputs({}, draws=draws)
    method = Chaos(samples=samples, seed=seed, fields=False, quantiles=ENDS)
    try:
        expanded = method.expand(inputs, evaluate)
        whole = expansion_dataset(evaluate, expanded, seed, ENDS, fields=False, of=moments)  # nobody asks for effects
        found = with_errors_of_draws(whole, inputs)
    except SolveError as error:
        return Band.unknown(len(evaluate.outputs), error.reason), None
    mean, mean_error, std, std_error = (found[name].to_numpy() for name in ("mean", "mean_error", "std", "std_error"))
    lower, upper = found["quantiles"].to_numpy()
    doubts = [one for one in findings(found) if one.severity != "note"]
    said = tuple(one.text for one in once_for_outputs(doubts, evaluate.outputs))
    failed = int((~found["ok"]).sum())
    said += (f"{failed} of {samples} solves have no answer",) if failed else ()
    band = Band(mean, mean_error, std, std_error, lower, upper, 1 + samples, said)
    if more is None:
        return band, None
    return band, band.plus(Expansion.of(whole).outputs(draws.values), more, draws.weights)


def mesh_error_at(draws: Draws, evaluate: Evaluate) -> FloatArray:
    """Estimate what the mesh takes away from the outputs (k,) at the mean of draws; NaN where nothing tells."""
    inputs = Inputs({}, draws=draws)
    nothing = np.full(len(evaluate.outputs), np.nan)
    try:
        start = linearise(inputs, evaluate).prediction
    except SolveError:
        return nothing
    found = evaluate(Request(inputs.mean[None], start=start, mesh_errors=True, saturations=SPARE))
    if found.failures or found.mesh_errors is None:
        return nothing
    factors, shifts = np.ones(len(nothing)), np.zeros(len(nothing))
    if found.saturations is not None:
        factors, shifts = (np.nan_to_num(found.saturations[0][name]) for name in ("factors", "shifts"))
        factors = np.where(factors == 0, 1.0, factors)
    return np.asarray(found.mesh_errors[0] * factors + shifts)


# --- fields ----------------------------------------------------------------------------------------------------------


def _of_field(
    model: ForwardModel,
    mean: FloatArray,
    covariance: Callable[[FloatArray], FloatArray],
    deviations: FloatArray,
    weighted: tuple[FloatArray, FloatArray] | None = None,
    *,
    of_mesh: bool = False,
) -> tuple[Band, FloatArray, FloatArray]:
    """Return what N(m̂ (N,), Γ) of a field says on the k outputs of a model, their gradients, and mesh errors (k,).

    The covariance multiplies Γ with (k, N); draws (S, N) of N(0, Γ) are the deviations. Others as of `after_field`.
    """
    count, pairs = len(model.outputs), len(deviations)
    mesh = np.full(count, np.nan)
    try:
        solution = model.solve(mean)
    except SolveError as error:
        return Band.unknown(count, error.reason), np.zeros((count, len(mean))), mesh
    centre, gradients = np.asarray(solution.outputs), solution.adjoint(np.eye(count))
    steps = solution.state_tangent(deviations) if pairs else np.zeros((0, 0))  # before the factor is another's
    if of_mesh:
        mesh = _of_mesh(solution, mesh)
    middle = np.zeros(count)
    variance = np.einsum("kn,kn->k", gradients, covariance(gradients))
    if weighted is not None:
        values, weights = weighted
        along = (values - mean) @ gradients.T
        middle = weights @ along
        variance = weights @ (along - middle) ** 2
    even, more = _beyond(model, solution, mean, deviations, steps, gradients)
    failed = pairs - len(even)
    moved, wider, mean_error, of_variance = (np.zeros(count) for _ in range(4))
    if len(even):
        moved, wider = even.mean(axis=0), more.mean(axis=0)
    if len(even) > 1:
        scatter = even.var(axis=0, ddof=1)
        wider = wider + scatter
        mean_error = np.sqrt(scatter / len(even))
        of_variance = np.sqrt((more.var(axis=0, ddof=1) + 2 * scatter**2) / len(even))
    std = np.sqrt(np.maximum(variance + wider, 0.0))
    std_error = np.divide(of_variance, 2 * std, out=np.zeros(count), where=std > 0)
    at = centre + middle + moved
    said = (f"{failed} of {pairs} pairs of draws have no answer",) if failed else ()
    band = Band(at, mean_error, std, std_error, at - Z * std, at + Z * std, 1 + 2 * pairs, said)
    return band, gradients, mesh


def _beyond(
    model: ForwardModel,
    solution: Solution,
    mean: FloatArray,
    deviations: FloatArray,
    steps: FloatArray,
    gradients: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return what ψ adds to L in pairs of draws (P, k) that have an answer: its even part, and to the odd one squared.

    Solves start from the state moved by its derivatives, `steps` (S, U_local).
    """
    even, more = [np.zeros((0, len(gradients)))], [np.zeros((0, len(gradients)))]
    for delta, step in zip(deviations, steps, strict=True):
        try:
            above, below = (
                np.asarray(model.solve(mean + sign * delta, Guess(solution.state + sign * step)).outputs)
                for sign in (1.0, -1.0)
            )
        except SolveError:
            continue
        even.append(((above + below) / 2 - solution.outputs)[None])
        more.append((((above - below) / 2) ** 2 - (gradients @ delta) ** 2)[None])
    return np.concatenate(even), np.concatenate(more)


def deviations(prior: Prior, size: int, pairs: int, seed: int, found: LowRankPosterior | None = None) -> FloatArray:
    """Return draws (pairs, N) of a field less its mean, of the prior or of a posterior."""
    whitened = np.random.default_rng([seed, STREAM]).standard_normal((pairs, size))
    return prior.root(whitened if found is None else found.spectrum.root(whitened)) if pairs else whitened


def _normals(pairs: int, beside: Beside, seed: int) -> FloatArray:
    return np.random.default_rng([seed, STREAM, 1]).standard_normal((pairs, beside.root.shape[1]))


def before_field(model: ForwardModel, prior: Prior, size: int, pairs: int, seed: int, count: int = 0) -> Band:
    """Return what the prior N(0, LLᵀ) of a field says on the outputs of a model.

    The model's last parameters, so many, are what is uncertain beside, in its deviations.
    """
    beside = Beside.before(size, count)
    drawn = beside.deviations(deviations(prior, size, pairs, seed), _normals(pairs, beside, seed))
    covariance = beside.covariance(lambda g: prior.root(prior.root_transposed(g)))
    return _of_field(model, np.zeros(size + count), covariance, drawn)[0]


def after_field(
    model: ForwardModel,
    found: LowRankPosterior,
    before: Band,
    pairs: int,
    seed: int,
    weighted: tuple[FloatArray, FloatArray] | None = None,
    beside: Beside | None = None,
    *,
    of_mesh: bool,
) -> Record:
    """Return what the posterior of a field says on the outputs of a model, beside what was known before the data.

    Parameters of the model are values of the field and, at last, what is uncertain beside, if something is. Pairs of
    draws show what gradients leave out. Values (n, N) with weights (n,) correct the normal distribution; None where it
    is right. The error of the mesh is estimated if asked for.
    """
    size = len(found.mean)
    beside = beside or Beside.before(size, 0)
    drawn = beside.deviations(deviations(found.prior, size, pairs, seed, found), _normals(pairs, beside, seed))
    mean, covariance = np.append(found.mean, beside.mean), beside.covariance(found.covariance)
    both = None if weighted is None else beside.weighted(found.mean, *weighted)
    after, gradients, mesh = _of_field(model, mean, covariance, drawn, both, of_mesh=of_mesh)
    of_field, of_rest = np.split(gradients, [size], axis=1)
    whole = (found.prior.root_transposed(of_field) ** 2).sum(axis=1) + (of_rest**2).sum(axis=1)
    left = np.einsum("kn,kn->k", gradients, covariance(gradients))
    share = np.divide(whole - left, whole, out=np.full(len(whole), np.nan), where=whole > 0)
    return record(before, after, mesh, share)


def _of_mesh(solution: Solution, nothing: FloatArray) -> FloatArray:
    """Estimate what the mesh takes away from the outputs (k,)."""
    with suppress(SolveError):
        error = solution.mesh_error()
        calibrated = None if error is None else solution.saturation(SPARE)
        if error is not None:
            return error.outputs if calibrated is None else error.calibrated(calibrated).outputs
    return nothing
