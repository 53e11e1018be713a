"""Small total indices by exchanged samples: how often 95 % intervals miss them, and claimed over true errors."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.coverage import CASES, Case, Vectorised
from forward.model import FloatArray
from uq.estimators.moments import half_width
from uq.inputs.distributions import LogNormal, Normal, Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods.sobol import Sobol

REPEATS = 60
SMALL = 0.1
POINTS = 2**17
UNIT = Uniform(lower=0.0, upper=1.0)
FLOOD = {
    "Q": LogNormal(mean=1300, std=700),
    **{
        name: Uniform(lower=float(lower), upper=float(upper))
        for name, lower, upper in (
            ("Ks", 20, 40), ("Zv", 49, 51), ("Zm", 54, 56), ("Hd", 7, 9), ("Cb", 55, 56), ("L", 4990, 5010),
            ("B", 295, 305),
        )
    },
}  # fmt: skip


def _lowest(x: Any) -> Any:
    """RP33 of otbenchmark."""
    return np.minimum(3 * 3**0.5 - x.sum(axis=1), 3 - x[:, 2])


def _flood(x: Any) -> Any:
    q, k, zv, zm, hd, cb, length, b = x.T
    return zv + (q / (b * k * ((zm - zv) / length) ** 0.5)) ** 0.6 - hd - cb


def _g_star(name: str, alpha: float, a: Sequence[float]) -> Case:
    """Sobol' G* (A. Saltelli et al., Comput. Phys. Commun. 181 (2010) 259–270), shifted."""
    weights, shift = np.array(a), np.random.default_rng(len(name)).random(len(a))

    def function(x: Any) -> Any:
        z = x + shift
        distance = 2 * (z - np.floor(np.real(z))) - 1
        size = np.where(np.real(distance) < 0, -distance, distance) ** alpha
        return (((1 + alpha) * size + weights) / (1 + weights)).prod(axis=1)

    return Case(name, function, Inputs({f"x{i}": UNIT for i in range(len(a))}))


def cases() -> list[Case]:
    """Return functions of literature, some of whose parameters matter rarely."""
    named = {case.name: case for case in CASES}
    return [
        Case("RP33", _lowest, Inputs({name: Normal(mean=0.0, std=1.0) for name in "abc"})),
        _g_star("G*, α = 1", 1.0, (0, 0, *[9] * 8)),
        _g_star("G*, α = 2", 2.0, (0, 0, *[9] * 8)),
        _g_star("G*, α = 1/2", 0.5, (0, 0.1, 0.2, 0.3, 0.4, 0.8, 1, 2, 3, 4)),
        Case("flood", _flood, Inputs(FLOOD)),
        *(named[name] for name in ("borehole", "wing weight", "Ishigami", "peak")),
    ]


def totals(case: Case) -> FloatArray:
    """Total indices (d,) by many plain random points."""
    d, random = len(case.inputs.names), np.random.default_rng(77)
    u, v = random.random((2, POINTS, d))
    before = np.real(case.function(case.inputs.points(u)))
    found = []
    for i in range(d):
        other = u.copy()
        other[:, i] = v[:, i]
        found.append(((before - np.real(case.function(case.inputs.points(other)))) ** 2).mean() / 2)
    return np.array(found) / before.var()


def main(words: Sequence[str] = ()) -> None:
    """Print for each function the share of small totals that are missed, and claimed over true errors of all."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks small_indices")
    parser.add_argument("--repeats", type=int, default=REPEATS)
    parser.add_argument("--rows", type=int, default=64)
    options = parser.parse_args(words)
    print("| function | small totals missed | claimed/true errors |\n|---|---|---|", flush=True)
    every = []
    for case in cases():
        exact, missed, errors, claims = totals(case), [], [], []
        for seed in range(options.repeats):
            method = Sobol(design="saltelli", samples=options.rows, seed=seed, fields=False, quantiles=())
            data = method.run(case.inputs, Vectorised(case))
            total, error = (data[name].to_numpy()[0] for name in ("sobol_total", "sobol_total_error"))
            missed.append(np.abs(total - exact) > half_width(data) * error + 1e-2 * exact)
            errors.append(total - exact)
            claims.append(error)
        small = exact < SMALL
        ratio = np.sqrt(np.mean(np.square(claims), axis=0) / np.mean(np.square(errors), axis=0))
        every.append(np.array(missed)[:, small].ravel())
        share = f"{every[-1].mean():.1%}" if small.any() else ""
        print(f"| {case.name} | {share} | {ratio.min():.2g} to {ratio.max():.2g} |", flush=True)
    print(f"| all | {np.concatenate(every).mean():.1%} | |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
