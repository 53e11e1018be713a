"""What estimates cost: fits of many parameters, comparisons of quick functions, and indices not asked for."""

from __future__ import annotations

import resource
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import numpy as np

from forward.model import FloatArray
from forward.pointwise import FunctionModel
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.methods.compare import Compare
from uq.methods.derivative_based import DerivativeBased
from uq.methods.method import METHODS  # noqa: F401, the methods that a comparison names
from uq.surrogates.basis import DICTIONARY, candidates_of, orthonormal
from uq.surrogates.least_squares import Data, fit_best

SAMPLES = 200  # values of a fit
UNIT = Uniform(lower=0.0, upper=1.0)
BUDGETS, REPEATS = (1024, 4096), 8


def _inputs(d: int) -> Inputs:
    return Inputs({f"x{i}": UNIT for i in range(d)})


def _smooth(x: FloatArray) -> FloatArray:
    """Return a function (n,) in which parameters matter less and less, and some act together."""
    return np.asarray(np.exp(x @ (1 / (1 + np.arange(x.shape[1])))) + x[:, 0] * x[:, -1])


def _memory() -> float:
    """Peak of this process in MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _expansion(d: int, *, gradients: bool) -> tuple[int, float, float, float, float]:
    """Functions to choose from; processor time (s) of finding them, and memory (MiB) for that; the same of a fit."""
    inputs = _inputs(d)
    points = inputs.points(sobol_points(0, 0, 0, SAMPLES, d))
    slopes = np.stack([(_smooth(points + 1e-20j * e).imag / 1e-20) for e in np.eye(d)], axis=1) if gradients else None
    data = Data.at(points, _smooth(points)[:, None], None if slopes is None else slopes[:, None, :], inputs)
    orthonormal(inputs, np.eye(d, dtype=np.int64))  # imports and tables
    before, begin = _memory(), time.process_time()
    bases = candidates_of(inputs, 6, SAMPLES * (1 + d if gradients else 1), DICTIONARY)
    found, memory = time.process_time() - begin, _memory() - before
    fit_best(bases, data)
    return len(bases.basis.indices), found, memory, time.process_time() - begin, _memory() - before


def _alone(function: Any, *arguments: Any, **settings: Any) -> Any:
    """Call a function in a process of its own, whose peak of memory is its own."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments, **settings).result()


def _comparison() -> tuple[float, int]:
    """Processor time (s) that a comparison adds to each evaluation of a function of microseconds, and their number."""
    inputs = _inputs(4)
    weights = np.arange(1.0, 5.0)
    calls = 0

    def value(p: FloatArray) -> float:
        nonlocal calls
        calls += 1
        return float(weights @ p)

    model = FunctionModel(value, inputs.names, ("f",), lambda p: weights[None, :])
    points = inputs.points(sobol_points(0, 0, 0, 4096, 4))
    begin = time.process_time()
    for point in points:
        value(point)
    alone, calls = (time.process_time() - begin) / len(points), 0
    methods = ({"kind": "monte-carlo", "budgets": BUDGETS}, {"kind": "quasi-monte-carlo", "budgets": BUDGETS})
    block = {
        "methods": methods,
        "reference": {"kind": "given", "values": {"f": {"mean": 5.0, "std": (30 / 12) ** 0.5}}},
        "textbook": 0,
        "repeats": REPEATS,
    }
    begin = time.process_time()
    Compare.model_validate(block).run(inputs, SerialEvaluate(model))
    return (time.process_time() - begin) / calls - alone, calls


def _derivatives(indices: bool | None) -> tuple[float, bool]:
    """Processor time (s) of bounds by derivatives of 30 parameters, and whether indices come with them."""
    inputs = _inputs(30)
    weights = 1 / (1 + np.arange(30.0))

    def value(p: FloatArray) -> FloatArray:
        return np.asarray(np.exp(weights @ p))

    model = FunctionModel(value, inputs.names, ("f",), lambda p: value(p) * weights[None, :])
    begin = time.process_time()
    found = DerivativeBased(samples=128, fields=False, indices=indices).run(inputs, SerialEvaluate(model))
    return time.process_time() - begin, "sobol_total" in found


def main() -> None:
    """Print the three tables."""
    print("| parameters | functions | candidates: CPU (s), MiB | with a fit to 200 values | and to their gradients |")
    print("|---|---|---|---|---|")
    for d in (10, 30, 50, 100):
        functions, found, memory, fit, most = _alone(_expansion, d, gradients=False)
        *_, sloped, largest = _alone(_expansion, d, gradients=True)
        told = f"{found:.2f}, {memory:.0f} | {fit:.2f}, {most:.0f} | {sloped:.1f}, {largest:.0f}"
        print(f"| {d} | {functions} | {told} |", flush=True)
    added, count = _comparison()
    print(f"\nA comparison adds {1e3 * added:.3f} ms to each of {count} evaluations of a quick function.\n")
    for name, indices in (("by default", None), ("with indices", True)):
        seconds, there = _derivatives(indices)
        print(f"Bounds by derivatives, 30 parameters, {name}: {seconds:.2f} s of CPU, indices: {there}", flush=True)
