"""One realisation: Newton from zero against Newton from the tangent prediction, and what derivatives cost."""

from __future__ import annotations

import time

import numpy as np
from mpi4py import MPI

from benchmarks.beams import beam
from uq.evaluate import SerialEvaluate
from uq.linearisation import linearise
from uq.sampling import random_points

SIZES = {(8, 1, 3): 12, (12, 2, 4): 12, (18, 3, 8): 8}


def main() -> None:
    """Print medians over random draws of the published beam, both ways on the same draws in turn."""
    print("| unknowns | from zero (s) | from prediction (s) | ratio | factorisations | all tangents / solve |")
    print("|---|---|---|---|---|---|")
    for cells, draws in SIZES.items():
        study = beam(cells)
        inputs = study.inputs
        model = study.model.build(MPI.COMM_SELF, inputs.names)
        prediction = linearise(inputs, SerialEvaluate(model)).prediction
        assert prediction is not None
        predict = prediction.on(model)
        cold, warm, derivatives, counts, gap = [], [], [], [], 0.0
        for point in inputs.points(random_points(1, 0, draws, 2)):
            begin = time.perf_counter()
            reference = model.solve(point)
            middle = time.perf_counter()
            solution = model.solve(point, predict(point))
            end = time.perf_counter()
            for direction in np.eye(2):
                solution.tangent(direction)
            derivatives.append((time.perf_counter() - end) / (middle - begin))
            cold.append(middle - begin)
            warm.append(end - middle)
            counts.append((reference.work.factorisations, solution.work.factorisations - 1))
            gap = max(gap, np.abs(reference.state - solution.state).max() / np.abs(reference.state).max())
        zero, predicted = np.median(cold), np.median(warm)
        a, b = np.median(counts, axis=0)
        print(
            f"| {study.model.unknowns:,} | {zero:.3f} | {predicted:.3f} | {np.median(np.divide(cold, warm)):.2f} "
            f"| {a:.0f} against {b:.0f} | {100 * np.median(derivatives):.0f} % |"
        )
        print(f"<!-- largest relative difference of the states {gap:.1e} -->")
