"""Models that share random parameters, at work: linearised, sampled in groups, and paid for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray, SolveError
from uq.estimators.blue import Group, subsets
from uq.estimators.fidelities import Samples
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


@dataclass
class Member:
    """A model that is sampled.

    Attributes
    ----------
    label
        Its name in results, and before reasons of its failures; empty where the group says which it is.
    evaluate
        Its evaluation.
    cost
        Of a solve, by which numbers of samples are chosen.
    centre
        Its linearisation at the mean parameters.
    stopped_after
        Iterations of its solver.
    company
        How many points go together in a block.
    solves, seconds
        Number of its solves at samples so far, and their processor time (s).
    first
        The first of these.
    """

    label: str
    evaluate: Recorder
    cost: float
    centre: Linearisation
    stopped_after: int | None = None
    company: int = COMPANY
    solves: int = 0
    seconds: float = 0.0
    first: Evaluations | None = None

    def solve(self, points: FloatArray, *, tangents: bool = False) -> Evaluations:
        """Solve at points (n, d)."""
        start, iterations = self.centre.prediction, self.stopped_after
        asked = Request(points, tangents=tangents, start=start, iterations=iterations, company=self.company)
        found = self.evaluate(asked)
        self.solves += len(points)
        self.seconds += float(found.seconds.sum())
        self.first = self.first or found
        return found


@dataclass(frozen=True)
class Taken:
    """The samples of a group: points (n, d), outputs (n, K, m), NaN for models outside it, and reasons of failures."""

    points: FloatArray
    values: FloatArray
    reasons: set[str] = field(default_factory=set)


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
        return np.asarray(np.isfinite(self.taken.values[:, list(self.group)]).all(axis=(1, 2)))


class Team:
    """Models, of which groups are solved at the same random parameters: every group has its own stream of these.

    Attributes
    ----------
    inputs, seed
        The random parameters, and the seed of all streams.
    members
        The models, at most `most`.
    groups
        Groups of models, by their numbers.
    taken
        The samples of groups.
    """

    def __init__(self, inputs: Inputs, evaluate: Recorder, seed: int, most: int) -> None:
        self.inputs, self.evaluate, self.seed, self._most = inputs, evaluate, seed, most
        self.members: list[Member] = []
        self.groups: list[Group] = []
        self.taken: dict[int, Taken] = {}

    @property
    def costs(self) -> FloatArray:
        """Cost (G,) of one sample of each group, in the unit of that of its members."""
        return np.array([sum(self.members[k].cost for k in group) for group in self.groups])

    def take(self, g: int, count: int, *, tangents: bool = False) -> None:
        """Take further samples of a group, or of all models for a pilot that does not count."""
        there = self.taken.get(g)
        more = self.drawn(g, 0 if there is None else len(there.points), count, tangents=tangents)
        if there is not None:
            points, values = np.concatenate([there.points, more.points]), np.concatenate([there.values, more.values])
            more = Taken(points, values, there.reasons | more.reasons)
        self.taken[g] = more

    def drawn(self, g: int, start: int, count: int, *, tangents: bool = False) -> Taken:
        """Draw points of a group's stream and solve its models there; others have NaN."""
        stream = g if g >= 0 else len(self.groups)
        points = self.inputs.points(random_points((self.seed, stream), start, start + count, len(self.inputs.names)))
        found = Taken(points, np.full((count, self._most, len(self.evaluate.outputs)), np.nan))
        for k in self.groups[max(g, 0)] if count else ():
            found.values[:, k] = self.solved(k, points, found.reasons, tangents=tangents and k == 0)
        return found

    def blocks(self) -> list[Block]:
        """What was taken of each group."""
        return [Block(self.groups[max(g, 0)], self.taken[g], pilot=g == PILOT) for g in sorted(self.taken)]

    def solved(self, k: int, points: FloatArray, reasons: set[str], *, tangents: bool = False) -> FloatArray:
        """Solve a model at points; NaN where it has no answer, with the reasons added to others."""
        one = self.members[k]
        found = one.solve(points, tangents=tangents)
        reasons.update(f"{one.label}: {failure.reason}" if one.label else failure.reason for failure in found.failures)
        return np.asarray(np.where(found.ok[:, None], found.outputs, np.nan))


class Fidelities(Team):
    """The model of a study (the first) and cheap ones.

    Attributes
    ----------
    groups
        All groups of models.
    spent
        Cost of all solves so far but those of the linearisation of the study's model, which every method needs.
    controlled
        Whether the tangent is taken off.
    slopes, variances
        Slopes (m, d) and E[T²] (m,) of the control: the tangent of the study's model, for all of them. Tangents of
        models that follow each other may differ, where the place of the largest stress jumps at the mean parameters,
        say. Each would take off something else then, and what is left would not be correlated.
    """

    def __init__(
        self, cheap: Sequence[CheapModel], inputs: Inputs, evaluate: Recorder, seed: int, *, controlled: bool
    ) -> None:
        super().__init__(inputs, evaluate, seed, 1 + len(cheap))
        self.controlled = controlled and evaluate.differentiable
        centre = linearise(inputs, evaluate)
        self.members.append(Member(OWN_LABEL, evaluate, 1.0, centre))
        self.spent = 0.0
        for one in cheap:
            stopped = one.stopped_after
            other, found = evaluate.on(one.label) if stopped is None else evaluate, centre
            cost = one.predicted(evaluate.displacements, other.displacements)
            if cost is None:
                raise ValueError(f"{one.label}: the cost of a solve cannot be predicted, expected its `cost`")
            if stopped is None:
                try:
                    found = linearise(inputs, other)
                except SolveError as error:
                    raise SolveError(f"{one.label}: {error.reason}", error.history) from None
                self.spent += TEXTBOOK * cost
            self.members.append(Member(one.label, other, cost, found, stopped, min(CHEAP, int(COMPANY / cost))))
        self.groups = subsets(len(self.members))
        self.offsets = np.array([one.centre.middle for one in self.members])
        self.slopes = centre.output_slopes if self.controlled else np.zeros_like(centre.output_slopes)
        self.variances = np.einsum("mi,ij,mj->m", self.slopes, inputs.correlation, self.slopes)

    def solved(self, k: int, points: FloatArray, reasons: set[str], *, tangents: bool = False) -> FloatArray:
        self.spent += len(points) * self.members[k].cost
        return super().solved(k, points, reasons, tangents=tangents)

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
        """Return the samples of a group; raises `SolveError` if the study's model has fewer than two answers."""
        taken, group = self.taken[g], self.groups[max(g, 0)]
        inside = np.isin(np.arange(len(self.members)), group)[:, None]
        found = Samples(group, np.where(inside, self.deviations(taken), 0.0), self._controls(taken.points))
        if found.answered.sum() < 2:
            reasons = "; ".join(sorted(taken.reasons)[:3])
            raise SolveError(f"{found.answered.sum()} of {found.count} samples have an answer, expected 2: {reasons}")
        return found
