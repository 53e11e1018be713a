"""Randomised quasi-Monte Carlo: independent scrambles of Sobol' points, with control variates.

The mean over one scramble is unbiased, since each of its points is uniform by itself; the scrambles are independent, so
their scatter gives an honest standard error without any assumption on the smoothness that makes it small
(A. B. Owen, SIAM J. Numer. Anal. 34 (1997) 1884–1910; C. Lemieux, Monte Carlo and Quasi-Monte Carlo Sampling (2009)).

The three controls share the scrambles and their sums, hence one file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from math import comb
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from forward.model import Finding, FloatArray, ForwardModel, ModelError, Solution, SolveError, scattered
from uq.estimators.doubts import of_control, of_field_tails, of_tails
from uq.estimators.moments import (
    ESTIMATES,
    Coefficient,
    Estimates,
    estimate,
    estimate_from_replicates,
    monomials,
    ratio,
    student,
)
from uq.estimators.quantiles import quantiles_from_replicates
from uq.estimators.tails import counted, influences, of_influences, skewed
from uq.evaluation.evaluate import Recorder
from uq.evaluation.request import Evaluate, Evaluations, Request, Start
from uq.findings import add
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import check_scrambles, power_of_two, sobol_points
from uq.methods.monte_carlo import FIRST_ROUND, UNLIMITED, MonteCarlo, by_node, failure_note, grown
from uq.surrogates.candidates import FULL, ROWS_PER_TERM
from uq.surrogates.field_regression import Deviations, fit_deviations
from uq.surrogates.linearisation import Linearisation, linearise, local_dataset
from uq.surrogates.regression import beyond
from uq.surrogates.taylor import Control, expansion, held_expansion, quadratic, tangent

if TYPE_CHECKING:
    import xarray as xr

    from uq.accuracy.goal import Goal

Pair = tuple[FloatArray, FloatArray]
LITTLE = 1e-3  # of the standard deviation: errors of means that may be claimed too large
ORDER = 6  # largest order of the expansions tried as control
FIT = 2**32 - 1  # number of the scramble to which the control is fitted; no sample belongs to it


class QuasiMonteCarlo(MonteCarlo):
    """Quasi-Monte Carlo: independent scrambles of Sobol' points, with a polynomial as control variate.

    Errors are one standard error from the scatter of the scrambles, without the factor of Student's distribution: a
    95 % interval is ± 2.13 of them for 16 scrambles. Those of the standard deviation cover 90 % with 4 points in each
    scramble, whose means are skewed, and 93 to 95 % from 16 points on.

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
        As in `MonteCarlo`. With `fields`, scrambles are evaluated one after the other, so that at most as many groups
        of ranks as points in a scramble have work.
    """

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
            message = f"control_samples = {self.control_samples}, expected none for control = '{self.control}'"
            raise ValueError(message)
        return self

    @property
    def limit(self) -> int:
        """Number of samples; the largest, if a tolerance may end the study earlier."""
        return self.samples or self.scrambles * power_of_two(UNLIMITED // self.scrambles)

    def planned(self, dimension: int) -> int:
        """Number of solves with so many parameters; the largest, if a tolerance may end the study earlier."""
        return 1 + self.limit + self._fitted(dimension)

    def with_tangents(self, samples: int) -> int:
        """Number of samples to which the control variate is fitted."""
        return max(0, samples - self.limit)

    @property
    def in_turn(self) -> bool:
        """Sobol' points lead to draws by their weights."""
        return False

    def stream(self) -> tuple[Any, ...] | None:
        """Scrambled Sobol' points."""
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
        """Say why these parameters do not allow the control, or None."""
        if self.control == "chaos" and inputs.correlations:
            return (
                "polynomial chaos needs independent parameters, expected no correlations for method.control = 'chaos'"
            )
        return None

    def run(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        """Sample and estimate.

        Returns
        -------
        xarray.Dataset
            As in `MonteCarlo`, with the scramble of each sample (`scramble`), its worth in plain samples
            (`variance_ratio`, `std_variance_ratio`) and the estimates from the first points of all scrambles
            (`running_mean`, `running_mean_error`); see docs/results.md.

        Raises
        ------
        SolveError
            If the model has no answer at the mean parameters, at one of the points that the quadratic control needs,
            or in fewer than two scrambles (four with the optimal coefficient), or at too many samples of the fit.
        ValueError
            If the model has no derivatives, which controls need, or the chaos control has correlated parameters.
        """
        return self._sampled(inputs, evaluate)

    def until(self, inputs: Inputs, evaluate: Evaluate, goal: Goal, expanded: Deviations | None = None) -> xr.Dataset:
        """Sample until errors are those of a goal; an expansion that is known already may be the control of "chaos".

        Its samples must not be among those of the scrambles. Results and errors as in `run`.
        """
        return self._sampled(inputs, evaluate, goal, expanded)

    def _sampled(
        self, inputs: Inputs, evaluate: Evaluate, goal: Goal | None = None, expanded: Deviations | None = None
    ) -> xr.Dataset:
        objection = self.objection(inputs)
        if objection is not None:
            raise ValueError(objection)
        if self.control != "none" and expanded is None and not evaluate.differentiable:
            message = f"the model has no derivatives, expected one that has for method.control = '{self.control}'"
            raise ModelError(message)
        evaluate = Recorder(evaluate)
        centre = linearise(inputs, evaluate)
        control = None
        if self.control == "tangent":
            control = tangent(inputs, centre)
        elif self.control == "quadratic":
            control = quadratic(inputs, evaluate, centre, fields=self.fields)
        fitted = held = None
        start: Start | None = centre.prediction
        if self.control == "chaos":
            fitted = expanded or self._expand(inputs, evaluate, centre)
            control, held, start = expansion(fitted), held_expansion(inputs, fitted), fitted.prediction or start
        growing: Evaluate = evaluate
        if self.fields and fitted is None:
            growing = grown(inputs, evaluate, centre, self.limit)
        samples = _Samples(self, inputs, growing, centre, control, held, start, None if fitted is None else fitted.rest)
        most = self.limit if goal is None else min(self.limit, max(goal.most - evaluate.solves, self.scrambles))
        last = power_of_two(most // self.scrambles)
        open_ended = self.open_ended or goal is not None
        first = min(last, power_of_two(FIRST_ROUND // self.scrambles)) if open_ended else last
        samples.extend(first)
        scalars = samples.scalars(first)

        def missed() -> float:
            if goal is not None:
                return goal.reached(scalars, student(samples.scrambles - 1))
            return np.inf if not self.met(float(scalars.relative_error.max())) else 0.0

        while (left := missed()) > 1:
            wider = samples.wider if left * samples.gained <= 1 else samples.scrambles
            each = samples.each * (1 if wider > samples.scrambles else 2)
            further = wider * each - samples.count
            if wider * each > most or further > self.affordable(evaluate.solves, evaluate.seconds):
                break
            samples.extend(each, wider)
            scalars = samples.scalars(each)
        return self._dataset(inputs, evaluate, centre, fitted, samples, scalars, as_asked=goal is None)

    def _expand(self, inputs: Inputs, evaluate: Evaluate, centre: Linearisation) -> Deviations:
        """Fit the expansion to a separate scramble, so that given the fit, the samples are still random."""
        d = len(inputs.names)
        points = inputs.points(sobol_points(self.seed, FIT, 0, self._fitted(d), d))
        try:
            return fit_deviations(inputs, evaluate, centre, points, ORDER, fields=self.fields)
        except SolveError as error:
            message = f"control = 'chaos': {error.reason}"
            raise SolveError(message, error.history) from None

    def _dataset(
        self,
        inputs: Inputs,
        evaluate: Evaluate,
        centre: Linearisation,
        fitted: Deviations | None,
        samples: _Samples,
        scalars: Estimates,
        *,
        as_asked: bool,
    ) -> xr.Dataset:
        values, ok, scramble = samples.in_order(samples.outputs), samples.in_order(samples.ok), samples.scramble
        of_quantiles = quantiles_from_replicates(values[ok], scramble[ok], self.quantiles)
        # What plain Monte Carlo would claim from as many independent samples.
        plain = estimate(monomials(values[ok] - centre.outputs, None).sum(axis=1), int(ok.sum()), centre.outputs)
        plain = counted(plain, inputs, values[ok])
        running = [(each, samples.scalars(each)) for each in samples.rounds if samples.usable(each)]
        by_output = ("output",)
        dataset = local_dataset(inputs, evaluate, centre, fields=self.fields)
        dataset = dataset.assign_coords(
            quantile=list(self.quantiles), round=[samples.scrambles * n for n, _ in running]
        )
        dataset = dataset.assign(
            {
                **{name: (by_output, getattr(scalars, name)) for name in ESTIMATES},
                **of_quantiles.variables,
                "points": (("sample", "parameter"), samples.in_order(samples.points)),
                "values": (("sample", "output"), values),
                "ok": (("sample",), ok),
                "scramble": (("sample",), scramble),
                **{
                    f"running_{name}": (("round", "output"), np.array([getattr(e, name) for _, e in running]))
                    for name in ("mean", "mean_error")
                },
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


def _products(deviation: FloatArray, controls: tuple[FloatArray, FloatArray] | None) -> FloatArray:
    """Return what is averaged over a scramble (2 or 4, …): the deviation, its square, and their controls."""
    return np.array([deviation, deviation**2, *(controls or ())])


@dataclass(frozen=True)
class _FieldProducts:
    """Sum of the products of the state's deviation and of its control, and of its third and fourth power."""

    state: FloatArray
    control: Control | None

    def on(self, model: ForwardModel) -> Callable[[Solution, FloatArray], FloatArray]:
        state = scattered(model, self.state[None, :])[0]
        control = self.control
        coefficients = None if control is None else scattered(model, control.state)

        def rows(solution: Solution, parameters: FloatArray) -> FloatArray:
            controls = None
            if control is not None and coefficients is not None:
                controls = control.predict(control.features(parameters), coefficients)
            deviation = solution.state - state
            return np.concatenate([_products(deviation, controls), [deviation**3, deviation**4]])

        return rows


class _Samples:
    """All scrambles, each of the same number of points, and the sums of the fields over each of them.

    The sums are kept for every scramble, since a longer study goes on with them: 4 R fields on rank 0, 512 bytes for
    each unknown with 16 scrambles, which is less than the factor of the stiffness that every model keeps.

    Attributes
    ----------
    each
        Number n of points of each scramble.
    points, outputs, ok
        (R, n, d), (R, n, m) and (R, n).
    """

    def __init__(
        self,
        method: QuasiMonteCarlo,
        inputs: Inputs,
        evaluate: Evaluate,
        centre: Linearisation,
        control: Control | None,
        held: Control | None,
        start: Start | None,
        rest: FloatArray | None,
    ) -> None:
        self._method, self._inputs, self._evaluate = method, inputs, evaluate
        self._centre, self._control, self._held, self._start, self._rest = centre, control, held, start, rest
        d, m = len(inputs.names), len(evaluate.outputs)
        self._field_control = control if control is not None and len(control.state) else None
        self.each = 0
        self.points = np.empty((method.scrambles, 0, d))
        self.outputs = np.empty((method.scrambles, 0, m))
        self.ok = np.empty((method.scrambles, 0), dtype=bool)
        self._sums: list[FloatArray | None] = [None] * method.scrambles
        self._higher: FloatArray | None = None
        self._reasons: set[str] = set()

    @property
    def scrambles(self) -> int:
        """Number R of scrambles."""
        return len(self.points)

    @property
    def count(self) -> int:
        """Number of samples."""
        return self.scrambles * self.each

    @property
    def wider(self) -> int:
        """Number of scrambles where half as many samples more are to be enough."""
        return self.scrambles + self.scrambles // 2

    @property
    def gained(self) -> float:
        """What so many scrambles make of half the width of an interval."""
        return float(np.sqrt(self.scrambles / self.wider) * student(self.wider - 1) / student(self.scrambles - 1))

    @property
    def rounds(self) -> list[int]:
        """Powers of two up to the number of points of each scramble."""
        return [1 << k for k in range(self.each.bit_length())]

    @property
    def scramble(self) -> NDArray[np.int64]:
        """Scramble (R n,) of each sample in the order of results."""
        return np.tile(np.arange(self.scrambles), self.each)

    def in_order(self, values: NDArray) -> NDArray:  # type: ignore[type-arg]
        """Flatten (R, n, …) to (R n, …), first points of all scrambles first: a shorter study is a prefix."""
        return np.ascontiguousarray(values.swapaxes(0, 1)).reshape(-1, *values.shape[2:])

    def extend(self, each: int, scrambles: int | None = None) -> None:
        """Go on to `each` points in every scramble, of which there may be more from now on."""
        R, more = self.scrambles, (scrambles or self.scrambles) - self.scrambles
        self._sums += [None] * more
        outputs, ok, points = self._solved(range(R), self.each, each)
        self.points = np.concatenate([self.points, points], axis=1)
        self.outputs = np.concatenate([self.outputs, outputs], axis=1)
        self.ok = np.concatenate([self.ok, ok], axis=1)
        if more:
            outputs, ok, points = self._solved(range(R, R + more), 0, each)
            self.points = np.concatenate([self.points, points])
            self.outputs = np.concatenate([self.outputs, outputs])
            self.ok = np.concatenate([self.ok, ok])
        self.each = each

    def _solved(self, scrambles: range, start: int, stop: int) -> tuple[FloatArray, NDArray[np.bool_], FloatArray]:
        """Outputs (r, n, m), answers (r, n) and points (r, n, d) of some scrambles, from a number of point to another.

        Their fields are added to the sums.
        """
        method, centre = self._method, self._centre
        r, d, new = len(scrambles), len(self._inputs.names), stop - start
        outputs, ok = np.empty((r, new, self.outputs.shape[2])), np.empty((r, new), dtype=bool)
        points = np.empty((r, new, d))
        if not new:
            return outputs, ok, points
        cubes = [sobol_points(method.seed, number, start, stop, d) for number in scrambles]
        points = self._inputs.points(np.concatenate(cubes)).reshape(r, new, d)
        if method.fields and centre.state.size:
            wanted = _FieldProducts(centre.state, self._field_control)
            for row, number in enumerate(scrambles):
                found = self._ask(Request(points[row], fields=wanted, start=self._start))
                outputs[row], ok[row] = found.outputs, found.ok
                if found.fields.size:
                    kept, products, higher = self._sums[number], found.fields[:-2], found.fields[-2:]
                    self._sums[number] = products if kept is None else kept + products
                    self._higher = higher if self._higher is None else self._higher + higher
        else:
            found = self._ask(Request(points.reshape(-1, d), start=self._start))
            outputs, ok = found.outputs.reshape(outputs.shape), found.ok.reshape(ok.shape)
        return outputs, ok, points

    def _ask(self, request: Request) -> Evaluations:
        found = self._evaluate(request)
        self._reasons |= {failure.reason for failure in found.failures}
        return found

    def usable(self, each: int) -> bool:
        """Whether enough scrambles have an answer among their first `each` points."""
        needed = 4 if self._method.coefficient == "optimal" else 2
        return int(self.ok[:, :each].any(axis=1).sum()) >= needed

    def scalars(self, each: int) -> Estimates:
        """Estimate the moments of the outputs from the first `each` points of every scramble that has answers there."""
        if not self.usable(each):
            answers = int(self.ok[:, :each].any(axis=1).sum())
            reasons = "; ".join(sorted(self._reasons)[:3])
            message = f"{answers} of {self.scrambles} scrambles have an answer, expected more: {reasons}"
            raise SolveError(message)
        centre = self._centre
        ok = self.ok[:, :each]
        some = ok.any(axis=1)
        deviations = np.where(ok[..., None], self.outputs[:, :each] - centre.outputs, 0.0)
        controls, expected = self._controls(each) or (None, None)
        products = np.where(ok[..., None], _products(deviations, controls), 0.0).sum(axis=2)
        means = products[:, some] / ok.sum(axis=1)[some, None]
        found = estimate_from_replicates(means, centre.outputs, expected, self._method.coefficient)
        # A tangent grows no faster than a normal quantity; controls that grow faster tell what lies beyond the samples.
        controlled = self.controlled(found, each)
        tails = counted(found, self._inputs, self.outputs[:, :each][ok], controlled)
        if controlled is None or self._method.control == "tangent":
            return tails
        of_mean, of_std = self._unseen(each)
        moved = influences(*controlled)
        further = np.maximum(of_std, of_influences(found, self._inputs, moved))
        known = np.hypot(found.std_error * skewed(moved), further)
        # What a polynomial leaves rises too steeply at its outermost samples to say much of its mean beyond them.
        most = np.hypot(found.mean_error, np.maximum(found.mean_error, LITTLE * found.std))
        within = np.minimum(tails.mean_error, most)
        return replace(
            found,
            mean_error=np.where(found.coefficient == 0, tails.mean_error, np.hypot(within, of_mean)),
            std_error=np.where(found.second_coefficient == 0, tails.std_error, known),
        )

    def _unseen(self, each: int) -> Pair:
        """Errors (m,) of mean and standard deviation from regions without samples, where a polynomial is the control.

        With the share b of its variance σ² from there, and the norm λ of what it leaves, ∫(f² − C²) over it is at most
        about 2λ√b σ, and ∫(f − C) at most about λ√(bp), p the probability of being there, or less where there are many
        parameters (`Beyond`). λ is in proportion to that at the samples, which have 1 − b of the variance; for the
        second moment, to which tails matter more, it is at least the norm of what an expansion misses, by the samples
        of its fit. A tangent does not grow faster than what it stands for.
        """
        control = self._control
        controls = self._controls(each)
        assert control is not None
        assert controls is not None
        ok = self.ok[:, :each]
        outside, of_mean = beyond(self._inputs, control.features, control.outputs, self.points[:, :each][ok])
        left = self.outputs[:, :each][ok] - self._centre.outputs - controls[0][0][ok]
        norm = left.std(axis=0) / np.maximum(1 - outside, 1 / ok.sum())
        most = norm if self._rest is None else np.maximum(norm, self._rest)
        return norm * of_mean, most * np.sqrt(outside)

    def _controls(self, each: int) -> tuple[Pair, Pair] | None:
        """Return the controls C and D (R, n, m) of the first points of every scramble, and E[C] and E[D] (m,)."""
        if self._control is None:
            return None
        controls, expected = self._of(self._control, each)
        held = self._which_held(each)
        if self._held is not None and held.any():
            (C, D), (C_mean, D_mean) = self._of(self._held, each)
            controls = np.where(held, C, controls[0]), np.where(held, D, controls[1])
            expected = np.where(held, C_mean, expected[0]), np.where(held, D_mean, expected[1])
        return controls, expected

    def _of(self, control: Control, each: int) -> tuple[Pair, Pair]:
        """Return the same of one control."""
        controls = control.predict(control.features(self.points[:, :each]), control.outputs)
        return controls, control.expected(control.outputs)

    def _which_held(self, each: int) -> NDArray[np.bool_]:
        """Of which outputs (m,) the expansion predicts the samples worse than when it is held beyond its own.

        By samples that tell the two apart: one hardly beyond says nothing, and what is held wrongly errs where no
        sample is.
        """
        if self._control is None or self._held is None:
            return np.zeros(self.outputs.shape[2], dtype=bool)
        ok = self.ok[:, :each]
        deviations = self.outputs[:, :each][ok] - self._centre.outputs
        whole, held = (
            deviations - control.predict(control.features(self.points[:, :each][ok]), control.outputs)[0]
            for control in (self._control, self._held)
        )
        told = 2 * np.abs(whole - held) > np.maximum(np.abs(whole), np.abs(held))
        return np.asarray(np.where(told, whole**2 - held**2, 0.0).sum(axis=0) > 0)

    def controlled(self, found: Estimates, each: int) -> Pair | None:
        """Samples (n, m) of both moments, the first of them that have an answer, with controls."""
        known = self._controls(each)
        if known is None:
            return None
        ok = self.ok[:, :each]
        C, D = (control[ok] for control in known[0])
        first = self.outputs[:, :each][ok] - self._centre.outputs
        return first - found.coefficient * C, first**2 - found.second_coefficient * D

    def field_doubts(self, found: Estimates) -> Iterator[Finding]:
        """Find what speaks against the estimates of the displacements."""
        count, sums = self._evaluate.displacements, [one for one in self._sums if one is not None]
        assert self._higher is not None
        powers = np.concatenate([np.sum([one[:2, :count] for one in sums], axis=0), self._higher[:, :count]])
        volumes = self._evaluate.node_volumes
        yield from of_field_tails(powers, int(self.ok.sum()), found.relative_std_error[:count], volumes)

    def field(self) -> Estimates | None:
        """Estimate the moments of the state, where its sums were kept."""
        counts = self.ok.sum(axis=1)
        means = [total / n for total, n in zip(self._sums, counts, strict=True) if total is not None]
        if not means:
            return None
        expected = None if self._field_control is None else self._field_control.expected(self._field_control.state)
        replicates = np.stack(means, axis=1)
        if self._which_held(self.each).any():
            # What is known of the field is where the samples of the expansion are not: it controls nothing.
            replicates, expected = replicates[:2], None
        return estimate_from_replicates(replicates, self._centre.state, expected, self._method.coefficient)
