"""What an estimate of the error of a mesh takes, which way is the cheapest, and the finer mesh that calibrates it."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any, NamedTuple

from forward.bodies.geometry import AXES
from forward.fem.cost import BYTES_PER_NONZERO, BYTES_PER_UNKNOWN, MOST_BYTES, REPORT, START, factor, times

if TYPE_CHECKING:
    from forward.bodies.geometry import Body

BLOCKS = 9  # residuals, for the blocks of the nodes
ACTION = 2  # a product with the stiffness, over a residual
SMOOTHING, ROUGHLY = 12, 5  # steps in the enriched space, and solves with a factor of the body, of an estimate
SADDLES = 3  # times as many steps and solves with pressures, of two solutions
SEVERAL = 3  # estimates among which what comes once is shared, in a choice between ways
COPIES = 4  # of the matrix, while what preconditions steps is taken from it

# The finer mesh by which estimates are calibrated.
MOST_UNKNOWNS = 40_000
TWICE = 2.0  # what a mesh in a file, and a single layer of cells, can be divided by
TIMES = (TWICE, 1.5, 1.25)  # cells along each edge, over those of the body: the first that is cheap and small enough
ALONE = 1.5  # the same of a mesh without an estimate of its own, where none of these is: with it the order shows best
SHARE = 0.2  # of what a study takes without its solves
OF_ALONE = 0.35  # the same for that mesh: without any, half of what is seen would be in doubt
AROUND = 0.3  # processor time (s) of what estimates need besides: forms, places of nodes, a longer report


class Way(StrEnum):
    """How the enriched equations are solved."""

    FACTOR = "a factor of their own"
    REFERENCE = "the factor of a reference, or one of their own where there is none"
    SMOOTHING = "steps of conjugate gradients and the factor of the body"


@dataclass(frozen=True)
class Estimate:
    """What one estimate of the error of a mesh takes, in elements of one degree more.

    Attributes
    ----------
    way
        How; by sizes, form and degree only.
    seconds
        Predicted processor time (s).
    once
        What comes once for many, before the first (s): a factor, or what the steps are preconditioned by.
    bytes
        Memory.
    calibration, calibration_bytes
        What calibrates estimates, once (s), and its memory besides; 0 where no finer mesh does.
    alone
        Whether the factor of a reference and one of its own are never kept together, since both would be too large.
    """

    way: Way
    seconds: float
    once: float
    bytes: float
    calibration: float = 0.0
    calibration_bytes: float = 0.0
    alone: bool = False


def estimate(body: Body, enriched: Body, *, mixed: bool, symmetric: bool) -> Estimate:
    """Predict an estimate for a body, and the same in elements of one degree more.

    Steps miss too much of the error of linear elements, which may lock.
    """
    coarse, fine = (times(one, mixed=mixed, symmetric=symmetric) for one in (body, enriched))
    forces = 2 * fine.residual  # in the enriched space, with the outputs
    factored = fine.assembly + fine.factorisation
    one = forces + factored + fine.substitution
    near = forces + ROUGHLY * (fine.substitution + ACTION * fine.residual)
    steps = SMOOTHING * ACTION * fine.residual + ROUGHLY * (coarse.substitution + ACTION * coarse.residual)
    smoothed, held = forces + (SADDLES if mixed else 1) * steps, 2 * fine.bytes
    if one <= min(near, smoothed):
        return Estimate(Way.FACTOR, one, fine.setup, held)
    alone = held > MOST_BYTES
    referred = Estimate(Way.REFERENCE, near, fine.setup + factored, fine.bytes if alone else held, alone=alone)
    vectors = BYTES_PER_UNKNOWN * 3 * enriched.nodes
    if mixed and body.cell == "hexahedron":  # whose steps leave a fifth of the error where κ ≫ μ
        return referred
    if not mixed:
        if body.degree == 1 and not alone:
            return referred
        return Estimate(Way.SMOOTHING, smoothed, BLOCKS * fine.residual, vectors)
    matrix = COPIES * BYTES_PER_NONZERO * factor(enriched, mixed=True).nonzeros
    stepped = Estimate(Way.SMOOTHING, smoothed, fine.setup + fine.assembly, vectors + matrix)
    return min((referred, stepped), key=lambda way: way.once + SEVERAL * way.seconds)


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


def own_estimate(spec: Any, enriched: Any | None = None) -> Estimate:
    """Predict an estimate for a body, by default in elements of one degree more, without what calibrates it."""
    fine = enriched or spec.enriched()
    return estimate(spec.body, fine.body, mixed=spec.mixed, symmetric=spec.symmetric)


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
    cost = own_estimate(spec, spec.enriched().enriched())
    return cost.once + cost.seconds


def finer(spec: Any, spare: float = math.inf) -> Finer | None:
    """Return a body on the finest mesh that is affordable; None where any takes too much."""
    allowed, of_alone = allowance(spec, spare), allowance(spec, spare, OF_ALONE)
    if of_alone <= 0:
        return None
    for more in TIMES:
        found = _there(spec, more, estimated=True)
        if found is not None and found.seconds <= allowed:
            return found
    found = _there(spec, ALONE, estimated=False)
    return found if found is not None and found.seconds <= of_alone else None


def _there(spec: Any, more: float, *, estimated: bool) -> Finer | None:
    """Return a body on a mesh with so many times the cells along edges; None without one, or if it is too large."""
    body = with_cells(spec, more)
    if body is None:
        return None
    there = spec.over({}).model_copy(update={"body": body, "adapt": None})
    cost = there.cost(factors=1)
    seconds, size = cost.setup + cost.assembly + cost.factorisation + cost.corrected, cost.bytes
    if estimated:
        estimating = own_estimate(there)
        seconds, size = seconds + estimating.once + estimating.seconds, size + estimating.bytes
    if there.unknowns > MOST_UNKNOWNS or size > MOST_BYTES - own_estimate(spec).bytes:
        return None
    return Finer(there, more, seconds, size, estimated)


def with_cells(spec: Any, more: float) -> Any | None:
    """Return the body with so many times the cells along each edge; None where it cannot be.

    Cells of a file are halved along each edge, and so are those of a single layer: two layers beside edges that are
    divided by less would show an order that is of neither direction.
    """
    body = spec.body
    thin = body.structured and any(n == 1 for axis, n in zip(AXES, body.cells, strict=True) if axis not in spec.plane)
    if more != TWICE and (thin or not body.structured):
        return None
    with suppress(ValueError):  # it is divided already, or too large
        return body.with_cells(more, spec.plane) if body.structured else body.refined(1)
    return None
