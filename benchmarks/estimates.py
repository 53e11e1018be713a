"""What estimates of the error of the mesh cost a study: processor time of whole runs, with and without."""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.beams import CONFIG

REPEATS = 6  # in turn, so that the load of the machine is the same for both
COMPRESSIBLE = (
    'model.material={kind="neo-hookean", C1=40e6, D1=80e6}',
    'parameters={"material.C1"={kind="uniform", lower=32e6, upper=48e6}}',
)
ONCE = ("organ",)  # a pair of runs only, of forms that a run of few solves has compiled: each takes minutes
CASES: dict[str, tuple[str, int, tuple[str, ...]]] = {
    "beam, 50 solves": ("beam", 50, ()),
    "Cook's membrane, nearly incompressible, 50 solves": ("cook", 50, ()),
    "Cook's membrane, compressible, 50 solves": ("cook", 50, COMPRESSIBLE),
    "beam, 500 solves": ("beam", 500, ()),
    "organ, 48 solves": ("organ", 48, ("method.scrambles=3",)),
}


def main(words: Sequence[str] = ()) -> None:
    """Print a table, a row for each study with a word in its name."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks estimates")
    parser.add_argument("--only", default="", help="part of the name of a study")
    only = parser.parse_args(words).only
    print("| study | run without (s) | with (s) | more | solves (s) | estimates and their calibration (s) |")
    print("|---|---|---|---|---|---|")
    for name, (config, solves, changes) in CASES.items():
        if only in name:
            once = config in ONCE
            first = f"method.samples={solves // 8 if once else solves}"
            _run(config, *changes, first, "accuracy.mesh_error=true")  # forms are compiled
            _row(name, config, 1 if once else REPEATS, *changes, f"method.samples={solves}")


def _row(name: str, config: str, repeats: int, *changes: str) -> None:
    without, together, told = [], [], {}
    for _ in range(repeats):
        without.append(_run(config, *changes, "accuracy.mesh_error=false")[0])
        seconds, told = _run(config, *changes, "accuracy.mesh_error=true")
        together.append(seconds)
    before, after = median(without), median(together)
    costs = f"{told['cpu_seconds']:.2g} | {told['mesh_error']['cpu_seconds']:.2g}"
    print(f"| {name} | {before:.1f} | {after:.1f} | {(after - before) / before:.0%} | {costs} |", flush=True)


def _run(config: str, *changes: str) -> tuple[float, dict[str, Any]]:
    """Run a study, with its report: processor time (s) and summary."""
    command = Path(sys.executable).with_name("tissuq")
    words = [word for change in changes for word in ("--set", change)]
    with tempfile.TemporaryDirectory() as place:
        before = _processor()
        subprocess.run(
            [command, "run", CONFIG.with_name(f"{config}.toml"), *words, "--quiet", "--out", place],
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            capture_output=True,
            check=True,
        )
        return _processor() - before, json.loads((Path(place) / "summary.json").read_text())


def _processor() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
