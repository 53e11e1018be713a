"""Random fields: the Matérn sampler against its closed form, and what a mean costs where the stiffness is a field."""

from __future__ import annotations

import time

import numpy as np
from mpi4py import MPI

from benchmarks.beams import field_beam
from forward.bodies.geometry import Box
from forward.bodies.random_fields import ROBIN, Matern, Smoothness
from tests.matern import correlation, inflation
from uq.evaluation.evaluate import SerialEvaluate
from uq.methods.chaos import Chaos
from uq.methods.monte_carlo import MonteCarlo, SensitivityMonteCarlo
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo

LENGTH = 0.4  # of the field on the unit cube
OUTPUT = "uy"
SAMPLES = 256


def main() -> None:
    """Print both."""
    sampler()
    mean()


def sampler() -> None:
    """Print variance (before it is set to one) and correlations of the field on the unit cube and on the thin beam."""
    bodies = {f"cube, {n}³": (Box(size=(1.0, 1.0, 1.0), cells=(n, n, n), degree=1), LENGTH) for n in (8, 16)}
    bodies["beam, 12 × 2 × 4"] = (Box(size=(0.28, 0.0215, 0.087), cells=(12, 2, 4), degree=1), 0.1)
    print("| smoothness | boundary | body | variance at centre | at an end | at a corner | error of correlations |")
    print("|---|---|---|---|---|---|---|")
    smoothnesses: tuple[Smoothness, ...] = (2, 4)
    for smoothness in smoothnesses:
        for condition, robin in (("Robin", ROBIN), ("Neumann", 0.0)):
            for name, (body, length) in bodies.items():
                matern = Matern.on(body, length, smoothness, robin)
                lines = [np.linspace(0, edge, n + 1) for edge, n in zip(body.size, body.cells, strict=True)]
                places = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
                middle = np.array(body.size) / 2
                centre, end = (int(np.abs(places - p).sum(axis=1).argmin()) for p in (middle, middle * [0, 1, 1]))
                row = matern.covariance(np.eye(len(places))[centre])
                distance = np.linalg.norm(places - middle, axis=1)
                near = distance <= length
                error = np.abs(row - correlation(distance, length, smoothness))[near].max()
                variances = inflation(matern, length, smoothness)
                shown = " | ".join(f"{variances[i]:.2f}" for i in (centre, end, 0))
                print(f"| {smoothness} | {condition} | {name} | {shown} | {error:.3f} |", flush=True)


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
    kept = 100 * model.space.variance_kept["stiffness"]
    print(f"\n{len(inputs.names)} modes keep {kept:.0f} % of the variance of the field.")
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
