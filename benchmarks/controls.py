"""Whether several models of one quantity, or an expansion in their place, do worse than plain Monte Carlo.

Functions with two cheaper ones each, which miss what matters: `multifidelity` with its defaults spends 64 full solves,
and the root mean square errors of its mean and standard deviation over the seeds are divided by those of plain Monte
Carlo with 64 solves, from many sets. "Held" are the shares of 95 % intervals with the truth.

    python -m benchmarks controls [--seeds 40] [--only wave]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.coverage import Case, truth
from benchmarks.multifidelity import CHEAP, Hierarchy
from forward.model import FloatArray
from uq.findings import findings
from uq.inputs.distributions import Distribution, LogNormal, Normal, Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods.multifidelity import Multifidelity

SEEDS, SAMPLES, SETS = 40, 64, 4000
COST = 0.05  # of each cheap function over the full one
WIDTH = 1.96
LIMIT = 1.1  # times the error of plain Monte Carlo
WAYS = {"chosen where cheap models differ": "points chosen", "taken in their place": "expansion"}

STANDARD, UNIT, SKEWED = Normal(mean=0.0, std=1.0), Uniform(lower=0.0, upper=1.0), LogNormal(mean=1.0, std=0.5)


class Form(NamedTuple):
    """Functions of single parameters, the full one first, and their distributions."""

    marginals: tuple[Distribution, ...]
    full: Callable[..., Any]
    one: Callable[..., Any]
    two: Callable[..., Any]


def _beyond(x: Any, start: float) -> Any:
    return np.where(np.real(x) > start, x - start, 0 * x)


FORMS = {
    # Each cheap one misses a part, as where two effects cancel.
    "two parts": Form(
        3 * (STANDARD,),
        lambda a, b, c: np.exp(a / 2) * (1 + 0.2 * b) + 0.3 * np.sin(2.5 * c),
        lambda a, b, c: np.exp(a / 2) + 0.3 * np.sin(2.5 * c) + 0 * b,
        lambda a, b, c: np.exp(a / 2) * (1 + 0.2 * b) + 0 * c,
    ),
    "wave": Form(
        2 * (STANDARD,),
        lambda a, b: np.sin(2.8 * a + 0.9) + 0.3 * b**2,
        lambda a, b: np.sin(2.8 * a + 0.9) + 0 * b,
        lambda a, b: np.sin(2.5 * a + 0.9) + 0.2 * b**2,
    ),
    "pole": Form(
        3 * (UNIT,),
        lambda a, b, c: 1 / (1.03 - a * b * c),
        lambda a, b, c: 1 / (1.1 - a * b * c),
        lambda a, b, c: 1 / (1.03 - a * b) + 0 * c,
    ),
    "limit state": Form(
        (Normal(mean=1.5, std=1.0), Normal(mean=2.5, std=1.0)),
        lambda a, b: (a**2 + 4) * (b - 1) / 20 - np.sin(2.5 * a) - 2,
        lambda a, b: -np.sin(2.5 * a) + 0.4 * b - 3,
        lambda a, b: (a**2 + 4) * (b - 1) / 20 - 2,
    ),
    "skewed": Form(
        3 * (SKEWED,),
        lambda a, b, c: np.cos(2 * a) * b + 0.2 * c,
        lambda a, b, c: np.cos(2 * a) + 0 * b * c,
        lambda a, b, c: np.cos(1.8 * a) * b + 0 * c,
    ),
    "product": Form(
        3 * (SKEWED,),
        lambda a, b, c: a * b / c,
        lambda a, b, c: a * b + 0 * c,
        lambda a, b, c: a / c + 0 * b,
    ),
    "smooth": Form(
        3 * (UNIT,),
        lambda a, b, c: np.exp(a) * (1 + b) + 0.3 * np.sin(3 * c),
        lambda a, b, c: np.exp(a) + 0.3 * np.sin(3 * c) + 0 * b,
        lambda a, b, c: np.exp(a) * (1 + b) + 0 * c,
    ),
    "kink": Form(
        2 * (STANDARD,),
        lambda a, b: _beyond(a, 0.5) + 0.3 * np.cos(b),
        lambda a, b: _beyond(a, 0.4) + 0 * b,
        lambda a, b: a / 2 + 0.3 * np.cos(b),
    ),
}  # fmt: skip


def _plain(case: Case, exact: FloatArray) -> FloatArray:
    """Return root mean square errors (2,) of the mean and standard deviation of plain samples."""
    u = np.random.default_rng(1).random((SETS * SAMPLES, len(case.inputs.names)))
    values = np.real(case.function(case.inputs.points(u))).reshape(SETS, SAMPLES)
    return _rms(np.stack([values.mean(axis=1), values.std(axis=1, ddof=1)], axis=1) - exact)


def _rms(errors: FloatArray) -> FloatArray:
    found: FloatArray = np.sqrt((errors**2).mean(axis=0))
    return found


def _row(name: str, form: Form, seeds: int) -> str:
    inputs = Inputs({f"x{i}": one for i, one in enumerate(form.marginals)})

    def of(function: Callable[..., Any]) -> Case:
        return Case(name, lambda x: function(*x.T), inputs)

    full = of(form.full)
    exact = truth(full, ())[0]
    evaluate = Hierarchy([full, of(form.one), of(form.two)])
    block = {"kind": "python", "function": "math.sin", "parameters": {"a": 1.0, "b": 1.0}, "outputs": ("f",)}
    cheap = [{"kind": "model", "name": of, "cost": COST, "model": block} for of in CHEAP]
    rows, ways = [], []
    for seed in range(1, seeds + 1):
        found = Multifidelity(samples=SAMPLES, seed=seed, cheap=cheap, quantiles=()).run(inputs, evaluate)
        rows.append([[found[f"{what}{error}"].item() for error in ("", "_error")] for what in ("mean", "std")])
        said = " ".join(one.text for one in findings(found))
        ways.append(next((way for words, way in WAYS.items() if words in said), "models"))
    values, claims = np.moveaxis(np.array(rows), 2, 0)
    ratio = _rms(values - exact) / _plain(full, exact)
    held = (np.abs(values - exact) <= WIDTH * claims).mean(axis=0)
    counted = ", ".join(f"{ways.count(way)} {way}" for way in sorted(set(ways)))
    cells = [name, f"{exact[0]:.4g}", f"{exact[1]:.4g}", *(f"{one:.2f}" for one in ratio)]
    return f"| {' | '.join([*cells, *(f'{one:.0%}' for one in held), counted])} |"


def main(words: Sequence[str] = ()) -> None:
    """Print a row for each function."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks controls")
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--only", default="", help="part of the name of a function")
    options = parser.parse_args(words)
    print(f"Of {options.seeds} seeds, {SAMPLES} solves each; not above {LIMIT} is wanted.\n")
    heads = ["function", "mean", "std", "error of the mean over plain Monte Carlo's", "of the std"]
    heads += ["mean held", "std held", "what was taken"]
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}", flush=True)
    for name, form in FORMS.items():
        if options.only in name:
            print(_row(name, form, options.seeds), flush=True)
