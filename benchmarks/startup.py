"""Start-up of many ranks on few cores: imports, forms of the beam and its first solve; empty and full cache."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time

from benchmarks.beams import CONFIG

RANKS = 16
SCRIPT = """
import os, time
begin = float(os.environ["BEGIN"])
from mpi4py import MPI
from benchmarks.beams import beam
imported = time.time() - begin
study = beam((12, 2, 4))
model = study.model.build(MPI.COMM_SELF, study.inputs.names)
built = time.time() - begin
model.solve(study.inputs.mean).tangent([1.0, 1.0])
times = MPI.COMM_WORLD.gather((imported, built, time.time() - begin))
if times:
    print(*(max(column) for column in zip(*times)))
"""


def main() -> None:
    """Print wall-clock times until the last rank is there, and processor time of all ranks."""
    print("| ranks | cache | imported (s) | forms ready (s) | first solve (s) | processor time (s) |")
    print("|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as cache:
        for ranks, state in ((1, "empty"), (1, "full")):
            _row(ranks, state, cache)
    with tempfile.TemporaryDirectory() as cache:
        for ranks, state in ((RANKS, "empty"), (RANKS, "full")):
            _row(ranks, state, cache)


def _row(ranks: int, state: str, cache: str) -> None:
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_", "PMIX_"))}
    environment |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1", "OMP_NUM_THREADS": "1"}
    environment |= {"OMPI_MCA_mpi_yield_when_idle": "1", "XDG_CACHE_HOME": cache, "BEGIN": str(time.time())}
    command = ["mpirun", "--oversubscribe", "--bind-to", "none", "-n", str(ranks), sys.executable, "-c", SCRIPT]
    before = _processor()
    done = subprocess.run(
        command, env=environment, stdout=subprocess.PIPE, text=True, cwd=CONFIG.parent.parent, check=True
    )
    times = " | ".join(f"{float(value):.0f}" for value in done.stdout.split())
    print(f"| {ranks} | {state} | {times} | {_processor() - before:.0f} |", flush=True)


def _processor() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
