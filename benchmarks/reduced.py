"""Reduced models of shipped bodies: modes, points, errors on 100 unseen samples, effectivity, times.

The slab (configs/slab.toml), or with `--organ` the organ (configs/organ.toml) in displacements alone; with `--mixed` in
its own form, whose snapshots take ten times as long.

All times are processor time on one core, measured side by side; frames are by the clock, since that is what counts.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from forward.reduced.data import load
from forward.reduced.model import ReducedModel
from forward.reduced.stream import Stream, local
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Request
from uq.inputs.sampling import random_points
from uq.surrogates.linearisation import linearise
from workflows.__main__ import main as command
from workflows.config.study import load as load_study

CONFIGS = Path(__file__).parent.parent / "configs"
OF_ORGAN = ("method.snapshots=48", "method.rounds=1", "method.unseen=100", "method.cubature=3e-4")
MODES = {"slab": (20, 40, 80), "organ": (30,)}
OF_METHOD = ("more", "snapshots", "unseen", "cubature")
FRAMES, EVERY = 5_000, 100
POINTS, LOCKSTEP = 20, 48


def main(words: Sequence[str] = ()) -> None:
    """Print a table for each size."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks reduced")
    parser.add_argument("--organ", action="store_true", help="configs/organ.toml in place of configs/slab.toml")
    parser.add_argument("--mixed", action="store_true", help="the organ in the mixed form that it has itself")
    parser.add_argument("--modes", type=int, nargs="*", help="sizes; those of the table if none are given")
    parser.add_argument("--keep", type=Path, help="a folder for the models; one that is there already is taken")
    for key in OF_METHOD:
        parser.add_argument(f"--{key}", type=float, help=f"method.{key}")
    asked = parser.parse_args(words)
    name = "organ" if asked.organ else "slab"
    others = [f"method.{key}={value:g}" for key in OF_METHOD if (value := getattr(asked, key)) is not None]
    for modes in asked.modes or MODES[name]:
        with tempfile.TemporaryDirectory() as folder:
            out = (asked.keep or Path(folder)) / f"{name}-{modes}"
            sets = [f"method.modes={modes}", *(OF_ORGAN if name == "organ" else ()), *others]
            if name == "organ" and not asked.mixed:
                sets.append("model.formulation=displacement")
            changes = [part for one in sets for part in ("--set", one)]
            study = CONFIGS / f"{name}.toml"
            if command(["reduce", str(study), "--out", str(out), "--quiet", "--no-report", *changes]):
                return
            told = json.loads((out / "summary.json").read_text())["reduced"]
            of_body = [one for one in sets if not one.startswith("method.")]
            _table(told, load(out / told["file"]), _full(load_study(study, of_body)))


def _full(study: Any) -> float:
    """Milliseconds of a solve of the body in lockstep, without derivatives: the fastest there is."""
    model = study.spec.build(MPI.COMM_SELF, study.inputs.names)
    evaluate = SerialEvaluate(model)
    start = linearise(study.inputs, evaluate).prediction
    points = study.inputs.points(random_points((0, 9), 0, LOCKSTEP, len(study.inputs.names)))
    return 1e3 * float(np.median(evaluate(Request(points, start=start)).seconds))


