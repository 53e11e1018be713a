"""Start-up of many ranks on few cores: imports, forms of the beam and its first solve; empty and full cache."""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence

from benchmarks.beams import CONFIG

SCRIPT = """
import json, os, sys, time
begin = float(os.environ["BEGIN"])
from mpi4py import MPI
from benchmarks.beams import beam
imported = time.time() - begin
study = beam(json.loads(sys.argv[1]))
model = study.model.build(MPI.COMM_SELF, study.inputs.names)
built = time.time() - begin
model.solve(study.inputs.mean).tangent([1.0, 1.0])
solved = time.time() - begin
share = next(line for line in open("/proc/self/smaps_rollup") if line.startswith("Pss:"))
found = MPI.COMM_WORLD.gather((imported, built, solved, int(share.split()[1])))
if found:
    *times, memory = zip(*found)
    print(*map(max, times), sum(memory))
"""


def main(words: Sequence[str] = ()) -> None:
    """Print wall-clock times until the last rank is there, and processor time and memory of all ranks."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks startup")
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 16])
    parser.add_argument("--cells", type=int, nargs=3, default=[12, 2, 4], help="of the beam")
    parser.add_argument("--cache", nargs="+", choices=("empty", "full"), default=["empty", "full"])
    given = parser.parse_args(words)
    print("| ranks | cache | imported (s) | forms ready (s) | first solve (s) | processor time (s) | memory (GiB) |")
    print("|---|---|---|---|---|---|---|")
    for ranks in given.ranks:
        with tempfile.TemporaryDirectory() as cache:
            if "empty" not in given.cache:
                _times(1, given.cells, cache)
            for state in given.cache:
                print(f"| {ranks} | {state} | {_times(ranks, given.cells, cache)} |", flush=True)


def _times(ranks: int, cells: list[int], cache: str) -> str:
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_", "PMIX_"))}
    environment |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1", "OMP_NUM_THREADS": "1"}
    environment |= {"OMPI_MCA_mpi_yield_when_idle": "1", "XDG_CACHE_HOME": cache, "BEGIN": str(time.time())}
    command = ["mpirun", "--oversubscribe", "--bind-to", "none", "-n", str(ranks), sys.executable, "-c", SCRIPT]
    command.append(json.dumps(cells))
    before = _processor()
    done = subprocess.run(
        command, env=environment, stdout=subprocess.PIPE, text=True, cwd=CONFIG.parent.parent, check=True
    )
    *times, memory = (float(value) for value in done.stdout.split())
    return " | ".join(f"{value:.0f}" for value in (*times, _processor() - before)) + f" | {memory / 2**20:.1f}"


def _processor() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
