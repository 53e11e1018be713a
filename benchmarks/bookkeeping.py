"""What the machinery costs per realisation, for a model that costs nothing."""

from __future__ import annotations

import time

import numpy as np

from forward.pointwise import FunctionModel
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods.monte_carlo import SensitivityMonteCarlo

SAMPLES = 100_000


def main() -> None:
    """Print microseconds per realisation of a sensitivity Monte Carlo study, all included."""
    inputs = Inputs({name: Uniform(lower=0.0, upper=1.0) for name in "abcd"})
    ones = np.ones((1, 4))
    model = FunctionModel(lambda p: p.sum(), inputs.names, ("sum",), lambda p: ones)
    begin = time.perf_counter()
    SensitivityMonteCarlo(samples=SAMPLES).run(inputs, SerialEvaluate(model))
    print(f"{1e6 * (time.perf_counter() - begin) / SAMPLES:.1f} µs per realisation ({SAMPLES:,} realisations)")
