"""Processor time and memory of a body against its size, with factors and by multigrid.

Each row is kept in a file as soon as it is measured: the same command goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from benchmarks.beams import CONFIG
from forward.bodies.geometry import Box
from forward.bodies.random_fields import Matern, Smoothness
from workflows.config.study import load

CELLS = {  # of tetrahedra of the published beam, by about how many unknowns these have
    1e4: (20, 2, 8),
    3e4: (32, 3, 12),
    1e5: (50, 4, 18),
    3e5: (74, 6, 26),
    1e6: (110, 9, 40),
}
SMOOTHNESS: tuple[Smoothness, ...] = (2, 4)
MODES = 'model.fields=[{of="stiffness", length=0.04, std=0.3, modes=20}]'
LENGTH = 0.3  # of random fields, over the edge of the cube
WITH_FACTORS = 1e5  # most unknowns of these
PARTS = ("build", "first solve", "of it stability", "tangents", "memory (GiB)")
SCRIPT = """
import json, sys, time
import numpy as np
from mpi4py import MPI
from benchmarks.beams import beam
from forward.fem.linearisation import Linearisation
cells, linear = json.loads(sys.argv[1]), sys.argv[2]
changes = ('model.body.cell="tetrahedron"', f"model.solver.linear={linear}")
study = beam(cells, *changes)
beam((2, 1, 1), *changes).model.build(MPI.COMM_SELF, study.inputs.names).solve(study.inputs.mean).tangent(np.eye(2))
counting, count = [0.0], Linearisation.inertia
def timed(self):
    begin = time.process_time()
    found = count(self)
    counting[0] += time.process_time() - begin
    return found
Linearisation.inertia = timed
marks = [time.process_time()]
model = study.model.build(MPI.COMM_WORLD, study.inputs.names)
marks.append(time.process_time())
if sys.argv[3] == "step":
    equations, zero = model.equations, np.zeros(model.equations.size)
    equations.set_parameters(study.inputs.mean)
    equations.at_load(1.0)
    residual = equations.residual(zero)
    equations.factorise(zero)
    equations.solve(-residual.vector)
    equations.inertia()
    marks += [time.process_time()] * 2
else:
    solution = model.solve(study.inputs.mean)
    marks.append(time.process_time())
    solution.tangent(np.eye(2))
    marks.append(time.process_time())
# That of this program alone: what `getrusage` tells begins with the memory of the process that has started it.
own = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
peak = MPI.COMM_WORLD.allreduce(int(own.split()[1])) / 2**20
build, first, tangents = np.diff(marks)
if MPI.COMM_WORLD.rank == 0:
    print(json.dumps([study.model.unknowns, build, first, counting[0], tangents, peak]))
"""


def main(words: Sequence[str] = ()) -> None:
    """Print processor times of one rank (s), peak memory (GiB), and their slopes against unknowns; draw them if asked.

    Forms are compiled. "first solve" is Newton's method from zero to the solver's tolerance, with the test for
    stability, which takes Lanczos' method in place of inertia without factors.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks size")
    parser.add_argument("--unknowns", type=float, nargs="+", choices=sorted(CELLS), default=sorted(CELLS))
    parser.add_argument("--linear", nargs="+", choices=("factor", "multigrid"), default=("factor", "multigrid"))
    parser.add_argument("--ranks", type=int, default=1, help="ranks that share the body")
    parser.add_argument("--step", action="store_true", help="one step of Newton's method in place of a solve")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--kept", type=Path, default=Path("sizes.jsonl"), help="file of the rows that were measured")
    parser.add_argument("--fields", action="store_true", help="random fields on cubes, in place of bodies")
    parser.add_argument(
        "--field-on-a-million", action="store_true", help="a random field on the largest beam, in place of bodies"
    )
    given = parser.parse_args(words)
    if given.fields:
        of_fields()
        return
    if given.field_on_a_million:
        of_a_million()
        return
    found: dict[str, list[list[float]]] = {}
    print("| solved by | unknowns | " + " | ".join(PARTS) + " |\n|---|" + "---:|" * (len(PARTS) + 1))
    for linear in given.linear:
        for size in given.unknowns:
            if linear == "factor" and size > WITH_FACTORS:
                continue
            row = kept(given.kept, CELLS[size], linear, given.ranks, step=given.step)
            found.setdefault(linear, []).append(row)
            print(f"| {linear} | {row[0]:,.0f} | " + " | ".join(f"{value:.2f}" for value in row[1:]) + " |", flush=True)
    slopes = {linear: slopes_of(rows) for linear, rows in found.items() if len(rows) > 1}
    for linear, values in slopes.items():
        words = ", ".join(f"{part} {slope:.2f}" for part, slope in zip(PARTS, values, strict=True))
        print(f"\nslopes, {linear}: {words}")
    if given.picture is not None:
        draw(found, slopes, steps_in(given.kept), given.picture)


def slopes_of(rows: list[list[float]]) -> list[float]:
    """Return the power of the unknowns with which each of `PARTS` grows."""
    sizes, *columns = np.log(np.maximum(np.array(rows), 1e-3)).T
    return [float(np.polyfit(sizes, column, 1)[0]) for column in columns]