def _table(told: dict[str, Any], data: Any, full: float) -> None:
    model = ReducedModel(data, data.parameters)
    rng = np.random.default_rng(0)
    points = data.lower + (data.upper - data.lower) * rng.random((POINTS, len(data.parameters)))
    for point in points:
        model.reduced(point)
    cold = _times(model.reduced, points)
    gradient = _times(lambda point: model.reduced(point).adjoint(np.eye(len(model.outputs))), points)
    estimate = _times(lambda point: model.reduced(point).estimate, points)
    seconds = told["seconds"]
    off_line = (
        f"off-line {seconds['snapshots']:.0f} s of solves with adjoints and tangents, {seconds['reduction']:.0f} s"
    )
    print(
        f"\n{told['modes']} modes, {told['points']} points (larger model: {told['modes of the larger model']}, "
        f"{told['points of the larger model']}); {off_line} of reduction"
    )
    derived = 1e3 * seconds["full solve"]
    print(
        f"cold {cold:.2f} ms, with gradients of all outputs {gradient:.2f} ms, with error estimates {estimate:.1f} ms; "
        f"fastest full solve {full:.1f} ms: {full / cold:.0f} times as long, with gradients {derived:.1f} ms"
    )
    print(f"state: error {100 * told['error of the state']:.2g} %")
    print(
        "| output | error (% of the spread) | after correction | effectivity | gradient (%) | corrected "
        "| largest at the same place (% of the samples), corrected | gradient there (%) | corrected |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for name, error in told["errors"].items():
        after, effectivity = told["errors after correction"][name], told["effectivity"][name]
        gradients, there, share = (
            [f"{100 * told[before + which + end][name]:.2g}" for which in ("", " after correction")]
            for before, end in (
                ("errors of gradients", ""),
                ("errors of gradients", ", at the same place"),
                ("share of samples at the same place", ""),
            )
        )
        print(
            f"| {name} | {100 * error:.2g} | {100 * after:.2g} | {effectivity:.2f} | {' | '.join(gradients)} "
            f"| {', '.join(share)} | {' | '.join(there)} |"
        )
    _frames(model)


def _times(what: Any, points: Any) -> float:
    """Milliseconds of processor time for a call, the median of several: other jobs slow some of them down."""
    taken = []
    for point in points:
        start = time.process_time()
        what(point)
        taken.append(time.process_time() - start)
    return 1e3 * float(np.median(taken))


def _frames(model: ReducedModel) -> None:
    """A thousand frames a second of a spot that circles at 0.1 m/s, or of a pressure that swings once a second."""
    data, uncertain = model.data, model.data.spread.copy()
    names, radius = list(data.parameters), 0.015
    moved = [i for i, name in enumerate(names) if name in {"loads.spot.x", "loads.spot.y", "loads.pressure.size"}]
    uncertain[moved] = 0
    stream = Stream(model, local(model, model.data.nominal, None, uncertain))
    lasted, busy = np.empty((2, FRAMES))
    errors = []
    for k in range(FRAMES):
        at = data.nominal.copy()
        angle = 0.1 / radius * k / 1000
        if len(moved) == 2:
            at[moved] += radius * np.array([np.cos(angle) - 1, np.sin(angle)])
        else:
            at[moved] += data.spread[moved] * np.sin(angle)
        if k % EVERY == 0:
            stream.moved(local(model, at, stream.modes, uncertain))
        start, used = time.perf_counter(), time.process_time()
        frame = stream.frame(at)
        lasted[k], busy[k] = time.perf_counter() - start, time.process_time() - used
        if k % 997 == 0:
            exact = model.reduced(at)
            errors.append(np.abs(frame.outputs - exact.outputs) / np.array(data.about["spread"]))
    low, high, worst = 1e3 * np.array([np.median(lasted), np.quantile(lasted, 0.99), lasted.max()])
    linear = np.array([output.kind == "peak" for output in data.outputs])
    off, held = 100 * np.max(errors, axis=0)[~linear].max(), 100 * np.max(errors, axis=0)[linear].max(initial=0.0)
    cpu = 1e3 * np.array([np.median(busy), np.quantile(busy, 0.99)])
    print(
        f"frames: processor time {cpu[0]:.3f} ms (99 % {cpu[1]:.3f}); by the clock median {low:.3f} ms, "
        f"99 % {high:.3f} ms, worst of {FRAMES} {worst:.2f} ms, {(lasted > 1e-3).mean():.2%} over 1 ms; "
        f"off the equilibrium by at most {off:.2g} % of the spread (stress, linear in between: {held:.2g} %)"
    )
