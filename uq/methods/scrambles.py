"""Means over independent scrambles of Sobol' points, with the controls of scalars and fields.

The controls share the scrambles and their sums, hence one file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from forward.model import Finding, FloatArray, ForwardModel, Solution, SolveError, scattered
from uq.estimators.doubts import of_field_tails
from uq.estimators.moments import Coefficient, Estimates, estimate_from_replicates, student
from uq.estimators.tails import by_chance, counted, influences, of_influences, skewed
from uq.evaluation.request import Evaluate, Evaluations, Request, Start
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.surrogates.linearisation import Linearisation
from uq.surrogates.regression import beyond
from uq.surrogates.taylor import Control

Pair = tuple[FloatArray, FloatArray]
LITTLE = 1e-3  # of the standard deviation: errors of means that may be claimed too large


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


class Asked(Protocol):
    """What a method asks of its scrambles."""

    @property
    def seed(self) -> int:
        """Of all scrambles."""

    @property
    def scrambles(self) -> int:
        """Number R of scrambles, to begin with."""

    @property
    def fields(self) -> bool:
        """Whether sums of the fields are kept."""

    @property
    def control(self) -> str:
        """Name of the control variate."""

    @property
    def coefficient(self) -> Coefficient:
        """Of the control."""


class Scrambles:
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
        asked: Asked,
        inputs: Inputs,
        evaluate: Evaluate,
        centre: Linearisation,
        control: Control | None,
        held: Control | None,
        start: Start | None,
        rest: FloatArray | None,
    ) -> None:
        self._asked, self._inputs, self._evaluate = asked, inputs, evaluate
        self._centre, self._control, self._held, self._start, self._rest = centre, control, held, start, rest
        d, m = len(inputs.names), len(evaluate.outputs)
        self._field_control = control if control is not None and len(control.state) else None
        self.each = 0
        self.points = np.empty((asked.scrambles, 0, d))
        self.outputs = np.empty((asked.scrambles, 0, m))
        self.ok = np.empty((asked.scrambles, 0), dtype=bool)
        self._sums: list[FloatArray | None] = [None] * asked.scrambles
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
        asked, centre = self._asked, self._centre
        r, d, new = len(scrambles), len(self._inputs.names), stop - start
        outputs, ok = np.empty((r, new, self.outputs.shape[2])), np.empty((r, new), dtype=bool)
        points = np.empty((r, new, d))
        if not new:
            return outputs, ok, points
        cubes = [sobol_points(asked.seed, number, start, stop, d) for number in scrambles]
        points = self._inputs.points(np.concatenate(cubes)).reshape(r, new, d)
        if asked.fields and centre.state.size:
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
        needed = 4 if self._asked.coefficient == "optimal" else 2
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
        found = estimate_from_replicates(means, centre.outputs, expected, self._asked.coefficient)
        values, controlled = self.outputs[:, :each][ok], self.controlled(found, each)
        plain = values - values.mean(axis=0)
        found = by_chance(found, influences(*(controlled or (plain, plain**2))), int(some.sum()))
        # A tangent grows no faster than a normal quantity; controls that grow faster tell what lies beyond the samples.
        tails = counted(found, self._inputs, values, controlled)
        if controlled is None or self._asked.control == "tangent":
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
        return estimate_from_replicates(replicates, self._centre.state, expected, self._asked.coefficient)
