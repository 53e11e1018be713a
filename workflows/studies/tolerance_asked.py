"""One tolerance for all errors: what a study says of it before anything is solved, and whether it is within reach.

Errors of outputs fall at best like h^(2p) in elements of degree p, and N^(−2p/3) with the number of unknowns, on meshes
that are refined where errors arise too. One mesh is held against that, two against the rate that they show.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.adapt import Adapt
from forward.findings import Finding, entries
from forward.machine import MIB
from forward.model import ModelError
from forward.scalars import Mistake
from forward.words import number
from uq.accuracy.budget import LEAST, OF_SOLVER
from uq.inputs.sampling import power_of_two
from uq.methods.method import UNASKED
from workflows.studies.predictions import never_estimable, times_of

if TYPE_CHECKING:
    from uq.accuracy.goal import Goal
    from workflows.studies.sampling_blocks import SamplingBlocks

AUTOMATIC = "automatic"
SCRAMBLES = 16  # of quasi-Monte Carlo, by default
AMOUNTS = ("samples", "tolerance", "budget_seconds")
SOLVES = 10_000  # most, by default
COUNTS = 3, 4, 6, 9  # estimates of the error of a mesh
# Methods that stop at a goal, and so need no number of samples.
AIMING = ("monte-carlo", "sensitivity-monte-carlo", "quasi-monte-carlo", "chaos")

STEP = 1.1  # ratio of the numbers of cells that are looked at
AIM = 0.6  # of the tolerance: what a mesh may take that is predicted
HOPELESS = 3.0  # times the tolerance that the finest mesh is predicted to take, from which on it is not tried
RATE = 1.6  # at which errors are assumed to fall with the size of cells: slowly, as at edges that are held
LARGEST_ASKED = 0.5  # tolerance that is worth asking for
FALL = {1: 2.0, 2: 2.0}  # power of their number with which what they leave open falls, by the number of parameters
OF_MANY = 1.5  # the same of more parameters
RATES = 0.8, 4.0  # that are believed of two meshes


def completed(blocks: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the blocks of a study, with what its tolerance decides: a method, or the most samples of the given one."""
    accuracy = blocks.get("accuracy")
    if not isinstance(accuracy, Mapping) or accuracy.get("tolerance") is None:
        return blocks
    method = blocks.get("method")
    if method is None:
        return {**blocks, "method": {"kind": AUTOMATIC}}
    if not isinstance(method, Mapping) or method.get("kind") not in AIMING or method.get("fit") == "projection":
        return blocks
    most = accuracy.get("solves", SOLVES)
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


def mistakes(study: SamplingBlocks) -> Iterator[Mistake]:
    """Find what cannot be asked together with a tolerance, or by it."""
    asked, method = study.accuracy.tolerance, study.method
    if asked is None:
        if method.kind == AUTOMATIC:
            yield ("method", "kind"), UNASKED, method.kind
        return
    if not method.aims:
        message = (
            "does not stop at accuracy.tolerance, expected no block [method], or one of the kinds "
            f"{', '.join(AIMING)}{' by regression' if method.kind == 'chaos' else ''}"
        )
        yield ("method", "kind"), message, method.kind
    another = getattr(method, "tolerance", None)
    if another is not None:
        message = "another tolerance than accuracy.tolerance, which counts all errors; expected one of the two"
        yield ("method", "tolerance"), message, another
    if asked < LEAST:
        yield ("accuracy", "tolerance"), f"below what rounding leaves of results, expected at least {LEAST:g}", asked
    solver = study.model.solver_tolerance
    normal = type(study.model).model_fields.get("solver")
    if solver is not None and normal is not None and solver > max(OF_SOLVER * asked, normal.default.tolerance):
        message = (
            f"below what the solver reaches (model.solver.tolerance = {solver:g}), expected at least "
            f"{solver / OF_SOLVER:g}, or a smaller model.solver.tolerance"
        )
        yield ("accuracy", "tolerance"), message, asked


def refinement(study: SamplingBlocks) -> tuple[str, str]:
    """Return how the mesh of a study could be refined, "cells", "adapt" or "", and the same in words."""
    model = study.model
    if model.adaptive:
        return "", "is refined as model.adapt says, and no further"
    body, objection = study.solid.body, None
    try:
        model.finer(2.0)
    except ModelError as error:
        objection = str(error)
    except ValueError:
        objection = "it would be too large"
    if objection is None and body.cell != "tetrahedron":
        return "cells", "gets more cells along all edges, if its error is too large"
    if body.cell == "tetrahedron" and not any(field.basis != "modes" for field in study.solid.fields):
        return "adapt", "is refined where its error arises, if that is too large"
    return "", f"is not refined: {objection}"


