"""Polynomial chaos against chaospy's and OpenTURNS's own, from the same samples."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import chaospy
import numpy as np
from mpi4py import MPI
from scipy.linalg import cho_solve

from benchmarks.beams import CONFIG
from forward.model import WORK, FloatArray, ForwardModel, displacements
from forward.pointwise import FunctionModel
from uq.estimators.indices import coefficient_moments
from uq.evaluation.block import Merger
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Evaluations, Request
from uq.inputs.distributions import Beta, Uniform
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import random_points, sobol_points
from uq.surrogates.basis import gauss, hyperbolic, orthonormal
from uq.surrogates.field_regression import Projections
from uq.surrogates.regression import Regression
from workflows.config.study import load as load_study

SEEDS = 4  # designs of each size, over which errors are averaged
NODES = 10_000
HEAD = "| case | solves | method | terms | L2 error | mean | std | Sobol' indices | CPU (s) |"
Found = tuple[int, FloatArray, float, float, FloatArray]  # terms, predictions, mean, std, first-order indices


@dataclass(frozen=True)
class Case:
    """A model, numbers of solves to compare at, and the order up to which all methods may go."""

    name: str
    inputs: Inputs
    model: ForwardModel
    sizes: tuple[int, ...]
    order: int
    exact: tuple[float, float, FloatArray]  # mean, standard deviation, first-order indices


class Remembered:
    """An evaluation that solves each point once, with its derivatives: all methods see the same samples."""

    def __init__(self, model: ForwardModel) -> None:
        self._evaluate = SerialEvaluate(model)
        self._known: dict[bytes, Evaluations] = {}
        self.parameters, self.outputs = model.parameters, model.outputs
        self.differentiable, self.displacements = model.differentiable, displacements(model)

    def __call__(self, request: Request) -> Evaluations:
        """Evaluate, or remember."""
        key = request.points.tobytes()
        if key not in self._known:
            self._known[key] = self._evaluate(Request(request.points, tangents=True, start=request.start))
        found = self._known[key]
        fields = np.zeros((0, 0)) if request.fields is None else self._evaluate(request).fields
        return replace(found, tangents=found.tangents if request.tangents else None, fields=fields)


# --- cases ---------------------------------------------------------------------------------------------------------


def _function(function: Callable[[Any], Any], inputs: Inputs) -> FunctionModel:
    """Return a model with derivatives by complex steps."""

    def jacobian(p: FloatArray) -> list[list[float]]:
        return [[float(np.imag(function(p + 1e-20j * e))) / 1e-20 for e in np.eye(len(p))]]

    return FunctionModel(function, inputs.names, ("f",), jacobian)


def _ishigami(p: Any) -> Any:
    return np.sin(p[0]) + 7 * np.sin(p[1]) ** 2 + 0.1 * p[2] ** 4 * np.sin(p[0])


def _smooth(p: Any) -> Any:
    return (1 + p[0]) ** 1.5 / ((1 + 0.8 * p[1]) * (1 + 0.5 * p[2] * p[3]))


WEIGHTS = np.array([0, 1, 4.5, 9, 99, 99, 99, 99])


def _sobol_g(p: Any) -> Any:
    x, a = 4 * p - 2, WEIGHTS[: len(p)]
    return np.prod((np.where(np.real(x) < 0, -x, x) + a) / (1 + a))


def _by_quadrature(
    inputs: Inputs, function: Callable[[FloatArray], Any], order: int
) -> tuple[float, float, FloatArray]:
    """Moments and first-order indices by projection on a Gauss grid."""
    points, weights = gauss(inputs, order + 2)
    values = np.array([np.ravel(function(p))[0] for p in points])
    indices = hyperbolic(len(inputs.names), order, 1.0)
    coefficients = (weights * values) @ orthonormal(inputs, indices).values(points)
    mean = float(weights @ values)
    variance = float(weights @ (values - mean) ** 2)
    alone = [((indices > 0).sum(axis=1) == 1) & (indices[:, i] > 0) for i in range(len(inputs.names))]
    return mean, variance**0.5, np.array([(coefficients[some] ** 2).sum() for some in alone]) / variance


def _cases() -> Iterator[Case]:
    angle, unit = Uniform(lower=-np.pi, upper=np.pi), Uniform(lower=0.0, upper=1.0)
    inputs = Inputs(dict.fromkeys("abc", angle))
    indices = np.array([0.313905191147811, 0.442411144790041, 0.0])
    exact = (3.5, 13.844587940719254**0.5, indices)
    yield Case("Ishigami", inputs, _function(_ishigami, inputs), (60, 120), 10, exact)
    for d, sizes, order in ((4, (50, 100), 8), (8, (100,), 5)):
        inputs = Inputs(dict.fromkeys("abcdefgh"[:d], unit))
        parts = 1 / (3 * (1 + WEIGHTS[:d]) ** 2)
        variance = float(np.prod(1 + parts) - 1)
        exact = (1.0, variance**0.5, parts / variance)
        yield Case(f"Sobol' g, {d} parameters", inputs, _function(_sobol_g, inputs), sizes, order, exact)
    inputs = Inputs(dict.fromkeys("abcd", unit))
    exact = _by_quadrature(inputs, _smooth, 8)
    yield Case("smooth, 4 parameters", inputs, _function(_smooth, inputs), (20, 40, 80), 6, exact)
    study = load_study(CONFIG.with_name("tiny.toml"))
    more = {"material.C1": Uniform(lower=5e3, upper=2e4), "material.C2": Beta(a=2, b=2, lower=1.5e5, upper=2.5e5)}
    for extra, sizes, nodes in (({}, (10, 20), 8), (more, (20, 40), 3)):
        inputs = Inputs(study.inputs.marginals | extra)
        model = study.model.build(MPI.COMM_SELF, inputs.names)
        exact = _by_quadrature(inputs, lambda p, model=model: model.solve(p).outputs, nodes)
        yield Case(f"beam, {len(inputs.names)} parameters", inputs, model, sizes, 6, exact)


# --- methods -------------------------------------------------------------------------------------------------------


def _joint(inputs: Inputs) -> Any:
    """Return chaospy's distribution: it takes parameters that share an object for the same parameter."""
    return chaospy.J(
        *(
            chaospy.Beta(m.a, m.b, m.lower, m.upper) if isinstance(m, Beta) else chaospy.Uniform(m.lower, m.upper)
            for m in inputs.marginals.values()
        )
    )


