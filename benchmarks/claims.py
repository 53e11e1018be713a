"""What expansions claim of means and deviations over their errors, and how often 95 % intervals hold.

Functions of literature with 32, 128 and 512 values, and of 30 and 100 normal quantities with two and four values for
each. A claim is the median over seeds, an error the root mean square.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.special import gammaln

from benchmarks import promises, small_indices
from benchmarks.coverage import CASES, Case, Vectorised, truth
from forward.model import FloatArray
from uq.estimators.moments import half_width
from uq.inputs.distributions import LogNormal, Normal, Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods import chaos
from uq.methods.chaos import Chaos

SEEDS = 40
SIZES = 32, 128, 512
NORMALS, EACH = (30, 100), (2, 4)
STANDARD, UNIT = Normal(mean=0.0, std=1.0), Uniform(lower=0.0, upper=1.0)
LITERATURE = ("Ishigami", "Sobol' g", "borehole", "wing weight", "transformerless", "piston", "flood", "RP33",
              "waves between normals", "four branches")  # fmt: skip


def _friedman(x: Any) -> Any:
    """J. H. Friedman, Ann. Stat. 19 (1991) 1–67."""
    return 10 * np.sin(np.pi * x[:, 0] * x[:, 1]) + 20 * (x[:, 2] - 0.5) ** 2 + 10 * x[:, 3] + 5 * x[:, 4]


def _cylinder(x: Any) -> Any:
    """RP14 of otbenchmark, with a log-normal torque."""
    strength, d, p, f, t = x.T
    return strength - 32 / (np.pi * d**3) * np.sqrt(p**2 * f**2 / 16 + t**2)


def literature() -> list[Case]:
    """Return functions of literature."""
    named = {one.name: one for one in (*promises.ONES, *promises.OTHERS, *small_indices.cases(), *CASES)}
    shaft = {
        "strength": Uniform(lower=70.0, upper=80.0),
        "d": Normal(mean=39.0, std=0.1),
        "p": LogNormal(mean=1500.0, std=350.0),
        "f": Normal(mean=400.0, std=0.1),
        "t": Normal(mean=250e3, std=35e3),
    }
    return [
        *(named[name] for name in LITERATURE),
        Case("Friedman", _friedman, Inputs({f"x{i}": UNIT for i in range(5)})),
        Case("RP14", _cylinder, Inputs(shaft)),
    ]


def normals(d: int) -> list[Case]:
    """Return functions of d standard normal quantities with moments in closed form, or by a rule in one or three."""
    inputs = Inputs({f"z{i}": STANDARD for i in range(d)})
    a = np.arange(1, d + 1) ** -0.5
    a /= np.linalg.norm(a)
    s = np.linspace(0.5, 0.1, d)
    z = np.linspace(-12, 12, 200_001)
    density = np.exp(-(z**2) / 2) / np.exp(-(z**2) / 2).sum()

    def case(name: str, function: Callable[[Any], Any], mean: Any, variance: Any) -> Case:
        return Case(f"{name}, {d} normals", function, inputs, exact=(float(mean), float(variance) ** 0.5))

    def of_sum(name: str, function: Callable[[Any], Any]) -> Case:
        values = function(z)
        mean = density @ values
        return case(name, lambda x: function(x @ a), mean, density @ (values - mean) ** 2)

    def link(x: Any, y: Any) -> Any:
        return x + 0.2 * (y - 0.5 * x**2) ** 2

    h, w = np.polynomial.hermite_e.hermegauss(12)
    x, y, last = np.meshgrid(h, h, h, indexing="ij")
    weights = np.einsum("i,j,k->ijk", w, w, w) / w.sum() ** 3
    one, two = link(x, y), link(y, last)
    mean = (weights * one).sum()
    own, next_one = ((weights * one * other).sum() - mean**2 for other in (one, two))
    norm = 2**0.5 * np.exp(gammaln((d + 1) / 2) - gammaln(d / 2))
    logarithmic = np.exp(s**2)
    return [
        case("linear and quadratic", lambda x: x @ a + 0.1 * x**2 @ a, 0.1 * a.sum(), 1.02),
        case("sum of exp", lambda x: np.exp(x * s) @ a, a @ logarithmic**0.5, a**2 @ (logarithmic**2 - logarithmic)),
        case("chain", lambda x: link(x[:, :-1], x[:, 1:]).sum(axis=1), (d - 1) * mean,
             (d - 1) * own + 2 * (d - 2) * next_one),
        case("norm", lambda x: np.sqrt((x**2).sum(axis=1)), norm, d - norm**2),
        of_sum("exp of sum", lambda t: np.exp(0.5 * t)),
        of_sum("sin of sum", lambda t: np.sin(t + 0.5)),
        of_sum("tanh of sum", lambda t: np.tanh(1.5 * t + 0.5)),
        of_sum("|sum|", lambda t: np.where(np.real(t) < -0.3, -1, 1) * (t + 0.3)),
    ]  # fmt: skip


def ratios(case: Case, samples: int, seeds: int, *, gradients: bool) -> tuple[FloatArray, FloatArray]:
    """Claimed over true errors (2,) of mean and deviation, and the shares (2,) of 95 % intervals that hold."""
    exact, floor = (promises.exact(case), 0.0) if len(case.inputs.names) in promises.GRID else truth(case, ())
    off, claims = [], []
    for seed in range(seeds):
        method = Chaos(samples=samples, gradients=gradients, seed=seed, quantiles=(), fields=False)
        data = method.run(case.inputs, Vectorised(case))
        off.append([data[name].item() for name in ("mean", "std")] - exact)
        claims.append([data[f"{name}_error"].item() for name in ("mean", "std")])
    held = np.abs(off) <= np.hypot(half_width(data) * np.array(claims), 3 * floor) + 1e-12 * np.abs(exact)
    return np.median(claims, axis=0) / np.sqrt(np.mean(np.square(off), axis=0)), held.mean(axis=0)


def main(words: Sequence[str] = ()) -> None:
    """Print for each function and number of values claimed over true errors, and the shares of intervals that hold."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks claims")
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--gradients", action="store_true", help="with derivatives, and a quarter of the solves")
    parser.add_argument("--only", default="", help="part of the name of a function")
    options = parser.parse_args(words)
    chaos.DRAWN = 13
    print(
        "| function | solves | claimed/true: mean | std | 95 % intervals that hold: mean | std |\n" + "|---" * 6 + "|"
    )
    runs = [(case, n) for case in literature() for n in SIZES]
    runs += [(case, each * d) for d in NORMALS for case in normals(d) for each in EACH]
    for case, n in runs:
        if options.only in case.name:
            solves = n // 4 if options.gradients else n
            ratio, held = ratios(case, solves, options.seeds, gradients=options.gradients)
            cells = *(f"{one:.2g}" for one in ratio), *(f"{one:.0%}" for one in held)
            print(f"| {case.name} | {solves} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
