"""The linear model of a body beside the body: processor time of a sample, and how closely its outputs follow."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from mpi4py import MPI

from forward.model import FloatArray
from forward.spec import ModelSpec
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Request
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import random_points
from uq.methods.low_fidelity import FewIterations, Linear
from uq.surrogates.linearisation import linearise
from workflows.config.study import load

CONFIG = Path(__file__).parent.parent / "configs" / "slab.toml"
DRAWS = 256


def main() -> None:
    """Print a row for the slab's body, with and without its test of stability, few iterations of it, and linear ones.

    All samples begin at the tangent's prediction and are solved together. Correlations and errors (root mean squares,
    over the standard deviations of the body) are those of the outputs.
    """
    study = load(CONFIG)
    inputs, body = study.inputs, study.model.over({})
    points = inputs.points(random_points(1, 0, DRAWS, len(inputs.names)))
    untested = body.model_copy(update={"solver": body.solver.model_copy(update={"accept_unstable": True})})
    models: dict[str, tuple[ModelSpec, int | None]] = {
        "the body": (body, None),
        "without the test of stability": (untested, None),
        **{one.label: (untested, one.iterations) for one in (FewIterations(iterations=k) for k in (1, 2))},
        "linear, to its tolerance": (body.linearised(), None),
        "linear, as a cheap model": (Linear().of(body), None),
    }
    known: FloatArray | None = None
    names = [output.name for output in body.outputs]
    print(f"{DRAWS} samples, {body.unknowns:,} unknowns, {len(inputs.names)} parameters\n")
    print(f"| model | ms a sample | correlations: {', '.join(names)} | errors |\n|---|---|---|---|")
    for label, (spec, iterations) in models.items():
        seconds, values = _sampled(spec, inputs, points, iterations)
        known = values if known is None else known
        follows = [np.corrcoef(a, b)[0, 1] for a, b in zip(values.T, known.T, strict=True)]
        errors = np.sqrt(((values - known) ** 2).mean(axis=0)) / known.std(axis=0)
        told = (", ".join(f"{x:.{digits}f}" for x in of) for of, digits in ((follows, 4), (errors, 3)))
        print(f"| {label} | {1e3 * seconds:.3g} | {' | '.join(told)} |", flush=True)


def _sampled(spec: ModelSpec, inputs: Inputs, points: FloatArray, iterations: int | None) -> tuple[float, FloatArray]:
    """Return the processor time (s) of a sample, and the outputs (n, m); forms are compiled before."""
    evaluate = SerialEvaluate(spec.build(MPI.COMM_SELF, inputs.names))
    start = linearise(inputs, evaluate).prediction

    def ask(some: FloatArray) -> FloatArray:
        return np.asarray(evaluate(Request(some, start=start, iterations=iterations)).outputs)

    ask(points[:4])
    begin = time.process_time()
    values = ask(points)
    return (time.process_time() - begin) / len(points), values