def _by_chaospy(case: Case, points: FloatArray, values: FloatArray, test: FloatArray, order: int) -> Found:
    """Least squares on a full basis: chaospy itself selects nothing."""
    joint = _joint(case.inputs)
    basis = chaospy.generate_expansion(order, joint, normed=True)
    fitted = chaospy.fit_regression(basis, points.T, values)
    mean, std = float(chaospy.E(fitted, joint)), float(chaospy.Std(fitted, joint))
    return len(basis), fitted(*test.T), mean, std, chaospy.Sens_m(fitted, joint)


def _by_openturns(ot: Any, case: Case, points: FloatArray, values: FloatArray, test: FloatArray, q: float) -> Found:
    """Least-angle regression with corrected leave-one-out errors."""
    marginals, families = [], []
    for m in case.inputs.marginals.values():
        if isinstance(m, Beta):
            marginals.append(ot.Beta(m.a, m.b, m.lower, m.upper))
            families.append(ot.StandardDistributionPolynomialFactory(ot.Beta(m.a, m.b, -1.0, 1.0)))
        else:
            lower, upper = m.support
            marginals.append(ot.Uniform(lower, upper))
            families.append(ot.LegendreFactory())
    d = len(marginals)
    order = ot.LinearEnumerateFunction(d) if q == 1 else ot.HyperbolicAnisotropicEnumerateFunction(d, q)
    basis = ot.OrthogonalProductPolynomialFactory(families, order)
    algorithm = ot.FunctionalChaosAlgorithm(
        ot.Sample(points),
        ot.Sample(values[:, None]),
        ot.JointDistribution(marginals),
        ot.FixedStrategy(basis, order.getBasisSizeFromTotalDegree(case.order)),
        ot.LeastSquaresStrategy(ot.LeastSquaresMetaModelSelectionFactory(ot.LARS(), ot.CorrectedLeaveOneOut())),
    )
    algorithm.run()
    result = algorithm.getResult()
    vector, indices = ot.FunctionalChaosRandomVector(result), ot.FunctionalChaosSobolIndices(result)
    first = np.array([indices.getSobolIndex(i) for i in range(d)])
    predicted = np.array(result.getMetaModel()(ot.Sample(test)))[:, 0]
    return len(result.getIndices()), predicted, vector.getMean()[0], vector.getCovariance()[0, 0] ** 0.5, first


def _errors(case: Case, expected: FloatArray, found: Found, seconds: float) -> FloatArray:
    terms, predicted, mean, std, first = found
    exact_mean, exact_std, indices = case.exact
    error = np.sqrt(np.mean((predicted - expected) ** 2)) / expected.std()
    return np.array(
        [terms, error, abs(mean / exact_mean - 1), abs(std / exact_std - 1), np.abs(first - indices).max(), seconds]
    )


