"""Solves that plain Monte Carlo needs for the error of sensitivity Monte Carlo, on the published beam."""

from __future__ import annotations

import time

from mpi4py import MPI

from benchmarks.beams import beam
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Evaluations, Request
from uq.methods.monte_carlo import SensitivityMonteCarlo

SAMPLES = 256


class Remembered:
    """An evaluation that solves each set of points once: all estimators see the same samples."""

    def __init__(self, evaluate: SerialEvaluate) -> None:
        self._evaluate = evaluate
        self._known: dict[bytes, Evaluations] = {}
        self.parameters = evaluate.parameters
        self.outputs = evaluate.outputs
        self.differentiable = evaluate.differentiable
        self.displacements = evaluate.displacements

    def __call__(self, request: Request) -> Evaluations:
        """Evaluate, or remember."""
        key = request.points.tobytes()
        if key not in self._known:
            self._known[key] = self._evaluate(request)
        return self._known[key]


def main() -> None:
    """Print measured variance ratios, for both coefficients and both second moments."""
    study = beam((12, 2, 4))
    inputs = study.inputs
    evaluate = Remembered(SerialEvaluate(study.model.build(MPI.COMM_SELF, inputs.names)))
    print(
        "| coefficient | second moment | output | mean: MC solves per solve | standard deviation: MC solves per solve |"
    )
    print("|---|---|---|---|---|")
    begin = time.perf_counter()
    for coefficient in ("one", "optimal"):
        for second in ("quadratic", "linear"):
            method = SensitivityMonteCarlo(
                samples=SAMPLES, seed=1, coefficient=coefficient, second_moment=second, fields=False
            )
            data = method.run(inputs, evaluate)
            for output in data.output.values:
                row = data.sel(output=output)
                gains = f"{row['variance_ratio'].item():.0f} | {row['std_variance_ratio'].item():.2g}"
                print(f"| {coefficient} | {second} | {output} | {gains} |")
    print(f"<!-- {SAMPLES} solves, {time.perf_counter() - begin:.0f} s -->")
