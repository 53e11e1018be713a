"""Odd functions: how often claims of mean and standard deviation miss the truth in silence, by method."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks import coverage, held_out
from benchmarks.coverage import Case, measure
from uq.inputs.distributions import LogNormal, Normal, Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods import chaos
from uq.methods.chaos import Chaos
from uq.methods.derivative_based import DerivativeBased
from uq.methods.monte_carlo import MonteCarlo, SensitivityMonteCarlo
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo
from uq.methods.sobol import Sobol

REPEATS = 40
UNIT = Uniform(lower=0.0, upper=1.0)
STANDARD = Normal(mean=0.0, std=1.0)
MANY = 12  # parameters from which expansions are left out, for time
Function = Callable[[Any], Any]


def _of(d: int, marginal: Any = UNIT) -> Inputs:
    return Inputs({f"x{i}": marginal for i in range(d)})


def _fall(d: int) -> Any:
    return 1 / (1 + np.arange(d))


def _flat(function: Function) -> Function:
    """Return a function whose derivatives are zero wherever it has some."""
    return lambda x: function(np.real(x)) + 0 * x[:, 0]


def _root_of_four_fifths(x: Any) -> Any:
    """Return a root that exists on four fifths of the range."""
    return np.sqrt(np.where(np.real(x[:, 0]) > 0.2, x[:, 0] - 0.2, np.nan)) + x[:, 1]


def _pole_that_fails(x: Any) -> Any:
    return np.where(np.real(x.sum(axis=1)) < 2.2, 1 / (2.5 - x.sum(axis=1)), np.nan)


def _rare_kink(x: Any) -> Any:
    return x[:, 1] + 5 * np.where(np.real(x[:, 0]) > 0.9, x[:, 0] - 0.9, 0)


def _jump_on_slope(x: Any) -> Any:
    return x[:, 2] + np.where(np.real(x[:, 0] * x[:, 1]) > 0.67, 3.0, 0.0)


def _largest(x: Any) -> Any:
    return np.take_along_axis(x, np.real(x).argmax(axis=1)[:, None], axis=1)[:, 0]


def _student(x: Any) -> Any:
    """Return Student's t with five degrees of freedom, of six normals."""
    return x[:, 0] / np.sqrt(1e-12 + (x[:, 1:] ** 2).mean(axis=1))


def _outlier(x: Any) -> Any:
    return x[:, 1] + np.where(np.real(x[:, 0]) < 0.01, 5.0, 0.0)


def cases() -> tuple[Case, ...]:
    """Return the functions; the truth is what 2^18 points give where there is no closed form."""
    return *_first(), *_tails()


