"""Heavy tails: how often claims for the standard deviation hold for functions of log-normal parameters, or say so."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from benchmarks import coverage
from benchmarks.coverage import CASES, Case, measure
from uq.inputs.distributions import LogNormal
from uq.inputs.quadrature import panels
from uq.inputs.random_parameters import Inputs
from uq.methods import chaos
from uq.methods.chaos import Chaos
from uq.methods.derivative_based import DerivativeBased
from uq.methods.monte_carlo import MonteCarlo, SensitivityMonteCarlo
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo
from uq.methods.sobol import Sobol

REPEATS = 40


def cases() -> tuple[Case, ...]:
    """Return functions of log-normal parameters of mean 1, with their moments; and the exponential of ten normals."""
    found = []
    for cv in (0.5, 1.0, 2.0):
        parameter = LogNormal(mean=1.0, std=cv)
        two, one = Inputs(dict.fromkeys("ab", parameter)), Inputs({"a": parameter})
        z, weights = panels(np.linspace(-9, 9, 40).tolist())
        weights = weights * np.exp(-(z**2) / 2)
        values = np.exp(-np.outer((1, 2), parameter.from_normal(z)[0]))
        single, double = values @ weights / weights.sum()
        found += [
            Case(f"product, cv {cv:g}", lambda x: x[:, 0] * x[:, 1], two, exact=(1, ((1 + cv**2) ** 2 - 1) ** 0.5)),
            Case(f"sum, cv {cv:g}", lambda x: x.sum(axis=1), two, exact=(2, 2**0.5 * cv)),
            Case(f"1/ω, cv {cv:g}", lambda x: 1 / x[:, 0], one, exact=(1 + cv**2, (1 + cv**2) * cv)),
            Case(
                f"exp(−a − b), cv {cv:g}",
                lambda x: np.exp(-x.sum(axis=1)),
                two,
                exact=(single**2, (double**2 - single**4) ** 0.5),
            ),
        ]
    return *found, next(case for case in CASES if case.name == "exponential")


def methods() -> dict[str, Any]:
    """Return what is tried."""
    plain = {"fields": False}
    qmc = partial(QuasiMonteCarlo, **plain)
    found: dict[str, Any] = {}
    for n in (64, 256):
        found |= {
            f"monte-carlo {n}": MonteCarlo(samples=n, **plain),
            f"sensitivity {n}": SensitivityMonteCarlo(samples=n, **plain),
            **{f"qmc, {c} {n}": qmc(samples=n, control=c) for c in ("none", "tangent", "quadratic", "chaos")},
        }
    return found | {
        "sensitivity, optimal 128": SensitivityMonteCarlo(samples=128, coefficient="optimal", **plain),
        "chaos 16": Chaos(samples=16, **plain),
        "chaos 64": Chaos(samples=64, **plain),
        "chaos, values 64": Chaos(samples=64, gradients=False, **plain),
        "sobol, exchanged 64 rows": Sobol(design="saltelli", samples=64, **plain),
        "derivative-based 64": DerivativeBased(samples=64, **plain),
    }


def main(words: Sequence[str] = ()) -> None:
    """Print the coverage of the standard deviation in %; in brackets runs with a finding, and misses without one."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks tails")
    parser.add_argument("--repeats", type=int, default=REPEATS)
    parser.add_argument("--cases", default="")
    parser.add_argument("--methods", default="")
    options = parser.parse_args(words)
    chaos.DRAWN, coverage.REFERENCE = 13, 8  # quantiles are not looked at
    chosen = [case for case in cases() if options.cases in case.name]
    print("| method | " + " | ".join(case.name for case in chosen) + " |")
    print("|" + "---|" * (1 + len(chosen)), flush=True)
    for name, method in methods().items():
        if options.methods in name:
            rows = [measure(case, method, options.repeats) for case in chosen]
            cells = [f"{_percent(row.covered[1])} ({_percent(row.found)}, {_percent(row.silent[1])})" for row in rows]
            print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def _percent(share: float) -> str:
    return f"{100 * share:.0f}"


if __name__ == "__main__":
    main(sys.argv[1:])
