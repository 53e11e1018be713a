"""What an estimate of the error of a mesh takes, and which way of solving the enriched equations is the cheapest."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from forward.fem.cost import BYTES_PER_NONZERO, BYTES_PER_UNKNOWN, MOST_BYTES, Meshed, factor, times

BLOCKS = 9  # residuals, for the blocks of the nodes
ACTION = 2  # a product with the stiffness, over a residual
SMOOTHING, ROUGHLY = 12, 5  # steps in the enriched space, and solves with a factor of the body, of an estimate
SADDLES = 3  # times as many steps and solves with pressures, of two solutions
SEVERAL = 3  # estimates among which what comes once is shared, in a choice between ways
COPIES = 4  # of the matrix, while what preconditions steps is taken from it


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


def estimate(body: Meshed, enriched: Meshed, *, mixed: bool, symmetric: bool) -> Estimate:
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
