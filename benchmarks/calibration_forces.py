"""Calibration of inversions of curves of force over depth, with data of another mesh: which intervals hold the truth.

Specimens of `configs/indentation.toml`, on a coarser mesh and at five depths, have constants drawn from the prior.
Their curves come from another mesh, of tetrahedra, with errors of 3 %; they are inverted as in a batch with
`method.expansion`: solves, also those on finer meshes, are shared. Since 200 curves of the other mesh would take longer
than everything else, they come from an expansion of their own, whose error is printed beside the noise.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from benchmarks.beams import CONFIG
from forward.fem.finer import extrapolated
from forward.model import FloatArray
from inverse.data.measurements import Measurements
from inverse.methods.infer import Problem
from inverse.methods.invert import Invert
from inverse.methods.invert_few import invert_few
from inverse.methods.stand_ins import SharedExpansion, shared_expansion
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.random_parameters import Inputs
from workflows.config.study import load
from workflows.studies.inversion import Inversion

if TYPE_CHECKING:
    import xarray as xr

STUDY = CONFIG.parent / "indentation.toml"
OWN = ["model.body.cells=[3,3,3]", "model.loads=[LOAD]"]
OTHER = [*OWN, "model.body.cells=[6,6,6]", 'model.body.cell="tetrahedron"']
LOAD = (
    '{ kind = "indenter", name = "ball", shape = "sphere", radius = 0.003, on = "z-max", at = [0, 0, 0.01], '
    "direction = [0, 0, -1], depth = [0.3e-3, 0.6e-3, 0.9e-3, 1.2e-3, 1.5e-3] }"
)
NOISE = 0.03  # of the root mean square of a curve
SOLVES, SAMPLES = 24, 128
TRUTH, LEVELS = (450.0, 350.0), (0.01, 0.03, 0.1)
FILE = Path("results/calibration-forces.csv")


def study(changes: list[str]) -> Inversion:
    """Return the shipped study with changes, and data that are never used."""
    given = [change.replace("LOAD", LOAD) for change in changes]
    found = load(STUDY, [*given, 'data={ outputs = { "force.1" = 1e-3 }, noise = { relative = 0.03 } }'])
    assert isinstance(found, Inversion)
    return found


def expanded() -> tuple[Inversion, SharedExpansion, SharedExpansion]:
    """Return the study, the expansions that all specimens share, and that of the other mesh."""
    own, other = study(OWN), study(OTHER)
    names = own.inputs.names
    model: Any = own.spec.build(MPI.COMM_SELF, names)
    finer = SerialEvaluate(extrapolated(model, own.inputs.mean).of(model))
    mine = shared_expansion(own.inputs, SerialEvaluate(model), finer, SOLVES)
    truth = other.spec.build(MPI.COMM_SELF, names)
    return own, mine, shared_expansion(own.inputs, SerialEvaluate(truth), None, SOLVES)


def main(specimens: int = 200) -> None:
    """Print how many intervals hold the truth."""
    begin = time.process_time()
    own, mine, other = expanded()
    solved = time.process_time() - begin
    inputs = own.inputs
    rng = np.random.default_rng(7)
    truths = inputs.from_normals(rng.standard_normal((specimens, len(inputs.names))))[0]
    ranks, inside, off, failed = [], [], [], 0
    for truth in truths:
        clean = np.asarray(other.model.solve(truth).outputs)
        found, size = _inverted(inputs, mine, clean, NOISE, rng)
        off.append((float(mine.error.max() / size), float(other.error.max() / size), _mesh(mine, truth, clean, size)))
        failed += int(found["trust"]) == 2
        draws = _with_sum(found["draw"].to_numpy())
        right = _with_sum(truth[None])[0]
        ranks.append((draws < right).mean(axis=0))
        inside.append((np.quantile(draws, 0.025, axis=0) <= right) & (right <= np.quantile(draws, 0.975, axis=0)))
    _print([*inputs.names, "their sum"], np.array(ranks), np.array(inside), specimens)
    mean = np.median(np.array(off), axis=0)
    print(
        f"\n{specimens} specimens, {failed} of them not to be trusted; {mine.solves} solves, {mine.finer_solves} on "
        f"finer meshes, {other.solves} on the other mesh, which all share. Medians, over the noise: error of the "
        f"expansion {mean[0]:.2g}, of that of the other mesh {mean[1]:.2g}, difference of the meshes {mean[2]:.2g}. "
        f"{time.process_time() - begin:.0f} s of CPU, of which {solved:.0f} s are solves."
    )
    print("\n| noise | C1 | C2 | C1 + C2 |")
    print("|---|---|---|---|")
    print(f"| truth | {TRUTH[0]:g} | {TRUTH[1]:g} | {sum(TRUTH):g} |")
    clean = np.asarray(other.model.solve(np.array(TRUTH)).outputs)
    for noise in LEVELS:
        found, _ = _inverted(inputs, mine, clean, noise, np.random.default_rng(1))
        draws = _with_sum(found["draw"].to_numpy())
        cells = " | ".join(f"{m:.0f} ± {s:.0f}" for m, s in zip(draws.mean(axis=0), draws.std(axis=0), strict=True))
        print(f"| {100 * noise:g} % | {cells} |")
    FILE.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(FILE, np.column_stack([truths, np.array(ranks)]), delimiter=",")


def _inverted(
    inputs: Inputs, mine: SharedExpansion, clean: FloatArray, noise: float, rng: np.random.Generator
) -> tuple[xr.Dataset, float]:
    """Measure a curve with errors, and invert it; also their standard deviation (N)."""
    outputs, size = mine.model.outputs, noise * float(np.sqrt((clean**2).mean()))
    values = clean + size * rng.standard_normal(len(clean))
    sigma, numbers = np.hypot(size, mine.error), range(len(outputs))
    data = Measurements.of(values, sigma, numbers, numbers, outputs, parts=outputs, some=True)
    method = Invert(samples=SAMPLES, starts=1, seed=1)
    return invert_few(inputs, SerialEvaluate(mine.model), Problem(data, method, finer=mine.finer)).dataset, size


def _mesh(mine: SharedExpansion, truth: FloatArray, clean: FloatArray, size: float) -> float:
    """Root mean square difference of the own mesh and the other one, over the noise."""
    return float(np.sqrt(((np.asarray(mine.model.solve(truth).outputs) - clean) ** 2).mean()) / size)


def _with_sum(points: FloatArray) -> FloatArray:
    return np.column_stack([points, points.sum(axis=1)])


def _print(names: list[str], ranks: FloatArray, inside: FloatArray, n: int) -> None:
    from scipy.stats import kstest

    print("| | 50 % intervals hold the truth in | 95 % | ranks uniform? p |")
    print("|---|---|---|---|")
    for k, name in enumerate(names):
        half = np.abs(ranks[:, k] - 0.5) <= 0.25
        p = kstest(ranks[:, k], "uniform").pvalue
        print(f"| {name} | {_share(half, n)} | {_share(inside[:, k], n)} | {p:.2g} |")


def _share(held: FloatArray, n: int) -> str:
    share = float(held.mean())
    return f"{100 * share:.1f} ± {100 * np.sqrt(max(share * (1 - share), 1 / n**2) / n):.1f} %"
