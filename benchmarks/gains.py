"""Where expansions fail: 50 modes of a stiffness field, a load that may press anywhere, the largest stress; the gain.

A slab of tissue (configs/slab.toml) with 57 random parameters. `tissuq reduce` makes a model of it; studies of
`multifidelity` take that model and its nested larger one beside the body. Costs are processor times of everything,
measured in one run: solves of the body in lockstep are what plain Monte Carlo would be charged.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from forward.model import FloatArray
from uq.evaluation.evaluate import Recorder, SerialEvaluate
from uq.evaluation.request import OWN
from uq.findings import findings
from uq.methods.multifidelity import Multifidelity
from workflows.__main__ import main as command
from workflows.config.study import load

CONFIG = Path(__file__).parent.parent / "configs" / "slab.toml"
FIELD = 'model.fields=[{of="stiffness", length=0.04, std=0.3, modes=50}]'
OUTPUTS = (
    'model.outputs=[{name="deepest", kind="max-displacement"}, {name="middle", kind="displacement", '
    'at=[0.06, 0.045, 0.03], component="z"}, {name="stress", kind="max-von-mises"}]'
)
TAKEN = "making.json"  # beside a reduced model: what its making took
PERCENT = (1.0, 0.5, 0.25)  # errors, of the standard deviation, for which a making is charged


def main(words: Sequence[str] = ()) -> None:
    """Make the reduced model, and print gains and coverage of repeated studies."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks gains")
    parser.add_argument("--cells", default="[16,12,6]", help="of the slab")
    parser.add_argument("--snapshots", type=int, default=320)
    parser.add_argument("--modes", type=int, default=60)
    parser.add_argument("--more", type=int, default=240, help="of the larger model")
    parser.add_argument("--rounds", type=int, default=1, help="in which half of the snapshots are drawn")
    parser.add_argument("--samples", type=int, default=64, help="what a study may spend, in solves of the body")
    parser.add_argument("--pilot", type=int, default=16)
    parser.add_argument("--costs", type=float, nargs=2, help="of both models, in solves of the body; or as predicted")
    parser.add_argument(
        "--full", default="auto", choices=["auto", "evenly", "differences"], help="choice of full solves"
    )
    parser.add_argument("--repeats", type=int, default=4)
    parser.add_argument(
        "--keep", default="", help="folder of the reduced model and of studies: what is there already counts"
    )
    given = parser.parse_args(words)
    changes = [f"model.body.cells={given.cells}", FIELD, OUTPUTS]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(given.keep or folder) / "slab"
        if not (out / TAKEN).exists():
            _made(out, changes, given)
        told = json.loads((out / TAKEN).read_text())
        print(told["text"], flush=True)
        if given.repeats:
            _studies(out, told["seconds"], changes, given)


def _made(out: Path, changes: Sequence[str], given: argparse.Namespace) -> None:
    """Make the reduced model in a folder, and write down the processor time of the making."""
    method = {"snapshots": given.snapshots, "modes": given.modes, "more": given.more}
    method |= {"cubature": 3e-3, "rounds": given.rounds, "unseen": 0}
    sets = [*changes, *(f"method.{key}={value}" for key, value in method.items()), "method.derivatives=false"]
    options = [part for one in sets for part in ("--set", one)]
    begin = time.process_time()
    command(["reduce", str(CONFIG), "--out", str(out), "--quiet", "--no-report", *options])
    seconds = time.process_time() - begin
    told = json.loads((out / "summary.json").read_text())["reduced"]
    parts = told["seconds"]
    text = (
        f"{told['snapshots']} snapshots in {parts['snapshots']:.0f} s, reduction {parts['reduction']:.0f} s, all "
        f"{seconds:.0f} s: {told['modes']} modes at {told['points']} points, {told['modes of the larger model']} at "
        f"{told['points of the larger model']}"
    )
    (out / TAKEN).write_text(json.dumps({"text": text, "seconds": seconds}))