def _first() -> tuple[Case, ...]:
    e, none = np.exp(1), (np.inf, np.inf)
    normals, wide = _of(2, STANDARD), _of(2, LogNormal(mean=1.0, std=1.0))
    near = 1 / 1e-3 - 1 / 1.001 - np.log(1001) ** 2
    power = 10 - 1 / 0.55**2 + 1 / 12
    return (
        Case("kink, rare", _rare_kink, _of(2)),
        Case("kinks of 6", lambda x: np.where(np.real(x) > 0.37, x - 0.37, 0.37 - x).sum(axis=1), _of(6)),
        Case("event, 3 %", _flat(lambda x: 1.0 * (x[:, 0] + x[:, 1] < 0.245)), _of(2)),
        Case("event, 10 %, on a slope", _jump_on_slope, _of(3)),
        Case("steps", _flat(lambda x: np.floor(5 * x[:, 0]) + np.floor(3 * x[:, 1])), _of(2)),
        Case("counts", _flat(lambda x: np.floor(np.exp(1.2 * x[:, 0] + 0.5 * x[:, 1]))), normals),
        Case("fast oscillation", lambda x: np.sin(40 * x[:, 0]) + x[:, 1], _of(2)),
        Case("oscillation of normals", lambda x: np.cos(3 * x[:, 0] + 2 * x[:, 1]), normals),
        Case("oscillation of 1 %", lambda x: x[:, 0] + x[:, 1] + 0.01 * np.sin(60 * x[:, 0]), _of(2)),
        Case("steep ridge", lambda x: 1 / (1 + np.exp(-30 * (x @ _fall(4) - 1.0))), _of(4)),
        Case("exponential ridge", lambda x: np.exp(2 * x @ _fall(8)), _of(8)),
        Case("cubic ridge", lambda x: (x @ _fall(6)) ** 3, _of(6, STANDARD)),
        Case("fifth power of a ridge", lambda x: (x @ _fall(3)) ** 5, _of(3, STANDARD)),
        Case("five inert of six", lambda x: np.exp(x[:, 0]) + 0 * x[:, 1], _of(6)),
        Case("five inert, a jump", _flat(lambda x: 1.0 * (x[:, 0] > 0.3)), _of(6)),
        Case("inputs near zero", lambda x: np.exp(1e12 * x[:, 0]), _of(2, Uniform(lower=0.0, upper=1e-12))),
        Case("large offset", lambda x: 1e9 + np.sin(5 * x[:, 0]) * x[:, 1], _of(2)),
        Case("product of ten", lambda x: np.prod(2 * x, axis=1), _of(10), exact=(1, ((4 / 3) ** 10 - 1) ** 0.5)),
        Case("high power", lambda x: x[:, 0] ** 12 + x[:, 1], _of(2)),
        Case("1/(0.001 + u)", lambda x: 1 / (1e-3 + x[:, 0]), _of(1), exact=(np.log(1001), near**0.5)),
        Case("1/(0.02 + u)", lambda x: 1 / (0.02 + x[:, 0]) + x[:, 1], _of(2)),
        Case("logarithm", lambda x: np.log(1e-9 + x[:, 0]) + x[:, 1], _of(2)),
        Case("roots", lambda x: np.sqrt(x[:, 0]) + x[:, 1] ** 0.2, _of(2)),
        Case("u^-0.45", lambda x: x[:, 0] ** -0.45 + x[:, 1], _of(2), exact=(1 / 0.55 + 0.5, power**0.5)),
        Case("u^-0.6, no variance", lambda x: x[:, 0] ** -0.6 + x[:, 1], _of(2), exact=(3.0, np.inf)),
        Case("Cauchy", lambda x: np.tan(np.pi * (x[:, 0] - 0.5)) + x[:, 1], _of(2), exact=none),
        Case("ratio of normals", lambda x: x[:, 0] / x[:, 1], normals, exact=none),
        Case("1 + exp(1.5 z)", lambda x: 1 + np.exp(1.5 * x[:, 0]) + x[:, 1], normals, exact=(
            1 + np.exp(1.125), (np.exp(2.25) * np.expm1(2.25) + 1) ** 0.5)),
        Case("sinh(1.5 z)", lambda x: np.sinh(1.5 * x[:, 0]) + x[:, 1], normals, exact=(
            0, (np.expm1(4.5) / 2 + 1) ** 0.5)),
        Case("5 - exp(z)", lambda x: 5 - np.exp(x[:, 0]) + x[:, 1] / 2, normals, exact=(
            5 - e**0.5, (e * (e - 1) + 0.25) ** 0.5)),
        Case("difference of log-normals", lambda x: x[:, 0] - x[:, 1], wide, exact=(0, 2**0.5)),
        Case("fails on a fifth", _root_of_four_fifths, _of(2)),
        Case("fails where large", _pole_that_fails, _of(4)),
        Case("30 parameters", lambda x: x @ _fall(30) + x[:, 0] * x[:, 1] + np.sin(3 * x[:, 2]), _of(30)),
        Case("100 parameters", lambda x: np.exp(x @ _fall(100) / 3) + x[:, 0] * x[:, 50], _of(100)),
    )  # fmt: skip


