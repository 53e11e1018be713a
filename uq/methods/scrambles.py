"""Means over independent scrambles of Sobol' points, with the controls of scalars and fields."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from forward.findings import Finding
from forward.model import FloatArray, ForwardModel, Solution, SolveError, scattered
from uq.estimators.doubts import of_field_tails
from uq.estimators.moments import Coefficient, Estimates, either, estimate_from_replicates, ratio, student
from uq.estimators.tails import agree, by_chance, counted, influences, of_influences, skewed
from uq.evaluation.request import Evaluate, FieldSum, Request
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.surrogates.basis import Basis
from uq.surrogates.field_regression import Deviations
from uq.surrogates.gate import wrong
from uq.surrogates.linearisation import Linearisation
from uq.surrogates.outside_samples import Beyond, beyond, drawn_beyond
from uq.surrogates.taylor import Control, Held, expansion, held_expansion

Found = TypeVar("Found")
Pair = tuple[FloatArray, FloatArray]
MOSTLY = 0.5  # of the variance of an expansion: beyond all samples it is a guess
FALL = 2**-1.5  # what errors of even points fall by at best where these are twice as many
LITTLE = 1e-3  # of the standard deviation: errors of means that may be claimed too large


def _products(deviation: FloatArray, controls: tuple[FloatArray, FloatArray] | None) -> FloatArray:
    """Return what is averaged over a scramble (2 or 4, …): the deviation, its square, and their controls."""
    return np.array([deviation, deviation**2, *(controls or ())])


@dataclass(frozen=True)
class _FieldProducts(FieldSum):
    """Sum of the products of the state's deviation and of its control, and of its third and fourth power."""

    state: FloatArray
    control: Control | None

    def on(self, model: ForwardModel) -> Callable[[Solution, FloatArray], FloatArray]:
        state = scattered(model, self.state[None, :])[0]
        control = self.control
        coefficients = np.empty((0, 0)) if control is None else scattered(model, control.state)

        def rows(solution: Solution, parameters: FloatArray) -> FloatArray:
            controls = None if control is None else control.predict(control.features(parameters), coefficients)
            deviation = solution.state - state
            return np.concatenate([_products(deviation, controls), [deviation**3, deviation**4]])

        return rows


class Sets:
    """Scrambles of the same number of points, and what a model answers there to a request without points.

    Attributes
    ----------
    each
        Number n of points of each scramble.
    points, outputs, ok
        (R, n, d), (R, n, m) and (R, n).
    tangents
        (R, n, m, d), if they are asked for.
    """

    needed = 2  # scrambles with answers, for estimates

    def __init__(self, inputs: Inputs, evaluate: Evaluate, asked: Request, seed: int, scrambles: int) -> None:
        self._inputs, self._evaluate, self._asked, self._seed = inputs, evaluate, asked, seed
        self.each = 0
        d, m = len(inputs.names), len(evaluate.outputs)
        self.points, self.outputs = np.empty((scrambles, 0, d)), np.empty((scrambles, 0, m))
        self.tangents, self.ok = np.empty((scrambles, 0, m, d)), np.empty((scrambles, 0), dtype=bool)
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
    def scramble(self) -> NDArray[np.int64]:
        """Scramble (R n,) of each sample in the order of results."""
        return np.tile(np.arange(self.scrambles), self.each)

    def extend(self, each: int, scrambles: int | None = None) -> None:
        """Go on to `each` points in every scramble, of which there may be more from now on."""
        R = self.scrambles
        if each > self.each:
            self._take(range(R), self.each, each, axis=1)
        if scrambles is not None and scrambles > R:
            self._take(range(R, scrambles), 0, each, axis=0)
        self.each = each

    def _take(self, scrambles: range, start: int, stop: int, *, axis: int) -> None:
        """Solve at points of some scrambles, from one number to another: all at once, or apart for sums."""
        r, new = len(scrambles), stop - start
        cubes = [sobol_points(self._seed, number, start, stop, len(self._inputs.names)) for number in scrambles]
        points = self._inputs.points(np.concatenate(cubes))
        parts = [points] if self._asked.fields is None else np.split(points, r)
        found = [self._evaluate(replace(self._asked, points=part)) for part in parts]
        for number, one in zip(scrambles, found, strict=False):
            self._reasons |= {failure.reason for failure in one.failures}
            if one.fields.size:
                self._sum(number, one.fields)

        def longer(kept: NDArray[Any], more: Sequence[NDArray[Any]]) -> NDArray[Any]:
            return np.concatenate([kept, np.concatenate(more).reshape(r, new, *kept.shape[2:])], axis=axis)

        self.points = longer(self.points, [points])
        self.outputs = longer(self.outputs, [one.outputs for one in found])
        self.ok = longer(self.ok, [one.ok for one in found])
        if self._asked.tangents:
            self.tangents = longer(self.tangents, [one.tangents for one in found if one.tangents is not None])

    def _sum(self, number: int, fields: FloatArray) -> None:
        """Take the sums of the fields over more points of a scramble."""

    def answered(self, each: int) -> int:
        """Return how many scrambles have an answer among their first `each` points."""
        return int(self.ok[:, :each].any(axis=1).sum())

    @property
    def rounds(self) -> list[int]:
        """Powers of two up to the number of points of each scramble, of which enough scrambles have an answer."""
        return [1 << k for k in range(self.each.bit_length()) if self.answered(1 << k) >= self.needed]

    def check(self, each: int) -> None:
        """Raise a SolveError unless enough scrambles have an answer among their first `each` points."""
        if (found := self.answered(each)) < self.needed:
            reasons = "; ".join(sorted(self._reasons)[:3])
            raise SolveError(f"{found} of {self.scrambles} scrambles have an answer, expected more: {reasons}")