def kept(file: Path, cells: tuple[int, int, int], linear: str, ranks: int, *, step: bool) -> list[float]:
    """Return a row of the file; measure it and add it where it is missing."""
    about = {"cells": list(cells), "linear": linear, "ranks": ranks, "step": step}
    for one in map(json.loads, file.read_text().splitlines() if file.exists() else ()):
        if about.items() <= one.items():
            return [float(value) for value in one["row"]]
    row = measured(cells, linear, ranks, step=step)
    with file.open("a") as lines:
        lines.write(json.dumps(about | {"row": row}) + "\n")
    return row


def steps_in(file: Path) -> list[list[float]]:
    """Return the rows of single steps of Newton's method by one rank, which cost too much to be taken to the end."""
    found = [json.loads(line) for line in file.read_text().splitlines()]
    return [one["row"] for one in found if one["step"] and one["linear"] == "multigrid" and one["ranks"] == 1]


def measured(cells: tuple[int, int, int], linear: str, ranks: int, *, step: bool = False) -> list[float]:
    """Measure one size in a process of its own: unknowns, and `PARTS`."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_", "PMIX_"))}
    environment = kept | {
        "OMPI_ALLOW_RUN_AS_ROOT": "1",
        "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
        "OMP_NUM_THREADS": "1",
    }
    program = [sys.executable, "-c", SCRIPT, json.dumps(cells), linear, "step" if step else ""]
    if ranks > 1:
        program = ["mpirun", "--bind-to", "none", "--oversubscribe", "-n", str(ranks), *program]
    done = subprocess.run(
        program, env=environment, stdout=subprocess.PIPE, text=True, cwd=CONFIG.parent.parent, check=True
    )
    return [float(value) for value in json.loads(done.stdout.splitlines()[-1])]


def of_fields(cells: Sequence[int] = (24, 35)) -> None:
    """Print what the variance of random fields and their modes take, on cubes with so many cells along each edge."""
    print("| vertices | smoothness | factor (s) | variance (s) | 20 modes (s) |\n|---:|---:|---:|---:|---:|")
    for n in cells:
        for smoothness in SMOOTHNESS:
            marks = [time.process_time()]
            matern = Matern.on(Box(size=(1.0, 1.0, 1.0), cells=(n, n, n), degree=1), LENGTH, smoothness)
            marks.append(time.process_time())
            assert matern.raw_std.min() > 0
            marks.append(time.process_time())
            matern.modes(20)
            marks.append(time.process_time())
            times = " | ".join(f"{seconds:.2f}" for seconds in np.diff(marks))
            print(f"| {(n + 1) ** 3:,} | {smoothness} | {times} |", flush=True)


def of_a_million() -> None:
    """Print what a field of twenty modes adds to configs/beam-million.toml, and a solve and a tangent with it."""
    study: Any = load(CONFIG.with_name("beam-million.toml"), [MODES])
    body, names = study.spec, study.inputs.names
    values = study.inputs.mean.copy()
    field = [name.startswith("fields.") for name in names]
    values[field] = np.random.default_rng(0).standard_normal(sum(field))
    begin = time.process_time()

    def told(what: str) -> None:
        nonlocal begin
        print(f"{what}: {time.process_time() - begin:.1f} s", flush=True)
        begin = time.process_time()

    matern = Matern.on(body.body, body.fields[0].length, body.fields[0].smoothness)
    told(f"factor of the operator on {len(matern.mass):,} vertices")
    assert matern.raw_std.min() > 0
    told("variance")
    matern.modes(body.fields[0].modes)
    told("modes")
    del matern
    model = body.build(MPI.COMM_SELF, names)
    told(f"build, with the field, of {body.unknowns:,} unknowns")
    solution = model.solve(values)
    told("first solve")
    solution.tangent(np.eye(len(names))[field.index(True)])
    told("a tangent")
    peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    print(f"peak memory {int(peak.split()[1]) / 2**20:.2f} GiB")


def draw(
    found: dict[str, list[list[float]]], slopes: dict[str, list[float]], steps: list[list[float]], file: Path
) -> None:
    """Draw first solves, derivatives and memory against unknowns, each with its slope."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.6), layout="constrained")
    columns = {"first solve (s)": 1, "two tangents (s)": 3, "memory (GiB)": 4}
    for axes, (label, part) in zip(figure.subplots(1, 3), columns.items(), strict=True):
        for linear, rows in found.items():
            sizes, values = np.array(rows)[:, [0, part + 1]].T
            slope = f", slope {slopes[linear][part]:.2f}" if linear in slopes else ""
            axes.loglog(sizes, values, "o-", label=f"{'factors' if linear == 'factor' else linear}{slope}")
        if part == len(PARTS) - 1 and steps:
            axes.loglog(*np.array(steps)[:, [0, -1]].T, "o", mfc="none", color="C1", label="one Newton step")
        axes.set(xlabel="unknowns", ylabel=label)
        axes.grid(visible=True, alpha=0.3)
        axes.legend(frameon=False)
    figure.savefig(file, dpi=110)
