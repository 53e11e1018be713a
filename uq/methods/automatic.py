"""A method that is chosen by what solves show: an expansion first, quasi-Monte Carlo where that takes less.

An expansion with gradients needs few solves of a smooth model, and any number of one that is not. Which of both a model
is, the first solves tell: the claimed errors of the expansion are extrapolated as a power of the number of samples,
with at least the exponent ½ of sampling. Against that stands quasi-Monte Carlo with the tangent, or the expansion so
far, as control variate: what the control leaves of the standard deviation σ of an output, λσ, and with it about

    √2 λσ n^(−1/2) (n/R)^(−1/4)

of error after n samples in R scrambles, for a standard deviation (Sobol' points do better on smooth functions, and the
¼ is on the safe side of most). Claims decide when it ends, predictions only which way is gone on.
"""

from __future__ import annotations

import json
from dataclasses import replace
from math import comb
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from forward.model import FloatArray, SolveError
from uq.estimators.indices import shares
from uq.estimators.moments import student
from uq.evaluation.evaluate import Recorder
from uq.evaluation.request import Evaluate
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import power_of_two, sobol_points
from uq.methods.chaos import AGAIN, LARGEST, LEAST_GROWTH, Chaos, Expanded
from uq.methods.method import UNASKED, Method, Probability
from uq.methods.quasi_monte_carlo import FIT, QuasiMonteCarlo
from uq.surrogates.field_regression import deviations

if TYPE_CHECKING:
    from collections.abc import Sequence

    import xarray as xr

    from uq.accuracy.goal import Goal

SEEN = 3  # last rounds of an expansion from which the next ones are predicted
ROUNDS = 5  # of an expansion in any case, where samples are few
SOME = 1024  # samples beyond which tails are looked at
LEAST_POWER = 0.5  # of the number of samples with which claims fall: that of sampling
ENOUGH = 1.1  # times the further samples that are predicted to be enough
WORTH = 1.5  # times fewer solves, predicted: then what was begun is given up,
PATIENCE = 0.5  # but not before it has taken this share of what would follow: expansions may begin slowly
FUNCTIONS, LEAST_ORDER, LARGEST_ORDER = 500, 6, 20  # of the largest whole basis, and orders
SCRAMBLES = 16
GAIN = 0.25  # power of the points in a scramble with which errors fall besides, usually
LIMITLESS = 10**9
WITH_DERIVATIVES = 2.0  # solves that one with derivatives counts as
Control = Literal["none", "tangent", "chaos"]
IN_WORDS: dict[Control, str] = {
    "none": "without a control variate",
    "tangent": "with the tangent as control variate",
    "chaos": "with an expansion as control variate",
}


