"""Groups of ranks: throughput of two against one, and against two independent processes; memory over many solves."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.beams import CONFIG

SAMPLES = 512
REPEATS = 3
SCRIPT = """
import sys, time
from mpi4py import MPI
from benchmarks.beams import beam
from uq.evaluation.ensemble import Ensemble
from uq.evaluation.request import Request
from uq.surrogates.linearisation import linearise
from uq.inputs.sampling import random_points

study = beam((12, 2, 4))
inputs = study.inputs
ensemble = Ensemble.split(MPI.COMM_WORLD)
model = study.model.build(ensemble.group, inputs.names)

def task(evaluate):
    points = inputs.points(random_points(1, 0, int(sys.argv[1]), 2))
    start = linearise(inputs, evaluate).prediction
    evaluate(Request(points[:8], start=start))  # every group factorises the reference
    begin = time.perf_counter()
    evaluate(Request(points, start=start))
    print(time.perf_counter() - begin)

ensemble.run(model, task)
"""


def main(words: Sequence[str] = ()) -> None:
    """Print the ratios, measured in turn without start-up, and the memory of many realisations; or the memory only."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks throughput")
    parser.add_argument("--memory", type=int, metavar="N", help="only the memory, of so many realisations")
    given = parser.parse_args(words)
    if given.memory is not None:
        print(memory(given.memory))
        return
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_", "PMIX_"))}
    environment |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1", "OMP_NUM_THREADS": "1"}

    def seconds(ranks: int, samples: int, processes: int = 1) -> float:
        program = [sys.executable, "-c", SCRIPT, str(samples)]
        command = ["mpirun", "--bind-to", "none", "-n", str(ranks), *program]
        started = [
            subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True, cwd=CONFIG.parent.parent)
            for _ in range(processes)
        ]
        return max(float(process.communicate()[0]) for process in started)

    rows = []
    for _ in range(REPEATS):
        one, two, apart = seconds(1, SAMPLES), seconds(2, SAMPLES), seconds(1, SAMPLES // 2, processes=2)
        rows.append((one / two, one / apart))
    groups, independent = (sorted(column)[REPEATS // 2] for column in zip(*rows, strict=True))
    print(f"2 groups on 2 cores: {groups:.2f} times the throughput of 1 ({SAMPLES} solves, median of {REPEATS})")
    print(f"2 independent processes: {independent:.2f} times")
    print(memory())


def memory(realisations: int = 10_000) -> str:
    """Say how the resident memory grows over many realisations of a coarse body, one by one and in lockstep."""
    few = realisations // 10
    lines = [
        f"memory, {how}: {sizes[0]:.1f} MiB after {few:,} realisations, {sizes[-1]:.1f} MiB after {realisations:,}"
        for how, sizes in (("one by one", memory_over(realisations)), ("in lockstep", memory_together(realisations)))
    ]
    return "\n".join(lines)


def memory_over(realisations: int) -> list[float]:
    """Return the resident memory (MiB) after each tenth of many realisations with tangents, corrected and by Newton."""
    import numpy as np

    model, inputs, prediction = _coarse()
    guess = prediction.on(model)
    sizes = []
    for i in range(realisations):
        point = inputs.mean * (1 + 0.01 * np.sin(i))
        model.solve(point, replace(guess(point), reference=None) if i % 4 == 0 else guess(point)).tangent(np.ones(2))
        if i % (realisations // 10) == realisations // 10 - 1:
            sizes.append(resident())
    return sizes


def memory_together(realisations: int) -> list[float]:
    """Return the resident memory (MiB) after each tenth of many realisations as studies solve them, in lockstep."""
    from uq.evaluation.evaluate import SerialEvaluate
    from uq.evaluation.request import Request
    from uq.inputs.sampling import random_points

    model, inputs, prediction = _coarse()
    sizes, each = [], realisations // 10
    for tenth in range(10):
        points = inputs.points(random_points(1, tenth * each, (tenth + 1) * each, 2))
        SerialEvaluate(model)(Request(points, start=prediction))
        sizes.append(resident())
    return sizes


def _coarse() -> tuple[Any, Any, Any]:
    """A body of two cells, its inputs, and the tangent at their mean."""
    from mpi4py import MPI

    from uq.evaluation.evaluate import SerialEvaluate
    from uq.surrogates.linearisation import linearise
    from workflows.config.study import load

    study = load(CONFIG.with_name("tiny.toml"), ["model.body.cells=[2, 1, 1]"])
    model = study.model.build(MPI.COMM_SELF, study.inputs.names)
    prediction = linearise(study.inputs, SerialEvaluate(model)).prediction
    assert prediction is not None
    return model, study.inputs, prediction


def resident() -> float:
    """Resident memory of this process in MiB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
