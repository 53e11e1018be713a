"""A map of what the solver does at the ends of what it is made for: five families of hard cases.

Each case is solved, and checked by what did not take part in the solve: the residual in equations that were set up
anew, the Newton correction that is left, and the state that small load steps from zero lead to.

- converged: an equilibrium with J > 0 that no check refutes (a note says so where small steps did not arrive in time);
- failed: no answer, and the error says at what load it stopped and why;
- WRONG: an answer that a check refutes;
- SILENT: anything else, such as NaN, another exception, or no end.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import re
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from benchmarks.beams import CONFIG
from forward.bodies.geometry import AXES, Box
from forward.fem.model import HyperelasticModel
from forward.fem.solution import FiniteElementSolution
from forward.hyperelastic import Hyperelastic
from forward.model import FloatArray, Guess, SolveError
from workflows.config.study import load

ROOT = Path(__file__).parent.parent
TABLE, PICTURE = ROOT / "results" / "stability.csv", ROOT / "docs" / "stability.png"

FORMULATIONS = ("displacement", "mixed")
SAME = 1e-6  # states, relative to their size, that count as one
EQUILIBRIUM = 1e-6  # relative residual that counts as none, as does what is rounding
LIMIT = 60  # seconds after which a solve counts as hanging
PATH = 12  # small load steps that check an answer, or more,
PATIENCE = 4  # but no longer than so many seconds
EXPLAINED = re.compile(r"^stopped at [\d.e+-]+ % of the load: \w+")
REFERENCE_UNKNOWNS = 3000  # what a finer mesh may have to be cheap


@dataclass(frozen=True)
class Case:
    """One solve: the body, its numbers, and a finer body that is solved for comparison."""

    family: str
    x: str
    y: str
    spec: Hyperelastic
    numbers: tuple[tuple[str, float], ...]
    finer: tuple[Hyperelastic, tuple[tuple[str, float], ...]] | None = None


@dataclass(frozen=True)
class Row:
    """What came of a case; numbers that there are not are NaN or −1."""

    family: str
    x: str
    y: str
    outcome: str
    factorisations: int = -1
    load_steps: int = -1
    smallest_jacobian: float = np.nan
    negative: int = -1
    condition: float = np.nan
    residual: float = np.nan
    correction: float = np.nan
    path: float = np.nan
    accuracy: float = np.nan
    seconds: float = np.nan
    note: str = ""


class Hang(BaseException):
    """A case took longer than the limit."""


# --- the families ----------------------------------------------------------------------------------------------------


def compressibility() -> Iterator[Case]:
    """Cantilever bent by a traction at its end, from compressible to incompressible."""
    size, mu = [0.1, 0.02, 0.02], 1e4
    for name, traction in itertools.product(FORMULATIONS, (30.0, 150.0, 600.0)):
        spec, finer = (
            Hyperelastic.model_validate(
                {
                    "formulation": form,
                    "body": {"size": size, "cells": cells},
                    "material": {"kind": "neo-hookean", "C1": mu / 2, "D1": mu / 2},
                    "clamp": ["x-min"],
                    "loads": [{"kind": "traction", "on": "x-max", "direction": [0, 0, -1], "size": traction}],
                    "outputs": [{"kind": "mean-displacement", "name": "tip", "on": "x-max", "component": "z"}],
                }
            )
            for form, cells in ((name, [4, 1, 1]), ("mixed", [8, 2, 2]))
        )
        for power in range(9):
            numbers = {"loads.traction.size": traction}
            at = tuple((numbers | {"material.D1": 10.0**power * mu / 2}).items())
            yield Case("κ/μ and bending", f"1e{power}", f"{traction:g} Pa, {name}", spec, at, (finer, at))


def inclusions() -> Iterator[Case]:
    """Cube with a ball in its middle, pulled or pressed: between plates that slip, and that grip."""
    slip = {"displacements": [{"on": f"{axis}-min", axis: 0.0} for axis in AXES] + [{"on": "x-max", "x": 0.0}]}
    grip = {"clamp": ["x-min"], "displacements": [{"on": "x-max", "x": 0.0, "y": 0.0, "z": 0.0}]}
    ball = {"x": 0.05, "y": 0.05, "z": 0.05, "radius": 0.03, "contrast": 1.0, "width": 0.012}
    for name, held in {"slip": slip, "grip": grip}.items():
        spec, finer = (
            Hyperelastic.model_validate(
                {
                    "body": {"size": [0.1, 0.1, 0.1], "cells": [n, n, n]},
                    "material": {"kind": "mooney-rivlin", "C1": 5e3, "C2": 1e3, "D1": 6e4},
                    "inclusions": [ball],
                    "outputs": [{"kind": "reaction", "name": "force", "on": "x-max", "component": "x"}],
                }
                | held
            )
            for n in (3, 4)
        )
        for power, stretch in itertools.product((-4, -2, 0, 2, 4), (0.4, 0.6, 0.8, 1.5, 2.0, 3.0)):
            numbers = (("inclusions.sphere.contrast", 10.0**power), ("displacements.x-max.x", 0.1 * (stretch - 1)))
            reference = (finer, numbers) if stretch in {0.8, 1.5} else None
            yield Case(f"inclusion, ends {name}", f"{stretch:g}", f"1e{power}", spec, numbers, reference)


MOST_UNKNOWNS = 200_000  # of shipped studies: dense checks follow


def studies() -> Iterator[Case]:
    """The shipped studies of bodies, with every parameter at an end of its distribution."""
    seen = []
    for path in sorted(CONFIG.parent.glob("*.toml"), key=lambda path: (len(path.stem), path)):
        study = load(path)
        model = getattr(study, "model", None)  # a selection has several, with the same loads
        if type(model) is not Hyperelastic or (model, study.parameters) in seen:  # a path, or by another method
            continue
        if model.unknowns > MOST_UNKNOWNS:
            continue
        seen.append((model, study.parameters))
        ends = {name: [d.at(p) for p in (1e-6, 1 - 1e-6)] for name, d in study.parameters.items()}
        signs = list(itertools.product((0, 1), repeat=len(ends)))
        if len(signs) > 16:  # of many parameters, those corners where all but one are low, or all but one high
            one = np.eye(len(ends), dtype=int)
            signs = [tuple(int(s) for s in row) for row in (*one, *(1 - one))]
        for sign in signs:
            numbers = tuple((name, end[s]) for (name, end), s in zip(ends.items(), sign, strict=True))
            corner = "".join("−+"[s] for s in sign)
            yield Case("shipped studies", corner, path.stem, model, numbers, finer(model, numbers))


def cells() -> Iterator[Case]:
    """Flat cells in a cube under shear, and slender cells in a cantilever of four."""
    for aspect in (1, 3, 10, 30, 100):
        bodies: dict[str, tuple[dict[str, Any], float]] = {
            "flat hexahedra": ({"size": [0.1, 0.1, 0.1], "cells": [aspect, 1, 1]}, 2e3),
            "flat tetrahedra": ({"size": [0.1, 0.1, 0.1], "cells": [aspect, 1, 1], "cell": "tetrahedron"}, 2e3),
            "slender hexahedra": (
                {"size": [0.1, 0.025 / aspect, 0.025 / aspect], "cells": [4, 1, 1]},
                100.0 / aspect**2,
            ),
        }
        for name, (body, traction) in bodies.items():
            spec = Hyperelastic.model_validate(
                {
                    "body": body,
                    "material": {"kind": "neo-hookean", "C1": 5e3, "D1": 5e4},
                    "formulation": "displacement",  # of which the condition does not depend on units
                    "clamp": ["x-min"],
                    "loads": [{"kind": "traction", "on": "x-max", "direction": [0, 0, -1], "size": traction}],
                    "outputs": [{"kind": "mean-displacement", "name": "tip", "on": "x-max", "component": "z"}],
                }
            )
            numbers = (("loads.traction.size", traction),)
            yield Case("shape of cells", f"1:{aspect}", name, spec, numbers, finer(spec, numbers))


def collapse() -> Iterator[Case]:
    """The published beam under multiples of its weight."""
    model = load(CONFIG.with_name("tiny.toml")).model
    for name, n in {"4 × 1 × 2": [4, 1, 2], "6 × 1 × 2": [6, 1, 2]}.items():
        spec = Hyperelastic.model_validate(model.model_dump() | {"body": model.body.model_dump() | {"cells": n}})
        for times in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000):
            numbers = (("loads.gravity.density", 750.0 * times),)
            other = finer(spec, numbers) if times <= 10 else None
            yield Case("weight of the slender beam", f"{times}", name, spec, numbers, other)


def finer(spec: Hyperelastic, numbers: tuple[tuple[str, float], ...]) -> Any:
    """Return the body with half the cell lengths, where it is a box and cheap."""
    if not isinstance(spec.body, Box):
        return None
    body = spec.body.model_dump() | {"cells": [2 * n for n in spec.body.cells]}
    twice = Hyperelastic.model_validate(spec.model_dump() | {"body": body})
    return (twice, numbers) if twice.unknowns <= REFERENCE_UNKNOWNS else None


FAMILIES = {
    "κ/μ and bending": ("κ/μ", "traction at the end", compressibility),
    "inclusion, ends slip": ("stretch", "contrast of the inclusion", inclusions),
    "inclusion, ends grip": ("stretch", "contrast of the inclusion", inclusions),
    "shipped studies": ("parameters at their 1e-6 (−) or 1 − 1e-6 (+) quantile", "study", studies),
    "shape of cells": ("thickness : length of the cells", "cells", cells),
    "weight of the slender beam": ("weight (multiples of 750 kg/m³)", "cells", collapse),
}


# --- one case --------------------------------------------------------------------------------------------------------


@cache
def built(spec: Hyperelastic, paths: tuple[str, ...]) -> HyperelasticModel:
    """Build a model once."""
    return spec.build(MPI.COMM_SELF, paths)


@cache
def reference(spec: Hyperelastic, numbers: tuple[tuple[str, float], ...]) -> float:
    """First output of a finer body; NaN where it has no answer."""
    paths, values = zip(*numbers, strict=True)
    try:
        return float(built(spec, tuple(paths)).solve(np.array(values)).outputs[0])
    except SolveError:
        return float("nan")


def run(case: Case) -> Row:
    """Solve a case and judge it."""
    row = Row(case.family, case.x, case.y, "SILENT")
    # Loads and displacements that keep their values are parameters too: the path scales them all.
    numbers = {k: s.value for k, s in case.spec.scalars.items() if k.startswith(("loads.", "displacements."))}
    numbers |= dict(case.numbers)
    paths, point = tuple(numbers), np.array(list(numbers.values()))
    loads = np.array([path.startswith(("loads.", "displacements.")) for path in paths])
    # The other model shares nothing with the one that is judged, and takes small steps only where it is told to.
    direct = case.spec.solver.model_dump() | {"minimum_load_step": 1.0}
    other = built(Hyperelastic.model_validate(case.spec.model_dump() | {"solver": direct}), paths)
    model = built(case.spec, paths)
    begin = time.perf_counter()
    try:
        solution = within_limit(model, point)
    except SolveError as error:
        explained = EXPLAINED.match(error.reason) and error.history
        seconds = time.perf_counter() - begin
        _, reached = walk(other, point, loads)
        return replace(
            row,
            outcome="failed" if explained else "SILENT",
            factorisations=error.work.factorisations,
            load_steps=error.work.load_steps,
            seconds=seconds,
            note=f"{error.reason} [small steps reach {100 * reached:.4g} %]",
        )
    except Hang:
        return replace(row, note=f"no end after {LIMIT} s")
    except Exception as error:  # whatever it is, it is a finding
        return replace(row, note=f"{type(error).__name__}: {error}")
    seconds = time.perf_counter() - begin
    # Linearisations count into the work of a solution, so it is read first.
    counts = {"factorisations": solution.work.factorisations, "load_steps": solution.work.load_steps}
    row = replace(row, seconds=seconds, **counts)
    if not (np.isfinite(solution.outputs).all() and np.isfinite(solution.state).all()):
        return replace(row, note="outputs or state are not finite")
    try:
        row, balanced = inspect(row, model, other, solution, point)
    except SolveError as error:
        return replace(row, outcome="WRONG", note=f"no linearisation: {error}")
    along, reached = walk(other, point, loads)
    note = "" if along is not None else f"small steps are lost at {100 * reached:.4g} %"
    path = np.nan
    if along is not None:
        path = float(np.linalg.norm(along.state - solution.state) / np.linalg.norm(along.state))
        if path > SAME:
            there = negatives(along.linearise(), along.state)
            note = f"small steps lead elsewhere: {there} negative eigenvalues there"
    refuted = {
        "J ≤ 0": not row.smallest_jacobian > 0,
        "no equilibrium": not balanced,
        "not converged": not (row.correction <= SAME),
        "another state": path > SAME,
    }
    reasons = [what for what, found in refuted.items() if found]
    accuracy = np.nan
    if case.finer is not None:
        expected = reference(*case.finer)
        accuracy = abs(float(solution.outputs[0]) / expected - 1)
    outcome = "WRONG" if reasons else "converged"
    note = "; ".join(filter(None, [*reasons, note]))
    return replace(row, outcome=outcome, path=path, accuracy=accuracy, note=note)


def within_limit(model: HyperelasticModel, point: FloatArray) -> FiniteElementSolution:
    """Solve, unless it takes too long."""

    def stop(*_: object) -> None:
        raise Hang

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(LIMIT)
    try:
        return model.solve(point)
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def inspect(
    row: Row, model: HyperelasticModel, other: HyperelasticModel, solution: FiniteElementSolution, point: FloatArray
) -> tuple[Row, bool]:
    """Look at the state that was found: residual in other equations, what Newton would still change, its stiffness.

    Returns the row with what was seen, and whether the state is an equilibrium in the other equations.
    """
    check = other.equations
    check.set_parameters(point)
    check.at_load(1.0)
    residual = check.residual(solution.state)
    equations = solution.linearise()
    correction = equations.norm(equations.back_substitute(-residual.vector)) / equations.norm(solution.state)
    seen = replace(
        row,
        smallest_jacobian=equations.smallest_jacobian(solution.state),
        negative=negatives(equations, solution.state),
        condition=condition(equations),
        residual=residual.relative,
        correction=correction,
    )
    small = residual.size <= max(EQUILIBRIUM * residual.scale, check.rounding(solution.state, residual.scale))
    return seen, small and residual.gap == 0


def negatives(equations: Any, u: FloatArray) -> int:
    """Number of negative eigenvalues of the stiffness at u, where equations are linearised; of its symmetric part."""
    found = equations.inertia()
    return int(equations.negative_eigenvalues(u) if found is None else found)


def condition(equations: Any, iterations: int = 15) -> float:
    """Estimate |λ|max/|λ|min of the stiffness of the free unknowns, from below, by (inverse) power iterations."""
    rng = np.random.default_rng(0)
    sizes = []
    for inverse in (False, True):
        v = rng.standard_normal(equations.size)
        for _ in range(iterations):
            v[equations.fixed] = 0
            v /= equations.norm(v)
            v = equations.back_substitute(v) if inverse else equations.stiffness_times(v)
        v[equations.fixed] = 0
        sizes.append(equations.norm(v))
    return float(sizes[0] * sizes[1])


def walk(model: HyperelasticModel, point: FloatArray, loads: FloatArray) -> tuple[FiniteElementSolution | None, float]:
    """Follow the equilibrium by small steps of the load; where one jumps or fails, by smaller ones.

    Returns the solution at full load, or nothing with the fraction where the path is lost.
    """
    at, step, u, slope, solution = 0.0, 1 / PATH, np.zeros(model.equations.size), None, None
    end = time.perf_counter() + PATIENCE
    while time.perf_counter() < end and at + step > at:
        to = min(1.0, at + step)
        start = u if slope is None else u + (to - at) * slope
        try:
            solution = model.solve(np.where(loads, to * point, point), Guess(start))
            change = (solution.state - u) / (to - at)
            steady = slope is None or np.linalg.norm(change - slope) <= np.linalg.norm(slope)
            good = steady and solution.work.load_steps == 0
        except SolveError:
            good = False
        if not good:
            step /= 4
            continue
        at, u, slope = to, solution.state, change
        if at == 1:
            return solution, at
        step = min(2 * step, 1 / PATH)
    return None, at


# --- what is shown ---------------------------------------------------------------------------------------------------


def main(words: Sequence[str] = ()) -> None:
    """Print a table for each family (or those that are named), and write the table and the picture of all."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks stability")
    parser.add_argument("--only", nargs="*", default=[], help="parts of the names of families")
    names = parser.parse_args(words).only
    chosen = [family for family in FAMILIES if not names or any(name in family for name in names)]
    rows: list[Row] = []
    begin = time.perf_counter()
    for make in dict.fromkeys(FAMILIES[family][2] for family in chosen):
        for case in make():
            if case.family in chosen:
                rows.append(run(case))
                sys.stderr.write(f"{time.perf_counter() - begin:.0f} s {rows[-1]}\n")
        built.cache_clear()
    for family in chosen:
        across, down, _ = FAMILIES[family]
        print(f"\n### {family}\n")
        print(
            f"| {down} | {across} | outcome | factorisations | load steps | smallest J | negative eigenvalues "
            "| condition | residual | correction left | off the path | off a finer mesh | s | |"
        )
        print("|---" * 14 + "|")
        for r in rows:
            if r.family == family:
                values = (r.smallest_jacobian, r.condition, r.residual, r.correction, r.path, r.accuracy, r.seconds)
                j, *rest = ("–" if np.isnan(value) else f"{value:.2g}" for value in values)
                counts = [r.factorisations, r.load_steps, j, r.negative if r.negative >= 0 else "–"]
                print("| " + " | ".join(map(str, (r.y, r.x, r.outcome, *counts, *rest, r.note))) + " |")
    counts = {outcome: sum(r.outcome == outcome for r in rows) for outcome in COLOURS}
    print(f"\n{', '.join(f'{count} {outcome}' for outcome, count in counts.items())}")
    unstable = sum(r.outcome == "converged" and r.negative > 0 for r in rows)
    alone = sum(r.outcome == "converged" and np.isnan(r.path) for r in rows)
    print(f"of the converged, small steps did not arrive in time at {alone}; {unstable} are unstable")
    print(f"<!-- {len(rows)} cases, {time.perf_counter() - begin:.0f} s -->")
    TABLE.parent.mkdir(exist_ok=True)
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(asdict(rows[0])))
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)
    if not names:
        draw(rows)


