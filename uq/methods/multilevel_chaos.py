"""Multilevel polynomial chaos: a few iterations of the solver for each sample, from the expansion of the level before.

The levels are those of the solver, on one mesh. Level k draws fresh samples, starts each from the state that the
expansion of level k − 1 predicts there, lets the solver make a few iterations, and fits an expansion of the whole state
to what they have reached. Source: the published study of `configs/beam.toml` (P. Hauseux, J. S. Hale, S. Cotin,
S. P. A. Bordas, Applied Mathematical Modelling 62 (2018) 86–102), where an iteration is one of Newton's with a new
factor and the first level starts from the solution at the mean parameters. Here an iteration is a residual and a
back-substitution with the factor at the mean, and the first level starts from the tangent there.

No level gets below the error of its polynomials, whatever the number of levels: an expansion predicts the state to
this error, and a few corrections divide it by a constant. So, once the moments have settled, one more level iterates to
the solver's tolerance, and the reported results rest on equilibria.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field

from forward.model import WORK, FloatArray
from uq.estimators.estimate import Variables
from uq.estimators.indices import coefficient_moments
from uq.estimators.moments import ESTIMATES, Moments, estimate, monomials, ratio
from uq.evaluation.evaluate import Recorder
from uq.evaluation.request import Evaluate, Evaluations, Prediction, Request, Start
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.methods.chaos import Expanded, expansion_dataset, objection
from uq.methods.method import Amount, Probability, refuse
from uq.surrogates.basis import Basis, hyperbolic_count, whole
from uq.surrogates.field_regression import Projections, StateExpansion
from uq.surrogates.least_squares import Data, Fit, fit_best
from uq.surrogates.linearisation import Linearisation, linearise
from uq.surrogates.regression import Regression

if TYPE_CHECKING:
    import xarray as xr

    from forward.scalars import Mistake
    from forward.spec import ModelSpec

SAMPLES_PER_TERM = 3  # of a level by default; rounded up to a power of two
TO_TOLERANCE = 1_000_000  # iterations: as many as the solver needs


class MultilevelChaos(Amount):
    """Polynomial chaos of states that the solver approaches level by level, a few iterations for each sample.

    Parameters
    ----------
    samples
        Number of samples of each level; by default the power of two above three for each term of the expansion.
    tolerance
        Stop when the solver's tolerance is met at all samples and the moments change by less than this from one level
        to the next: means relative to the means (to the standard deviations where these are larger), standard
        deviations relative to themselves, those of the displacement field in the Euclidean norm.
    budget_seconds
        As in `Amount`; another level is begun only if the budget covers all of it.
    iterations
        Iterations of the solver for each sample of a level.
    order
        Order of the expansion, which has all (d + order)! / d! order! terms.
    max_levels
        Largest number of levels; the last one iterates to the solver's tolerance.
    first
        Where the first level starts: from the "tangent" at the mean parameters, or from the state there ("mean"), as
        published.
    seed
        Seed of the Sobol' points; each level uses a different scramble.
    quantiles
        Probabilities of the quantiles of the outputs.
    fields
        Whether mean, standard deviation and expansion of the displacement field are reported.
    """

    kind: Literal["multilevel-chaos"] = "multilevel-chaos"
    tolerance: Annotated[float, Field(gt=0)] | None = 1e-3
    iterations: Annotated[int, Field(ge=1)] = 2
    order: Annotated[int, Field(ge=1, le=20)] = 3
    max_levels: Annotated[int, Field(ge=1)] = 10
    first: Literal["tangent", "mean"] = "tangent"
    seed: Annotated[int, Field(ge=0)] = 0
    quantiles: tuple[Probability, ...] = (0.05, 0.5, 0.95)
    fields: bool = True

    def check_amount(self) -> None:
        """Raise no error: levels have a default number of samples, and there is a default number of levels."""

    def per_level(self, dimension: int) -> int:
        """Number of samples of a level for so many parameters."""
        if self.samples is not None:
            return self.samples
        return 1 << (SAMPLES_PER_TERM * hyperbolic_count(dimension, self.order, 1.0) - 1).bit_length()

    def planned(self, dimension: int) -> int:
        return 1 + self.max_levels * self.per_level(dimension)

    def objection(self, inputs: Inputs) -> str | None:
        if self.order > inputs.largest_degree:
            most = inputs.largest_degree
            return f"the draws tell polynomials up to degree {most} apart, expected at most that as method.order"
        return objection(inputs, f"method.kind = '{self.kind}'")

    def unfit(self, spec: ModelSpec) -> Iterator[Mistake]:
        """Find that there is no solver that could be stopped early."""
        if not spec.iterative:
            message = f"a model of kind '{spec.kind}' has no iterations of a solver, expected another method"
            yield ("method", "kind"), message, self.kind

    def mistakes(self, inputs: Inputs, spec: ModelSpec) -> Iterator[Mistake]:
        yield from super().mistakes(inputs, spec)
        shortage = self.shortage(len(inputs.names))
        if shortage is not None:
            yield ("method", "samples"), shortage, self.samples

    def shortage(self, dimension: int) -> str | None:
        """Say that there are too few samples for the terms of the expansion, or None."""
        terms = hyperbolic_count(dimension, self.order, 1.0)
        if self.per_level(dimension) > terms:
            return None
        return f"an expansion of order {self.order} in {dimension} parameters has {terms} terms, expected more samples"

    def run(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        """Go from level to level, fit and estimate.

        Returns
        -------
        xarray.Dataset
            As in `uq.methods.chaos.Chaos`, from the last level; the same moments from its samples with the expansion of
            the level before as control variate (`control_mean`, …); and by level what it has cost and reached
            (`level_residual`, `level_change`, …); see docs/results.md.
        """
        d = len(inputs.names)
        refuse(self.objection(inputs) or self.shortage(d))
        evaluate = Recorder(evaluate)
        centre = linearise(inputs, evaluate)
        bases, n = whole(inputs, self.order), self.per_level(d)
        basis = bases.basis
        start = _start(centre, self.first)
        sums = None
        if start is not None:
            sums = Projections(basis, centre.state, False, None, None, evaluate.displacements, evaluate.node_volumes)
        known = _of_tangent(centre, evaluate.displacements)
        levels: list[_Level] = []
        finishing = False
        while True:
            finishing = finishing or len(levels) + 1 == self.max_levels
            iterations = TO_TOLERANCE if finishing else self.iterations
            points = inputs.points(sobol_points(self.seed, len(levels), 0, n, d))
            found = evaluate(Request(points, fields=sums, start=start, iterations=iterations))
            data = Data.of(found, inputs, None)
            fit = fit_best(bases, data)
            states = None if start is None else StateExpansion.fitted(basis, fit, found.fields, centre)
            start = states
            expected, known = known, _of_expansion(basis, fit, states, evaluate.displacements)
            levels.append(_Level(0 if finishing else iterations, found, known, known.change_from(expected)))
            settled = self.met(levels[-1].change)
            enough = settled and bool(found.converged[found.ok].all())
            finishing = finishing or settled
            paid = self.affordable(evaluate.solves, evaluate.seconds)
            if enough or len(levels) == self.max_levels or paid < n:
                break
        controlled = _controlled(data, expected)
        # Samples and coefficients go different ways to the moments; short of equilibrium, levels do too.
        others: list[_Known | Moments] = [controlled]
        if not found.converged[found.ok].all():
            others.append(expected)
        further = {
            "mean": np.linalg.norm([known.mean - other.mean for other in others], axis=0),
            "std": np.linalg.norm([known.std - other.std for other in others], axis=0),
        }
        change, largest = levels[-1].change, float(np.nanmax(found.residuals))
        error = f"moments changed by {change:.3g}, largest residual {largest:.2g}"
        count = f"{len(levels)} level{'s' if len(levels) > 1 else ''} of {n} samples"
        stopped = self.why_stopped(change, error, len(levels), self.max_levels, count)
        expanded = Expanded(centre, found, Regression(inputs, bases, data, fit), stopped)
        dataset = expansion_dataset(evaluate, expanded, self.seed, self.quantiles, further, fields=self.fields)
        controls = controlled.variables(*ESTIMATES, "variance_ratio").items()
        return dataset.assign(_by_level(levels)).assign({f"control_{name}": variable for name, variable in controls})


@dataclass(frozen=True)
class _Known:
    """An approximation of the model whose moments are known, of outputs (m,) and of displacements (3 nodes,)."""

    mean: FloatArray
    std: FloatArray
    field_mean: FloatArray
    field_std: FloatArray
    outputs: Callable[[FloatArray], FloatArray]  # its values (n, m) at points (n, d)

    def change_from(self, other: _Known) -> float:
        """Return the largest relative change of a moment."""
        norm = np.linalg.norm
        mean = np.append(np.abs(self.mean), norm(self.field_mean))
        std = np.append(self.std, norm(self.field_std))
        by_mean = np.append(np.abs(self.mean - other.mean), norm(self.field_mean - other.field_mean))
        by_std = np.append(np.abs(self.std - other.std), norm(self.field_std - other.field_std))
        return float(max(ratio(by_mean, np.maximum(mean, std)).max(), ratio(by_std, std).max()))


@dataclass(frozen=True)
class _Level:
    """What was done on a level, and by how much the moments have changed; 0 iterations: to the solver's tolerance."""

    iterations: int
    found: Evaluations
    known: _Known
    change: float


