"""Square roots at limit points, and staircases, by few solves with gradients: what is missed and not said.

Of smooth functions also how often a warning speaks of them, which accuses them wrongly where the claims hold. No
constant of an estimator was chosen on these.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks import coverage
from benchmarks.coverage import UNIT, Case, measure
from uq.inputs.distributions import Beta, Distribution, LogNormal, Normal, Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods import chaos
from uq.methods.chaos import Chaos

REPEATS = 200
BOTH, STANDARD = Uniform(lower=-1.0, upper=1.0), Normal(mean=0.0, std=1.0)
HUMP, NARROW = Beta(a=2.0, b=2.0, lower=0.0, upper=1.0), LogNormal(mean=1.0, std=0.2)


def _case(name: str, function: Callable[..., Any], *marginals: Distribution, exact: Any = None) -> Case:
    inputs = Inputs({f"x{i}": one for i, one in enumerate(marginals)})
    return Case(name, lambda x: function(*x.T), inputs, exact=exact)


def _root(x: Any) -> Any:
    """Return the root of the positive part, with a finite derivative."""
    return np.where(np.real(x) > 0, np.sqrt(np.where(np.real(x) > 0, x, 1.0)), 0 * x)


def _absolute(x: Any) -> Any:
    return np.where(np.real(x) < 0, -x, x)


def _steps(x: Any) -> Any:
    return np.floor(20 * np.real(x)) / 20


def _exponential(*sizes: float) -> tuple[float, float]:
    """Return mean and standard deviation of exp(Σ s_i z_i)."""
    square = np.exp(np.square(sizes).sum())
    return float(square**0.5), float((square * (square - 1)) ** 0.5)


def edges() -> tuple[Case, ...]:
    """Return functions with roots: of limit points, next to them, of beginnings and of distances."""
    return (
        _case("limit point", lambda u: 1 - np.sqrt(1 - u), UNIT, exact=(1 / 3, 18**-0.5)),
        _case("limit point, 2", lambda u, v: np.sqrt(1.2 - 0.7 * u - 0.5 * v), UNIT, UNIT),
        _case("near a limit point, 2", lambda u, v: (1 + v) * (2 - np.sqrt(1.03 - u)), UNIT, UNIT),
        _case("limit point, 3", lambda u, v, w: 1 - np.sqrt(1.5 - 0.8 * u - 0.4 * v - 0.3 * w), *3 * [UNIT]),
        _case("limit point of a product", lambda u, v: np.sqrt(1.01 - u * v), UNIT, UNIT),
        _case("buckling", lambda u, v: _root(u - 0.45) + 0.3 * v, UNIT, UNIT),
        _case("root of |u|", lambda u, v: np.sqrt(_absolute(u - 0.13)) + v, BOTH, UNIT),
        _case("|u|^1.5", lambda u, v: _absolute(u + 0.2) ** 1.5 * (1 + v / 2), BOTH, UNIT),
    )


def smooth() -> tuple[Case, ...]:
    """Return smooth functions."""
    return (
        _case("cubic", lambda u, v: u**3 - u * v + v**2 / 2 + u, BOTH, BOTH),
        _case("product of 3", lambda u, v, w: (1 + u) * (1 + v / 2) * (1 + w / 3), *3 * [UNIT]),
        _case("exp", lambda u, v: np.exp(u + v / 2), UNIT, UNIT),
        _case("sin(3 u)", lambda u: np.sin(3 * u + 0.5), UNIT),
        _case("sin(2 u + v)", lambda u, v: np.sin(2 * u + v), BOTH, UNIT),
        _case("1/(1 + u²)", lambda u: 1 / (1 + u**2), UNIT),
        _case("root of 1.6 - u", lambda u, v: np.sqrt(1.6 - u) * (1 + v), UNIT, UNIT),
        _case("ln(1 + u + v)", lambda u, v: np.log(1 + u + v), UNIT, UNIT),
        _case("1/(1 + b), beta", lambda b, v: (1 + v) / (1 + b), HUMP, UNIT),
        _case("quadratic of normals", lambda y, z: y + z / 2 + 0.2 * y**2 + 0.1 * y * z, *2 * [STANDARD], exact=(
            0.2, (1 + 0.25 + 0.08 + 0.01) ** 0.5)),
        _case("exp of 3 normals", lambda x, y, z: np.exp(0.2 * x + 0.1 * y + 0.1 * z), *3 * [STANDARD],
              exact=_exponential(0.2, 0.1, 0.1)),
        _case("a/b, log-normal", lambda a, b: a / b, NARROW, NARROW, exact=(1.04, 1.04 * (1.04**2 - 1) ** 0.5)),
    )  # fmt: skip


def staircases() -> tuple[Case, ...]:
    """Return steps with gradients of nothing, or of what they are the steps of."""
    return (
        _case("steps, none", lambda u: _steps(u) + 0 * u, UNIT),
        _case("steps of a sum, none", lambda u, v: _steps(u + v / 2) + 0 * u, UNIT, UNIT),
        _case("steps, smooth ones", lambda u, v: _steps(u + v / 2) + 1j * np.imag(u + v / 2), UNIT, UNIT),
    )


LISTS = {"edges": edges, "smooth": smooth, "staircases": staircases}


def main(words: Sequence[str] = ()) -> None:
    """Print shares (%): of mean and standard deviation those that are missed, (in silence), and runs with a warning."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks edges")
    parser.add_argument("--repeats", type=int, default=REPEATS)
    parser.add_argument("--solves", type=int, nargs="+", default=[6, 8, 12])
    parser.add_argument("--list", choices=LISTS, nargs="+", default=list(LISTS))
    parser.add_argument("--values", action="store_true", help="without gradients")
    options = parser.parse_args(words)
    chaos.DRAWN, coverage.REFERENCE = 10, 16  # quantiles are not looked at
    print("| function | " + " | ".join(f"{n}" for n in options.solves) + " |")
    print("|" + "---|" * (1 + len(options.solves)), flush=True)
    for case in (case for name in options.list for case in LISTS[name]()):
        cells = []
        for n in options.solves:
            row = measure(case, Chaos(samples=n, gradients=not options.values, fields=False), options.repeats)
            missed, silent = (
                ", ".join(f"{100 * one:.1f}" for one in shares[:2]) for shares in (1 - row.covered, row.silent)
            )
            cells.append(f"{missed} ({silent}) {100 * row.found:.1f}")
        print(f"| {case.name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
