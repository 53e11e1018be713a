"""Random fields: the Matérn sampler against its closed form, and what a mean costs where the stiffness is a field."""

from __future__ import annotations

import time

import numpy as np
from mpi4py import MPI

from benchmarks.beams import field_beam
from forward.fields import ROBIN, Matern, Smoothness, correlation
from forward.geometry import Box
from uq.chaos import Chaos
from uq.evaluate import SerialEvaluate
from uq.monte_carlo import MonteCarlo, SensitivityMonteCarlo
from uq.quasi_monte_carlo import QuasiMonteCarlo

LENGTH = 0.4  # of the field on the unit cube
OUTPUT = "uy"
SAMPLES = 256


def main() -> None:
    """Print both."""
    sampler()
    mean()


def sampler() -> None:
    """Print variance (before it is set to one) and correlations of the field on the unit cube."""
    print("| smoothness | boundary | cells | variance at centre | at a face | at a corner | error of correlations |")
    print("|---|---|---|---|---|---|---|")
    smoothnesses: tuple[Smoothness, ...] = (2, 4)
    for smoothness in smoothnesses:
        for name, robin in (("Robin", ROBIN), ("Neumann", 0.0)):
            for n in (8, 16):
                body = Box(size=(1.0, 1.0, 1.0), cells=(n, n, n), degree=1)
                matern = Matern.on(body, LENGTH, smoothness, robin)
                places = np.stack(np.meshgrid(*3 * [np.linspace(0, 1, n + 1)], indexing="ij"), axis=-1).reshape(-1, 3)
                centre, face = (int(np.abs(places - p).sum(axis=1).argmin()) for p in ([0.5] * 3, [0, 0.5, 0.5]))
                row = matern.covariance(np.eye(len(places))[centre])
                distance = np.linalg.norm(places - 0.5, axis=1)
                near = distance <= LENGTH
                error = np.abs(row - correlation(distance, LENGTH, smoothness))[near].max()
                variance = matern.inflation
                shown = " | ".join(f"{variance[i]:.2f}" for i in (centre, face, 0))
                print(f"| {smoothness} | {name} | {n}³ | {shown} | {error:.3f} |", flush=True)


def mean() -> None:
    """Print the error of a mean by each method, and its gain over plain sampling with as many solves."""
    study = field_beam((12, 2, 4))
    inputs = study.inputs
    model = study.model.build(MPI.COMM_SELF, inputs.names)
    evaluate = SerialEvaluate(model)
    methods = {
        "Monte Carlo": MonteCarlo(samples=SAMPLES, seed=1, fields=False),
        "sensitivity Monte Carlo": SensitivityMonteCarlo(samples=SAMPLES, seed=1, fields=False),
        "quasi-Monte Carlo, tangent": QuasiMonteCarlo(samples=SAMPLES, seed=1, fields=False),
        "quasi-Monte Carlo, quadratic": QuasiMonteCarlo(samples=SAMPLES, seed=1, fields=False, control="quadratic"),
        "chaos": Chaos(samples=64, seed=1, fields=False, max_order=4),
    }
    print(
        f"\n{len(inputs.names)} modes keep {100 * model.variance_kept['stiffness']:.0f} % of the variance of the field."
    )
    print(
        f"\n| method | solves | CPU time (s) | mean of {OUTPUT} (m) | error | variance ratio to MC of as many solves |"
    )
    print("|---|---|---|---|---|---|")
    variance = None
    for name, method in methods.items():
        begin = time.process_time()
        found = method.run(inputs, evaluate).sel(output=OUTPUT)
        seconds, solves = time.process_time() - begin, method.planned(len(inputs.names))
        variance = variance or float(found["std"]) ** 2
        error = float(found["mean_error"])
        gain = variance / solves / error**2
        print(
            f"| {name} | {solves} | {seconds:.1f} | {float(found['mean']):.6f} | {error:.1e} | {gain:.3g} |", flush=True
        )