def _start(centre: Linearisation, first: Literal["tangent", "mean"]) -> Start | None:
    """Prediction of the first level; None for a model without a state."""
    if centre.state.size == 0:
        return None
    if first == "tangent" and centre.prediction is not None:
        return centre.prediction
    none = np.zeros((len(centre.point), centre.state.size))
    return Prediction(centre.reference, none, centre.coordinates)


def _of_tangent(centre: Linearisation, count: int) -> _Known:
    """The tangent at the mean parameters; what is known there is constant in a model without derivatives."""
    tangents = np.nan_to_num(centre.output_slopes)
    std, field_std = np.linalg.norm(tangents, axis=1), np.linalg.norm(centre.state_slopes[:, :count], axis=0)
    moments = centre.middle, std, centre.state_middle[:count], field_std
    return _Known(*moments, lambda points: centre.middle + centre.coordinates.of(points) @ tangents.T)


def _of_expansion(basis: Basis, fit: Fit, states: StateExpansion | None, count: int) -> _Known:
    outputs = coefficient_moments(fit.coefficients.T, basis.indices)
    state = np.zeros((len(basis.indices), 0)) if states is None else states.coefficients[:, :count]
    field = coefficient_moments(state.T, basis.indices)
    moments = outputs["mean"], outputs["std"], field["mean"], field["std"]
    return _Known(*moments, lambda points: basis.values(points) @ fit.coefficients)


