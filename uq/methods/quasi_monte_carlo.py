"""Randomised quasi-Monte Carlo: independent scrambles of Sobol' points, with control variates.

The mean over one scramble is unbiased, since each of its points is uniform by itself; the scrambles are independent, so
their scatter gives an honest standard error without any assumption on the smoothness that makes it small
(A. B. Owen, SIAM J. Numer. Anal. 34 (1997) 1884–1910; C. Lemieux, Monte Carlo and Quasi-Monte Carlo Sampling (2009)).
"""

from __future__ import annotations

from math import comb
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from forward.model import ModelError, SolveError
from uq.estimators.doubts import of_control, of_tails
from uq.estimators.estimate import of_samples
from uq.estimators.moments import Coefficient, plain_moments, ratio, running, student
from uq.estimators.quantiles import quantiles_from_replicates, quantiles_of_predictions
from uq.estimators.tails import counted, influences
from uq.evaluation.evaluate import Recorder
from uq.evaluation.request import Evaluate
from uq.findings import add
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import check_scrambles, in_order, power_of_two, sobol_points
from uq.methods.chaos import objection, predictions
from uq.methods.method import refuse
from uq.methods.monte_carlo import FIRST_ROUND, UNLIMITED, MonteCarlo, by_node, failure_note, grown
from uq.methods.scrambles import Scrambles
from uq.surrogates.basis import FULL, ROWS_PER_TERM
from uq.surrogates.field_regression import Deviations, fit_deviations
from uq.surrogates.linearisation import Linearisation, linearise, local_dataset
from uq.surrogates.taylor import expansion, quadratic, tangent

if TYPE_CHECKING:
    import xarray as xr

    from uq.accuracy.goal import Goal

ORDER = 6  # largest order of the expansions tried as control
FIT = 2**32 - 1  # number of the scramble to which the control is fitted; no sample belongs to it


