"""Realisations of a body with 10⁵ unknowns and a random field, on ranks that share the model: memory stays flat."""

from __future__ import annotations

import os
import subprocess
import sys

from benchmarks.beams import CONFIG

REALISATIONS = 200
RANKS = 2  # that share the one model
CELLS = (42, 6, 15)
SCRIPT = """
import sys, time
import numpy as np
from mpi4py import MPI
from benchmarks.beams import field_beam
from benchmarks.throughput import resident
from uq.evaluation.ensemble import Ensemble
from uq.evaluation.request import Request
from uq.surrogates.linearisation import linearise
from uq.methods.monte_carlo import _JointMoments
from uq.inputs.sampling import random_points

world = MPI.COMM_WORLD
realisations, cells = int(sys.argv[1]), tuple(map(int, sys.argv[2].split(",")))
study = field_beam(cells)
inputs = study.inputs
ensemble = Ensemble.split(world, world.size)
model = study.model.build(ensemble.group, inputs.names)
built = world.allreduce(resident())
after = []

def progress(done, failed):
    after.extend([resident()] * done)

def task(evaluate):
    centre = linearise(inputs, evaluate)
    points = inputs.points(random_points(1, 0, realisations, len(inputs.names)))
    fields = _JointMoments(centre.point, centre.state, centre.slopes)
    after.clear()
    begin = time.perf_counter()
    found = evaluate(Request(points, fields=fields, start=centre.prediction))
    seconds = time.perf_counter() - begin
    marks = sorted({max(1, realisations * part // 4) for part in (1, 2, 4)})
    print(f"{study.model.unknowns:,} unknowns, {len(inputs.names)} modes, {world.size} ranks for one model: "
          f"{seconds / realisations:.2f} s and {found.work[:, 0].mean():.1f} residuals a realisation, "
          f"{len(found.failures)} failed")
    for n in marks:
        print(f"memory of rank 0 after {n} realisations: {after[n - 1]:.0f} MiB")
    print(f"of which the sums over the fields: {14 * 8 * centre.state.size / 2**20:.0f} MiB")

ensemble.run(model, task, progress=progress)
last = world.allreduce(resident())
if world.rank == 0:
    print(f"memory of all ranks: {built:.0f} MiB before the first solve, {last:.0f} MiB at the end")
"""


def main(realisations: int = REALISATIONS, cells: tuple[int, int, int] = CELLS, ranks: int = RANKS) -> None:
    """Print the memory after a quarter, half and all of the realisations."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_", "PMIX_"))}
    environment |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1", "OMP_NUM_THREADS": "1"}
    program = [sys.executable, "-c", SCRIPT, str(realisations), ",".join(map(str, cells))]
    command = ["mpirun", "--bind-to", "none", "--oversubscribe", "-n", str(ranks), *program]
    print(
        subprocess.run(
            command, env=environment, stdout=subprocess.PIPE, text=True, cwd=CONFIG.parent.parent, check=True
        ).stdout,
        end="",
    )