def _tails() -> tuple[Case, ...]:
    """Return functions with tails on one or both sides, ends, rare events and corners."""
    normals, four, ten, two = (_of(d, STANDARD) for d in (2, 4, 10, 2))
    narrow = LogNormal(mean=1.0, std=0.3)
    return (
        Case("exp(z)^2", lambda x: np.exp(2 * x[:, 0]) + x[:, 1], normals, exact=(
            np.exp(2), (np.exp(4) * np.expm1(4) + 1) ** 0.5)),
        Case("exp(0.7 z)", lambda x: np.exp(0.7 * x[:, 0]) + x[:, 1] / 2, normals, exact=(
            np.exp(0.245), (np.exp(0.49) * np.expm1(0.49) + 0.25) ** 0.5)),
        Case("sinh(z)", lambda x: np.sinh(x[:, 0]) + x[:, 1] / 2, normals, exact=(
            0, (np.expm1(2) / 2 + 0.25) ** 0.5)),
        Case("|z|^3", lambda x: np.where(np.real(x[:, 0]) < 0, -x[:, 0], x[:, 0]) ** 3 + x[:, 1], normals, exact=(
            2 * (2 / np.pi) ** 0.5, (15 - 8 / np.pi + 1) ** 0.5)),
        Case("z^3", lambda x: x[:, 0] ** 3 + x[:, 1], normals, exact=(0, 4.0)),
        Case("z^4", lambda x: x[:, 0] ** 4 + x[:, 1], normals, exact=(3, 97**0.5)),
        Case("z^2", lambda x: x[:, 0] ** 2 + x[:, 1] / 2, normals, exact=(1, 1.5)),
        Case("sum of squares of 10", lambda x: (x**2).sum(axis=1), ten, exact=(10, 20**0.5)),
        Case("product of normals", lambda x: x[:, 0] * x[:, 1], normals, exact=(0, 1)),
        Case("product of four normals", lambda x: np.prod(x, axis=1), four, exact=(0, 1)),
        Case("z exp(z')", lambda x: x[:, 0] * np.exp(x[:, 1]), two, exact=(0, np.exp(1))),
        Case("exp(z z'/3)", lambda x: np.exp(x[:, 0] * x[:, 1] / 3), two, exact=(
            (1 - 1 / 9) ** -0.5, ((1 - 4 / 9) ** -0.5 - 1 / (1 - 1 / 9)) ** 0.5)),
        Case("Student, 5", _student, _of(6, STANDARD), exact=(0, (5 / 3) ** 0.5)),
        Case("1/(1 + 100 z²)", lambda x: 1 / (1 + 100 * x[:, 0] ** 2) + x[:, 1] / 10, normals),
        Case("largest of 10", _largest, ten),
        Case("product of 10 log-normals", lambda x: np.prod(x, axis=1), _of(10, narrow), exact=(
            1, (1.09**10 - 1) ** 0.5)),
        Case("product of 30 log-normals", lambda x: np.prod(x, axis=1), _of(30, LogNormal(mean=1.0, std=0.1)), exact=(
            1, (1.01**30 - 1) ** 0.5)),
        Case("1/ω − ω'", lambda x: 1 / x[:, 0] - x[:, 1], _of(2, LogNormal(mean=1.0, std=0.7))),
        Case("event, 1 %", _flat(lambda x: 1.0 * (x[:, 0] < 0.01)), _of(2)),
        Case("outlier, 1 %", _outlier, _of(2)),
        Case("sin(20 u)", lambda x: np.sin(20 * x[:, 0]), _of(1)),
        Case("tan near its pole", lambda x: np.tan(1.55 * x[:, 0]) + x[:, 1], _of(2)),
        Case("pole at a corner", lambda x: 1 / (0.02 + x.sum(axis=1)), _of(3)),
        Case("−ln u", lambda x: -np.log(x[:, 0]) + x[:, 1], _of(2), exact=(1.5, (13 / 12) ** 0.5)),
        Case("u^-0.3", lambda x: x[:, 0] ** -0.3 + x[:, 1], _of(2), exact=(
            1 / 0.7 + 0.5, (1 / 0.4 - 1 / 0.49 + 1 / 12) ** 0.5)),
        Case("u^-0.25 − v^-0.25", lambda x: x[:, 0] ** -0.25 - x[:, 1] ** -0.25, _of(2), exact=(
            0, (2 * (2 - 16 / 9)) ** 0.5)),
        Case("peak at an end", lambda x: np.exp(-40 * x[:, 0]) + x[:, 1] / 10, _of(2)),
        Case("exp(6 u)", lambda x: np.exp(6 * x[:, 0]) * (1 + x[:, 1]), _of(2)),
        Case("exp(3 sum of 4)", lambda x: np.exp(3 * x.sum(axis=1)), _of(4)),
    )  # fmt: skip