def findings(study: SamplingBlocks) -> Iterator[Finding]:
    """Say what of the errors the tolerance cannot hold."""
    if not study.spec.meshed and not study.spec.hidden:
        return
    if not study.estimates:
        why = "accuracy.mesh_error = false"
        if study.accuracy.mesh_error:
            why = "it is not estimated, so that the tolerance will not be said to be kept"
        yield Finding("tolerance-without-mesh", "warning", {"why": why})
        return
    unknown = never_estimable(study.spec)
    if unknown:
        yield Finding("tolerance-without-mesh-of", "warning", about=entries(unknown))
    how, words = refinement(study)
    if not how and not study.model.adaptive:
        yield Finding("tolerance-mesh-fixed", "note", {"words": words})


def plan(study: SamplingBlocks) -> Iterator[str]:
    """Say what is held, and what is decided by it."""
    accuracy = study.accuracy
    parts = [
        *(["the method"] if study.method.kind == AUTOMATIC else []),
        f"the number of solves (up to {most(study):,})",
    ]
    parts += ["the mesh"] if study.estimates else []
    yield f"tolerance   {accuracy.tolerance:g} of every mean and standard deviation, all errors together, at 95 %"
    listed = " and ".join(filter(None, [", ".join(parts[:-1]), parts[-1]]))
    yield f"            {listed} follow{'s' if len(parts) == 1 else ''} from it"
    if study.estimates:
        limit = f"accuracy.memory = {accuracy.memory:,.0f} MiB for each group of ranks"
        yield f"            the mesh {refinement(study)[1]}, up to {limit}"
        yield "            times and memory are those of the given one"


# --- whether there is memory for a mesh that is fine enough, by those seen so far -----------------------------------


@dataclass(frozen=True)
class Assessed:
    """A mesh and its error.

    Attributes
    ----------
    unknowns, cells
        Of the mesh; the cells along each edge, where a body has such.
    estimates
        Number of estimates of its error.
    share
        Largest part of the tolerance that it takes; infinite where that cannot be estimated.
    parameters
        Number of random parameters.
    output, of
        Of which estimate of which output that is.
    close, between
        Parts of the tolerance that each estimate of each output (2, m) takes, since estimates of the error are not
        exact, and since there are few; empty where there are none.
    relative
        Largest error of an output at the mean parameters, relative to it.
    means
        Of each output with an estimate: its name, its mean by tangents, the error of that, and what is not known of it.
    solves, seconds
        What it took to find out; the time depends on the machine, and nothing on the time.
    """

    unknowns: int
    cells: tuple[int, ...]
    estimates: int
    share: float
    parameters: int
    output: str
    of: str
    close: list[list[float]]
    between: list[list[float]]
    relative: float
    means: list[tuple[str, float, float, float]]
    solves: int
    seconds: float

    @property
    def document(self) -> dict[str, Any]:
        """As it is written down."""
        return {name: None if value is np.inf else value for name, value in vars(self).items()}

    def share_with(self, factor: float, estimates: int) -> float:
        """Predict the share where errors are so many times smaller, and with another number of estimates."""
        if not self.close:
            return np.inf
        few = (self.estimates / estimates) ** FALL.get(self.parameters, OF_MANY)
        return float(np.hypot(self.close, few * np.array(self.between)).max() / factor)


def most_unknowns(study: SamplingBlocks) -> int:
    """Return the unknowns of the largest mesh for which accuracy.memory is enough, with the estimates of its error."""
    model: Any = study.model
    memory = MIB * study.accuracy.memory
    most: int = model.unknowns
    if refinement(study)[0] == "adapt":
        while most < 10**7:
            more = int(most * STEP) + 1
            if model.model_copy(update={"adapt": Adapt(tolerance=0.5, unknowns=more)}).largest_bytes > memory:
                break
            most = more
        return most
    times = STEP
    while True:
        try:
            spec = study.of(model.finer(times)).spec
        except ValueError:  # too large
            return most
        estimating = spec.mesh_error_cost()
        if estimating is None or times_of(spec).bytes + estimating.bytes > memory:
            return most
        most, times = max(most, spec.unknowns), times * STEP