def _studies(out: Path, off_line: float, changes: Sequence[str], given: argparse.Namespace) -> None:
    """Repeat studies, beside those of the same options that are kept, and print them all."""
    study: Any = load(CONFIG, [*changes, "method={kind='monte-carlo', samples=16}"])
    costs = given.costs or [None, None]
    cheap = [
        {"kind": "reduced", "file": str(out / "reduced.npz"), "larger": larger, "cost": cost}
        for larger, cost in zip((False, True), costs, strict=True)
    ]
    first = Multifidelity(
        samples=given.samples, cheap=tuple(cheap), pilot=given.pilot, control="tangent", full_solves=given.full
    )  # type: ignore[arg-type]
    names = study.inputs.names
    others = {name: spec.build(MPI.COMM_SELF, names) for name, spec in first.models(study.spec).items()}
    model = study.spec.build(MPI.COMM_SELF, names)
    kept = out / f"studies-{given.samples}-{given.pilot}-{costs}-{given.full}.npz"
    rows, times, outputs = [], [], list(model.outputs)
    if kept.exists():
        with np.load(kept) as there:
            rows, times = [*there["rows"]], [there["times"]]
    for seed in range(len(rows), len(rows) + given.repeats):
        recorder = Recorder(SerialEvaluate(model, others=others))
        begin = time.process_time()
        data = first.model_copy(update={"seed": seed}).run(study.inputs, recorder)
        cpu = time.process_time() - begin
        # After the linearisation the pilot, of which nothing was chosen: solves that were chosen take longer.
        pilot = [one for one, name in zip(recorder.log, recorder.models, strict=True) if name == OWN][1]
        times.append(pilot.seconds[1:])  # the first makes what all need
        needed = data["alternative_solves"]
        tangent = needed.sel(alternative="monte-carlo") / needed.sel(alternative="sensitivity-monte-carlo")
        rows.append(
            np.array([*(data[n].values for n in ("mean", "mean_error", "std")), np.full(len(outputs), cpu), tangent])
        )
        np.savez(kept, rows=np.array(rows), times=np.concatenate(times))
        if seed == 0:
            _described(data, recorder, outputs)
    _gains(np.array(rows), float(np.concatenate(times).mean()), off_line, outputs)


def _described(data: Any, recorder: Recorder, outputs: list[str]) -> None:
    """Print what the first study took, and how models follow the body."""
    log: dict[str, tuple[int, float]] = {}
    for one, name in zip(recorder.log, recorder.models, strict=True):
        n, s = log.get(name, (0, 0.0))
        log[name] = (n + len(one.points), s + float(one.seconds.sum()))
    for name, (n, s) in log.items():
        print(f"{name or 'the body'}: {n} solves, {1e3 * s / n:.2g} ms each")
    print("predicted costs", np.round(data["fidelity_cost"].values, 4))
    for name, rho, left in zip(
        outputs, data["fidelity_correlation"].values, data["fidelity_remainder_correlation"].values, strict=True
    ):
        print(f"{name}: 1 − ρ² {1 - rho[1:] ** 2}, of what tangents leave {1 - left[1:] ** 2}")
    for finding in findings(data):
        print(f"{finding.severity}: {finding.text}")
    print(data.attrs["stopped"], data.attrs.get("note", ""), flush=True)


def _gains(rows: FloatArray, per_solve: float, off_line: float, outputs: list[str]) -> None:
    """Print errors, claims and gains."""
    means, errors, cpu = rows[:, 0], rows[:, 1], rows[:, 3, 0].mean()
    n, spread = len(means), np.sqrt((rows[:, 2] ** 2).mean(axis=0))
    print(
        f"\n{n} studies of {cpu:.0f} s each; a solve of the body in lockstep {per_solve:.3g} s; making {off_line:.0f} s"
    )
    print(
        "| output | spread | error of a study, claimed (% of it) | true | 95 % intervals hold | gain | over tangent |"
    )
    print("|---|---|---|---|---|---|---|")
    middle = means.mean(axis=0)
    scatter = means.std(axis=0, ddof=1) if n > 1 else np.full(len(outputs), np.nan)
    claimed = np.sqrt((errors**2).mean(axis=0))
    # Against the mean of the other studies, which is uncertain itself; their errors differ.
    others = (n * middle - means) / max(n - 1, 1)
    of_others = ((errors**2).sum(axis=0) - errors**2) / max(n - 1, 1) ** 2
    held = (np.abs(means - others) <= 1.96 * np.sqrt(errors**2 + of_others)).mean(axis=0)
    for j, name in enumerate(outputs):
        error = scatter[j] if n >= 16 else claimed[j]
        gain = spread[j] ** 2 / error**2 * per_solve / cpu
        print(
            f"| {name} | {spread[j]:.3g} | {100 * claimed[j] / spread[j]:.3g} | {100 * scatter[j] / spread[j]:.3g} | "
            f"{held[j]:.0%} | {gain:.3g} | {gain / rows[:, 4, j].mean():.2g} |"
        )
    print("\n| error wanted, % of the spread | plain Monte Carlo (s) | " + " | ".join(outputs) + " |")
    print("|---|---|" + "---|" * len(outputs))
    for percent in PERCENT:
        alone = per_solve * (100 / percent) ** 2
        best = scatter if n >= 16 else claimed
        with_making = off_line + cpu * (best / spread * 100 / percent) ** 2
        gains = " | ".join(f"{alone / one:.3g}" for one in with_making)
        print(f"| {percent:g} | {alone:.3g} | {gains} |")


if __name__ == "__main__":
    main(sys.argv[1:])
