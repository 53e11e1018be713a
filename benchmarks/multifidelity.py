"""Several models of one body: honesty of the errors on closed forms, and gain over the tangent on the beam."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from mpi4py import MPI

from benchmarks.beams import CONFIG
from benchmarks.coverage import Case, Vectorised
from forward.model import FloatArray
from uq.estimators.scores import gains
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Normal, Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods.compare import Compare
from uq.methods.multifidelity import Multifidelity
from workflows.config.study import load

REPEATS = 400
CHEAP = ("close", "far")  # models of the closed forms
COSTS = (0.05, 0.002)
NESTED = (0.01, 0.005)  # of two reduced models, which the closed forms with tails are like


class Hierarchy(Vectorised):
    """A closed form and two cheaper ones, with all points at once."""

    def __init__(self, cases: Sequence[Case]) -> None:
        super().__init__(cases[0])
        self._others = dict(zip(CHEAP, cases[1:], strict=True))

    def on(self, model: str) -> Vectorised:
        """Return one of the cheaper ones."""
        return Vectorised(self._others[model]) if model else self


def _forms() -> dict[str, tuple[Inputs, list[Any], FloatArray]]:
    """Closed forms with cheaper neighbours, and exact mean and standard deviation."""
    unit = Inputs({"a": Uniform(lower=0.0, upper=1.0), "b": Uniform(lower=0.0, upper=1.0)})
    normal = Inputs(dict.fromkeys("ab", Normal(mean=0.0, std=1.0)))
    w = 2 * np.pi

    def wave(amplitude: float, tilt: float) -> Any:
        return lambda x: np.exp(x[:, 0] + tilt) + amplitude * np.sin(5 * w * x[:, 0]) * np.cos(3 * w * x[:, 1])

    def root(power: float) -> Any:
        return lambda x: np.sqrt(1e-300 + x[:, 0] ** power) + 0.5 * x[:, 1] ** 2

    def tails(curve: float) -> Any:
        return lambda x: np.exp(0.4 * x[:, 0]) + curve * x[:, 1] ** 2

    def peak(cut: float, bend: float) -> Any:
        return lambda x: 1 / (np.exp(-0.9 * x[:, 0]) + cut) + 0.5 * x[:, 1] + bend * np.sin(4 * x[:, 1])

    def power(cut: float, bend: float) -> Any:
        return lambda x: (x[:, 0] ** 1.2 + cut) ** (-1 / 6) + 0.3 * x[:, 1] + bend * np.sin(20 * x[:, 1])

    e = np.e
    mean = e - 1
    variance = (e**2 - 1) / 2 - mean**2 + 0.25 * 0.3**2
    m = np.exp(0.08)
    spread = np.exp(0.16) * (np.exp(0.16) - 1)
    return {
        "a fast wave that the cheap ones miss in part": (
            unit,
            [wave(0.3, 0.0), wave(0.27, 0.1), wave(0.0, 0.3)],
            np.array([mean, np.sqrt(variance)]),
        ),
        "powers": (
            unit,
            [root(6.0), root(5.0), root(2.0)],
            np.array([1 / 4 + 1 / 6, np.sqrt(1 / 7 - 1 / 16 + 0.25 * (1 / 5 - 1 / 9))]),
        ),
        "log-normal and square": (
            normal,
            [tails(0.2), tails(0.1), tails(0.0)],
            np.array([m + 0.2, np.sqrt(spread + 2 * 0.04)]),
        ),
        "a log-normal peak that the cheap ones cut off": (
            normal,
            [peak(0.0, 0.0), peak(0.02, 0.02), peak(0.06, 0.04)],
            np.array([np.exp(0.405), np.sqrt(np.exp(0.81) * (np.exp(0.81) - 1) + 0.25)]),
        ),
        "a power without fifth moment that they cut off": (
            unit,
            [power(0.0, 0.0), power(2e-4, 0.003), power(2e-3, 0.006)],
            np.array([1.25 + 0.15, np.sqrt(1 / 0.6 - 1.25**2 + 0.09 / 12)]),
        ),
    }


def closed_forms(repeats: int, only: str) -> None:
    """Print bias, coverage and gain of the claims on closed forms."""
    print(
        "| function | full solves | spent | bias of the mean over its error | of the std | 95 % intervals: mean | std "
        "| gain, true | claimed | error of the std |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    block = {"kind": "python", "function": "math.sin", "parameters": {"a": 1.0, "b": 1.0}, "outputs": ("f",)}
    forms = {name: form for name, form in _forms().items() if only in name}
    for (name, (inputs, functions, exact)), full in product(forms.items(), ("evenly", "differences", "auto")):
        evaluate = Hierarchy([Case(name, function, inputs) for function in functions])
        costs = NESTED if "cut off" in name else COSTS
        cheap = [{"kind": "model", "name": n, "cost": c, "model": block} for n, c in zip(CHEAP, costs, strict=True)]
        for samples in (48, 128):
            rows = []
            for seed in range(repeats):
                options: dict[str, Any] = {"cheap": cheap, "control": "none", "quantiles": (), "full_solves": full}
                data = Multifidelity(samples=samples, seed=seed, **options).run(inputs, evaluate)  # type: ignore[arg-type]
                rows.append([float(data[n][0]) for n in ("mean", "mean_error", "std", "std_error", "gain")])
            mean, mean_error, std, std_error, gain = np.array(rows).T
            both = (mean - exact[0], mean_error), (std - exact[1], std_error)
            held = [100 * (np.abs(error) < 1.96 * s).mean() for error, s in both]
            bias = [error.mean() / error.std() for error, _ in both]
            true = exact[1] ** 2 / samples / (both[0][0] ** 2).mean()
            print(
                f"| {name} | {full} | {samples} | {bias[0]:+.3f} ± {repeats**-0.5:.3f} | {bias[1]:+.3f} | "
                f"{held[0]:.1f} % | {held[1]:.1f} % | {true:.0f} ± {true * (2 / repeats) ** 0.5:.0f} | "
                f"{np.median(gain):.0f} | {(both[1][0] ** 2).mean() ** 0.5 / exact[1]:.3g} |",
                flush=True,
            )


SAG = '{name = "uy_max", kind = "max-displacement", component = "y"}'
STRESS = '{name = "stress", kind = "max-von-mises"}'
COARSE = {"kind": "mesh", "coarser": 2.0}
LINEAR = {"kind": "mesh", "coarser": 1.0, "degree": 1}


def beam(
    title: str, changes: Sequence[str], cheap: Sequence[Any], reference: dict[str, Any], repeats: int, budget: int
) -> None:
    """Compare with the tangent on the beam: errors are those of repeats, costs processor times."""
    study = load(CONFIG, list(changes))
    entries: list[dict[str, Any]] = [
        {"kind": "monte-carlo", "budgets": (budget,)},
        {"name": "tangent", "kind": "sensitivity-monte-carlo", "budgets": (budget,)},
        {"name": "models", "kind": "multifidelity", "control": "tangent", "cheap": tuple(cheap), "budgets": (budget,)},
        {"name": "models, auto", "kind": "multifidelity", "cheap": tuple(cheap), "budgets": (budget,)},
    ]
    method = Compare(methods=tuple(entries), reference=reference, repeats=repeats, textbook=4)  # type: ignore[arg-type]
    others = {n: m.build(MPI.COMM_SELF, study.inputs.names) for n, m in method.models(study.spec).items()}
    evaluate = SerialEvaluate(study.spec.build(MPI.COMM_SELF, study.inputs.names), others=others)
    data = method.run(study.inputs, evaluate)
    print(f"\n{title}; {repeats} repeats, {budget} solves of the study's model or what they cost by prediction:\n")
    print("| method | output | solves | CPU (s) | error of the mean | claims hold | gain over MC | over the tangent |")
    print("|---|---|---|---|---|---|---|---|")
    gain = gains(data, "mean")["cpu"]
    names = data["row_method"].to_numpy().tolist()
    for i, name in enumerate(names):
        if name.endswith("textbook solver"):
            continue
        row = data.isel(row=i)
        for output in data["output"].values:
            one = row.sel(output=output)
            g = float(gain.isel(row=i).sel(output=output))
            to = float(gain.isel(row=names.index("tangent")).sel(output=output))
            print(
                f"| {name} | {output} | {int(one['solves']):,} | {float(one['cpu_seconds']):.2g} | "
                f"{float(one['mean_rmse']):.3g} ± {float(one['mean_rmse_error']):.1g} | "
                f"{float(one['mean_coverage']):.0%} | "
                f"{g:.3g} | {g / to:.2g} ± {2 * g / to / repeats**0.5:.1g} |",
                flush=True,
            )


def main(words: Sequence[str] = ()) -> None:
    """Print everything, or one part of it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks multifidelity")
    parser.add_argument("--repeats", type=int, default=REPEATS, help="of closed forms")
    parser.add_argument("--beam", type=int, default=20, help="repeats on the beam")
    parser.add_argument("--only", choices=["closed", "beam"], default=None)
    parser.add_argument("--form", default="", help="closed forms whose names have this in them")
    given = parser.parse_args(words)
    if given.only in (None, "closed"):
        closed_forms(given.repeats, given.form)
    outputs = f"model.outputs=[{SAG},{STRESS}]"
    if given.only in (None, "beam"):
        beam(
            "Two parameters",
            [outputs, "model.body.cells=[12,2,4]"],
            [COARSE, LINEAR],
            {"kind": "chaos", "samples": 64, "max_order": 8},
            given.beam,
            96,
        )


if __name__ == "__main__":
    main(sys.argv[1:])
