"""Models in Python for the studies of this folder: a slender cantilever, with its derivatives and without."""

from collections.abc import Sequence

SECOND_MOMENT = 0.02 * 0.01**3 / 12  # m⁴


def beam(p: Sequence[float]) -> list[float]:
    """Return tip deflection (m) and weight (N) for modulus (Pa), weight per length (N/m) and length (m)."""
    E, q, length = p
    return [q * length**4 / (8 * E * SECOND_MOMENT), q * length]


def slopes(p: Sequence[float]) -> list[list[float]]:
    """Return the derivatives (outputs, parameters)."""
    E, q, length = p
    tip = beam(p)[0]
    return [[-tip / E, tip / q, 4 * tip / length], [0.0, length, q]]


def stiff_beam(p: Sequence[float]) -> list[float]:
    """Return the same for a beam whose shear is not neglected: another model of the same measurements."""
    E, q, length = p
    tip, weight = beam(p)
    return [tip + 3 * q * length**2 / (2 * E * 0.02 * 0.01), weight]
