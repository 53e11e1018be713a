"""The finer mesh by which estimates of the error of a mesh are calibrated, and what that costs, before it is made."""

from __future__ import annotations

from typing import Any, NamedTuple

from forward.fem.cost import MOST_BYTES, Estimate, estimate

MOST_UNKNOWNS = 40_000
TIMES = (2.0, 1.5)  # cells along each edge, over those of the body: the first that is small enough
STEPS = 3  # of Newton's method from the solution on the mesh of the body


class Finer(NamedTuple):
    """A body on a finer mesh (a `forward.hyperelastic.Hyperelastic`).

    Attributes
    ----------
    spec, times
        The body there, and how many times the cells along each edge.
    seconds, bytes
        Of one solution with its estimate, and the memory.
    """

    spec: Any
    times: float
    seconds: float
    bytes: float


def own_estimate(spec: Any) -> Estimate:
    """Predict an estimate for a body, without what calibrates it."""
    found: Estimate = estimate(spec.body, spec.enriched().body, mixed=spec.mixed, symmetric=spec.symmetric)
    return found


def finer(spec: Any) -> Finer | None:
    """Return a body on a finer mesh; None where that takes too much."""
    formulation, left = "mixed" if spec.mixed else "displacement", MOST_BYTES - own_estimate(spec).bytes
    for times in TIMES:
        try:
            body = spec.body.refined(1) if times == 2.0 else spec.body.finer(times, (), 1.0, 1.0)
        except ValueError:  # it is divided already, or too large
            continue
        if times != 2.0 and body.cell_count >= 8 * spec.body.cell_count:
            continue  # cells of a file are divided into eight
        there = spec.model_copy(update={"body": body, "formulation": formulation, "adapt": None})
        cost, estimating = there.cost(factors=1), own_estimate(there)
        if there.unknowns <= MOST_UNKNOWNS and cost.bytes + estimating.bytes <= left:
            newton = STEPS * (cost.assembly + cost.factorisation + cost.substitution + 2 * cost.residual)
            seconds = cost.setup + newton + estimating.once + estimating.seconds
            return Finer(there, times, seconds, cost.bytes + estimating.bytes)
    return None
