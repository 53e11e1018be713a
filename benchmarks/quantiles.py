"""Quantiles far out: how often their 95 % intervals hold, by function, method and probability.

Quantiles of the functions are known in closed form. An interval without an end holds what it does not tell; the share
of these stands in brackets. Tables of draws stand for a distribution of which each run has other draws.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy import stats

from benchmarks.coverage import Case, Vectorised
from forward.model import FloatArray
from uq.estimators.input_sample_error import with_errors_of_draws
from uq.findings import findings
from uq.inputs.distributions import LogNormal, Normal, Uniform
from uq.inputs.draws import Draws
from uq.inputs.random_parameters import Inputs
from uq.methods import chaos
from uq.methods.chaos import Chaos
from uq.methods.monte_carlo import MonteCarlo
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo

REPEATS = 200
LEVELS = (0.0001, 0.001, 0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 0.999, 0.9999)
CORRELATED = np.array([[1.0, 0.6, 0.0], [0.6, 1.0, -0.3], [0.0, -0.3, 1.0]])


@dataclass(frozen=True, eq=False)
class Known:
    """A function of `Case` with its quantile function; of a table of so many draws, if there are `draws`."""

    case: Case
    quantile: Callable[[FloatArray], FloatArray]
    draws: int = 0

    def inputs(self, seed: int) -> Inputs:
        """Return the parameters of one run."""
        if not self.draws:
            return self.case.inputs
        normals = np.random.default_rng([seed, self.draws]).standard_normal((self.draws, 3))
        weights = np.full(self.draws, 1 / self.draws)
        return Inputs({}, draws=Draws(("x", "y", "z"), normals @ np.linalg.cholesky(CORRELATED).T, weights, self.draws))


def _normals(d: int) -> Inputs:
    return Inputs({f"x{i}": Normal(mean=0.0, std=1.0) for i in range(d)})


def _uniform(d: int, end: float = 1.0) -> Inputs:
    return Inputs({f"x{i}": Uniform(lower=1e-12 * end, upper=end) for i in range(d)})


def _of_table(slope: float) -> float:
    ones = np.ones(3)
    return float(slope * (ones @ CORRELATED @ ones) ** 0.5)


def cases() -> tuple[Known, ...]:
    """Return smooth, bounded, skewed and heavy-tailed functions."""
    logs = Inputs({name: LogNormal(mean=1.0, std=0.5) for name in "abcd"})
    size = np.log(1.25)
    product = stats.lognorm(s=2 * size**0.5, scale=np.exp(-2 * size))
    table = _normals(3)
    linear, skew = stats.norm(0, _of_table(1.0)), stats.lognorm(s=_of_table(0.5))
    return (
        Known(Case("2 uniforms", lambda x: x.sum(axis=1), _uniform(2)), stats.triang(0.5, 0, 2).ppf),
        Known(Case("5 squares of normals", lambda x: (x**2).sum(axis=1), _normals(5)), stats.chi2(5).ppf),
        Known(Case("sine", lambda x: np.sin(x[:, 0] + x[:, 1] ** 2), _turning()), stats.arcsine(-1, 2).ppf),
        Known(Case("2 exponentials", lambda x: -np.log(x).sum(axis=1), _uniform(2)), stats.gamma(2).ppf),
        Known(Case("4 log-normals", lambda x: x.prod(axis=1), logs), product.ppf),
        Known(Case("6 normals, exp", lambda x: np.exp(x.sum(axis=1) / 6**0.5), _normals(6)), stats.lognorm(s=1).ppf),
        Known(
            Case("2 Pareto", lambda x: x.prod(axis=1) ** -0.25, _uniform(2)),
            lambda p: np.exp(stats.gamma(2).ppf(p) / 4),
        ),
        Known(Case("table, linear", lambda x: x.sum(axis=1), table), linear.ppf, 300),
        Known(Case("table, exp", lambda x: np.exp(0.5 * x.sum(axis=1)), table), skew.ppf, 300),
    )


def _turning() -> Inputs:
    """Return a full turn, and what is added to it."""
    return Inputs({"a": Uniform(lower=-np.pi, upper=np.pi), "b": Uniform(lower=0.0, upper=1.0)})


def methods() -> dict[str, Any]:
    """Return what is tried."""
    plain = {"fields": False, "quantiles": LEVELS}
    found: dict[str, Any] = {f"chaos {n}": Chaos(samples=n, **plain) for n in (30, 100)}
    found["chaos, values 60"] = Chaos(samples=60, gradients=False, **plain)
    found |= {f"monte-carlo {n}": MonteCarlo(samples=n, **plain) for n in (64, 512)}
    qmc = partial(QuasiMonteCarlo, **plain)
    found |= {f"qmc, {c} {n}": qmc(samples=n, control=c) for n in (64, 512) for c in ("none", "chaos")}
    return found


@dataclass(frozen=True)
class Row:
    """What intervals are worth, as shares of the runs.

    Attributes
    ----------
    held, endless
        By probability (k,): those that hold, and those that have no end.
    width
        Their median width (k,), over half the distance of the quantiles of 16 and 84 %.
    rising
        Runs in which quantiles and both ends rise with the probability.
    silent
        By probability (k,): those that miss in runs in which no warning speaks of the output.
    """

    held: FloatArray
    endless: FloatArray
    width: FloatArray
    rising: float
    silent: FloatArray


def measure(known: Known, method: Any, repeats: int) -> Row:
    """Run a method with many seeds."""
    levels = np.array(method.quantiles)
    exact = known.quantile(levels)
    held, widths, rising, warned = [], [], [], []
    for seed in range(repeats):
        inputs = known.inputs(seed)
        evaluate = Vectorised(Case(known.case.name, known.case.function, inputs))
        data = method.model_copy(update={"seed": seed}).run(inputs, evaluate)
        data = with_errors_of_draws(data, inputs, method.in_turn * data.sizes["sample"])
        low, middle, up = (data[f"quantiles{side}"].to_numpy()[:, 0] for side in ("_lower", "", "_upper"))
        held.append((low <= exact) & (exact <= up))
        widths.append(up - low)
        rising.append(all((one[1:] >= one[:-1]).all() for one in (low, middle, up)))
        warned.append(any(one.severity != "note" for one in findings(data)))
    inside, width = np.array(held), np.array(widths)
    scale = np.diff(known.quantile(np.array([0.16, 0.84]))) / 2
    silent = ~inside & ~np.array(warned)[:, None]
    return Row(
        inside.mean(axis=0),
        np.isinf(width).mean(axis=0),
        np.median(width, axis=0) / scale,
        float(np.mean(rising)),
        silent.mean(axis=0),
    )


def main(words: Sequence[str] = ()) -> None:
    """Print shares of intervals that hold, (of those without an end), and of those that miss without a warning."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks quantiles")
    parser.add_argument("--repeats", type=int, default=REPEATS)
    parser.add_argument("--cases", default="")
    parser.add_argument("--methods", default="")
    parser.add_argument("--widths", action="store_true", help="also over the standard deviation of the middle")
    options = parser.parse_args(words)
    chaos.DRAWN = 15
    print("| function | method | " + " | ".join(f"{p:g}" for p in LEVELS) + " | rising |")
    print("|" + "---|" * (3 + len(LEVELS)), flush=True)
    for name, method in methods().items():
        for known in cases():
            if options.cases not in known.case.name or options.methods not in name:
                continue
            row = measure(known, method, options.repeats)
            cells = [
                f"{100 * h:.0f}" + (f" ({100 * e:.0f})" if e else "") + (f", {100 * s:.0f}" if s else "")
                for h, e, s in zip(row.held, row.endless, row.silent, strict=True)
            ]
            print(f"| {known.case.name} | {name} | {' | '.join(cells)} | {100 * row.rising:.0f} |", flush=True)
            if options.widths:
                print(f"| | width | {' | '.join(f'{w:.2g}' for w in row.width)} | |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