class Automatic(Method):
    """Means and standard deviations to the tolerance of a study, `[accuracy] tolerance`, by the method that suits.

    Parameters
    ----------
    seed
        Seed of all points.
    quantiles
        Probabilities of the quantiles of the outputs.
    fields
        Whether the displacement field is estimated too, at each node.
    """

    undecided: ClassVar[str] = "a first expansion"
    kind: Literal["automatic"] = "automatic"
    seed: Annotated[int, Field(ge=0)] = 0
    quantiles: tuple[Probability, ...] = (0.05, 0.5, 0.95)
    fields: bool = True

    def planned(self, dimension: int) -> int:
        terms = comb(dimension + 2, 2)
        return 1 + max(4, -(-2 * terms // (1 + dimension)))

    def with_tangents(self, samples: int) -> int:
        return samples

    def run(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        raise ValueError(UNASKED)

    def until(self, inputs: Inputs, evaluate: Evaluate, goal: Goal) -> xr.Dataset:
        """Solve until errors are those of a goal.

        Returns
        -------
        xarray.Dataset
            The results of the method that was chosen; its attribute `chosen` says which, and why.
        """
        recorder = Recorder(evaluate)
        control, why, found = self._pilot(inputs, recorder, goal)
        solves, reasons = recorder.solves, [why]
        if control is None and found is not None:
            chosen, dataset = "chaos", self._chaos(inputs, goal).reported(recorder, found)
        else:
            control, left = control or "none", replace(goal, most=max(goal.most - solves, 2))
            chosen, reasons = "quasi-monte-carlo", [f"Quasi-Monte Carlo {IN_WORDS[control]}: {why}."]
            method = QuasiMonteCarlo(
                samples=SCRAMBLES * power_of_two(LIMITLESS // SCRAMBLES),  # the goal says how many
                scrambles=SCRAMBLES,
                control=control,
                seed=self.seed,
                quantiles=self.quantiles,
                fields=self.fields,
            )
            expanded = None
            if control == "chaos" and found is not None:
                expanded = deviations(found.regression, found.evaluations, found.centre)
            dataset = method.until(inputs, recorder, left, expanded)
            if solves:
                reasons.append(f"In all {recorder.solves:,} solves, {solves:,} of them to find out.")
        dataset.attrs["chosen"] = json.dumps({"method": chosen, "reasons": reasons}, ensure_ascii=False)
        return dataset

    def _pilot(self, inputs: Inputs, evaluate: Recorder, goal: Goal) -> tuple[Control | None, str, Expanded | None]:
        """Expand until the claims are those of the goal, or something else takes less.

        Returns the control of quasi-Monte Carlo, if this is to follow; why, in words; the expansion, if there is one.
        """
        gradients = evaluate.differentiable
        plain: Control = "tangent" if gradients else "none"
        if inputs.correlations:
            return plain, "there are no expansions in parameters that are correlated", None
        chaos = self._chaos(inputs, goal)
        trail: list[tuple[int, float]] = []
        found: Expanded | None = None
        control, samples = plain, 0  # of quasi-Monte Carlo, as predicted

        def wanted() -> float:
            return trail[-1][0] + ENOUGH * _further(trail) if len(trail) >= AGAIN else np.inf

        try:
            for one in chaos.rounds(inputs, evaluate, chaos.most(goal), FIT, wanted):
                found, reached = one.held_to(goal)
                trail.append((found.count, reached))
                if reached <= 1 and len(trail) >= AGAIN:
                    break
                control, samples = _outlook(found, goal, gradients=gradients)
                weight = WITH_DERIVATIVES if gradients else 1.0
                spent, further = weight * found.count, weight * _further(trail)
                if len(trail) >= ROUNDS and spent > PATIENCE * samples and further > WORTH * samples:
                    break
        except SolveError as error:
            if found is None:
                return plain, error.reason, None
            raise
        assert found is not None
        (first, before), (count, last) = trail[0], trail[-1]
        fell, counts = (f"fell from {before:.2g}", f"{first} to {count}") if len(trail) > 1 else ("came", f"{count}")
        why = f"its claimed error {fell} to {last:.2g} times what is allowed with {counts} samples"
        if last <= 1 or not samples or goal.most - count < WORTH * count:
            what = "fitted to values and gradients" if gradients else "fitted to values"
            return None, f"Polynomial chaos {what}: {why}.", found
        more = f"an expansion would take {_rounded(_further(trail))} more"
        return control, f"about {samples:,} samples are predicted, {more}: {why}", found

    def _chaos(self, inputs: Inputs, goal: Goal) -> Chaos:
        return Chaos(
            samples=max(2, min(LARGEST, goal.most - 1)),
            max_order=order_for(len(inputs.names)),
            seed=self.seed,
            quantiles=self.quantiles,
            fields=self.fields,
        )


def order_for(dimension: int) -> int:
    """Return the largest order of expansions: more than usual in few parameters, for small tolerances."""
    orders = [order for order in range(1, LARGEST_ORDER + 1) if comb(dimension + order, order) <= FUNCTIONS]
    return max([LEAST_ORDER, *orders])


def _further(trail: Sequence[tuple[int, float]]) -> float:
    """Predict the number of further samples until a claim is 1, from those after numbers of samples."""
    (before, first), (count, last) = trail[max(0, len(trail) - SEEN)], trail[-1]
    if not np.isfinite(first) or not np.isfinite(last):
        return np.inf
    power = np.log(first / last) / np.log(count / before) if count > before and last < first else 0.0
    # A claim that is larger than one before it is that of an unlucky choice of functions: both say how many are enough.
    with np.errstate(over="ignore"):
        enough = [n * np.float64(claim) ** (1 / max(power, LEAST_POWER)) for n, claim in trail[-SEEN:] if claim <= last]
    return float(max(min(enough) - count, (LEAST_GROWTH - 1) * count))


def _outlook(found: Expanded, goal: Goal, *, gradients: bool) -> tuple[Control, int]:
    """Predict the control variate with which quasi-Monte Carlo takes least, and the samples, from an expansion."""
    regression, centre = found.regression, found.centre
    inputs, fit, data, estimates = regression.inputs, regression.fit, regression.data, regression.estimates()
    std = np.asarray(estimates["std"])
    left: dict[Control, FloatArray] = {"none": std, "chaos": np.minimum(fit.loo, std)}
    missed: dict[Control, FloatArray] = {"none": data.values - data.values.mean(axis=0), "chaos": fit.unseen}
    if gradients:
        missed["tangent"] = data.values - (centre.middle + centre.predicted(data.points))
        left["tangent"] = np.minimum(missed["tangent"].std(axis=0), std)
    outside = regression.beyond(inputs.points(sobol_points(0, 0, 0, SOME, len(inputs.names)))).share
    ways: dict[Control, int] = {}
    for way, of in left.items():
        missing = regression.rest() if way == "chaos" else None
        gain = GAIN if missing is None else 0.0  # what an expansion misses in tails is at few of the points
        tails = np.zeros_like(of) if missing is None else missing * np.sqrt(outside)  # as that method claims them
        ways[way] = _samples(goal, estimates, (of, _left_of_std(data.values, missed[way])), tails, gain)
    return min(ways.items(), key=lambda way: way[1])


def _left_of_std(values: FloatArray, missed: FloatArray) -> FloatArray:
    """What a control leaves (m,) of standard deviations by one sample, from values and what it misses of them (n, m).

    Where values are large it misses most: the difference of squares is more than independent errors of its size make.
    """
    deviations = values - values.mean(axis=0)
    squares = missed * (2 * deviations - missed)
    return np.asarray(shares(squares.std(axis=0), 2 * deviations.std(axis=0)))


def _samples(
    goal: Goal, estimates: dict[str, FloatArray], left: tuple[FloatArray, FloatArray], tails: FloatArray, gain: float
) -> int:
    """Predict the samples of quasi-Monte Carlo whose control leaves so much (m,) of means and standard deviations.

    And so much (m,) of the latter in tails, however many samples there are. Errors fall by such a power (`gain`) of the
    points in a scramble faster than those of independent samples.
    """
    n, half_width = 4 * SCRAMBLES, student(SCRAMBLES - 1)
    while n < goal.most:
        falls = n**-0.5 * (n / SCRAMBLES) ** -gain
        of_std = np.maximum(np.sqrt(2) * left[0], left[1]) * falls
        then = {**estimates, "mean_error": left[0] * falls, "std_error": np.hypot(of_std, tails)}
        if goal.reached(then, half_width) <= 1:
            break
        n *= 2
    return n


def _rounded(count: float) -> str:
    """A predicted number in words."""
    return f"about {float(f'{count:.1g}'):,.0f}" if count < 1e6 else "more than a million"
