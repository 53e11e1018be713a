"""Two public collections of test problems: how many printed numbers are within their errors, or said not to be.

They are no part of this program: pip install --no-deps --target DIRECTORY uqtestfuns tabulate otbenchmark openturns,
and PYTHONPATH=DIRECTORY. Derivatives are differences of their functions
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np

from benchmarks.coverage import Case, Vectorised, truth
from forward.model import FloatArray
from uq.accuracy.goal import Goal
from uq.estimators.moments import half_width
from uq.findings import findings
from uq.inputs.distributions import Chaospy, Distribution, Gamma, LogNormal, Normal, Triangular, Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods import chaos
from uq.methods.automatic import Automatic
from uq.methods.chaos import Chaos
from uq.methods.monte_carlo import MonteCarlo
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo

STATISTICS, KEPT = ("mean", "std", "q05", "q50", "q95"), ("held", "said", "silent")
GOAL = Goal.of(1e-2, ["1"], 2000)  # of the method that is chosen by itself
BEYOND, DIMENSION = 1.5, 4  # claimed half widths from which a number is wrong; parameters, where these may be chosen
STEP, STEPS = 1e-5, 1e-30  # of a standard deviation, for differences; of `Vectorised`
# Three take a millisecond or more for each of the 2^20 points of the truth, and OpenTURNS does not read two.
SKIPPED = "CoffeeCup", "SolarCell", "MorrisSensitivity", *(f"ReliabilityProblem{n}" for n in (110, 77))
Function = Callable[[FloatArray], FloatArray]
KINDS: dict[str, Callable[..., Distribution]] = {
    "normal": lambda mean, std: Normal(mean=mean, std=std),
    "uniform": lambda lower, upper: Uniform(lower=lower, upper=upper),
    "lognormal": lambda m, s, _=0.0: LogNormal(mean=(e := np.exp(m + s**2 / 2)), std=e * np.expm1(s**2) ** 0.5),
    "lognormalmusigma": lambda mean, std, _: LogNormal(mean=mean, std=std),
    "exponential": lambda rate, shift: Gamma(shape=1.0, scale=1 / rate, shift=shift),
    "triangular": lambda lower, upper, mode: Triangular(lower=lower, upper=upper, mode=mode),
    "gumbel": lambda mode, scale: Chaospy.model_validate({"name": "LogWeibull", "shift": mode, "scale": scale}),
    "gumbelmusigma": lambda mean, std: KINDS["gumbel"](mean - np.euler_gamma * (s := std * 6**0.5 / np.pi), s),
}


def _case(name: str, function: Function, marginals: Sequence[tuple[str, Sequence[float], Function]]) -> Case:
    """Return a problem, from kinds, numbers and inverses of marginals, whose function answers complex steps.

    What has no kind here is a function of a uniform number.
    """
    known = [KINDS.get(kind, lambda *_: Uniform(lower=0.0, upper=1.0))(*numbers) for kind, numbers, _ in marginals]
    inverses = [None if kind in KINDS else inverse for kind, _, inverse in marginals]
    inputs = Inputs({f"x{i}": one for i, one in enumerate(known)})
    lower, upper = np.transpose([one.support or (-np.inf, np.inf) for one in known])

    def values(x: FloatArray) -> FloatArray:
        return function(np.column_stack([of(u) if of else u for u, of in zip(x.T, inverses, strict=True)]))

    def answered(x: Any) -> Any:
        if not np.iscomplexobj(x):
            return values(x)
        along = x.imag / STEPS
        after, before = (np.clip(x.real + step * inputs.std * along, lower, upper) for step in (STEP, -STEP))
        return 1j * STEPS * (values(after) - values(before)) / ((after - before) * along).sum(axis=1)

    return Case(name, answered, inputs)


def _of_uqtestfuns() -> Iterator[Case]:
    collection = import_module("uqtestfuns")
    for name in sorted({*collection.list_functions(tabulate=False)} - {*SKIPPED}):
        try:
            problem = getattr(collection, name)()
        except ValueError:
            problem = getattr(collection, name)(input_dimension=DIMENSION)
        marginals = [
            (one.distribution, [*map(float, one.parameters)], one.icdf) for one in problem.prob_input.marginals
        ]
        yield _case(name, problem, marginals)


def _of_otbenchmark() -> Iterator[Case]:
    openturns = import_module("openturns")
    openturns.ComposedDistribution = openturns.JointDistribution  # its name of old
    collection = import_module("otbenchmark")
    base = collection.ReliabilityBenchmarkProblem
    for name, kind in sorted(vars(collection).items()):
        if name in SKIPPED or kind is base or not isinstance(kind, type):
            continue
        if issubclass(kind, base):
            event = kind().getEvent()
            function, joint = event.getFunction(), event.getAntecedent().getDistribution()
        elif name.endswith("Sensitivity"):
            function, joint = kind().getFunction(), kind().getInputDistribution()
        else:
            continue
        marginals = [_of_openturns(joint.getMarginal(i).getImplementation()) for i in range(joint.getDimension())]
        yield _case(name, lambda x, f=function: np.asarray(f(x))[:, 0], marginals)  # type: ignore[misc]


def _of_openturns(one: Any) -> tuple[str, Sequence[float], Function]:
    words, numbers = str(one).lower().replace("parametrizeddistribution(parameters = ", ""), list(one.getParameter())
    kind = words.split("(")[0]
    if kind in ("gumbel", "triangular"):  # in another order
        numbers = [*numbers[:-2], *numbers[:-3:-1]]
    return kind, numbers, lambda u: np.asarray(one.computeQuantile(u.tolist()))[:, 0]


def _methods() -> dict[str, tuple[Any, bool]]:
    """Return methods, and whether they have derivatives, by what they are called."""
    found: dict[str, tuple[Any, bool]] = {"automatic": (Automatic(fields=False), False)}
    for n in (64, 256):
        found[f"monte-carlo {n}"] = MonteCarlo(samples=n, fields=False), False
        found[f"quasi-monte-carlo {n}"] = QuasiMonteCarlo(samples=n, control="none", fields=False), False
        found[f"quasi-monte-carlo, chaos {n}"] = QuasiMonteCarlo(samples=n, control="chaos", fields=False), True
        found[f"chaos {n}"] = Chaos(samples=n, fields=False), False
        found[f"chaos, gradients {n // 4}"] = Chaos(samples=n // 4, fields=False), True
    return found


def outcomes(case: Case, data: Any) -> list[tuple[str, float]]:
    """Return of each number whether it is held, said to be doubtful or silent, and its error over the claimed one."""
    exact, floor = truth(case, tuple(data["quantile"].to_numpy()))
    moments = {end: [data[f"{name}{end}"].item() for name in STATISTICS[:2]] for end in ("", "_error")}
    values, claims = (np.array([*of, *data[f"quantiles{end}"].to_numpy()[:, 0]]) for end, of in moments.items())
    low, high = (np.append(values[:2], data[f"quantiles_{side}"].to_numpy()) for side in ("lower", "upper"))
    errors = np.maximum(np.abs(values - exact) - 3 * floor - 1e-9 * np.abs(exact), 0)
    times = errors / np.maximum(half_width(data) * claims, 1e-300)
    held = (times <= BEYOND) | ((low <= exact) & (exact <= high))
    said = "note" in data.attrs or any(one.severity != "note" for one in findings(data))
    return list(zip(np.where(held, KEPT[0], KEPT[1 if said else 2]).tolist(), times.tolist(), strict=True))


def main(words: Sequence[str] = ()) -> None:
    """Print for each method the shares of numbers that are held, said and silent, and then all silent misses."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks collections_of_others")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--methods", default="", help="part of the name of a method")
    options = parser.parse_args(words)
    if not all(map(find_spec, ("uqtestfuns", "tabulate", "otbenchmark", "openturns"))):
        print(__doc__)
        return
    chaos.DRAWN = 15  # with 13, points of the expansion alone miss quantiles
    cases = [one for of in (_of_uqtestfuns, _of_otbenchmark) for one in of()]
    silent: list[tuple[float, str]] = []
    print(f"{len(cases)} problems\n\n| method | {' | '.join(KEPT)} |\n|{'---|' * 4}", flush=True)
    for name, (method, gradients) in _methods().items():
        found: list[str] = []
        for case in cases if options.methods in name else ():
            evaluate: Any = Vectorised(case, differentiable=gradients)
            for seed in range(options.seeds):
                run = method.model_copy(update={"seed": seed})
                data = run.until(case.inputs, evaluate, GOAL) if name == "automatic" else run.run(case.inputs, evaluate)
                for statistic, (kind, times) in zip(STATISTICS, outcomes(case, data), strict=True):
                    found.append(kind)
                    if kind == KEPT[2]:
                        silent.append((times, f"{case.name}, {name}, seed {seed}, {statistic}"))
        print(f"| {name} | {' | '.join(f'{found.count(k) / max(len(found), 1):.1%}' for k in KEPT)} |", flush=True)
    print(*(f"{which}: {times:.2g} claimed errors" for times, which in sorted(silent, reverse=True)), sep="\n")
