"""Standard deviations against OpenTURNS and Saltelli's indices against SALib, from equal numbers of evaluations."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from benchmarks.chaos import quiet_openturns
from benchmarks.coverage import CASES, Case, Vectorised, truth
from forward.model import FloatArray
from uq.evaluation.request import Request
from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.methods.sobol import Sobol
from uq.surrogates.regression import Regression

DESIGNS, SCRAMBLES = 8, 40
TRUNCATIONS = ((1.0, 2), (1.0, 3), (0.75, 4), (0.5, 6))  # q and order
WEIGHTS = np.array([0, 1, 4.5, 9, 99, 99, 99, 99])


def _by_openturns(ot: Any, inputs: Inputs, points: FloatArray, values: FloatArray, q: float, order: int) -> float:
    """Standard deviation by least-angle regression with corrected leave-one-out errors."""
    d = len(inputs.names)
    bases = ot.LinearEnumerateFunction(d) if q == 1 else ot.HyperbolicAnisotropicEnumerateFunction(d, q)
    algorithm = ot.FunctionalChaosAlgorithm(
        ot.Sample(points),
        ot.Sample(values[:, None]),
        ot.JointDistribution([ot.Uniform(*(m.support or (0.0, 1.0))) for m in inputs.marginals.values()]),
        ot.FixedStrategy(
            ot.OrthogonalProductPolynomialFactory([ot.LegendreFactory()] * d, bases),
            bases.getBasisSizeFromTotalDegree(order),
        ),
        ot.LeastSquaresStrategy(ot.LeastSquaresMetaModelSelectionFactory(ot.LARS(), ot.CorrectedLeaveOneOut())),
    )
    algorithm.run()
    return float(ot.FunctionalChaosRandomVector(algorithm.getResult()).getCovariance()[0, 0] ** 0.5)


def _deviations(ot: Any) -> None:
    """Print errors of the standard deviation of the wing-weight function, and processor times of fits."""
    case = next(case for case in CASES if case.name == "wing weight")
    inputs, exact = case.inputs, truth(case, (0.5,))[0][1]
    print("| solves | fit | relative error of std | CPU (s) |\n|---|---|---|---|")
    for n in (64, 128, 256):
        rows: dict[str, list[tuple[float, float]]] = {}
        for seed in range(DESIGNS):
            points = inputs.points(sobol_points(seed, 0, 0, n, len(inputs.names)))
            solved: Any = Vectorised(case)(Request(points, tangents=True))

            def own(tangents: FloatArray | None, p: FloatArray = points, y: FloatArray = solved.outputs) -> float:
                return float(Regression.of(inputs, p, y, tangents, 6).estimates()["std"][0])

            fits: dict[str, Callable[[], float]] = {
                "tissuq, gradients": partial(own, solved.tangents),
                "tissuq, values": partial(own, None),
            }
            for q, order in TRUNCATIONS if ot else ():
                other = partial(_by_openturns, ot, inputs, points, solved.outputs[:, 0], q, order)
                fits[f"OpenTURNS, q = {q:g}, order {order}"] = other
            for name, fit in fits.items():
                begin = time.process_time()
                error = fit() / exact - 1
                rows.setdefault(name, []).append((error, time.process_time() - begin))
        for name, found in rows.items():
            errors, seconds = np.array(found).T
            print(f"| {n} | {name} | {np.sqrt((errors**2).mean()):.1e} | {seconds.mean():.2f} |", flush=True)


def _g(x: FloatArray) -> FloatArray:
    return np.asarray(np.prod((np.abs(4 * np.real(x) - 2) + WEIGHTS) / (1 + WEIGHTS), axis=1))


def _ishigami(x: FloatArray) -> FloatArray:
    x = np.real(x)
    return np.asarray(np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0]))


def _indices() -> None:
    """Print root mean square errors of indices by exchanged points, and the numbers of evaluations."""
    from SALib.analyze import sobol as analysis
    from SALib.sample import sobol as sample

    parts = 1 / (3 * (1 + WEIGHTS) ** 2)
    variance = np.prod(1 + parts) - 1
    of_g = np.array([parts, parts * np.prod(1 + parts) / (1 + parts)]) / variance
    of_ishigami = np.array(
        [[0.313905191147811, 0.442411144790041, 0.0], [0.557588855209959, 0.442411144790041, 0.243683664062148]]
    )
    print(
        "| function | evaluations: tissuq, SALib | first-order: tissuq, SALib | total: tissuq, SALib |\n" + "|---" * 4
    )
    for name, function, ends, exact in (
        ("Ishigami", _ishigami, (-np.pi, np.pi), of_ishigami),
        ("Sobol' g, 8 parameters", _g, (0.0, 1.0), of_g),
    ):
        d = exact.shape[1]
        inputs = Inputs({f"x{i}": Uniform(lower=ends[0], upper=ends[1]) for i in range(d)})
        problem = {"num_vars": d, "names": list(inputs.names), "bounds": [list(ends)] * d}
        evaluate: Any = Vectorised(Case(name, function, inputs))
        for rows in (64, 256, 1024):
            errors: list[list[FloatArray]] = [[], []]
            for seed in range(SCRAMBLES):
                found = Sobol(design="saltelli", samples=rows, fields=False, seed=seed).run(inputs, evaluate)
                own = [found[f"sobol_{kind}"].to_numpy()[0] for kind in ("first", "total")]
                points = sample.sample(problem, rows, calc_second_order=False, seed=seed)
                other = analysis.analyze(problem, function(points), calc_second_order=False, num_resamples=2, seed=0)
                errors[0].append(np.array(own) - exact)
                errors[1].append(np.array([other["S1"], other["ST"]]) - exact)
            sizes = np.sqrt((np.array(errors) ** 2).mean(axis=(1, 3)))
            told = " | ".join(f"{a:.4f}, {b:.4f}" for a, b in sizes.T)
            print(f"| {name} | {found['points'].shape[0]}, {len(points)} | {told} |", flush=True)


def main() -> None:
    """Print both tables."""
    _deviations(quiet_openturns())
    print()
    try:
        _indices()
    except ImportError:
        print("SALib is not installed and left out")
