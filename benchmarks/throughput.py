"""Groups of ranks: throughput of two against one, and against two independent processes; memory over many solves."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.beams import CONFIG

SAMPLES = 96
REPEATS = 3


def main() -> None:
    """Print the ratios, run in turn, and the memory of 10⁴ realisations."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_", "PMIX_"))}
    environment |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1", "OMP_NUM_THREADS": "1"}
    program = str(Path(sys.executable).parent / "tissuq")

    def run(folder: Path, samples: int, ranks: int) -> list[str]:
        study = ["run", str(CONFIG), "--quiet", "--set", f"method.samples={samples}", "--out", str(folder)]
        return ["mpirun", "--bind-to", "none", "-n", str(ranks), program, *study]

    def seconds(commands: list[list[str]]) -> float:
        begin = time.perf_counter()
        for process in [subprocess.Popen(command, env=environment) for command in commands]:
            assert process.wait() == 0
        return time.perf_counter() - begin

    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        rows = []
        for i in range(REPEATS):
            start_1, start_2 = (seconds([run(root / f"s{n}-{i}", 2 * n, n)]) for n in (1, 2))
            one = seconds([run(root / f"1-{i}", SAMPLES, 1)]) - start_1
            two = seconds([run(root / f"2-{i}", SAMPLES, 2)]) - start_2
            apart = seconds([run(root / f"a{k}-{i}", SAMPLES // 2, 1) for k in (1, 2)]) - start_1
            rows.append((one / two, one / apart))
        ratios, independent = (sorted(column)[REPEATS // 2] for column in zip(*rows, strict=True))
        print(f"2 groups on 2 cores: {ratios:.2f} times the throughput of 1 (start-up taken off, {SAMPLES} solves)")
        print(f"2 independent processes: {independent:.2f} times")
    print(memory())


def memory(realisations: int = 10_000) -> str:
    """Return the growth of the resident memory over many realisations of a coarse body."""
    import numpy as np
    from mpi4py import MPI

    from workflows.config import load

    study = load(CONFIG.with_name("tiny.toml"), ["model.body.cells=[2, 1, 1]"])
    model = study.model.build(MPI.COMM_SELF, study.inputs.names)
    start = model.solve(study.inputs.mean).state
    sizes = []
    for i in range(realisations):
        model.solve(study.inputs.mean * (1 + 0.01 * np.sin(i)), start).tangent(np.ones(2))
        if i % (realisations // 10) == realisations // 10 - 1:
            sizes.append(resident())
    few, many = realisations // 10, realisations
    return f"memory: {sizes[0]:.1f} MiB after {few:,} realisations, {sizes[-1]:.1f} MiB after {many:,}"


def resident() -> float:
    """Resident memory of this process in MiB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
