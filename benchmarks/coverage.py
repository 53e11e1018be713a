"""How often 95 % intervals contain the truth: every method on the published beam, with a small mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
from mpi4py import MPI
from scipy import stats

from benchmarks.beams import CONFIG
from forward.model import FloatArray
from uq.basis import gauss
from uq.chaos import Chaos
from uq.evaluate import Evaluations, Request, SerialEvaluate
from uq.inputs import Inputs
from uq.monte_carlo import MonteCarlo, SensitivityMonteCarlo
from uq.quasi_monte_carlo import QuasiMonteCarlo
from workflows.config import load

REPEATS = 200
GAUSS = 6  # points for each parameter, of which the mean and the standard deviation hold to 1e-9
SCRAMBLES = 16
METHODS: dict[str, tuple[Any, int]] = {  # with the degrees of freedom of its errors, 0 where it claims normal ones
    "monte-carlo": (MonteCarlo(samples=64, fields=False), 0),
    "sensitivity-monte-carlo, one": (SensitivityMonteCarlo(samples=64, fields=False), 0),
    "sensitivity-monte-carlo, optimal": (SensitivityMonteCarlo(samples=64, fields=False, coefficient="optimal"), 0),
    **{
        f"quasi-monte-carlo, {control}": (
            QuasiMonteCarlo(samples=64, scrambles=SCRAMBLES, fields=False, control=control),
            SCRAMBLES - 1,
        )
        for control in ("none", "tangent", "quadratic")
    },
    "chaos, gradients": (Chaos(samples=8, fields=False), 0),
    "chaos": (Chaos(samples=20, gradients=False, fields=False), 0),
}


class Started:
    """An evaluation that solves at the mean parameters once."""

    def __init__(self, evaluate: SerialEvaluate, centre: FloatArray) -> None:
        self._evaluate, self._centre = evaluate, centre
        self._known: Evaluations | None = None
        self.parameters, self.outputs = evaluate.parameters, evaluate.outputs
        self.differentiable, self.displacements = evaluate.differentiable, evaluate.displacements

    def __call__(self, request: Request) -> Evaluations:
        """Evaluate, or remember."""
        if not (len(request.points) == 1 and (request.points[0] == self._centre).all()):
            return self._evaluate(request)
        if self._known is None:
            self._known = self._evaluate(request)
        return self._known


def truth(inputs: Inputs, evaluate: SerialEvaluate, count: int) -> tuple[FloatArray, FloatArray]:
    """Return mean and standard deviation (m,) of the outputs by a tensor product of Gauss rules."""
    points, weights = gauss(inputs, count)
    values = evaluate(Request(points)).outputs
    mean = weights @ values
    return mean, np.sqrt(weights @ (values - mean) ** 2)


def main() -> None:
    """Print the share of repeats in which the intervals contain the truth, and the claim over the actual error."""
    study = load(CONFIG.with_name("tiny.toml"), ["model.body.cells=[2, 1, 1]"])
    inputs = study.inputs
    evaluate = SerialEvaluate(study.model.build(MPI.COMM_SELF, inputs.names))
    exact = dict(zip(("mean", "std"), truth(inputs, evaluate, GAUSS), strict=True))
    started = Started(evaluate, inputs.mean)
    print(f"{REPEATS} repeats\n\n| method | output | mean (%) | std (%) | claimed over actual: mean | std |")
    print("|---|---|---|---|---|---|")
    for name, (method, freedom) in METHODS.items():
        runs = [method.model_copy(update={"seed": seed}).run(inputs, started) for seed in range(REPEATS)]
        factor = stats.t.ppf(0.975, freedom) if freedom else stats.norm.ppf(0.975)
        columns = []
        for quantity, value in exact.items():
            errors = np.array([data[quantity].to_numpy() for data in runs]) - value
            claims = np.array([data[f"{quantity}_error"].to_numpy() for data in runs])
            hits = (np.abs(errors) <= factor * claims).mean(axis=0)
            columns.append((hits, np.sqrt((claims**2).mean(axis=0) / (errors**2).mean(axis=0))))
        (mean, claim), (std, std_claim) = columns
        for i, output in enumerate(evaluate.outputs):
            shares = f"{100 * mean[i]:.1f} | {100 * std[i]:.1f}"
            print(f"| {name} | {output} | {shares} | {claim[i]:.2f} | {std_claim[i]:.2f} |", flush=True)