def _once(method: Callable[[Scrambles, int], Found]) -> Callable[[Scrambles, int], Found]:
    """Remember what is found of so many scrambles and their first points: results ask for rounds again."""

    @wraps(method)
    def known(scrambles: Scrambles, each: int) -> Found:
        key = method.__name__, scrambles.scrambles, each
        if key not in scrambles._known:
            scrambles._known[key] = method(scrambles, each)
        found: Found = scrambles._known[key]
        return found

    return known


class Scrambles(Sets):
    """Scrambles with the controls of their moments, and the sums of the fields over each of them.

    The sums are kept for every scramble, since a longer study goes on with them: 4 R fields on rank 0, 512 bytes for
    each unknown with 16 scrambles, which is less than the factor of the stiffness that every model keeps.
    """

    def __init__(
        self,
        inputs: Inputs,
        evaluate: Evaluate,
        centre: Linearisation,
        control: Control | None,
        fitted: Deviations | None,
        seed: int,
        scrambles: int,
        coefficient: Coefficient,
        *,
        fields: bool,
    ) -> None:
        field_control = control if control is not None and len(control.state) else None
        wanted = _FieldProducts(centre.state, field_control) if fields and centre.state.size else None
        start = centre.prediction if fitted is None else fitted.prediction or centre.prediction
        asked = Request(np.empty((0, len(inputs.names))), fields=wanted, start=start)
        super().__init__(inputs, evaluate, asked, seed, scrambles)
        self._centre, self._control, self._fitted = centre, control, fitted
        self._held = None if fitted is None else held_expansion(inputs, fitted)
        self._field_control, self._coefficient = field_control, coefficient
        self.needed = 4 if coefficient == "optimal" else 2
        repeats = () if fitted is None else fitted.repeats
        self._repeats = [(expansion(one), held_expansion(inputs, one)) for one in repeats]
        self._known: dict[tuple[str, int, int], Any] = {}  # what `_once` remembers
        self._sums: dict[int, FloatArray] = {}
        self._higher: FloatArray | None = None

    @property
    def wider(self) -> int:
        """Number of scrambles where half as many samples more are to be enough."""
        return self.scrambles + self.scrambles // 2

    @property
    def gained(self) -> float:
        """What so many scrambles make of half the width of an interval."""
        return float(np.sqrt(self.scrambles / self.wider) * student(self.wider - 1) / student(self.scrambles - 1))

    def _sum(self, number: int, fields: FloatArray) -> None:
        kept, products, higher = self._sums.get(number), fields[:-2], fields[-2:]
        self._sums[number] = products if kept is None else kept + products
        self._higher = higher if self._higher is None else self._higher + higher

    @_once
    def scalars(self, each: int) -> Estimates:
        """Estimate the moments of the outputs from the first `each` points of every scramble that has answers there."""
        self.check(each)
        found, hidden = self._estimated(each, self._controls(each))
        if self._fitted is None:  # Taylor polynomials of a low order have little far out
            return found
        plain, _ = self._estimated(each, None)
        stands = agree(found, plain) & (hidden <= np.hypot(plain.mean_error, plain.std_error))
        return either(stands, found, plain)

    def _estimated(self, each: int, known: tuple[Pair, Pair] | None) -> tuple[Estimates, FloatArray]:
        """Estimate the moments from the first points of every scramble, with controls and their expectations or not.

        Also what a control hides (m,): the part of the errors that is in no scatter.
        """
        found, ok = self._by_scatter(each, known), self.ok[:, :each]
        values, controlled = self.outputs[:, :each][ok], known and self.controlled(found, each)
        plain = values - values.mean(axis=0)
        found = by_chance(found, influences(*(controlled or (plain, plain**2))), int(ok.any(axis=1).sum()))
        tails = counted(found, self._inputs, values, controlled)
        if controlled is None or (self._control is not None and self._control.linear):
            return tails, np.zeros_like(tails.std)
        first, moved = controlled[0] - controlled[0].mean(axis=0), influences(*controlled)
        wrong_mean, wrong_std = self._wrong(each)
        of_mean, of_std = self._unseen(each, first)
        of_mean = np.hypot(of_mean, wrong_mean)
        further = np.hypot(np.maximum(of_std, of_influences(found, self._inputs, moved)), wrong_std)
        hidden = np.linalg.norm(np.broadcast_arrays(of_mean, of_std, wrong_std), axis=0)
        known_error = np.hypot(found.std_error * skewed(moved), further)
        # What a polynomial leaves rises too steeply at its outermost samples to say much of its mean beyond them.
        most = np.hypot(found.mean_error, np.maximum(found.mean_error, LITTLE * found.std))
        within = np.minimum(tails.mean_error, most)
        claimed = replace(
            found,
            mean_error=np.where(found.coefficient == 0, tails.mean_error, np.hypot(within, of_mean)),
            std_error=np.where(found.second_coefficient == 0, tails.std_error, known_error),
        )
        return claimed, hidden

    def _by_scatter(self, each: int, known: tuple[Pair, Pair] | None) -> Estimates:
        """Estimate the moments of the outputs with the errors that the scatter of the scrambles shows."""
        centre, ok = self._centre, self.ok[:, :each]
        controls, expected = known or (None, None)
        some = ok.any(axis=1)
        deviations = np.where(ok[..., None], self.outputs[:, :each] - centre.outputs, 0.0)
        products = np.where(ok[..., None], _products(deviations, controls), 0.0).sum(axis=2)
        means = products[:, some] / ok.sum(axis=1)[some, None]
        return estimate_from_replicates(means, centre.outputs, expected, self._coefficient)

    def _unseen(self, each: int, left: FloatArray) -> Pair:
        """Errors (m,) of mean and standard deviation from regions without samples, where a polynomial is the control.

        It leaves `left` (n, m) of samples. With the share b of its variance σ² from there, and the norm λ of what it
        leaves, ∫(f² − C²) over it is at most about 2λ√b σ, and ∫(f − C) at most about λ√(bp), p the probability of
        being there, or less where there are many parameters (`Beyond`). λ is in proportion to that at the samples,
        which have 1 − b of the variance; for the second moment, to which tails matter more, it is at least the norm of
        what an expansion misses, by the samples of its fit. A tangent does not grow faster than what it stands for.
        """
        control, held = self._control, self.held(each)
        assert control is not None
        points = self._all_points(each)
        share, of_mean = self._beyond(control, points)
        if self._held is not None and held.any():
            share, of_mean = (
                np.where(held, *pair) for pair in zip(self._beyond(self._held, points), (share, of_mean), strict=True)
            )
        norm = np.sqrt((left**2).mean(axis=0)) / np.maximum(1 - share, 1 / len(points))
        rest = None if self._fitted is None else self._fitted.rest
        # What the next powers would be grows without limit, and what is held does not.
        most = norm if rest is None else np.where(held, norm, np.maximum(norm, rest))
        return norm * of_mean, most * np.sqrt(share)

    def _all_points(self, each: int) -> FloatArray:
        """Points (n, d) that have an answer, those of the fit too."""
        points = self.points[:, :each][self.ok[:, :each]]
        return points if self._fitted is None else np.concatenate([points, self._fitted.trial.points])

    @_once
    def _wrong(self, each: int) -> Pair:
        """Errors (m,) of mean and standard deviation, as differences of the control and its repeated fits show.

        What half of the points have shown of them falls no faster than errors of even points of smooth functions, in
        proportion to n^(−3/2): A. B. Owen, Ann. Stat. 25 (1997) 1541–1562.
        """
        known, ok = self._controls(each), self.ok[:, :each, None]
        found = self._by_scatter(each, known)
        controlled = self.controlled(found, each)
        assert known is not None
        assert controlled is not None
        some, count = ok.any(axis=(1, 2)), np.maximum(ok.sum(axis=1), 1)

        def means(of: tuple[Pair, Pair]) -> tuple[FloatArray, FloatArray]:
            C, D = (np.where(ok, one - mean, 0.0).sum(axis=1) / count for one, mean in zip(*of, strict=True))
            return C[some], D[some]

        if self._fitted is None:
            return np.zeros_like(found.mean), np.zeros_like(found.std)
        if not self._repeats:  # nothing is known
            return np.full_like(found.mean, np.inf), np.full_like(found.std, np.inf)
        C, D = means(known)
        others = [means(self._mixed(*one, each)) for one in self._repeats]
        first, second = np.array([one - C for one, _ in others]), np.array([one - D for _, one in others])
        middle = found.mean - self._centre.outputs
        sizes, norm = None, np.zeros_like(found.std)
        if not self._inputs.tails.any():  # in tails what no sample shows is in other claims, and has no limit
            left = controlled[0] - controlled[0].mean(axis=0)
            sizes, norm = self._fitted.trial.scaled(self.points[:, :each][self.ok[:, :each]], left)
        of_std = ratio(wrong(second - 2 * middle * first, sizes), 2 * found.std)
        of_mean, of_std = np.hypot(wrong(first, sizes), norm / np.sqrt(ok.sum())), np.hypot(of_std, norm)
        if self.answered(each // 2) < self.needed:
            return of_mean, of_std
        before = self._wrong(each // 2)
        return np.maximum(of_mean, FALL * before[0]), np.maximum(of_std, FALL * before[1])

    def _beyond(self, control: Control, points: FloatArray) -> Beyond:
        """Return what a control has in tails beyond points (n, d)."""
        match control.polynomials:
            case Held(basis, lower, upper):
                return beyond(self._inputs, basis, control.outputs, points, (lower, upper))
            case Basis() as basis:
                return beyond(self._inputs, basis, control.outputs, points)
            case polynomials:
                return drawn_beyond(self._inputs, polynomials.values, control.outputs, points)

    @_once
    def _controls(self, each: int) -> tuple[Pair, Pair] | None:
        """Return the controls C and D (R, n, m) of the first points of every scramble, and E[C] and E[D] (m,)."""
        return None if self._control is None else self._mixed(self._control, self._held, each)

    def _mixed(self, control: Control, held_one: Control | None, each: int) -> tuple[Pair, Pair]:
        """Return the same of a control, and of one that is held in place of it where this is to be."""
        controls, expected = self._of(control, each)
        held = self.held(each)
        if held_one is not None and held.any():
            (C, D), (C_mean, D_mean) = self._of(held_one, each)
            controls = np.where(held, C, controls[0]), np.where(held, D, controls[1])
            expected = np.where(held, C_mean, expected[0]), np.where(held, D_mean, expected[1])
        return controls, expected

    def _of(self, control: Control, each: int) -> tuple[Pair, Pair]:
        """Return the same of one control."""
        controls = control.predict(control.features(self.points[:, :each]), control.outputs)
        return controls, control.expected(control.outputs)

    @_once
    def held(self, each: int) -> NDArray[np.bool_]:
        """Of which outputs (m,) the expansion predicts the samples worse than when it is held beyond its own.

        By samples that tell the two apart: one hardly beyond says nothing, and what is held wrongly errs where no
        sample is. And those that have most of their variance beyond all samples.
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
        guessed = self._beyond(self._control, self._all_points(each)).share > MOSTLY
        return np.asarray(guessed | (np.where(told, whole**2 - held**2, 0.0).sum(axis=0) > 0))

    def controlled(self, found: Estimates, each: int) -> Pair | None:
        """Samples (n, m) of both moments, the first of them that have an answer, with controls."""
        known, ok = self._controls(each), self.ok[:, :each]
        if known is None:
            return None
        C, D = (control[ok] for control in known[0])
        first = self.outputs[:, :each][ok] - self._centre.outputs
        return first - found.coefficient * C, first**2 - found.second_coefficient * D

    def field_doubts(self, found: Estimates) -> Iterator[Finding]:
        """Find what speaks against the estimates of the displacements."""
        count = self._evaluate.displacements
        assert self._higher is not None
        sums = np.sum([self._sums[number][:2, :count] for number in sorted(self._sums)], axis=0)
        powers = np.concatenate([sums, self._higher[:, :count]])
        volumes = self._evaluate.node_volumes
        yield from of_field_tails(powers, int(self.ok.sum()), found.relative_std_error[:count], volumes)

    def field(self) -> Estimates | None:
        """Estimate the moments of the state, where its sums were kept."""
        counts = self.ok.sum(axis=1)
        means = [self._sums[number] / counts[number] for number in sorted(self._sums)]
        if not means:
            return None
        expected = None if self._field_control is None else self._field_control.expected(self._field_control.state)
        replicates = np.stack(means, axis=1)
        found = self.scalars(self.each)
        refused = (found.coefficient == 0) & (found.second_coefficient == 0) & (self._fitted is not None)
        if self.held(self.each).any() or refused.any():
            # What is known of the field is where the samples of the expansion are not: it controls nothing.
            replicates, expected = replicates[:2], None
        return estimate_from_replicates(replicates, self._centre.state, expected, self._coefficient)
