"""The models of a multifidelity study at work: linearised, sampled in groups, and paid for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray, SolveError
from uq.estimators.blue import Group, subsets
from uq.estimators.fidelities import Samples, ok_rows
from uq.evaluation.evaluate import Recorder
from uq.evaluation.request import COMPANY, Evaluations, Request
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import random_points
from uq.methods.low_fidelity import CheapModel
from uq.methods.method import TEXTBOOK
from uq.surrogates.linearisation import Linearisation, linearise

OWN_LABEL = "model"  # name in results of the model of the study
CHEAP = 64  # points of a cheap model in a block, unless they cost more than those of the study's model
PILOT = -1  # group of a pilot that does not count in estimates, in results


@dataclass(frozen=True)
class Member:
    """A model that is sampled.

    Attributes
    ----------
    label
        Its name in results.
    evaluate
        Its evaluation.
    stopped_after
        Iterations of its solver.
    cost
        Of a solve, over that of the study's model.
    centre
        Its linearisation at the mean parameters.
    """

    label: str
    evaluate: Recorder
    stopped_after: int | None
    cost: float
    centre: Linearisation

    def solve(self, points: FloatArray, *, tangents: bool = False) -> Evaluations:
        """Solve at points (n, d)."""
        start, company = self.centre.prediction, min(CHEAP, int(COMPANY / self.cost))
        return self.evaluate(
            Request(points, tangents=tangents, start=start, iterations=self.stopped_after, company=company)
        )


@dataclass(frozen=True)
class Taken:
    """The samples of a group: points (n, d), outputs (n, K, m), NaN for models outside it, and reasons of failures."""

    points: FloatArray
    values: FloatArray
    reasons: set[str] = field(default_factory=set)

    def extended(self, more: Taken) -> Taken:
        """Return these samples and others behind them."""
        return Taken(
            np.concatenate([self.points, more.points]),
            np.concatenate([self.values, more.values]),
            self.reasons | more.reasons,
        )


@dataclass(frozen=True)
class Block:
    """Samples of a group, as results have them: of a pilot that does not count, or of a pool with a choice."""

    group: Group
    taken: Taken
    pilot: bool = False
    chosen: bool = False

    @property
    def ok(self) -> NDArray[np.bool_]:
        """Which samples (n,) have answers of all models of the group."""
        return ok_rows(self.taken.values, self.group)


class Team:
    """The model of a study (the first) and cheap ones.

    Attributes
    ----------
    members
        The models.
    groups, costs
        All groups of models, and the cost (G,) of a sample of each, in solves of the study's model.
    spent
        Cost of all solves so far but those of the linearisation of the study's model, which every method needs.
    controlled
        Whether the tangent is taken off.
    slopes, variances
        Slopes (m, d) and E[T²] (m,) of the control: the tangent of the study's model, for all of them. Tangents of
        models that follow each other may differ, where the place of the largest stress jumps at the mean parameters,
        say. Each would take off something else then, and what is left would not be correlated.
    pilot
        Evaluations of the model of the study at the points of the pilot.
    """

    def __init__(
        self, cheap: Sequence[CheapModel], inputs: Inputs, evaluate: Recorder, seed: int, *, controlled: bool
    ) -> None:
        self.inputs, self.evaluate = inputs, evaluate
        self.seed, self.controlled = seed, controlled and evaluate.differentiable
        centre = linearise(inputs, evaluate)
        self.members = [Member(OWN_LABEL, evaluate, None, 1.0, centre)]
        self.spent = 0.0
        for one in cheap:
            if one.stopped_after is not None:
                cost = one.predicted(0, 0)
                self.members.append(Member(one.label, evaluate, one.stopped_after, _known(one, cost), centre))
                continue
            other = evaluate.on(one.label)
            cost = _known(one, one.predicted(evaluate.displacements, other.displacements))
            try:
                found = linearise(inputs, other)
            except SolveError as error:
                raise SolveError(f"{one.label}: {error.reason}", error.history) from None
            self.members.append(Member(one.label, other, None, cost, found))
            self.spent += TEXTBOOK * cost
        self.groups: list[Group] = subsets(len(self.members))
        self.costs = np.array([sum(self.members[k].cost for k in group) for group in self.groups])
        self.offsets = np.array([one.centre.middle for one in self.members])
        self.slopes = centre.output_slopes if self.controlled else np.zeros_like(centre.output_slopes)
        self.variances = np.einsum("mi,ij,mj->m", self.slopes, inputs.correlation, self.slopes)
        self.taken: dict[int, Taken] = {}
        self.pilot: Evaluations | None = None

    def blocks(self) -> list[Block]:
        """What was taken of each group."""
        return [Block(self.groups[max(g, 0)], self.taken[g], pilot=g == PILOT) for g in sorted(self.taken)]

    def begin(self, count: int, *, counts: bool, tangents: bool) -> None:
        """Take the pilot, which counts in estimates or does not, with derivatives of the study's model or without."""
        self.take(0 if counts else PILOT, count, tangents=tangents, keep=True)

    def take(self, g: int, count: int, *, tangents: bool = False, keep: bool = False) -> None:
        """Take further samples of a group, or of all models for a pilot that does not count."""
        d, K, m = len(self.inputs.names), len(self.members), len(self.evaluate.outputs)
        before = self.taken.setdefault(g, Taken(np.empty((0, d)), np.empty((0, K, m))))
        found = self.drawn(g, len(before.points), count, tangents=tangents, keep=keep)
        self.taken[g] = before.extended(found)

    def drawn(self, g: int, start: int, count: int, *, tangents: bool = False, keep: bool = False) -> Taken:
        """Draw points of a group's stream and solve its models there; others have NaN."""
        d, K, m = len(self.inputs.names), len(self.members), len(self.evaluate.outputs)
        stream = g if g >= 0 else len(self.groups)
        points = self.inputs.points(random_points((self.seed, stream), start, start + count, d))
        found = Taken(points, np.full((count, K, m), np.nan))
        for k in self.groups[max(g, 0)] if count else ():
            found.values[:, k] = self.solved(k, points, found.reasons, tangents=tangents and k == 0, keep=keep)
        return found

    def solved(
        self, k: int, points: FloatArray, reasons: set[str], *, tangents: bool = False, keep: bool = False
    ) -> FloatArray:
        """Solve a model at points, and pay for it; NaN where it has no answer, with the reasons added to others."""
        found = self.members[k].solve(points, tangents=tangents)
        reasons.update(f"{self.members[k].label}: {failure.reason}" for failure in found.failures)
        if keep and k == 0:
            self.pilot = found
        self.spent += len(points) * self.members[k].cost
        return np.asarray(np.where(found.ok[:, None], found.outputs, np.nan))

    def counts(self) -> FloatArray:
        """Numbers of samples (G,) of the groups that count."""
        return np.array([float(len(self.taken[g].points)) if g in self.taken else 0.0 for g in range(len(self.groups))])

    def deviations(self, taken: Taken) -> FloatArray:
        """Return the deviations (n, K, m) of all models at points; NaN where the study's model has no answer.

        The tangent stands for a cheap model that has none: whatever is taken for it there is right, as long as it is
        taken everywhere. Leaving such points out would estimate something else.
        """
        found = taken.values - self.offsets
        tangent = self._controls(taken.points)[:, None]
        found[:, 1:] = np.where(np.isfinite(found[:, 1:]), found[:, 1:], tangent)
        return np.asarray(found)

    def _controls(self, points: FloatArray) -> FloatArray:
        return np.asarray(self.members[0].centre.coordinates.of(points) @ self.slopes.T)

    def samples(self, g: int) -> Samples:
        """Return the samples of a group.

        Raises
        ------
        SolveError
            If the study's model has fewer than two answers.
        """
        taken, group = self.taken[g], self.groups[max(g, 0)]
        inside = np.isin(np.arange(len(self.members)), group)[:, None]
        found = Samples(group, np.where(inside, self.deviations(taken), 0.0), self._controls(taken.points))
        if found.answered.sum() < 2:
            reasons = "; ".join(sorted(taken.reasons)[:3])
            raise SolveError(f"{found.answered.sum()} of {found.count} samples have an answer, expected 2: {reasons}")
        return found


def _known(one: CheapModel, cost: float | None) -> float:
    if cost is None:
        raise ValueError(f"{one.label}: the cost of a solve cannot be predicted, expected its `cost`")
    return cost