def cells(study: SamplingBlocks) -> tuple[int, ...]:
    """Cells along each edge, or how often those of a file are halved."""
    body = study.solid.body
    return tuple(body.cells) if hasattr(body, "cells") else (2**body.levels,)


def factor(before: Sequence[int], after: Sequence[int]) -> float:
    """By what the longest edges of cells have become shorter, but for a layer of plane strain, which stays one cell."""
    return min((n / m for m, n in zip(before, after, strict=True) if max(m, n) > 1), default=1.0)


def rate_of(meshes: Sequence[Assessed]) -> float:
    """The rate at which errors fall with the size of cells, by the last two meshes."""
    factors = [factor(meshes[0].cells, one.cells) for one in meshes]
    sizes = [float(np.max(one.close, initial=0.0)) for one in meshes]
    known = {times: size for times, size in zip(factors, sizes, strict=True) if size > 0}
    if len(known) < 2:
        return RATE
    (coarse, before), (fine, after) = list(known.items())[-2:]
    return float(np.clip(np.log(before / after) / np.log(fine / coarse), *RATES))


def dimension(study: SamplingBlocks) -> int:
    """Number of directions in which a mesh gets finer: two of a layer of plane strain."""
    here = cells(study)
    if refinement(study)[0] != "cells" or len(here) == 1:
        return 3
    there = cells(study.of(study.model.finer(2.0)))
    return sum(after > before for before, after in zip(here, there, strict=True))


def rate_seen(meshes: Sequence[Assessed], degree: int, d: int) -> float | None:
    """Return the rate at which errors fall with the size of cells in d directions, by two meshes; None of one.

    Coarse meshes may show too little: none is believed to be less than what is assumed elsewhere.
    """
    known = {one.unknowns: size for one in meshes if (size := float(np.max(one.close, initial=0.0))) > 0}
    if len(known) < 2:
        return None
    (coarse, before), (fine, after) = sorted(known.items())[-2:]
    return float(np.clip(d * np.log(before / after) / np.log(fine / coarse), RATE, 2 * degree))


def least_share(first: SamplingBlocks, now: Assessed, rate: float) -> float:
    """Predict what the largest mesh takes of the tolerance, by one that was seen; `first` is on the given mesh."""
    finer = max(most_unknowns(first) / now.unknowns, 1.0) ** (1 / dimension(first))
    return now.share_with(finer**rate, COUNTS[-1])


def out_of_reach(study: SamplingBlocks, first: SamplingBlocks, meshes: Sequence[Assessed]) -> str | None:
    """Say that no mesh in memory is fine enough, what is reachable and what to do; None where one may be.

    Parameters
    ----------
    study, first
        On the last mesh, and on the one that was given.
    meshes
        Those seen.
    """
    now, degree = meshes[-1], int(study.solid.body.degree)
    if not math.isfinite(now.share):
        return None
    d = dimension(first)
    seen = rate_seen(meshes, degree, d)
    rate = 2.0 * degree if seen is None else seen
    least = least_share(first, now, rate)
    if least <= HOPELESS:
        return None
    tolerance, memory = study.accuracy.tolerance, study.accuracy.memory
    assert tolerance is not None
    needed = now.unknowns * (now.share_with(1.0, COUNTS[-1]) / AIM) ** (d / rate)
    here = f"the mesh of {now.unknowns:,} unknowns takes {number(now.share, 2)} times the tolerance once corrected"
    falls = "even where errors fall as fast as they can" if seen is None else "as errors have fallen so far"
    remedies = [] if degree > 1 else ["elements of degree 2 (model.body.degree)"]
    remedies += ["more accuracy.memory"]
    reachable = tolerance * least / AIM
    remedies += [f"a tolerance of {number(reachable, 2)} or more"] if reachable < LARGEST_ASKED else []
    return (
        f"accuracy.tolerance = {tolerance:g} is out of reach: {here}; {falls}, about {number(needed, 2)} unknowns are "
        f"needed, and accuracy.memory = {memory:,.0f} MiB is enough for {most_unknowns(first):,}; expected "
        f"{' or '.join(filter(None, [', '.join(remedies[:-1]), remedies[-1]]))}"
    )
