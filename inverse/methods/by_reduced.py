"""Posteriors of a body by its reduced model, which full solves correct and check.

The posterior is that of ψ_r(ω) + δ(ω), ψ_r by the reduced model and δ(ω) = δ̂ + T (ω − ω̂) what it misses: values and
derivatives by one full solve at the most probable parameters. Draws ω_i of that posterior are solved in full; the
weights p(y | ω_i)/p_r(y | ω_i) lead from it to the posterior of the body (importance sampling), so their evenness
(Σw)²/(n Σw²) says how alike both are, and their mean is the ratio of the evidences. Where they are uneven, δ takes the
smallest change that suits the new solves, and new draws are solved: what is checked is never what was fitted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from forward.model import FloatArray, ForwardModel
from inverse.criticism.doubts import SAME
from inverse.criticism.weights import effective_sample_size, normalised, resampled
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.methods.infer import Problem
from inverse.methods.invert import Invert
from inverse.methods.invert_few import Inverted, invert_few
from inverse.methods.record import noise_of
from uq.evaluation.evaluate import OfEvaluate, Recorder, SerialEvaluate
from uq.evaluation.request import Evaluate, Evaluations, Request
from uq.inputs.random_parameters import Inputs
from uq.surrogates.linearisation import Linearisation, linearise

if TYPE_CHECKING:
    import xarray as xr

ROUNDS = 3


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
        checked, points, left = _checked(found, full, centre, corrected, method)
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
    found: Inverted, full: Evaluate, centre: Linearisation, corrected: Corrected, method: Invert
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
