"""Efficiency on many ranks: constants and solve times are measured here, the ranks are simulated.

The simulation gives the next block to the group that is free first, as the counter does. What is serial is the time of
rank 0: keys of the blocks before they begin, one service of the counter for each block, one reception and one addition
to the sums. Files are written by the groups themselves, side by side.
"""

from __future__ import annotations

import argparse
import heapq
import os
import pickle
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.beams import CONFIG, beam
from uq.evaluation.request import FieldSum

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from forward.model import FloatArray, ForwardModel, Solution
    from uq.evaluation.request import Evaluations

ROOT = CONFIG.parent.parent
PICTURE = ROOT / "docs" / "scaling.png"
SOLVES = 150  # that are measured
EACH = 128  # samples for each group, in the table
GROUPS = (1, 10, 100, 1_000, 10_000, 100_000)
SCRIPT = """
import sys, time
import numpy as np
from mpi4py import MPI
from forward.pointwise import FunctionModel
from uq.evaluation.ensemble import Ensemble
from uq.evaluation.work_queue import Counter
from uq.evaluation.request import Request

mode, world = sys.argv[1], MPI.COMM_WORLD
if mode == "counter":
    with Counter(world) as counter:
        world.barrier()
        times = []
        for _ in range(100 if world.rank == world.size - 1 else 0):
            begin = time.perf_counter()
            for _ in range(50):
                counter.take()
            times.append((time.perf_counter() - begin) / 50)
        if times:
            print(np.quantile(times, 0.1))
        world.barrier()
else:
    durations = np.load(sys.argv[2])
    wait = lambda p: (time.sleep(durations[int(p[0])]), p)[1]
    model = FunctionModel(wait, ("a",), ("f",))
    def task(evaluate):
        evaluate(Request(np.zeros((world.size, 1))))
        begin = time.perf_counter()
        evaluate(Request(np.arange(len(durations), dtype=float)[:, None]))
        print(time.perf_counter() - begin)
    Ensemble.split(world).run(model, task, blocks=int(sys.argv[3]))
"""


@dataclass(frozen=True)
class Constants:
    """Times (s): of one take from the counter, of a block's key, file, and reception with addition; of the reference.

    The last is how long each group prepares before its first sample, in mean solves.
    """

    take: float
    key: float
    file: float
    merge: float
    reference: float


def main(words: Sequence[str] = ()) -> None:
    """Print the constants, the check of the simulation by a real run, and the table; draw the picture."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks scaling")
    parser.add_argument(
        "--take", type=float, help="of the counter (s), as measured on a quiet machine or on another one"
    )
    parser.add_argument("--file", type=float, help="of a block (s), likewise")
    given = parser.parse_args(words)
    constants, short, wide = measured()
    constants = replace(constants, take=given.take or constants.take, file=given.file or constants.file)
    print(f"counter {constants.take * 1e6:.1f} µs; each block: key {constants.key * 1e3:.2f} ms, ", end="")
    print(f"file {constants.file * 1e3:.1f} ms, reception and sum {constants.merge * 1e3:.2f} ms; ", end="")
    print(f"reference {constants.reference:.1f} solves")
    for name, times in (("near the mean", short), ("wide inputs", wide)):
        print(f"solves {name}: mean {times.mean():.4f} s, spread {times.std() / times.mean():.2f} of it, ", end="")
        print(f"slowest of {len(times)} {times.max() / times.mean():.1f} times it")
    check(constants, wide / wide.mean() * 0.05)
    curves = table(constants, wide / wide.mean())
    draw(curves)


def measured() -> tuple[Constants, FloatArray, FloatArray]:
    """Measure the constants on the published beam, and times of its solves with the inputs as published and wide."""
    from mpi4py import MPI

    from uq.evaluation.block import Merger
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.evaluate import SerialEvaluate
    from uq.evaluation.request import Request
    from uq.inputs.sampling import random_points
    from uq.surrogates.linearisation import linearise
    from workflows.config.study import load
    from workflows.studies.sampling import Study

    times = []
    for study in (beam((12, 2, 4)), load(CONFIG.with_name("beam-wide.toml"))):
        assert isinstance(study, Study)
        model = study.model.build(MPI.COMM_SELF, study.inputs.names)
        evaluate = SerialEvaluate(model)
        start = linearise(study.inputs, evaluate).prediction
        begin = time.process_time()
        linearise(study.inputs, evaluate)  # forms are at hand
        reference = time.process_time() - begin
        points = study.inputs.points(random_points(1, 0, SOLVES, len(study.inputs.names)))
        evaluate(Request(points[:2], start=start))  # factorises the reference
        request = Request(points, start=start, fields=_Moments())
        found = evaluate(request)
        times.append(found.seconds)
        if len(times) == 1:
            preparing = reference / found.seconds.mean()
            block = replace(request, points=points[:8])
            solved = evaluate(block)
    with tempfile.TemporaryDirectory(dir=ROOT) as folder:
        checkpoint = Checkpoint(Path(folder), "scaling")
        key = _seconds(lambda: checkpoint.key(block))
        file = _seconds(lambda: checkpoint.save("block", solved))
    merger = Merger(request.fields)
    merge = _seconds(lambda: merger.add(_sent(solved)))
    return Constants(float(_ranks(4, "counter")), key, file, merge, preparing), times[0], times[1]


@dataclass(frozen=True)
class _Moments(FieldSum):
    """Sums of a displacement field and of its squares."""

    def on(self, model: ForwardModel) -> Callable[[Solution, FloatArray], FloatArray]:
        """Return the terms of a realisation."""
        return lambda solution, parameters: np.array([solution.state, solution.state**2])


def _sent(block: Evaluations) -> Evaluations:
    """Return what arrives of a block that is sent to rank 0."""
    return pickle.loads(pickle.dumps(block, protocol=5))  # type: ignore[no-any-return]


def _seconds(call: Callable[[], object], repeats: int = 50) -> float:
    """Return the time that a tenth of the calls stays below: others may be delayed by other jobs of the machine."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return float(np.quantile(times, 0.1))


