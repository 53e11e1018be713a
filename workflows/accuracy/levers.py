"""What a study may move so that all its errors are within a tolerance, beside its method (`Method.until`).

The mesh (`MeshLever`), and the number of estimates of its error, which leave less of it open.

Errors of outputs fall at best like h^(2p) in elements of degree p, and N^(−2p/3) with the number of unknowns, on meshes
that are refined where errors arise too. One mesh is held against that, two against the rate that they show.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from forward.adapt import OF_ROUNDING, Adapt
from forward.machine import MIB
from forward.model import ModelError
from uq.inputs.sampling import power_of_two
from workflows.config.tables import at
from workflows.studies.study import times_of

if TYPE_CHECKING:
    from forward.fem.cost import Times
    from forward.fem.mesh_error_cost import Estimate
    from forward.spec import ModelSpec
    from uq.accuracy.goal import Goal
    from workflows.studies.sampling_blocks import S, SamplingBlocks

AUTOMATIC = "automatic"
SCRAMBLES = 16  # of quasi-Monte Carlo, by default
AMOUNTS = ("samples", "tolerance", "budget_seconds")
SOLVES = 10_000  # most, by default
# Methods that stop at a goal, and so need no number of samples.
AIMING = ("monte-carlo", "sensitivity-monte-carlo", "quasi-monte-carlo", "chaos")

COUNTS = 3, 4, 6, 9  # estimates of the error of a mesh
KEPT = 0.8  # of the tolerance: what a mesh may take that was not predicted (`AIM`: one that is)
AIM = 0.6  # of the tolerance: what a mesh may take that is predicted
STEP = 1.1  # ratio of the numbers of cells that are looked at
LARGEST = 16.0  # times as many cells along an edge
FAR = 2.0  # times as many cells: farther, an assumed rate says too little
DOUBLED = 1.9  # times as many cells, where nothing is known: then a mesh may do
MOST_MESHES = 4
MOST_UNKNOWNS = 10**7  # of meshes that are refined where errors arise
BETWEEN = 0.1  # error of a mesh between the given one and one that may be out of reach, over that of the former
OF_ADAPTED = 0.4  # the same of one that is refined where errors arise, which stops soon below what it is asked for
HOPELESS = 3.0  # times the tolerance that the finest mesh is predicted to take, from which on it is not tried
RATE = 1.6  # at which errors are assumed to fall with the size of cells: slowly, as at edges that are held
RATES = 0.8, 4.0  # that are believed of two meshes
FALL = {1: 2.0, 2: 2.0}  # power of their number with which what they leave open falls, by the number of parameters
OF_MANY = 1.5  # the same of more parameters
SAMPLES = {True: (30.0, 0.5), False: (1000.0, 1.5)}  # of expansions and others: number, and power of what is left


# --- the method and the number of its solves -------------------------------------------------------------------------


def completed(blocks: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the blocks of a study with a tolerance, and what it decides: a method, or most samples of a given one."""
    method = blocks.get("method")
    if method is None:
        return {**blocks, "method": {"kind": AUTOMATIC}}
    if at(method, "kind") not in AIMING or at(method, "fit") == "projection":
        return blocks
    most = blocks["accuracy"].get("solves", SOLVES)
    if not isinstance(most, int) or any(method.get(name) is not None for name in AMOUNTS):
        return blocks
    if method["kind"] == "quasi-monte-carlo":
        scrambles = method.get("scrambles", SCRAMBLES)
        if not isinstance(scrambles, int) or scrambles < 1:
            return blocks
        most = scrambles * power_of_two(most // scrambles)
    return {**blocks, "method": {**method, "samples": most}}


def most(study: SamplingBlocks) -> int:
    """Return how many solves there may be, by accuracy.solves or by the method's own number of samples."""
    samples = getattr(study.method, "samples", None)
    return min(study.accuracy.solves, samples or study.accuracy.solves)


def goal(study: SamplingBlocks) -> Goal:
    """Return what the tolerance asks of estimates, before anything is known of the mesh."""
    from uq.accuracy.goal import Goal

    assert study.accuracy.tolerance is not None
    units = [output.unit for output in study.spec.returned]
    return Goal.of(study.accuracy.tolerance, units, study.accuracy.solves, study.spec.solver_tolerance or 0.0)


# --- the mesh, and the number of estimates of its error --------------------------------------------------------------


@dataclass(frozen=True)
class Assessed:
    """A mesh and its error."""

    unknowns: int
    cells: tuple[int, ...]  # along each edge, where a body has such
    estimates: int  # of its error
    share: float  # largest part of the tolerance that it takes; infinite where that cannot be estimated
    parameters: int  # random ones
    output: str  # of which that is,
    of: str  # and of which estimate
    # Parts of the tolerance that each estimate of each output (2, m) takes, since estimates of the error are not exact,
    # and since there are few; empty where there are none.
    close: list[list[float]]
    between: list[list[float]]
    relative: float  # largest error of an output at the mean parameters, relative to it
    # Of each output with an estimate: its name, its mean by tangents, the error of that, and what is not known of it.
    means: list[tuple[str, float, float, float]]
    solves: int  # that it took to find out, as the time (s), which depends on the machine, and nothing on it
    seconds: float

    @property
    def document(self) -> dict[str, Any]:
        """As it is written down."""
        return {name: None if value is np.inf else value for name, value in vars(self).items()}

    @property
    def size(self) -> float:
        """Largest part of the tolerance that any number of estimates would leave; 0 where nothing is known."""
        return float(np.max(self.close, initial=0.0))

    def share_with(self, factor: float, estimates: int) -> float:
        """Predict the share where errors are so many times smaller, and with another number of estimates."""
        if not self.close:
            return np.inf
        few = (self.estimates / estimates) ** FALL.get(self.parameters, OF_MANY)
        return float(np.hypot(self.close, few * np.array(self.between)).max() / factor)


class Step(NamedTuple):
    """What is looked at next: a model and a number of estimates; no model where the last mesh is taken, and its limit.

    The limit is what ends the search though that mesh takes too much: "meshes", "memory", or "fixed".
    """

    model: ModelSpec | None
    estimates: int
    limit: Literal["", "meshes", "memory", "fixed"] = ""


class Reach(NamedTuple):
    """Where no mesh in memory is fine enough: unknowns of one that is, and of the largest with the share it takes.

    The share is over what it may be. Two meshes have shown how errors fall (`seen`), or they fall as fast as they can.
    """

    needed: float
    most: int
    share: float
    seen: bool


class _Way(NamedTuple):
    """A mesh that might be taken, its share of the tolerance, and the predicted time (s) of the study on it."""

    times: float
    model: ModelSpec
    estimates: int
    share: float
    seconds: float


@dataclass(frozen=True)
class MeshLever:
    """How the mesh of a study may move."""

    first: SamplingBlocks  # the study as it was given
    # To more cells along all edges, to one that is refined where errors arise (`forward.fem.adapt`), or not at all.
    moves: Literal["cells", "adapt", ""]
    words: str  # the same in words

    @classmethod
    def of(cls, study: SamplingBlocks) -> MeshLever:
        """Find it."""
        model = study.model
        if model.adaptive:
            return cls(study, "", "is refined as model.adapt says, and no further")
        body, objection = study.solid.body, None
        try:
            model.finer(2.0)
        except ModelError as error:
            objection = str(error)
        except ValueError:
            objection = "it would be too large"
        if objection is None and body.cell != "tetrahedron":
            return cls(study, "cells", "gets more cells along all edges, if its error is too large")
        if body.cell == "tetrahedron" and not any(field.basis != "modes" for field in study.solid.fields):
            return cls(study, "adapt", "is refined where its error arises, if that is too large")
        return cls(study, "", f"is not refined: {objection}")

    def step(self, study: SamplingBlocks, seen: Sequence[Assessed]) -> Step:
        """Return what follows from the meshes seen so far, on the last of which `study` is.

        Of the meshes and numbers of estimates that are enough, the study takes those by which it ends first.
        """
        now, cells = seen[-1], self.moves == "cells"
        if cells and len(seen) > MOST_MESHES and now.share > KEPT:
            return Step(None, now.estimates, "meshes")
        ways = list(self._ways(study, now, rate_of(seen) if cells else RATE))
        here = [way for way in ways if way.times == 1 and way.estimates == now.estimates and way.share <= KEPT]
        enough = [*here, *(way for way in ways if way.share <= AIM)]
        if not enough and not cells:
            return self._adapted(study, seen) if self.moves else Step(None, now.estimates, "fixed")
        best = min(enough, key=lambda way: way.seconds) if enough else min(ways, key=lambda way: way.share)
        if best.times == 1 and best.estimates == now.estimates:
            return Step(None, now.estimates, "" if enough else "memory")
        if len(seen) == 1 and best.times > FAR:  # a mesh between them costs little, and tells the rate
            return Step(next(way.model for way in ways if way.times >= best.times**0.5), COUNTS[0])
        return Step(best.model, best.estimates)

    def _ways(self, study: SamplingBlocks, now: Assessed, rate: float) -> Iterator[_Way]:
        """Go through numbers of estimates on this mesh, and on those with more and more cells."""
        few, power = SAMPLES[study.method.kind in ("automatic", "chaos") and study.inputs.independent]
        seen = set[int]()
        for other, cost, estimating in _finer_and_finer(study, LARGEST if self.moves == "cells" else 1.0):
            if other.spec.unknowns in seen:
                continue
            seen.add(other.spec.unknowns)
            finer = factor(cells(study), cells(other))
            for count in COUNTS:
                if other is study and count < now.estimates:
                    continue
                share = now.share_with(finer**rate, count)
                if not now.close and finer > DOUBLED:
                    share = AIM
                samples = few / max(1 - share**2, 0.05) ** (power / 2)
                estimates = estimating.once + count * (cost.sample + estimating.seconds)
                yield _Way(finer, other.model, count, share, cost.first + samples * cost.sample + estimates)

    def _adapted(self, study: SamplingBlocks, seen: Sequence[Assessed]) -> Step:
        """Refine where errors arise, from the mesh that was given, as far as those seen so far say."""
        now, before = seen[-1], study.solid.adapt
        if before is not None and (len(seen) > MOST_MESHES or study.spec.unknowns * STEP > before.unknowns):
            return Step(None, now.estimates, "memory")
        error = now.relative if before is None else before.tolerance
        to = 0.1 if now.share == np.inf else float(np.clip(error * OF_ADAPTED / now.share, OF_ROUNDING, 0.5))
        if len(seen) == 1 and now.close and self._least_share(now, RATE) > HOPELESS:
            to = max(to, min(BETWEEN * error, 0.5))  # it may be out of reach: a mesh between them tells the rate
        return Step(self.adapting(to, self.most_unknowns), COUNTS[0])

    def adapting(self, tolerance: float, unknowns: int) -> ModelSpec:
        """Return the model with a mesh that is refined until its relative error is so much, or so many unknowns."""
        adapt = Adapt(tolerance=tolerance, unknowns=unknowns)
        return self.first.model.model_copy(update={"adapt": adapt})

    @property
    def most_unknowns(self) -> int:
        """Unknowns of the largest mesh for which accuracy.memory is enough, with the estimates of its error."""
        most: int = self.first.model.unknowns
        if self.moves == "cells":
            return max(most, *(other.spec.unknowns for other, *_ in _finer_and_finer(self.first)))
        while most < MOST_UNKNOWNS:
            more = int(most * STEP) + 1
            if self.adapting(0.5, more).largest_bytes > MIB * self.first.accuracy.memory:
                break
            most = more
        return most

    @property
    def dimension(self) -> int:
        """Number of directions in which the mesh gets finer: two of a layer of plane strain."""
        here = cells(self.first)
        if self.moves != "cells" or len(here) == 1:
            return 3
        there = cells(self.first.of(self.first.model.finer(2.0)))
        return sum(after > before for before, after in zip(here, there, strict=True))

    def _least_share(self, now: Assessed, rate: float) -> float:
        """Predict what the largest mesh takes of the tolerance, by one that was seen."""
        finer = max(self.most_unknowns / now.unknowns, 1.0) ** (1 / self.dimension)
        return now.share_with(finer**rate, COUNTS[-1])

    def out_of_reach(self, seen: Sequence[Assessed]) -> Reach | None:
        """Return what is known where no mesh in memory is fine enough, by those seen so far; None where one may be."""
        now, degree = seen[-1], int(self.first.solid.body.degree)
        if not math.isfinite(now.share):
            return None
        known = {one.unknowns: one.size for one in seen if one.size > 0}
        # Coarse meshes may show too little: no rate is believed to be less than what is assumed elsewhere.
        shown = _rate(sorted(known.items()), RATE, 2 * degree, self.dimension)
        rate = 2.0 * degree if shown is None else shown
        least = self._least_share(now, rate)
        if least <= HOPELESS:
            return None
        needed = now.unknowns * (now.share_with(1.0, COUNTS[-1]) / AIM) ** (self.dimension / rate)
        return Reach(needed, self.most_unknowns, least / AIM, shown is not None)


def _finer_and_finer(study: S, largest: float = math.inf) -> Iterator[tuple[S, Times, Estimate]]:
    """Go through meshes with more and more cells for which there is memory, from that of a study on."""
    times = 1.0
    while times <= largest:
        try:
            other = study if times == 1 else study.of(study.model.finer(times))
        except ValueError:  # too large
            return
        cost, estimating = times_of(other.spec), other.spec.mesh_error_cost()
        if estimating is None or (cost.bytes + estimating.bytes > MIB * study.accuracy.memory and times > 1):
            return
        yield other, cost, estimating
        times *= STEP


# --- by how much cells are smaller, and how fast errors fall ---------------------------------------------------------


def cells(study: SamplingBlocks) -> tuple[int, ...]:
    """Cells along each edge, or how often those of a file are halved."""
    body = study.solid.body
    return tuple(body.cells) if body.structured else (2**body.levels,)


def factor(before: Sequence[int], after: Sequence[int]) -> float:
    """By what the longest edges of cells have become shorter, but for a layer of plane strain, which stays one cell."""
    return min((n / m for m, n in zip(before, after, strict=True) if max(m, n) > 1), default=1.0)


def rate_of(meshes: Sequence[Assessed]) -> float:
    """The rate at which errors fall with the size of cells, by the last two meshes."""
    known = {factor(meshes[0].cells, one.cells): one.size for one in meshes if one.size > 0}
    return _rate(list(known.items()), *RATES) or RATE


def _rate(known: Sequence[tuple[float, float]], least: float, most: float, d: int = 1) -> float | None:
    """The rate by the last two of how fine meshes are and their errors; None of fewer."""
    if len(known) < 2:
        return None
    (coarse, before), (fine, after) = known[-2:]
    return float(np.clip(d * np.log(before / after) / np.log(fine / coarse), least, most))
