"""The finer mesh by which estimates of the error of a mesh are calibrated, and what that costs, before it is made."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any, NamedTuple

from forward.fem.cost import MOST_BYTES, REPORT, START
from forward.fem.mesh_error_cost import Estimate, estimate

MOST_UNKNOWNS = 40_000
TIMES = (2.0, 1.5, 1.25)  # cells along each edge, over those of the body: the first that is cheap and small enough
ALONE = 1.5  # the same of a mesh without an estimate of its own, where none of these is: with it the order shows best
SHARE = 0.2  # of what a study takes without its solves
OF_ALONE = 0.35  # the same for that mesh: without any, half of what is seen would be in doubt
AROUND = 0.3  # processor time (s) of what estimates need besides: forms, places of nodes, a longer report


class Finer(NamedTuple):
    """A body on a finer mesh (a `forward.hyperelastic.Hyperelastic`).

    Attributes
    ----------
    spec, times
        The body there, and how many times the cells along each edge.
    seconds, bytes
        Of one solution with its estimate, and the memory.
    estimated
        Whether the error of that mesh is estimated too.
    """

    spec: Any
    times: float
    seconds: float
    bytes: float
    estimated: bool = True


def own_estimate(spec: Any) -> Estimate:
    """Predict an estimate for a body, without what calibrates it."""
    found: Estimate = estimate(spec.body, spec.enriched().body, mixed=spec.mixed, symmetric=spec.symmetric)
    return found


def allowance(spec: Any, spare: float, share: float = SHARE) -> float:
    """Predict the processor time (s) that a calibration may take: so many solves, and a share of what comes once.

    By counts only, and so the same on every machine.
    """
    if math.isinf(spare):
        return math.inf
    cost = spec.cost()
    once = START + REPORT + cost.first + cost.reference_factor(2)
    return float(share * once + spare * cost.sample - AROUND - own_estimate(spec).once)


def richer(spec: Any) -> float:
    """Predict the processor time (s) of an estimate in elements of two degrees more."""
    twice = spec.enriched().enriched()
    cost = estimate(spec.body, twice.body, mixed=spec.mixed, symmetric=spec.symmetric)
    return cost.once + cost.seconds


def finer(spec: Any, spare: float = math.inf) -> Finer | None:
    """Return a body on the finest mesh that is affordable; None where any takes too much."""
    allowed, of_alone = allowance(spec, spare), allowance(spec, spare, OF_ALONE)
    if of_alone <= 0:
        return None
    for times in TIMES:
        found = _there(spec, times, estimated=True)
        if found is not None and found.seconds <= allowed:
            return found
    found = _there(spec, ALONE, estimated=False)
    return found if found is not None and found.seconds <= of_alone else None


def _there(spec: Any, times: float, *, estimated: bool) -> Finer | None:
    """Return a body on a mesh with so many times the cells along edges; None without one, or if it is too large."""
    body = _with_cells(spec, times)
    if body is None:
        return None
    formulation = "mixed" if spec.mixed else "displacement"
    there = spec.model_copy(update={"body": body, "formulation": formulation, "adapt": None})
    cost = there.cost(factors=1)
    seconds, size = cost.setup + cost.assembly + cost.factorisation + cost.corrected, cost.bytes
    if estimated:
        estimating = own_estimate(there)
        seconds, size = seconds + estimating.once + estimating.seconds, size + estimating.bytes
    if there.unknowns > MOST_UNKNOWNS or size > MOST_BYTES - own_estimate(spec).bytes:
        return None
    return Finer(there, times, seconds, size, estimated)


def _with_cells(spec: Any, times: float) -> Any | None:
    """Return the body with so many times the cells along each edge; None where it cannot be."""
    with suppress(ValueError):  # it is divided already, or too large
        if hasattr(spec.body, "with_cells"):
            return spec.body.with_cells(times, spec.plane)
        return spec.body.refined(1) if times == TIMES[0] else None  # cells of a file are divided into eight
    return None