def methods() -> dict[str, Any]:
    """Return what is tried."""
    plain: dict[str, Any] = {"fields": False}
    return {
        "monte-carlo 64": MonteCarlo(samples=64, **plain),
        "sensitivity 64": SensitivityMonteCarlo(samples=64, **plain),
        "sensitivity, optimal 64": SensitivityMonteCarlo(samples=64, coefficient="optimal", **plain),
        "qmc, none 64": QuasiMonteCarlo(samples=64, control="none", **plain),
        "qmc, none 256": QuasiMonteCarlo(samples=256, control="none", **plain),
        "qmc, tangent 128": QuasiMonteCarlo(samples=128, **plain),
        "qmc, optimal 128": QuasiMonteCarlo(samples=128, coefficient="optimal", **plain),
        "qmc, quadratic 128": QuasiMonteCarlo(samples=128, control="quadratic", **plain),
        "qmc, chaos 64": QuasiMonteCarlo(samples=64, control="chaos", **plain),
        "qmc, 4 scrambles 128": QuasiMonteCarlo(samples=128, scrambles=4, **plain),
        "chaos 16": Chaos(samples=16, **plain),
        "chaos 40": Chaos(samples=40, **plain),
        "chaos, values 16": Chaos(samples=16, gradients=False, **plain),
        "chaos, values 64": Chaos(samples=64, gradients=False, **plain),
        "sobol, exchanged 32 rows": Sobol(design="saltelli", samples=32, **plain),
        "derivative-based 64": DerivativeBased(samples=64, **plain),
    }


LISTS = {"odd": cases, "held-out": held_out.first, "held-out-2": held_out.second}


def main(words: Sequence[str] = ()) -> None:
    """Print shares (%): intervals of mean and std that hold the truth; in brackets those that miss it in silence."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks oddities")
    parser.add_argument("--repeats", type=int, default=REPEATS)
    parser.add_argument("--cases", default="")
    parser.add_argument("--methods", default="")
    parser.add_argument("--list", choices=LISTS, default="odd")
    options = parser.parse_args(words)
    chaos.DRAWN, coverage.REFERENCE = 10, 14  # quantiles are not looked at
    chosen = {name: method for name, method in methods().items() if options.methods in name}
    print("| function | " + " | ".join(chosen) + " |")
    print("|" + "---|" * (1 + len(chosen)), flush=True)
    for case in LISTS[options.list]():
        if options.cases in case.name:
            cells = [_cell(case, name, method, options.repeats) for name, method in chosen.items()]
            print(f"| {case.name} | " + " | ".join(cells) + " |", flush=True)


def _cell(case: Case, name: str, method: Any, repeats: int) -> str:
    if len(case.inputs.names) > MANY and ("chaos" in name or "quadratic" in name or "sobol" in name):
        return "–"
    row = measure(case, method, repeats)
    covered, silent = (", ".join(f"{100 * share:.0f}" for share in shares[:2]) for shares in (row.covered, row.silent))
    return f"{covered} ({silent})"


if __name__ == "__main__":
    main(sys.argv[1:])
