"""Something cheap in place of a model: one expansion that all data sets of a batch share, or a reduced model of a body.

Data sets of one kind of specimen differ in what was measured, not in the model. So the model is solved at points of the
prior once, outputs are expanded in polynomials fitted to values and derivatives (`uq.surrogates.regression`), and every
data set is inverted with the expansion, which costs next to nothing. What finer meshes say of the error of the mesh
is smooth and small: a few solves expand it too. How far the expansions miss samples that are left out counts among
the errors of the data.

The posterior by a reduced model is that of ψ_r(ω) + δ(ω), δ(ω) = δ̂ + T (ω − ω̂) what it misses: values and
derivatives by one full solve at the most probable parameters. Draws ω_i of that posterior are solved in full; the
weights p(y | ω_i)/p_r(y | ω_i) lead from it to the posterior of the body (importance sampling), so their evenness
(Σw)²/(n Σw²) says how alike both are, and their mean is the ratio of the evidences. Where they are uneven, δ takes the
smallest change that suits the new solves, and new draws are solved: what is checked is never what was fitted.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtri

from forward.model import FloatArray, ForwardModel, SolveError
from forward.pointwise import FunctionModel
from inverse.criticism.doubts import SAME
from inverse.criticism.finer import Finer, Solved
from inverse.criticism.weights import effective_sample_size, normalised, resampled
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.methods.infer import Problem
from inverse.methods.invert import LEAST_SHARED, Invert
from inverse.methods.invert_few import Inverted, invert_few
from inverse.methods.record import noise_of
from uq.evaluation.evaluate import OfEvaluate, Recorder, SerialEvaluate
from uq.evaluation.request import Evaluate, Evaluations, Request
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.surrogates.basis import Basis
from uq.surrogates.linearisation import Linearisation, linearise
from uq.surrogates.regression import Regression

if TYPE_CHECKING:
    import xarray as xr

ORDER = 8  # highest degree that is tried
WIDER = 1.5  # standard deviations of the points over those of the prior: data may come from its tails
MARGIN = 0.3  # of the range of the points, by which the expansions reach beyond it on either side
FEWER = 4  # solves for each on finer meshes
ROUNDS = 3


@dataclass(frozen=True, eq=False)
class SharedExpansion:
    """Expansions in place of a model.

    Attributes
    ----------
    model
        The expansion of its outputs.
    finer
        That of what finer meshes say; None if there are no meshes.
    error
        Root mean square (m,) of the errors at samples that are left out, of both together.
    solves, finer_solves
        Numbers of solves.
    """

    model: FunctionModel
    finer: Finer | None
    error: FloatArray
    solves: int
    finer_solves: int


@dataclass(frozen=True, eq=False)
class _Expansion:
    """A polynomial on a range (d,) of its coordinates."""

    basis: Basis
    coefficients: FloatArray
    lower: FloatArray
    upper: FloatArray

    def outputs(self, point: FloatArray) -> FloatArray:
        self._check(point)
        return np.asarray(self.basis.values(point[None])[0] @ self.coefficients)

    def slopes(self, point: FloatArray) -> FloatArray:
        """Derivatives (m, d)."""
        self._check(point)
        along = (self.basis.derivatives(point[None]) @ self.coefficients)[0].T
        return np.asarray(along / self.basis.coordinates.steps(point[None])[0])

    def _check(self, point: FloatArray) -> None:
        at = self.basis.coordinates.of(point[None])[0]
        if (at < self.lower).any() or (at > self.upper).any():
            raise SolveError("beyond the points at which the expansion that the data sets share was fitted")


def shared_expansion(
    inputs: Inputs, evaluate: Evaluate, finer: Evaluate | None, samples: int, why: str = ""
) -> SharedExpansion:
    """Solve a model, and on finer meshes, at so many points of the prior, and expand both; collective over the groups.

    Finer meshes (`forward.fem.finer`) are None where there is nothing to look at, or where `why` says why not. Raises
    `SolveError` if too few points have an answer.
    """
    start = None
    with suppress(SolveError):  # or else every solve begins at zero
        start = linearise(inputs, evaluate, inputs.mean).prediction
    points = _points(inputs, samples)
    found = evaluate(Request(points, tangents=True, start=start))
    ok = found.ok
    assert found.tangents is not None
    own, error = _fitted(inputs, points[ok], found.outputs[ok], found.tangents[ok])
    model = FunctionModel(own.outputs, evaluate.parameters, evaluate.outputs, own.slopes)
    if finer is None:
        return SharedExpansion(model, Finer(None, why) if why else None, error, len(points), 0)
    few = _points(inputs, max(samples // FEWER, LEAST_SHARED))
    there, missed = expanded_finer(inputs, finer, few, lambda point: (own.outputs(point), own.slopes(point)))
    return SharedExpansion(model, there, np.hypot(error, missed), len(points), len(few))


def expanded_finer(
    inputs: Inputs, finer: Evaluate, points: FloatArray, own: Callable[[FloatArray], tuple[FloatArray, FloatArray]]
) -> tuple[Finer, FloatArray]:
    """Expand what finer meshes add to a model, by solves at points (n, d) of the prior; collective over the groups.

    Outputs (m,) and derivatives (m, d) of the model itself are given at parameters (d,). Returned are what finer meshes
    say anywhere, the model and the expansion of the difference, and the root mean square (m,) of the errors of the
    expansion at samples that are left out.
    """
    there = finer(Request(points, tangents=True))
    assert there.tangents is not None
    good = there.ok
    gap, slopes = there.outputs[good].copy(), there.tangents[good].copy()
    for k, point in enumerate(points[good]):
        outputs, tangents = own(point)
        m = len(outputs)
        gap[k, :m] -= outputs
        slopes[k, :m] -= tangents
    more, missed = _fitted(inputs, points[good], gap, slopes)

    def solve(point: FloatArray, tangents: bool) -> Solved:
        outputs, derivatives = more.outputs(point), more.slopes(point)
        here, of_here = own(point)
        outputs[: len(here)] += here
        derivatives[: len(here)] += of_here
        return outputs, derivatives if tangents else None

    return Finer(solve), missed[:m]


def _points(inputs: Inputs, count: int) -> FloatArray:
    """Points (n, d) of the prior, whose normal coordinates are wider, where the model is defined."""
    normals = ndtri(sobol_points(0, 0, 0, 2 * count, len(inputs.names)))
    points = np.concatenate([inputs.from_normals(width * normals)[0] for width in (WIDER, 1.0)])
    return np.asarray(points[inputs.allowed(points)][:count])


def _fitted(
    inputs: Inputs, points: FloatArray, values: FloatArray, tangents: FloatArray
) -> tuple[_Expansion, FloatArray]:
    """Expand values (n, m) with tangents (n, m, d); its errors (m,) at samples that are left out."""
    if len(points) < LEAST_SHARED:
        raise SolveError(f"{len(points)} points have an answer, too few for an expansion that the data sets share")
    found = Regression.of(inputs, points, values, tangents, ORDER)
    seen = inputs.coordinates.of(points)
    low, high = seen.min(axis=0), seen.max(axis=0)
    reach = MARGIN * (high - low)
    return _Expansion(found.basis, found.fit.coefficients, low - reach, high + reach), found.fit.loo


@dataclass(frozen=True, eq=False)
class Corrected(OfEvaluate):
    """An evaluation of a reduced model to which a linear function of the parameters is added.

    Attributes
    ----------
    point
        ω̂ (d,).
    error, slopes
        δ̂ (M,) and T (M, d) of all its outputs.
    """

    _evaluate: Evaluate
    point: FloatArray
    error: FloatArray
    slopes: FloatArray

    def on(self, model: str) -> Corrected:
        """Return itself: there is one model."""
        return self

    def at(self, points: FloatArray) -> FloatArray:
        """Return δ (n, M) at parameters (n, d)."""
        return np.asarray(self.error + (points - self.point) @ self.slopes.T)

    def __call__(self, request: Request) -> Evaluations:
        """Evaluate all points of a request; the reduced model knows where to begin."""
        found = self._evaluate(replace(request, start=None))
        tangents = None if found.tangents is None else found.tangents + self.slopes
        return replace(found, outputs=found.outputs + self.at(found.points), tangents=tangents)

    def nearer(self, points: FloatArray, left: FloatArray, scale: FloatArray) -> Corrected:
        """Return the smallest change that leaves least of errors (n, M) at parameters (n, d), of which scales (d,)."""
        rows = np.column_stack([np.ones(len(points)), (points - self.point) / scale])
        change = np.linalg.lstsq(rows, left, rcond=1e-8)[0]
        return replace(self, error=self.error + change[0], slopes=self.slopes + (change[1:] / scale[:, None]).T)


@dataclass(frozen=True)
class Agreement:
    """How alike two posteriors are, by the ratio of their densities at draws of the first.

    Attributes
    ----------
    share
        (Σw)²/(n Σw²) of the weights.
    shift
        How far the mean of each parameter (c,) moves by them, in standard deviations.
    log_ratio, error
        ln of the ratio of the evidences, and its standard error.
    """

    share: float
    shift: FloatArray
    log_ratio: float
    error: float

    @classmethod
    def of(cls, gaps: FloatArray, draws: FloatArray, deviations: FloatArray) -> Agreement:
        """Compare by ln of the ratios (n,) at draws (n, c) of a posterior with standard deviations (c,)."""
        n = len(gaps)
        if not np.isfinite(gaps).any():
            return cls(0.0, np.full(len(deviations), np.inf), -np.inf, np.inf)
        w = normalised(gaps)
        top = gaps.max()
        log_ratio = float(top + np.log(np.exp(gaps - top).mean()))
        shift = (w @ draws - draws.mean(axis=0)) / deviations
        return cls(effective_sample_size(w) / n, shift, log_ratio, float(n * w.std(ddof=1) / np.sqrt(n)))


def invert_by_reduced(
    inputs: Inputs, evaluate: Evaluate, reduced: ForwardModel, problem: Problem[Invert]
) -> xr.Dataset:
    """Invert a data set with a reduced model of a body, which has the same parameters and outputs.

    Raises `SolveError` if either has no answer where the search needs one.
    """
    method = problem.method
    assert method.reduced is not None
    full, cheap = Recorder(evaluate), Recorder(SerialEvaluate(reduced))
    centre, corrected = _corrected(inputs, full, cheap, problem)
    for number in range(1, ROUNDS + 1):
        found = invert_few(inputs, corrected, replace(problem, start=lambda _: None, model=None))
        checked, points, left = _checked(found, full, centre, method)
        share = f"weights worth {100 * checked.share:.0f} % of {method.reduced.solves} draws"
        problem.say(f"posterior by the reduced model against full solves: {share}")
        if checked.share >= SAME or number == ROUNDS:
            break
        corrected = corrected.nearer(points, left, found.dataset["std"].to_numpy()[: len(inputs.names)])
    one = found.dataset
    return one.assign(
        log_evidence=one["log_evidence"] + checked.log_ratio,
        log_evidence_error=np.hypot(one["log_evidence_error"], checked.error),
        solves=float(full.solves),
        reduced_share=checked.share,
        reduced_shift=("parameter", checked.shift),
        reduced_rounds=float(number),
        reduced_solves=float(cheap.solves),
    )


def _corrected(
    inputs: Inputs, full: Evaluate, cheap: Evaluate, problem: Problem[Invert]
) -> tuple[Linearisation, Corrected]:
    """Search with the reduced model as it is, and solve the body where that ends."""
    data, method = problem.data, problem.method
    posterior = Posterior(inputs, cheap, data.values, noise_of(problem), data.which)
    gaussian = laplace(posterior, starts=method.starts, seed=method.seed, exact=False)
    point = posterior.physical(gaussian.mode[None])[0, : len(inputs.names)]
    own = cheap(Request(point[None], tangents=True))
    assert own.tangents is not None
    centre = linearise(inputs, full, point)
    missed = centre.outputs - own.outputs[0], centre.tangents - own.tangents[0]
    return centre, Corrected(cheap, point, *missed)


def _checked(
    found: Inverted, full: Evaluate, centre: Linearisation, method: Invert
) -> tuple[Agreement, FloatArray, FloatArray]:
    """Solve draws of a posterior in full: how alike both are, parameters (n, d), and what is missed there (n, M)."""
    assert method.reduced is not None
    density = found.evidence.density
    chosen = resampled(found.evidence.weights, method.reduced.solves, method.seed)
    which, back = np.unique(chosen, return_inverse=True)  # a point that counts much is drawn several times
    posterior = replace(found.posterior, evaluate=full, start=centre.prediction)
    there = posterior.at(density.x[which])
    gaps = (there.log_likelihood - density.log_likelihood[which])[back.ravel()]
    draws = posterior.physical(density.x[chosen])
    solved = np.isfinite(there.log_likelihood)
    left = there.everything - density.everything[which]
    agreement = Agreement.of(gaps, draws, found.dataset["std"].to_numpy())
    return agreement, there.parameters[solved], left[solved]