class QuasiMonteCarlo(MonteCarlo):
    """Quasi-Monte Carlo: independent scrambles of Sobol' points, with a polynomial as control variate.

    Errors are one standard error from the scatter of the scrambles, without the factor of Student's distribution: a
    95 % interval is ± 2.13 of them for 16 scrambles. Those of the standard deviation cover 90 % with 4 points in each
    scramble, whose means are skewed, and 93 to 95 % from 16 points on. Where few samples carry it, they are at least
    those of as many independent samples, unless chance cannot explain that the scrambles agree so well. Tails that no
    sample shows are in no error: of Student's t with 3 to 5 degrees of freedom and 64 samples in 16 scrambles 71 to
    88 % of the intervals hold, and 10 to 15 % miss without a finding; an event that no sample has met is not seen.

    Parameters
    ----------
    samples
        Number of samples in all, `scrambles` times a power of two; with a tolerance, the largest number.
    tolerance
        As in `MonteCarlo`: the number of points is doubled until it is met, and all earlier points are kept. The error
        compared with it is itself uncertain (by 18 % for 16 scrambles). For the tolerance of a study, of all errors,
        half as many scrambles more are taken in place of that where they are predicted to be enough.
    seed
        Point z of scramble r of a seed is the same in every study with as many parameters.
    scrambles
        Number of independent scrambles R.
    control
        Control variate: "none", the "tangent" at the mean parameters, the "quadratic" Taylor polynomial there, which
        takes two more solves, with tangents, for each parameter, or "chaos", an expansion fitted to values and
        gradients at separate samples: its errors cost efficiency but cause no bias. It needs independent parameters,
        and with `fields` it also provides the starts of the solver.
    control_samples
        Number of samples to which the expansion is fitted; by default, twice what order 3 needs (order 2 above
        eight parameters). Order and terms are chosen as `Chaos` does. Where parameters have tails and the expansion
        goes wrong beyond the reach of these samples, which the others tell, it is held at its values there, and the
        displacement field has no control.
    coefficient
        "one", or "optimal": estimated by regression over the scrambles, of which there must be 4; it has a bias of
        order 1/R, a fraction of its error (seen with 4 points per scramble, for the standard deviation).
    quantiles, fields
        As in `MonteCarlo`. With an expansion as control, quantiles are those of it at many points where their intervals
        are the shorter ones so. With `fields`, scrambles are evaluated one after the other, so that at most as many
        groups of ranks as points in a scramble have work.
    """

    in_turn: ClassVar[bool] = False  # Sobol' points lead to draws by their weights
    kind: Literal["quasi-monte-carlo"] = "quasi-monte-carlo"  # type: ignore[assignment]
    scrambles: Annotated[int, Field(ge=2)] = 16
    control: Literal["none", "tangent", "quadratic", "chaos"] = "tangent"
    control_samples: Annotated[int, Field(ge=2)] | None = None
    coefficient: Coefficient = "one"

    @model_validator(mode="after")
    def _check_scrambles(self) -> QuasiMonteCarlo:
        R = self.scrambles
        check_scrambles(self.samples, R)
        if self.coefficient == "optimal" and R < 4:
            message = f"scrambles = {R}, expected at least 4 for coefficient = 'optimal', which is fitted to them"
            raise ValueError(message)
        if self.control_samples is not None and self.control != "chaos":
            raise ValueError(f"control_samples = {self.control_samples}, expected none for control = '{self.control}'")
        return self

    @property
    def limit(self) -> int:
        return self.samples or self.scrambles * power_of_two(UNLIMITED // self.scrambles)

    def planned(self, dimension: int) -> int:
        return 1 + self.limit + self._fitted(dimension)

    def with_tangents(self, samples: int) -> int:
        return max(0, samples - self.limit)

    def stream(self) -> tuple[Any, ...] | None:
        return "sobol", self.scrambles

    def _fitted(self, dimension: int) -> int:
        """Number of solves that the control takes besides the one at the mean parameters."""
        if self.control == "quadratic":
            return 2 * dimension
        if self.control == "chaos":
            terms = comb(dimension + 3, 3) if dimension <= FULL else comb(dimension + 2, 2)
            return self.control_samples or max(4, -(-ROWS_PER_TERM * terms // (1 + dimension)))
        return 0

    def objection(self, inputs: Inputs) -> str | None:
        return objection(inputs, "method.control = 'chaos'") if self.control == "chaos" else None

    def until(
        self, inputs: Inputs, evaluate: Evaluate, goal: Goal | None, expanded: Deviations | None = None
    ) -> xr.Dataset:
        """Sample until errors are those of a goal; an expansion that is known already may be the control of "chaos".

        Its samples must not be among those of the scrambles. Errors as in `run`.

        Returns
        -------
        xarray.Dataset
            As in `MonteCarlo`, with the scramble of each sample (`scramble`), its worth in plain samples
            (`variance_ratio`, `std_variance_ratio`) and the estimates from the first points of all scrambles
            (`running_mean`, `running_mean_error`); see docs/results.md.
        """
        refuse(self.objection(inputs))
        if self.control != "none" and expanded is None and not evaluate.differentiable:
            message = f"the model has no derivatives, expected one that has, or control = 'none' for '{self.control}'"
            raise ModelError(message)
        evaluate = Recorder(evaluate)
        centre = linearise(inputs, evaluate)
        control = None
        if self.control == "tangent":
            control = tangent(inputs, centre)
        elif self.control == "quadratic":
            control = quadratic(inputs, evaluate, centre, fields=self.fields)
        fitted = None
        if self.control == "chaos":
            fitted = expanded or self._expand(inputs, evaluate, centre)
            control = expansion(fitted)
        growing: Evaluate = evaluate
        if self.fields and fitted is None:
            growing = grown(inputs, evaluate, centre, self.limit)
        about = self.seed, self.scrambles, self.coefficient
        samples = Scrambles(inputs, growing, centre, control, fitted, *about, fields=self.fields)
        most = self.limit if goal is None else min(self.limit, max(goal.most - evaluate.solves, self.scrambles))
        last = power_of_two(most // self.scrambles)
        open_ended = self.open_ended or goal is not None
        samples.extend(min(last, power_of_two(FIRST_ROUND // self.scrambles)) if open_ended else last)

        def missed() -> float:
            scalars = samples.scalars(samples.each)
            if goal is not None:
                return goal.reached(scalars.named, student(samples.scrambles - 1))
            return np.inf if not self.met(float(scalars.relative_error.max())) else 0.0

        while (left := missed()) > 1:
            wider = samples.wider if left * samples.gained <= 1 else samples.scrambles
            each = samples.each * (1 if wider > samples.scrambles else 2)
            further = wider * each - samples.count
            if wider * each > most or further > self.affordable(evaluate.solves, evaluate.seconds):
                break
            samples.extend(each, wider)
        return self._dataset(inputs, evaluate, centre, fitted, samples, as_asked=goal is None)

    def _expand(self, inputs: Inputs, evaluate: Evaluate, centre: Linearisation) -> Deviations:
        """Fit the expansion to a separate scramble, so that given the fit, the samples are still random."""
        d = len(inputs.names)
        points = inputs.points(sobol_points(self.seed, FIT, 0, self._fitted(d), d))
        try:
            return fit_deviations(inputs, evaluate, centre, points, ORDER, fields=self.fields)
        except SolveError as error:
            raise SolveError(f"control = 'chaos': {error.reason}", error.history) from None

    def _dataset(
        self,
        inputs: Inputs,
        evaluate: Evaluate,
        centre: Linearisation,
        fitted: Deviations | None,
        samples: Scrambles,
        *,
        as_asked: bool,
    ) -> xr.Dataset:
        scalars = samples.scalars(samples.each)
        values, ok, scramble = in_order(samples.outputs), in_order(samples.ok), samples.scramble
        of_quantiles = quantiles_from_replicates(values[ok], scramble[ok], self.quantiles)
        if fitted is not None and inputs.draws is None:  # errors of draws are found by samples
            drawn, part = predictions(inputs, self.seed, fitted.basis, fitted.outputs)
            predicted = fitted.basis.values(in_order(samples.points)[ok]) @ fitted.outputs
            left = values[ok] - centre.outputs - predicted
            weights = np.ones(len(left))
            found = quantiles_of_predictions(drawn, part, predicted, left, weights, self.quantiles, fitted.rest)
            stands = (scalars.coefficient != 0) & ~samples.held(samples.each)
            of_quantiles = of_quantiles.or_shorter(found.moved(centre.outputs), stands)
        # What plain Monte Carlo would claim from as many independent samples.
        plain = counted(plain_moments(values[ok], centre.outputs), inputs, values[ok])
        rounds = [(each, samples.scalars(each)) for each in samples.rounds]
        by_output = ("output",)
        dataset = local_dataset(inputs, evaluate, centre, fields=self.fields)
        dataset = dataset.assign_coords(round=[samples.scrambles * n for n, _ in rounds])
        dataset = of_quantiles.on(dataset, self.quantiles).assign(
            {
                **scalars.variables(),
                **of_samples(in_order(samples.points), values, ok, scramble),
                **running(found for _, found in rounds),
                "variance_ratio": (by_output, ratio(plain.mean_error**2, scalars.mean_error**2, empty=1.0)),
                "std_variance_ratio": (by_output, ratio(plain.std_error**2, scalars.std_error**2, empty=1.0)),
            }
        )
        if self.control != "none":
            dataset = dataset.assign(coefficient=(by_output, scalars.coefficient))
            add(dataset, *of_control(evaluate.outputs, self.control, scalars))
        if fitted is not None:
            dataset = dataset.assign(loo_error=(by_output, fitted.relative), control_samples=((), int(fitted.ok.sum())))
        controlled = samples.controlled(scalars, samples.each)
        moved = None if controlled is None else influences(*controlled)
        add(dataset, *of_tails(evaluate.outputs, values[ok], scalars.relative_std_error, moved))
        field = samples.field()
        if field is not None:
            dataset = dataset.assign(by_node(field, evaluate.displacements))
            add(dataset, *samples.field_doubts(field))
        amount = f"{ok.size} samples ({samples.scrambles} scrambles of {samples.each} Sobol' points)"
        reached = float(scalars.relative_error.max())
        error = f"relative error {reached:.3g}"
        asked = self.why_stopped(reached, error, ok.size, self.limit, amount) if as_asked else f"{amount}: {error}"
        dataset.attrs["stopped"] = asked
        notes = []
        if fitted is not None and not fitted.ok.all():
            notes.append(f"{int((~fitted.ok).sum())} of {fitted.ok.size} samples for the chaos control have no answer")
        if not ok.all():
            followed = None if self.control == "none" else f"the {self.control} control"
            which = "all estimates" if self.control == "none" else "quantiles"
            notes.append(failure_note(ok, which, followed))
        if notes:
            dataset.attrs["note"] = "; ".join(notes)
        return dataset
