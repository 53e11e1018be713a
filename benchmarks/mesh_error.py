"""The error of the mesh: what is claimed over what it is, in 17 problems; and what an estimate costs."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from tempfile import TemporaryDirectory

import numpy as np
from mpi4py import MPI

from benchmarks.beams import beam
from benchmarks.mesh_problems import CONFIGS, Case, beams, cases, cook, exact, tube
from uq.accuracy.budget import estimates_for, spare_for
from uq.accuracy.effects import unknown_of
from uq.accuracy.mesh_errors import estimate
from uq.estimators.moments import Z
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs
from uq.surrogates.linearisation import linearise
from workflows.config.study import load

SAMPLES = 8
AFFORDED = spare_for(50)  # a calibration as in a study of 50 solves
NOTHING_SPARED = -1e9  # solves, so that none is calibrated
SIZES = (
    ((20, 4, 4), "tetrahedron"),
    ((12, 3, 6), "hexahedron"),
    ((28, 6, 6), "tetrahedron"),
    ((20, 5, 8), "hexahedron"),
    ((48, 8, 10), "tetrahedron"),
)
MOST_DIRECT = 30_000  # unknowns up to which the enriched equations are solved directly too


def main(words: Sequence[str] = ()) -> None:
    """Print effectivities, and costs unless problems are named."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks mesh_error")
    parser.add_argument("--only", nargs="*", default=[], help="parts of the names of problems")
    parser.add_argument("--costs", action="store_true", help="costs alone")
    asked = parser.parse_args(words)
    only = asked.only
    if asked.costs:
        costs()
        return
    heads = ("problem", "unknowns", "output", "value", "error (%)", "seen over true")
    heads += ("in a short study", "its doubt", "calibrated", "its doubt")
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    found: list[tuple[bool, float, bool]] = []
    with TemporaryDirectory() as folder:
        for make in cases(folder):
            case = make()
            if not only or any(word in case.name for word in only):
                found += effectivities(case)
    held_short, ratios, held = np.array(found).T
    within = [np.mean((low <= ratios) & (ratios <= high)) for low, high in ((0.8, 1.25), (0.6, 1.6))]
    print(f"\n{len(found)} outputs: {within[0]:.0%} within 0.8 and 1.25, {within[1]:.0%} within 0.6 and 1.6")
    print(f"the doubt covers what is left in {held.mean():.0%}, in short studies in {held_short.mean():.0%}\n")
    if not only:
        elsewhere()
        costs()


def effectivities(case: Case) -> list[tuple[bool, float, bool]]:
    """Print a row for each output of a problem, errors and doubts over what is true.

    Return whether the doubt of a short study covers what it leaves, what is calibrated over what is true, and whether
    its doubt covers the rest.
    """
    solution = case.coarse.build(MPI.COMM_SELF, ()).solve(np.zeros(0))
    error, name = solution.mesh_error(), case.name
    short, saturation = solution.saturation(NOTHING_SPARED), solution.saturation(AFFORDED)
    if not saturation.measured and (longer := solution.saturation()).measured:
        saturation, name = longer, f"{case.name}, in a long study"
    values, known_to = exact(case)
    true = values - solution.outputs
    unknowns = f"{case.coarse.unknowns:,} → {list(case.fine.values())[-1].unknowns:,}"
    told, held = [], []
    for one in (short, saturation):
        calibrated = error.calibrated(one).outputs
        assert one.doubts is not None
        told += [calibrated / true, one.doubts / np.abs(true)]
        held.append(np.abs(calibrated - true) <= one.doubts + known_to)
    for i, output in enumerate(case.coarse.outputs):
        shares = " | ".join(f"{column[i]:.2f}" for column in (error.outputs / true, *told))
        reference = f"{values[i]:.5g} ± {known_to[i]:.1g} | {100 * true[i] / values[i]:.2g}"
        print(f"| {name} | {unknowns} | {output.name} | {reference} | {shares} |", flush=True)
    return list(zip(held[0], told[2], held[1], strict=True))