COLOURS = {"converged": "#8fc1a3", "failed": "#e9c46a", "WRONG": "#c1272d", "SILENT": "#5b2a86"}


def draw(rows: list[Row]) -> None:
    """Draw a panel for each family: colour is the outcome, the number counts factorisations."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch, Rectangle

    figure = Figure(figsize=(13, 9), layout="constrained")
    FigureCanvasAgg(figure)
    for ax, (family, (across, down, _)) in zip(figure.subplots(3, 2).ravel(), FAMILIES.items(), strict=True):
        own = [row for row in rows if row.family == family]
        xs, ys = (list(dict.fromkeys(getattr(row, name) for row in own)) for name in ("x", "y"))
        for row in own:
            i, j = xs.index(row.x), ys.index(row.y)
            unstable = row.outcome == "converged" and row.negative > 0
            hatch = "///" if unstable else ""
            text = "white" if row.outcome in {"WRONG", "SILENT"} else "black"
            ax.add_patch(
                Rectangle(
                    (i - 0.48, j - 0.48), 0.96, 0.96, facecolor=COLOURS[row.outcome], edgecolor="white", hatch=hatch
                )
            )
            ax.text(i, j, str(row.factorisations), ha="center", va="center", fontsize=9, color=text)
        ax.set(title=family, xlabel=across, ylabel=down, xlim=(-0.5, len(xs) - 0.5), ylim=(-0.5, len(ys) - 0.5))
        ax.set_xticks(range(len(xs)), xs, rotation=90 if len(xs) > 12 else 0)
        ax.set_yticks(range(len(ys)), ys)
        ax.spines[:].set_visible(False)
        ax.tick_params(length=0)
    shown = [Patch(facecolor=colour, label=outcome) for outcome, colour in COLOURS.items()]
    shown.append(Patch(facecolor=COLOURS["converged"], hatch="///", edgecolor="white", label="converged, unstable"))
    figure.legend(handles=shown, loc="outside lower center", ncols=5, frameon=False)
    figure.suptitle("What the solver does in hard cases (numbers: factorisations of one solve)")
    figure.savefig(PICTURE, dpi=110)