def _ranks(ranks: int, *arguments: str) -> str:
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_", "PMIX_"))}
    environment |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1", "OMP_NUM_THREADS": "1"}
    environment |= {"OMPI_MCA_mpi_yield_when_idle": "1"}
    command = ["mpirun", "--oversubscribe", "--bind-to", "none", "-n", str(ranks), sys.executable, "-c", SCRIPT]
    command += arguments
    return subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, cwd=ROOT, check=True).stdout


def simulated(durations: FloatArray, groups: int, blocks: int, constants: Constants, latency: float = 0.0) -> float:
    """Seconds from the request until rank 0 has its answer.

    Parameters
    ----------
    durations
        Seconds (n,) of the solves, in their order.
    groups
        Groups of ranks.
    blocks
        Most blocks that the solves are cut into.
    constants
        Measured times.
    latency
        Longest time that rank 0 may leave the counter of the others alone: as long as a solve, where the network needs
        its help.
    """
    size = -(-len(durations) // blocks)
    edges = np.arange(0, len(durations), size)
    work = (np.add.reduceat(durations, edges) + constants.file).tolist()
    wait = (np.random.default_rng(0).random(len(edges)) * latency * (1 - 1 / groups)).tolist()
    free = [constants.key * len(edges) + constants.reference * float(durations.mean())] * groups
    counter, ends = 0.0, []
    for seconds, unheard in zip(work, wait, strict=True):
        counter = max(counter, free[0]) + constants.take
        ends.append(counter + unheard + seconds)
        heapq.heapreplace(free, ends[-1])
    added = 0.0
    for end in sorted(ends):
        added = max(added, end) + constants.merge
    return added


def check(constants: Constants, durations: FloatArray, ranks: int = 16) -> None:
    """Print what a real run with solves that only sleep takes beside its simulation."""
    durations = np.tile(durations, 3)
    alone = replace(constants, key=0.0, file=0.0, reference=0.0)
    with tempfile.TemporaryDirectory() as folder:
        np.save(Path(folder) / "durations.npy", durations)
        for blocks in (32, 128):
            real = float(_ranks(ranks, "sleep", f"{folder}/durations.npy", str(blocks)))
            expected = simulated(durations, ranks, blocks, alone)
            print(f"{ranks} ranks that sleep, {blocks} blocks: {real:.2f} s, simulated {expected:.2f} s")


def table(constants: Constants, shape: FloatArray) -> dict[str, list[tuple[int, float]]]:
    """Print efficiencies of samples in proportion to the groups; return them by what the lines of the picture say."""
    random = np.random.default_rng(0)
    draws = random.choice(shape, EACH * max(GROUPS))
    settings: dict[str, Callable[[int], int]] = {
        "128 blocks": lambda groups: 128,
        "4 blocks a group": lambda groups: max(128, 4 * groups),
        "8 blocks a group": lambda groups: max(128, 8 * groups),
    }
    curves: dict[str, list[tuple[int, float]]] = {}
    for mean in (0.025, 1.0, 60.0):
        for name, blocks in settings.items():
            for latency in (0.0, 1.0) if name.startswith("8") else (0.0,):
                rows = []
                for groups in GROUPS:
                    durations = mean * draws[: EACH * groups]
                    seconds = simulated(durations, groups, blocks(groups), constants, latency * mean)
                    rows.append((groups, float(durations.sum() / groups / seconds)))
                curves[f"{mean:g} s, {name}" + (", software counter" if latency else "")] = rows
    print(f"\n| solve, blocks | {' | '.join(f'{groups:,}' for groups in GROUPS)} |\n|---|{'---|' * len(GROUPS)}")
    for name, rows in curves.items():
        cells = [f"{efficiency:.2g}" for _, efficiency in rows]
        print(f"| {name} | {' | '.join(cells)} |")
    return curves


def draw(curves: dict[str, list[tuple[int, float]]]) -> None:
    """Draw efficiency against groups."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.5), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    for axis, mean in zip(axes, ("0.025 s", "1 s", "60 s"), strict=True):
        for name, rows in curves.items():
            solve, _, setting = name.partition(", ")
            if solve == mean:
                line = "--" if setting.endswith("software counter") else "-"
                colour = {"128": "C0", "4": "C1", "8": "C2"}[setting.split()[0]]
                axis.plot(*zip(*rows, strict=True), line, color=colour, label=setting)
        axis.set(xscale="log", title=f"solves of {mean}", xlabel="groups of ranks", ylim=(0, 1.02))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("efficiency")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(PICTURE, dpi=110)
