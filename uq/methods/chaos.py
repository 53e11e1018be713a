"""Polynomial chaos for outputs and for the whole displacement field: moments, Sobol' indices, and a surrogate.

The expansion in orthonormal polynomials is fitted to values and gradients (`uq.surrogates.regression`), or projected by
Gauss quadrature. Moments and Sobol' indices are sums of squares of its coefficients. The leave-one-out error decides
which functions it has, and when there are enough samples.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from forward.model import FloatArray
from uq.estimators.doubts import of_centre, of_indices
from uq.estimators.estimate import of_samples
from uq.estimators.indices import Analysis
from uq.estimators.quantiles import quantiles, quantiles_of_predictions
from uq.evaluation.block import merge
from uq.evaluation.evaluate import Recorder
from uq.evaluation.request import Evaluate, Evaluations, Request
from uq.findings import add
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.methods.method import Amount, Probability, refuse
from uq.surrogates.basis import DICTIONARY, FULL, ROWS_PER_TERM, Basis, candidates_of, gauss, rows_of, whole
from uq.surrogates.field_regression import (
    FIELD_DICTIONARY,
    Projections,
    among,
    doubts_of_field,
    estimates_of_field,
    regression_of_field,
)
from uq.surrogates.gate import repeated
from uq.surrogates.least_squares import ROUNDING, Data
from uq.surrogates.linearisation import Linearisation, linearise, local_dataset
from uq.surrogates.regression import HIGHEST, ORDER, Regression

if TYPE_CHECKING:
    import xarray as xr

    from uq.accuracy.goal import Goal

LARGEST = 1000  # samples after which a tolerance is given up by default
GROWTH, LEAST_GROWTH = 1.5, 1.1  # growth of the design between checks of the tolerance
AGAIN = 2  # rounds: the first samples are explained by what was chosen by them, until others show more
DRAWN = 17  # 2^17 points of the expansion give quantiles and densities
QUARTERS = 4
BINS = 80


class Chaos(Amount):
    """Polynomial chaos, by regression on values and gradients or by Gauss quadrature.

    Parameters
    ----------
    samples, budget_seconds
        As in `Amount`; there is one more solve, at the mean parameters.
    tolerance
        Stop when the leave-one-out error of every output is below this fraction of its standard deviation.
    max_order
        Largest order that is tried; the order of the projection. By default that is 6, and without `fields` a
        regression goes on to higher ones, up to 20, as long as functions of the highest are chosen and explain far
        more.
    gradients
        Whether derivatives are fitted too, if the model has them.
    fit
        "regression" on a scrambled Sobol' design, or "projection" by a tensor product of Gauss rules with
        ``max_order + 2`` points for each parameter, on values only: one more than orthogonality needs, so that the
        error can be measured.
    seed
        Seed of the design; sample z of a seed is the same in every study.
    quantiles
        Probabilities of the quantiles of the outputs; without any, there are no densities either.
    fields
        Whether the displacement field is expanded too, at each node.
    """

    kind: Literal["chaos"] = "chaos"
    max_order: Annotated[int, Field(ge=1, le=HIGHEST)] | None = None
    gradients: bool = True
    fit: Literal["regression", "projection"] = "regression"
    seed: Annotated[int, Field(ge=0)] = 0
    quantiles: tuple[Probability, ...] = (0.05, 0.5, 0.95)
    fields: bool = True

    def check_amount(self) -> None:
        if self.fit == "regression":
            super().check_amount()
        elif self.asked:
            raise ValueError(
                "gives samples, tolerance or budget_seconds, expected none: a projection takes (max_order + 2)^d points"
            )

    def planned(self, dimension: int) -> int:
        if self.fit == "projection":
            return int(1 + (self.order + 2) ** dimension)
        return 1 + (self.samples or LARGEST)

    @property
    def order(self) -> int:
        """Largest order that is tried first."""
        return self.max_order or ORDER

    def with_tangents(self, samples: int) -> int:
        return samples if self.gradients and self.fit == "regression" else 0

    @property
    def aims(self) -> bool:
        """Whether it can stop at a goal: the points of a projection are all or nothing."""
        return super().aims and self.fit == "regression"

    def stream(self) -> tuple[Any, ...] | None:
        return "design", self.gradients

    def objection(self, inputs: Inputs) -> str | None:
        if inputs.draws is not None and self.fit == "projection":
            return "parameters given by draws have no Gauss rules, expected method.fit = 'regression'"
        return objection(inputs, f"method.kind = '{self.kind}'")

    def run(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        """Solve at the points of the design, fit and estimate.

        Returns
        -------
        xarray.Dataset
            Estimates by output, Sobol' indices, the expansion itself (`load` makes it callable) and, with `fields`,
            moments and coefficients by node and component; see docs/results.md.
        """
        return self.reported(evaluate, self.expand(inputs, evaluate))

    def expand(self, inputs: Inputs, evaluate: Evaluate) -> Expanded:
        """Solve at the points of the design and fit; errors as in `run`."""
        for found in self.rounds(inputs, evaluate):
            if self.met(found.reached):
                break
        limit = self.planned(len(inputs.names)) - 1
        amount = f"{found.count} samples"
        return replace(found, stopped=self.why_stopped(found.reached, found.error, found.count, limit, amount))

    def until(self, inputs: Inputs, evaluate: Evaluate, goal: Goal) -> xr.Dataset:
        """Solve until the claimed errors are those of a goal, or there are no more solves; errors as in `run`."""
        for number, one in enumerate(self.rounds(inputs, evaluate, self.most(goal)), 1):
            found, reached = one.held_to(goal)
            if reached <= 1 and number >= AGAIN:
                break
        return self.reported(evaluate, found)

    def reported(self, evaluate: Evaluate, found: Expanded) -> xr.Dataset:
        """Return the results of an expansion."""
        return expansion_dataset(evaluate, found, self.seed, self.quantiles, fields=self.fields)

    def most(self, goal: Goal) -> int:
        """Return how many samples an expansion may take for a goal."""
        return min(self.samples or LARGEST, max(goal.most - 1, 2))

    def rounds(
        self,
        inputs: Inputs,
        evaluate: Evaluate,
        limit: int | None = None,
        scramble: int = 0,
        wanted: Callable[[], float] | None = None,
    ) -> Iterator[Expanded]:
        """Solve and fit, again and again with more samples, up to a limit (by default that of the method).

        The samples are those of a scramble of the Sobol' points. After each round `wanted` may say how many there
        should be next, at most half as many more. Errors as in `run`.
        """
        refuse(self.objection(inputs))
        evaluate = Recorder(evaluate)
        centre = linearise(inputs, evaluate)
        projection, open_ended = self.fit == "projection", self.open_ended or limit is not None
        gradients = self.gradients and evaluate.differentiable and not projection
        rows = rows_of(inputs, gradients=gradients)
        most = ROWS_PER_TERM * FIELD_DICTIONARY if limit is not None else np.inf  # of a basis that may grow
        limit = limit or self.planned(len(inputs.names)) - 1
        grid, weights = gauss(inputs, self.order + 2) if projection else (None, None)
        expand_fields = self.fields and centre.state.size > 0
        if projection:
            bases = whole(inputs, self.order)
        else:
            dictionary = FIELD_DICTIONARY if expand_fields else DICTIONARY
            bases = candidates_of(inputs, self.order, int(min(limit * rows, most)), dictionary)
        fields = None
        if expand_fields:
            fields = Projections(
                bases.basis, centre.state, gradients, grid, weights, evaluate.displacements, evaluate.node_volumes
            )
        found: list[Evaluations] = []
        count, target = 0, min(limit, first_samples(inputs, gradients=gradients)) if open_ended else limit
        while target > count:
            points = grid
            if points is None:
                points = inputs.points(sobol_points(self.seed, scramble, count, target, len(inputs.names)))
            found.append(evaluate(Request(points, tangents=gradients, fields=fields, start=centre.prediction)))
            count = target
            evaluations = merge(found)
            data = Data.of(evaluations, inputs, weights)
            regression = Regression.fitted(inputs, bases, data)
            if self.max_order is None and not projection and not expand_fields:
                regression = regression.higher()
            yield Expanded(centre, evaluations, regression)
            paid = count + self.affordable(evaluate.solves, evaluate.seconds)
            growth = GROWTH if wanted is None else max(LEAST_GROWTH, min(GROWTH, wanted() / count))
            target = int(min(limit, np.ceil(growth * count), paid))


def objection(inputs: Inputs, asked: str) -> str | None:
    """Say why what is asked for cannot expand in these parameters, or None."""
    if inputs.correlations:
        return f"polynomial chaos needs independent parameters, expected no correlations for {asked}"
    return None


def first_samples(inputs: Inputs, *, gradients: bool) -> int:
    """Samples before a tolerance is first checked: enough for all products of two parameters, or for all slopes."""
    d = len(inputs.names)
    terms = (d + 1) * (d + 2) // 2 if d <= FULL else 2 * (d + 1)
    return max(4, -(-ROWS_PER_TERM * terms // rows_of(inputs, gradients=gradients)))


@dataclass(frozen=True)
class Expanded:
    """An expansion with the evaluations from which it was made, and why they were enough.

    `unseen` are further errors (2, m) of mean and standard deviation, if it was held to a goal.
    """

    centre: Linearisation
    evaluations: Evaluations
    regression: Regression
    stopped: str = ""
    unseen: FloatArray | None = None

    def held_to(self, goal: Goal) -> tuple[Expanded, float]:
        """Return it, and the largest error over what the goal leaves.

        What errors are by its samples is believed only if the whole fit, repeated with fewer of them, says so too.
        """
        reached = goal.reached(self.estimates())
        if reached > 1:
            return self, reached
        spread = np.where(self.regression.controlled, 0.0, repeated(self.regression).spread)
        found = replace(self, unseen=spread)
        return found, goal.reached(found.estimates())

    def estimates(self, of: Analysis | None = None) -> dict[str, FloatArray]:
        """Return estimates by output with their errors, as `Regression.estimates` does."""
        found = self.regression.estimates(of)
        if self.unseen is not None:
            for name, error in zip(("mean_error", "std_error"), self.unseen, strict=True):
                found[name] = np.hypot(found[name], error)
        return found

    @property
    def count(self) -> int:
        """Number of samples."""
        return len(self.evaluations.points)

    @property
    def reached(self) -> float:
        """Largest leave-one-out error of an output, over its standard deviation."""
        return float(self.regression.fit.relative.max())

    @property
    def error(self) -> str:
        """What was fitted, and how well, in words."""
        chosen = self.regression.fit.chosen
        return f"order {chosen.order}, {chosen.which.size} terms, leave-one-out error {self.reached:.3g}"


# --- what follows from an expansion --------------------------------------------------------------------------------


def expansion_dataset(
    evaluate: Evaluate,
    expanded: Expanded,
    seed: int,
    probabilities: tuple[float, ...],
    further: Mapping[str, FloatArray] | None = None,
    *,
    fields: bool,
    of: Analysis | None = None,
) -> xr.Dataset:
    """Return the results of an expansion, with quantiles from points of a seed, and the displacement field or without.

    `further` errors (m,) of "mean" and "std" are known from elsewhere; analyses other than indices are `of` these.
    """
    centre, evaluations, regression = expanded.centre, expanded.evaluations, expanded.regression
    inputs, basis, data, fit = regression.inputs, regression.basis, regression.data, regression.fit
    supports = [m.support for m in inputs.marginals.values()]
    estimates = expanded.estimates(of)
    for name, error in (further or {}).items():
        estimates[f"{name}_error"] = np.hypot(estimates[f"{name}_error"], error)
    lower, upper = (
        np.array([edge if s is None else s[side] for s, edge in zip(supports, edges, strict=True)])
        for side, edges in enumerate((data.points.min(axis=0), data.points.max(axis=0)))
    )
    by_output, by_pair = ("output",), ("output", "parameter")
    dataset = local_dataset(inputs, evaluate, centre, fields=fields)
    field, terms = None, fit.chosen.which
    if evaluations.sketches is not None and fields:
        field = regression_of_field(regression, evaluations.sketches)
        terms = np.concatenate([terms, np.setdiff1d(field.fit.chosen.which, terms)])
    indices = regression.candidates.basis.indices[terms]
    coefficients = among(terms, fit.chosen.which, fit.coefficients)
    dataset = dataset.assign(
        {
            **{name: (by_pair if v.ndim > 1 else by_output, v) for name, v in estimates.items()},
            "loo_error": (by_output, fit.relative),
            **of_samples(evaluations.points, evaluations.outputs, evaluations.ok),
            "order": ((), fit.chosen.order),
            "q": ((), fit.chosen.q),
            "multi_index": (("term", "parameter"), indices),
            "coefficients": (("term", "output"), coefficients),
            "coordinate_logarithmic": (("parameter",), basis.coordinates.logarithmic.astype(np.int64)),
            "coordinate_mean": (("parameter",), basis.coordinates.centre),
            "coordinate_std": (("parameter",), basis.coordinates.scale),
            "recurrence_alpha": (("parameter", "degree"), basis.alpha),
            "recurrence_beta": (("parameter", "degree"), basis.beta),
            "range_lower": (("parameter",), lower),
            "range_upper": (("parameter",), upper),
        }
    )
    if basis.joint is not None:  # what else is needed to evaluate functions of draws
        dataset = dataset.assign(
            coordinate_mixing=(("parameter", "coordinate"), basis.coordinates.mixing),
            joint_index=(("function", "joint_parameter"), basis.joint.indices),
            joint_inverse=(("joint_product", "function"), basis.joint.inverse),
        )
    if probabilities:
        dataset = _distribution(dataset, seed, probabilities, regression)
    add(dataset, *regression.doubts(evaluate.outputs))
    missed = (centre.outputs - basis.values(centre.point[None, :]) @ fit.coefficients)[0]
    add(dataset, *of_centre(evaluate.outputs, centre.outputs, missed, fit.loo, estimates["std"]), *of_indices(dataset))
    if field is not None:
        count = evaluate.displacements
        dataset = dataset.assign(estimates_of_field(evaluations, centre, count, field, terms, regression, estimates))
        add(dataset, *doubts_of_field(field))
    dataset.attrs["stopped"] = expanded.stopped or f"{expanded.count} samples: {expanded.error}"
    failed = int((~evaluations.ok).sum())
    if failed:
        dataset.attrs["note"] = (
            f"{failed} of {len(evaluations.ok)} samples have no answer; the expansion is fitted to the others and "
            "extrapolates them to where the model has no answer"
        )
    return dataset


def _distribution(
    dataset: xr.Dataset, seed: int, probabilities: tuple[float, ...], regression: Regression
) -> xr.Dataset:
    """Return results with quantiles and densities, from many points of the expansion, or from the samples.

    Quantiles are those of the samples where their intervals are the shorter ones. If the moments are those of the
    samples, so are they, and densities are those of the expansion plus its errors at unseen samples, drawn apart.
    """
    inputs, fit, data = regression.inputs, regression.fit, regression.data
    drawn, part = predictions(inputs, seed, regression.basis, fit.coefficients)
    seen = data.values - fit.unseen
    found = quantiles_of_predictions(drawn, part, seen, fit.unseen, data.weights, probabilities, regression.missing())
    rough = regression.controlled
    if np.ptp(data.weights) == 0:
        found = quantiles(data.values, probabilities).or_shorter(found, ~rough)
    if rough.any():
        which = np.random.default_rng(seed).choice(len(data.values), len(drawn), p=data.weights / data.weights.sum())
        drawn = np.where(rough, drawn + fit.unseen[which], drawn)
    counts = [_density(column) for column in drawn.T]
    return found.on(dataset, probabilities).assign(
        density=(("output", "bin"), np.array([density for density, _ in counts])),
        density_edge=(("output", "edge"), np.array([edges for _, edges in counts])),
    )


def predictions(
    inputs: Inputs, seed: int, functions: Basis, coefficients: FloatArray
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return functions times coefficients at many points of the distribution (N, m), and the part (N,) of each.

    Each part of the points is a set of Sobol' points too.
    """
    uniforms = np.split(sobol_points(seed, 0, 0, 2**DRAWN, len(inputs.names)), 2 ** max(DRAWN - 12, 0))
    drawn = np.concatenate([functions.values(inputs.points(some)) @ coefficients for some in uniforms])
    return drawn, np.repeat(np.arange(QUARTERS), 2**DRAWN // QUARTERS)


def _density(drawn: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Density in bins of values (n,), and their edges; NaN for values that do not vary."""
    if np.ptp(drawn) <= ROUNDING * np.abs(drawn).max():
        return np.full(BINS, np.nan), np.linspace(drawn.min(), drawn.max(), BINS + 1)
    return np.histogram(drawn, BINS, density=True)
