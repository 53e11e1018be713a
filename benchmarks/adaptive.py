"""Meshes refined by what cells add to an output, by jumps of stresses, and everywhere: error against unknowns and time.

An L that hangs from its top, pulled down at its right end; quadratic tetrahedra. Stresses are infinite along the edge
where the arms meet, and along the edges of its top. One output is a displacement beside the former, the other one
beside the latter, where the former matters less. Draws docs/adaptive.png.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from matplotlib.figure import Figure
from mpi4py import MPI

from forward.fem.adapt import adapt
from forward.hyperelastic import Hyperelastic
from forward.model import FloatArray
from tests.meshes import corner

PICTURE = Path(__file__).parent.parent / "docs" / "adaptive.png"
LARGEST = 45_000  # unknowns
LEVELS = 4  # of meshes that are divided everywhere, each with 8 times the cells
WORDS = {"dual-weighted": "by what cells add", "recovery": "by jumps of stresses", "uniform": "everywhere"}
Curve = tuple[FloatArray, FloatArray, FloatArray]  # unknowns, values, processor time (s) of all meshes up to each


PLACES = {"where the arms meet": (0.55, 0.45, 0.125), "at the top": (0.45, 0.85, 0.125)}


def bracket(file: str, place: str, **adapting: object) -> Hyperelastic:
    """Return the L, of quadratic tetrahedra, with the vertical displacement at a place."""
    return Hyperelastic.model_validate(
        {
            "body": {"kind": "mesh", "file": file},
            "formulation": "displacement",
            "material": {"kind": "neo-hookean-coupled", "mu": 2e4, "lmbda": 4e4},
            "clamp": ("top",),
            "loads": ({"kind": "traction", "on": "right", "direction": (0.0, -1.0, 0.0), "size": 400.0},),
            "outputs": ({"kind": "displacement", "name": "sink", "at": PLACES[place], "component": "y"},),
            "adapt": {"tolerance": 1e-6, "unknowns": LARGEST, "cycles": 50} | adapting,
        }
    )


def main() -> None:
    """Print both indicators beside equal cells, what they need for equal errors, and draw it."""
    figure = Figure(figsize=(9.6, 6.4), layout="constrained")
    rows = figure.subplots(2, 2)
    with tempfile.TemporaryDirectory() as folder:
        file = f"{folder}/corner.msh"
        meshio.write(file, corner(), file_format="gmsh22", binary=False)
        for place, panels in zip(PLACES, rows, strict=True):
            _compare(file, place, panels)
    rows[0, 0].legend(title="cells are divided")
    figure.savefig(PICTURE, dpi=130)


def _compare(file: str, place: str, panels: Any) -> None:
    """Print and draw what an output takes."""
    bracket(file, place).model_copy(update={"adapt": None}).build(MPI.COMM_SELF, ()).solve(np.zeros(0))  # compiled now
    curves: dict[str, Curve] = {}
    limits = []
    for indicator in ("dual-weighted", "recovery"):
        found = adapt(bracket(file, place, indicator=indicator), MPI.COMM_SELF, (), np.zeros(0)).cycles
        seconds = np.cumsum([cycle.seconds for cycle in found])
        limits.append(found[-1].values[0] + found[-1].errors[0])
        curves[indicator] = np.array([c.unknowns for c in found]), np.array([c.values[0] for c in found]), seconds
    curves["uniform"] = _uniform(file, place)
    exact = float(np.mean(limits))
    print(f"\n### Displacement {place}\n\nextrapolated: {exact:.6f} m, by {np.ptp(limits) / abs(exact):.1e} apart\n")
    print("| refined | unknowns | value (m) | error | CPU (s), all meshes |\n|---|---|---|---|---|")
    for name, (unknowns, values, seconds) in curves.items():
        for n, value, taken in zip(unknowns, values, seconds, strict=True):
            print(f"| {WORDS[name]} | {n:,.0f} | {value:.6f} | {100 * abs(value / exact - 1):.2f} % | {taken:.1f} |")
    errors = {name: np.abs(values / exact - 1) for name, (_, values, _) in curves.items()}
    print("\n| at the error of equal cells | unknowns | by what cells add | times fewer | by jumps | times fewer |")
    print("|---|---|---|---|---|---|")
    for n, error in zip(curves["uniform"][0][1:], errors["uniform"][1:], strict=True):
        needed = [_at(error, errors[name], curves[name][0]) for name in ("dual-weighted", "recovery")]
        print(f"| {100 * error:.2f} % | {n:,.0f} | " + " | ".join(f"{m:,.0f} | {n / m:.1f}" for m in needed) + " |")
    for (name, (unknowns, _, seconds)), colour in zip(curves.items(), ("#0b6bb8", "#d1622b", "#8a97a6"), strict=True):
        for ax, along in zip(panels, (unknowns, seconds), strict=True):
            ax.loglog(along, errors[name], "o-", markersize=4, color=colour, label=WORDS[name])
            ax.spines[["top", "right"]].set_visible(False)
    panels[0].set(xlabel="unknowns", ylabel=f"relative error of the displacement\n{place}")
    panels[1].set(xlabel="processor time of all meshes up to this one (s)")


def _uniform(file: str, place: str) -> Curve:
    """Solve on meshes whose cells are divided everywhere."""
    spec = bracket(file, place).model_copy(update={"adapt": None})
    unknowns, values, seconds = [], [], []
    for level in range(LEVELS):
        begin = time.process_time()
        finer = spec.refined(level)
        values.append(finer.build(MPI.COMM_SELF, ()).solve(np.zeros(0)).outputs[0])
        seconds.append(time.process_time() - begin)
        unknowns.append(finer.unknowns)
    return np.array(unknowns), np.array(values), np.cumsum(seconds)


def _at(error: float, errors: FloatArray, unknowns: FloatArray) -> float:
    """Unknowns of the first mesh after which an error is never larger, between meshes by powers."""
    last = int(np.flatnonzero(errors > error).max())
    if last + 1 == len(errors):
        return np.nan
    ends = np.log(errors[[last + 1, last]])
    return float(np.exp(np.interp(np.log(error), ends, np.log(unknowns[[last + 1, last]]))))


if __name__ == "__main__":
    main()