def elsewhere(only: str = "") -> None:
    """Print what a study makes of estimates at other parameters, over what a calibration of their own makes of them.

    With the doubt that it states, as in a study of 50 solves, or in a long one where so few afford no calibration.
    """
    print("| problem | parameters, at their quantiles | output: by the study over its own (stated doubt) |")
    print("|---|---|---|")
    compressible = {"kind": "neo-hookean", "C1": 40e6, "D1": 80e6}
    of_cook = load(CONFIGS / "cook.toml").inputs
    of_tube = Inputs(
        {"material.c": Uniform(lower=8e3, upper=1.2e4), "loads.pressure.size": Uniform(lower=1.2e3, upper=1.9e3)}
    )
    found, covered = list[float](), list[bool]()
    with TemporaryDirectory() as folder:
        for case, inputs in (
            (beams(), load(CONFIGS / "beam.toml").inputs),
            (cook("Cook, compressible", {"material": compressible}, 4, ()), of_cook),
            (cook("Cook, nearly incompressible", {}, 8, ()), of_cook),
            (tube(folder), of_tube),
        ):
            if only not in case.name:
                continue
            model, names = case.coarse.build(MPI.COMM_SELF, inputs.names), ", ".join(inputs.names)
            evaluate = SerialEvaluate(model)
            centre, count = linearise(inputs, evaluate), estimates_for(50)
            spare = AFFORDED
            few = estimate(inputs, evaluate, centre, count, 0, fields=False, spare=spare)
            if not few.measured:  # a long study
                spare = math.inf
                few = estimate(inputs, evaluate, centre, count, 0, fields=False, spare=spare)
            unknown, at_mean = unknown_of(few), few.outputs[0]
            for quantiles in ((0.05, 0.05), (0.05, 0.95), (0.95, 0.05), (0.95, 0.95)):
                (point,) = inputs.points(np.array([quantiles]))
                solution = model.solve(point)
                error, shifts = solution.mesh_error(), np.nan_to_num(few.shifts)
                here = error.outputs * few.saturation + shifts * solution.outputs / at_mean
                own = solution.saturation(spare)
                its = error.calibrated(own).outputs
                left = np.zeros(len(its)) if own.doubts is None else own.doubts
                ratios, doubts = here / its, unknown * np.abs(here)
                found += ratios.tolist()
                covered += (np.abs(here - its) <= Z * np.hypot(doubts, left)).tolist()
                told = ", ".join(
                    f"{output.name} {r:.2f} ({d / abs(own):.2f})"
                    for output, r, d, own in zip(case.coarse.outputs, ratios, doubts, its, strict=True)
                )
                print(f"| {case.name} | {names}: {quantiles[0]}, {quantiles[1]} | {told} |", flush=True)
    print(f"\n{min(found):.2f} to {max(found):.2f}; at 95 % the doubts cover {np.mean(covered):.0%}\n")


def costs() -> None:
    """Print what an estimate takes, over a realisation by prediction and correction, medians of both on each draw."""
    print("| beam | form | unknowns | realisation (CPU s) | estimate (CPU s) | ratio | over a direct solve | how |")
    print("|---|---|---|---|---|---|---|---|")
    for cells, cell in SIZES:
        for form in ("displacement", "mixed") if math.prod(cells) < 1010 else ("displacement",):
            study = beam(cells, f'model.body.cell="{cell}"', f'model.formulation="{form}"')
            model = study.model.build(MPI.COMM_SELF, study.inputs.names)
            prediction = linearise(study.inputs, SerialEvaluate(model)).prediction
            assert prediction is not None
            guess = prediction.on(model)
            rows, size = [], model.equations.layout.size
            count = SAMPLES if size <= MOST_DIRECT else SAMPLES // 2
            for point in study.inputs.points(np.random.default_rng(0).uniform(size=(count + 1, 2))):
                begin = time.process_time()
                solution = model.solve(point, guess(point))
                middle = time.process_time()
                error = solution.mesh_error()
                rows.append([middle - begin, time.process_time() - middle])
            way, seconds = model.enriched.way, np.median(rows[1:], axis=0)  # the first compiles
            near = "–"
            if size <= MOST_DIRECT:
                model.enriched.way = type(way).FACTOR
                direct = model.solve(point, guess(point)).mesh_error()
                near = f"{error.outputs[0] / direct.outputs[0]:.3f}"
            print(
                f"| {'×'.join(map(str, cells))} {cell}s | {form} | {size:,} | {seconds[0]:.3f} "
                f"| {seconds[1]:.3f} | {seconds[1] / seconds[0]:.1f} | {near} | {way} |",
                flush=True,
            )
