"""Two ways to spend what a multifidelity study has: on groups of models, or on what an expansion leaves."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from forward.findings import Finding
from forward.model import FloatArray, SolveError
from uq.estimators.blue import Problem, informations
from uq.estimators.doubts import of_tails
from uq.estimators.fidelities import Found, Samples, estimated
from uq.estimators.moments import Estimates, Z, combine, controlled, either, plain_moments, ratio, student, term
from uq.estimators.quantiles import Quantiles, quantiles, quantiles_of_groups
from uq.estimators.tails import agree, influences, kurtosis, with_tails
from uq.methods.chaos import objection
from uq.methods.fidelity_team import PILOT, Block, Fidelities
from uq.surrogates.field_regression import Deviations, deviations
from uq.surrogates.gate import wrong
from uq.surrogates.outside_samples import beyond
from uq.surrogates.regression import Regression
from uq.surrogates.taylor import Control, expansion

FEWEST = 8  # samples of a group that gets any
ORDER = 6  # largest order of the expansion
UNLIMITED = 1e9


class Way:
    """A way to spend what a study has on a team.

    Attributes
    ----------
    estimates
        Mean and standard deviation.
    pilot
        What a pilot tells.
    """

    estimates: Estimates
    pilot: Found

    def __init__(self, team: Fidelities) -> None:
        self._team = team

    def blocks(self) -> list[Block]:
        """What was taken."""
        return self._team.blocks()

    def _values(self) -> FloatArray:
        """Outputs (n, m) of the study's model in samples in which it has an answer, or what stands for them."""
        values = np.concatenate([one.taken.values[:, 0] for one in self._team.blocks() if 0 in one.group])
        return np.asarray(values[np.isfinite(values).all(axis=1)])

    @abstractmethod
    def _relative(self) -> FloatArray:
        """Relative variances (2, m) of the squared errors of mean and variance, or (1, m) that of the mean alone."""

    def gains(self, cost: float) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Yield how many plain samples each unit of cost was worth, and the standard error, for means and variances."""
        e = self.estimates
        errors = (e.std**2, e.mean_error), ((kurtosis(self._values()) - 1) * e.std**4, 2 * e.std * e.std_error)
        for (variance, error), relative in zip(errors, self._relative(), strict=False):
            gain = ratio(variance, error**2 * cost, empty=1.0)
            yield gain, gain * np.sqrt(relative + 4 * ratio(e.std_error, e.std) ** 2)

    @property
    def plain(self) -> tuple[FloatArray, FloatArray]:
        """Variances (m,) of plain samples, and of those that have the tangent as control."""
        plain = np.asarray(self._values().var(axis=0, ddof=1))
        return plain, np.einsum("mkk->mk", self.pilot.covariance)[:, 0]


class ByModels(Way):
    """Groups of models that share their samples.

    Attributes
    ----------
    found
        What all samples so far tell.
    """

    found: Found

    def __init__(self, team: Fidelities) -> None:
        super().__init__(team)
        self._estimate()
        self.pilot = self.found

    def _samples(self) -> tuple[list[Samples], Samples | None]:
        """All groups that count, the pilot as long as nothing else was taken; and one that tells weights only."""
        team = self._team
        counted = [g for g in team.taken if g != PILOT] or [PILOT]
        apart = team.samples(PILOT) if PILOT in team.taken and counted != [PILOT] else None
        return [team.samples(g) for g in sorted(counted)], apart

    def quantiles(self, probabilities: tuple[float, ...]) -> Quantiles:
        """Return quantiles of the outputs."""
        samples, apart = self._samples()
        return quantiles_of_groups(samples, self._team.offsets[0], probabilities, apart)

    def _estimate(self) -> None:
        team = self._team
        samples, apart = self._samples()
        found = estimated(samples, team.offsets[0], team.variances, apart)
        self.estimates = with_tails(found.estimates, team.inputs, found.moved, self._values())
        self.found = replace(found, estimates=self.estimates)

    def _relative(self) -> FloatArray:
        return self.found.relative

    def _problem(self) -> Problem | None:
        """How to choose numbers of samples for means, relative to their sizes; None if controls leave nothing."""
        team, fitted = self._team, zip(self.found.fitted, self.estimates.size, strict=True)
        known = [(one.covariances[0], size) for one, size in fitted if one.covariances[0, 0, 0] > 0]
        told = [informations(team.groups, covariance / size**2) for covariance, size in known]
        return Problem(np.array(told), team.costs, team.counts()) if told else None

    def expected(self, cost: float) -> float:
        """Predict the largest relative variance of a mean once so much more is spent."""
        problem = self._problem()
        if problem is None:
            return 0.0
        return float(problem.variances(problem.taken + problem.best(cost)).max())

    def needed(self, target: float) -> float:
        """Predict what has to be spent for a largest relative variance."""
        problem = self._problem()
        return 0.0 if problem is None else problem.needed(target, UNLIMITED)

    def spend(self, cost: float) -> None:
        """Take samples for a cost, or a little less, and estimate again."""
        problem = self._problem()
        if problem is None:
            return
        team, wanted = self._team, problem.best(cost)
        # Groups too small to tell their own scatter give way to the others.
        few = (wanted < FEWEST) & (problem.taken < FEWEST)
        counts = np.where(few, 0.0, wanted)
        own = np.array([0 in group for group in team.groups])
        if not (problem.taken + counts)[own].any():
            counts[np.argmax(np.where(own, wanted, -1.0))] = FEWEST
        total = float(counts @ team.costs)
        if not total:
            counts[-len(team.members)] = total = cost  # the model of the study alone
        numbers = np.floor(counts * min(1.0, cost / total) + 1e-9).astype(int)
        numbers[(numbers < 2) & (problem.taken < 2)] = 0
        for g in np.flatnonzero(numbers):
            team.take(int(g), int(numbers[g]))
        if numbers.any():
            self._estimate()

    def doubts(self) -> Iterator[Finding]:
        """Find what a few samples decide."""
        team, found = self._team, self.found
        counted = sorted(g for g in team.taken if g != PILOT) or [PILOT]
        errors = np.array([one.var(axis=0) / len(one) for one in found.moved])  # of the standard deviation, by group
        largest = int(ratio(errors, errors.sum(axis=0)).max(axis=1).argmax())
        g = counted[largest]
        samples = team.samples(g)
        values, ok = samples.deviations[:, samples.group[0]], samples.answered
        values = team.offsets[samples.group[0]] + np.where(ok[:, None], values, values[ok].mean(axis=0))
        yield from of_tails(team.evaluate.outputs, values, found.estimates.relative_std_error, found.moved[largest])


class ByExpansion(Way):
    """An expansion fitted to the pilot, and samples of the study's model that correct what it leaves.

    Attributes
    ----------
    left
        What it leaves (m,), by the whole fit repeated without each part of its samples.
    """

    def __init__(self, team: Fidelities, told: Found, fitted: Deviations, scale: Estimates) -> None:
        super().__init__(team)
        self.pilot, self._fitted, self._scale = told, fitted, scale
        self._control: Control = expansion(fitted)
        self._repeats = [expansion(one) for one in fitted.repeats]
        self.left: FloatArray = np.maximum(fitted.relative, fitted.trial.relative) * scale.std
        self.estimates, self._moved = scale, np.zeros((0, 0))

    @classmethod
    def of(cls, team: Fidelities, told: Found) -> ByExpansion | None:
        """Fit to values, and gradients where there are some, at the pilot; None if that is impossible."""
        pilot, centre = team.members[0].first, team.members[0].centre
        if pilot is None or objection(team.inputs, "") is not None:
            return None
        ok = pilot.ok
        tangents = None if pilot.tangents is None else pilot.tangents[ok]
        try:
            regression = Regression.of(team.inputs, pilot.points[ok], pilot.outputs[ok], tangents, ORDER)
        except SolveError:
            return None
        plain = pilot.outputs[ok]
        scale = np.maximum(plain.std(axis=0, ddof=1), 1e-300)
        zero = np.zeros_like(scale)
        fitted = deviations(regression, replace(pilot, fields=np.zeros((0, 0))), centre)
        return cls(team, told, fitted, Estimates(plain.mean(axis=0), scale + np.inf, scale, zero + np.inf, zero, zero))

    def _relative(self) -> FloatArray:
        return np.full((1, self.left.size), 2 / len(self._values()))

    def quantiles(self, probabilities: tuple[float, ...]) -> Quantiles:
        """Return quantiles of the outputs, of the samples of the study's model alone."""
        return quantiles(self._alone()[1], probabilities)

    def _alone(self) -> tuple[FloatArray, FloatArray]:
        """Points (n, d) and outputs (n, m) of samples of the study's model alone that have an answer."""
        samples, taken = self._team.samples(self._own), self._team.taken[self._own]
        return taken.points[samples.answered], taken.values[samples.answered, 0]

    @property
    def _own(self) -> int:
        """Group of the study's model alone."""
        return len(self._team.groups) - len(self._team.members)

    def expected(self, cost: float) -> float:
        """Predict the largest relative variance of a mean with so many samples more."""
        before = self._team.counts()[self._own]
        return float(ratio(self.left**2, self._scale.size**2).max() / (before + max(cost, 1)))

    def needed(self, target: float) -> float:
        """Predict what has to be spent for a largest relative variance."""
        n = self._team.counts()[self._own]
        if not n:
            return self.expected(1) / target
        return float(n * ((self.estimates.relative_error.max() ** 2 / target) - 1))

    def spend(self, cost: float) -> None:
        """Take as many samples, and estimate again."""
        team, count = self._team, int(cost + 1e-9)
        if not count:
            return
        team.take(self._own, count)
        found, moved = self._controlled()
        # Without the control, the samples that it was fitted to count as well.
        own = self._values()
        moved_plain = influences(own - team.offsets[0], (own - team.offsets[0]) ** 2)
        plain = with_tails(plain_moments(own, team.offsets[0]), team.inputs, (moved_plain,), own)
        claims, without = (np.hypot(one.mean_error, one.std_error) for one in (found, plain))
        stands = agree(found, plain) & (claims <= without)
        self.estimates = either(stands, found, plain)
        values = self._alone()[1]
        self._moved = np.where(stands, moved, influences(values - team.offsets[0], (values - team.offsets[0]) ** 2))

    def _controlled(self) -> tuple[Estimates, FloatArray]:
        """Estimates with the expansion as control, and the influences (n, m) of the samples on the variance."""
        team, offset = self._team, self._team.offsets[0]
        points, values = self._alone()
        values = values - offset
        shift = offset - team.members[0].centre.outputs  # the expansion is one of deviations from these

        def centred(control: Control) -> tuple[FloatArray, FloatArray]:
            """Controls of both moments, of expectation zero."""
            L, _ = control.predict(control.features(points), control.outputs)
            expected, second = control.expected(control.outputs)
            L, expected, second = L - shift, expected - shift, second - 2 * shift * expected + shift**2
            return L - expected, L**2 - second

        controls = centred(self._control)
        found = combine(offset, [term(values, values**2, controls)])
        first, squares = controlled(values, values**2, controls)
        moved = influences(first, squares)
        factor = student(max(len(values) - 1, 1)) / Z
        others = [centred(one) for one in self._repeats]
        C, D = (np.array([one[i] - controls[i] for one in others]) for i in range(2))
        of_std = ratio(wrong(D - 2 * first.mean(axis=0) * C), 2 * found.std)
        found = replace(
            found,
            mean_error=np.hypot(found.mean_error * factor, wrong(C)),
            std_error=np.linalg.norm(
                np.broadcast_arrays(found.std_error * factor, of_std, self._unseen(points, first)), axis=0
            ),
        )
        return with_tails(found, team.inputs, (moved,), self._values()), moved

    def _unseen(self, points: FloatArray, left: FloatArray) -> FloatArray:
        """Error (m,) of the standard deviation from beyond all samples, which leaves so much of them (n, m)."""
        inputs, fitted = self._team.inputs, self._fitted
        points = np.concatenate([points, fitted.trial.points])
        share = beyond(inputs, fitted.basis, fitted.outputs, points).share
        norm = left.std(axis=0) / np.maximum(1 - share, 1 / len(points))
        return np.asarray(np.sqrt(share) * (norm if fitted.rest is None else np.maximum(norm, fitted.rest)))

    def doubts(self) -> Iterator[Finding]:
        """Find what a few samples decide."""
        team = self._team
        values = self._alone()[1]
        relative = self.estimates.relative_std_error
        yield from of_tails(team.evaluate.outputs, values, relative, self._moved, expanded=True)
