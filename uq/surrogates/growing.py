"""Predictions of the state that grow with the samples: from the tangent at the mean to expansions of rising order.

After 64 samples, and again after 512, an expansion is fitted to the states so far, and predicts the next ones. So what
predicts a sample depends on its number in the study only, and not on ranks, times, or where a study was interrupted.
A better prediction saves corrections; answers stay the same within the solver's tolerance.

The states are those of samples that are solved anyway, of which only sums are kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import takewhile

import numpy as np

from forward.model import FloatArray, ForwardModel, Solution, SolveError, scattered
from uq.evaluation.block import merge
from uq.evaluation.evaluate import OfEvaluate
from uq.evaluation.request import Evaluate, Evaluations, FieldSum, Request, Start
from uq.inputs.random_parameters import Inputs
from uq.surrogates.basis import ROWS_PER_TERM, Basis, Candidate, Candidates, hyperbolic, hyperbolic_count, orthonormal
from uq.surrogates.field_regression import StateExpansion
from uq.surrogates.least_squares import Data, Fit, fit_best
from uq.surrogates.linearisation import Linearisation

LEARNT = (64, 512)  # samples after which the prediction is fitted to all so far
WORTH = 8  # times as many samples must be planned: the first ones go in smaller company
TERMS, BYTES = 66, 2**26  # of an expansion: each term is a field, in every block that teaches it


class Growing(OfEvaluate):
    """An evaluation of one model whose predictions grow; where they cannot, requests are passed on as they are.

    Only requests that sum fields, sample by sample, teach it: others may be answered from memory.

    Parameters
    ----------
    inputs
        The random parameters.
    evaluate
        The evaluation.
    centre
        The linearisation that predicts the first samples.
    planned
        How many samples there may be.
    """

    def __init__(self, inputs: Inputs, evaluate: Evaluate, centre: Linearisation, planned: int) -> None:
        self._evaluate, self._inputs, self._centre = evaluate, inputs, centre
        self._candidates = _candidates(inputs, centre, planned)
        self._ends = [end for end in LEARNT if WORTH * end <= planned] if self._candidates is not None else []
        self._seen: list[Evaluations] = []
        self._start: Start | None = None
        self._count = 0

    def on(self, model: str) -> Evaluate:
        """Return the evaluation of another of the models."""
        return self._evaluate.on(model)

    def __call__(self, request: Request) -> Evaluations:
        """Evaluate all points of a request, predicted by what is known when it is their turn."""
        if request.fields is None or request.start is None or request.fields.compact:
            return self._evaluate(request)
        parts, points = [], request.points
        while len(points):
            stage = self._ends[0] - self._count if self._ends else len(points)
            part = replace(request, points=points[:stage], start=self._start or request.start)
            parts.append(self._learning(part) if self._ends else self._evaluate(part))
            points = points[stage:]
        return parts[0] if len(parts) == 1 else merge(parts)

    def _learning(self, request: Request) -> Evaluations:
        assert self._candidates is not None
        assert request.fields is not None
        basis = self._candidates.basis
        found = self._evaluate(replace(request, fields=_Beside(basis, self._centre.state, request.fields)))
        terms = len(basis.indices)
        self._seen.append(replace(found, fields=found.fields[:terms]))
        self._count += len(request.points)
        if self._count >= self._ends[0]:
            self._ends.pop(0)
            self._fit(self._candidates)
        return replace(found, fields=found.fields[terms:])

    def _fit(self, largest: Candidates) -> None:
        """Fit all that is known, in as many functions as it may determine; keep the fit if it is the better one."""
        seen = merge(self._seen)
        self._seen = [seen] if self._ends else []
        most = int(seen.ok.sum()) // ROWS_PER_TERM
        sets = tuple(one for one in largest.sets if one.which.size <= most)
        data = Data.of(seen, self._inputs, None)
        try:
            fit = fit_best(replace(largest, sets=sets), data)
        except SolveError:
            return
        if self._better(fit, data):
            chosen = orthonormal(self._inputs, largest.basis.indices[fit.chosen.which])
            self._start = StateExpansion.fitted(chosen, fit, seen.fields, self._centre)

    def _better(self, fit: Fit, data: Data) -> bool:
        """Whether an expansion predicts outputs better than the tangent: what it misses is smaller for most of them."""
        here = self._inputs.coordinates.of(data.points) - self._inputs.coordinates.of(self._centre.point)
        tangent = data.values - self._centre.outputs - here @ self._centre.output_slopes.T
        misses = np.sqrt((tangent**2).mean(axis=0))
        return bool(2 * (fit.loo <= misses).sum() > len(misses))


@dataclass(frozen=True)
class _Beside(FieldSum):
    """Projections of the deviations of states from one on the functions of a basis, and another sum."""

    basis: Basis
    state: FloatArray
    fields: FieldSum

    def on(self, model: ForwardModel) -> Callable[[Solution, FloatArray], FloatArray]:
        state, fields = scattered(model, self.state[None, :])[0], self.fields.on(model)

        def rows(solution: Solution, parameters: FloatArray) -> FloatArray:
            projections = np.outer(self.basis.at(parameters), solution.state - state)
            return np.vstack([projections, fields(solution, parameters)])

        return rows


def _candidates(inputs: Inputs, centre: Linearisation, planned: int) -> Candidates | None:
    """Return the bases that samples may determine, of all total degrees; None if the tangent is as good as any."""
    if inputs.correlations or centre.prediction is None or not len(centre.slopes):
        return None
    d = len(inputs.names)
    samples = max((end for end in LEARNT if WORTH * end <= planned), default=0)
    most = min(TERMS, BYTES // (8 * centre.state.size), samples // ROWS_PER_TERM)
    orders = range(1, inputs.largest_degree + 1)
    counts = list(takewhile(lambda count: count <= most, (hyperbolic_count(d, order, 1.0) for order in orders)))
    if len(counts) < 2:  # orders
        return None
    sets = tuple(Candidate(order, 1.0, np.arange(count)) for order, count in enumerate(counts, 1))
    return Candidates(orthonormal(inputs, hyperbolic(d, len(counts), 1.0)), sets)