def _controlled(data: Data, known: _Known) -> Moments:
    """Moments from samples, with an approximation that does not depend on them as control variate."""
    deviations, controls = data.values - known.mean, known.outputs(data.points) - known.mean
    sums = monomials(deviations, controls).sum(axis=1)
    return estimate(sums, len(data.points), known.mean, known.std**2)


def _by_level(levels: list[_Level]) -> Variables:
    """Cost and progress of the levels."""
    residuals = [level.found.residuals[level.found.ok] for level in levels]
    by_output = ("level", "output")
    columns: dict[str, tuple[tuple[str, ...], list[object]]] = {
        "level": (("level",), list(range(1, len(levels) + 1))),
        "operation": (("operation",), list(WORK)),
        "level_iterations": (("level",), [level.iterations for level in levels]),
        "level_solves": (("level",), [len(level.found.points) for level in levels]),
        "level_converged": (("level",), [int(level.found.converged.sum()) for level in levels]),
        "level_residual": (("level",), [r.max() for r in residuals]),
        "level_residual_median": (("level",), [np.median(r) for r in residuals]),
        "level_change": (("level",), [level.change for level in levels]),
        "level_work": (("level", "operation"), [level.found.work.sum(axis=0) for level in levels]),
        "level_mean": (by_output, [level.known.mean for level in levels]),
        "level_std": (by_output, [level.known.std for level in levels]),
    }
    return {name: (dims, np.array(values)) for name, (dims, values) in columns.items()}