def _compare(case: Case, ot: Any) -> None:
    inputs, evaluate = case.inputs, Remembered(case.model)
    test = inputs.points(random_points(99, 0, 400 if displacements(case.model) else 3000, len(inputs.names)))
    expected = SerialEvaluate(case.model)(Request(test)).outputs[:, 0]
    for n in case.sizes:
        rows: dict[str, list[FloatArray]] = {}

        def measure(name: str, fit: Callable[[], Found], rows: dict[str, list[FloatArray]] = rows) -> None:
            begin = time.process_time()
            found = fit()
            rows.setdefault(name, []).append(_errors(case, expected, found, time.process_time() - begin))

        for seed in range(SEEDS):
            points = inputs.points(sobol_points(seed, 0, 0, n, len(inputs.names)))
            solved = evaluate(Request(points, tangents=True))
            values = solved.outputs[:, 0]

            def own(
                tangents: FloatArray | None, points: FloatArray = points, outputs: FloatArray = solved.outputs
            ) -> Found:
                fitted = Regression.of(inputs, points, outputs, tangents, case.order)
                found = {name: estimate[0] for name, estimate in fitted.estimates().items()}
                predicted = fitted.basis.values(test) @ fitted.fit.coefficients[:, 0]
                return len(fitted.basis.indices), predicted, found["mean"], found["std"], found["sobol_first"]

            measure("tissuq, gradients", partial(own, solved.tangents))
            measure("tissuq", partial(own, None))
            measure("chaospy", partial(_by_chaospy, case, points, values, test, _largest(case, n)))
            if ot is not None:
                for truncation in (1.0, 0.75, 0.5):
                    fit = partial(_by_openturns, ot, case, points, values, test, truncation)
                    measure(f"OpenTURNS, q = {truncation:g}", fit)
        for name, found in rows.items():
            *_, seconds = np.mean(found, axis=0)
            terms, *errors = np.sqrt(np.mean(np.square(found), axis=0))[:-1]
            told = " | ".join(f"{e:.1e}" for e in errors)
            print(f"| {case.name} | {n} | {name} | {terms:.0f} | {told} | {seconds:.2f} |", flush=True)


def _largest(case: Case, n: int) -> int:
    """Order of the largest full basis with two samples for each function, as is usual."""
    d = len(case.inputs.names)
    return max([1, *(p for p in range(1, case.order + 1) if 2 * len(hyperbolic(d, p, 1.0)) <= n)])


# --- fields --------------------------------------------------------------------------------------------------------


def _fields() -> None:
    """Print the processor time of field fits from the same samples: coefficients, mean and standard deviation."""
    print(f"\nField fits, {NODES:,} nodes × 3 components, least squares on values:\n")
    print("| parameters | order | samples | chaospy (s) | tissuq (s) | ratio | largest difference |\n|" + "---|" * 7)
    for d, order, n in ((2, 3, 50), (3, 3, 60), (4, 3, 70)):
        inputs = Inputs(dict.fromkeys("abcd"[:d], Uniform(lower=0.0, upper=1.0)))
        shape = np.random.default_rng(0).random((d, 3 * NODES))
        points = inputs.points(random_points(1, 0, n, d))
        fields = np.exp(np.sin(points @ shape))
        joint = _joint(inputs)
        begin = time.process_time()
        basis = chaospy.generate_expansion(order, joint, normed=True)
        fitted = chaospy.fit_regression(basis, points.T, fields)
        mean, std = chaospy.E(fitted, joint), chaospy.Std(fitted, joint)
        slow = time.process_time() - begin
        begin = time.process_time()
        found = _own_fields(inputs, order, points, fields)
        fast = time.process_time() - begin
        gap = max(np.abs(mean - found[0]).max(), np.abs(std - found[1]).max())
        print(f"| {d} | {order} | {n} | {slow:.2f} | {fast:.3f} | {slow / fast:.0f} | {gap:.1e} |", flush=True)


def _own_fields(inputs: Inputs, order: int, points: FloatArray, fields: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sum the right-hand sides as blocks of one sample come in, and solve: the path of `field_regression`."""
    basis = orthonormal(inputs, hyperbolic(len(inputs.names), order, 1.0))
    merger = Merger(Projections(basis, fields[0], False, None, None))
    for point, state in zip(points, fields, strict=True):
        merger.add(
            Evaluations(
                point[None, :],
                np.zeros((1, 1)),
                None,
                (),
                np.zeros(1),
                np.zeros((1, len(WORK)), dtype=np.int64),
                np.zeros(1),
                np.ones(1, dtype=bool),
                np.zeros(1, dtype=np.int8),
                (state - fields[0])[None, :],
            )
        )
    triangle = np.linalg.qr(basis.values(points), mode="r")
    coefficients = cho_solve((triangle, False), merger.result().fields[:-1])
    coefficients[0] += fields[0]
    moments = coefficient_moments(coefficients.T, basis.indices)
    return moments["mean"], moments["std"]


def quiet_openturns() -> Any:
    """Return OpenTURNS without its log, or None where it is not installed, and say so."""
    try:
        import openturns
    except ImportError:
        print("OpenTURNS is not installed and left out: pip install -c constraints.txt -e '.[benchmarks]'\n")
        return None
    openturns.Log.Show(openturns.Log.NONE)
    return openturns


def main(words: Sequence[str] = ()) -> None:
    """Print errors on samples of their own, averaged over designs (root mean squares), and times of field fits.

    Processor times are those of fit, moments, indices and predictions from solves that are there.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks chaos")
    parser.add_argument("--cases", default="")
    options = parser.parse_args(words)
    openturns = quiet_openturns()
    print(f"{SEEDS} designs each; mean and standard deviation relative, Sobol' indices the largest, of first order")
    print(f"\n{HEAD}\n|{'---|' * 9}")
    for case in _cases():
        if options.cases in case.name:
            _compare(case, openturns)
    _fields()
