"""Runs of methods side by side: what each found and cost, though points that several ask for are solved once."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from forward.findings import Finding
from forward.model import FloatArray, SolveError
from uq.estimators.moments import ESTIMATES, half_width
from uq.evaluation.block import merge
from uq.evaluation.evaluate import OfEvaluate, Recorder
from uq.evaluation.request import Evaluate, Evaluations, Request
from uq.findings import findings
from uq.inputs.random_parameters import Inputs
from uq.methods.method import Amount


@dataclass(frozen=True)
class Trial:
    """The results of one run of a method, and its cost.

    Attributes
    ----------
    estimates
        `ESTIMATES` by output (m,); NaN where there are none.
    half_width
        Standard errors on either side of a claimed 95 % interval.
    solves
        Number of points that were requested.
    seconds, own_seconds
        Processor time (s) of their solves, and of everything else that the method did.
    reason
        Why there is no estimate.
    doubts
        The method's findings about its own numbers.
    """

    estimates: dict[str, FloatArray]
    half_width: float
    solves: int
    seconds: float
    own_seconds: float
    reason: str | None = None
    doubts: tuple[Finding, ...] = ()


def trial_of(method: Amount, inputs: Inputs, memory: Memory) -> Trial:
    """Run a method once; a run without an estimate says why."""
    recorder = Recorder(memory)
    begin, before = time.process_time(), memory.seconds
    try:
        found = method.run(inputs, recorder)
    except SolveError as error:
        nothing = np.full(len(memory.outputs), np.nan)
        return Trial(dict.fromkeys(ESTIMATES, nothing), 0.0, recorder.solves, recorder.seconds, 0.0, str(error))
    own = time.process_time() - begin - (memory.seconds - before)
    estimates = {name: found[name].to_numpy() for name in ESTIMATES}
    doubts = tuple(findings(found))
    return Trial(estimates, half_width(found), recorder.solves, recorder.seconds, max(own, 0.0), doubts=doubts)


class Memory(OfEvaluate):
    """An evaluation that solves each point once, and returns the result, with its time, as often as requested.

    Sums of fields over several points are not remembered.

    Attributes
    ----------
    seconds
        Processor time (s) that evaluations of all models took on this rank, in that of the first model.
    """

    def __init__(self, evaluate: Evaluate, whole: Memory | None = None) -> None:
        self._evaluate, self._whole, self.seconds = evaluate, whole or self, 0.0
        self._others: dict[str, Memory] = {}
        self._known: dict[tuple[bytes, bytes], Evaluations] = {}

    def on(self, model: str) -> Memory:
        """Return the evaluation of another of the models, with its own memory."""
        if model not in self._others:
            self._others[model] = Memory(self._evaluate.on(model), self._whole)
        return self._others[model]

    def __call__(self, request: Request) -> Evaluations:
        """Evaluate all points of a request, solving those that are new."""
        begin = time.process_time()
        try:
            if request.fields is not None and len(request.points) > 1:
                return self._evaluate(request)
            return self._remembered(request)
        finally:
            self._whole.seconds += time.process_time() - begin

    def _remembered(self, request: Request) -> Evaluations:
        from uq.evaluation.checkpoint import digest

        asked = digest(replace(request, points=request.points[:0]))
        keys = [(asked, point.tobytes()) for point in request.points]
        new = {key: i for i, key in enumerate(keys) if key not in self._known}
        if new:
            found = self._evaluate(replace(request, points=request.points[list(new.values())]))
            self._known |= dict(zip(new, _one_by_one(found), strict=True))
        return merge([self._known[key] for key in keys])


def _one_by_one(found: Evaluations) -> list[Evaluations]:
    """Split evaluations of n points into n; fields are kept only for single points."""
    n = len(found.points)
    if n == 1:
        return [found]
    failures = {failure.index: replace(failure, index=0) for failure in found.failures}
    return [
        Evaluations.of(
            {name: rows[i : i + 1] for name, rows in found.rows.items()},
            (failures[i],) if i in failures else (),
            np.zeros((0, 0)),
        )
        for i in range(n)
    ]
