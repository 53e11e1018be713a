"""Models of the cases: the borehole of Worley (1987), an oscillation after Genz (1984) and a rare event."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

WAVES = np.array([9.0, 7.25, 1.85, 7.03])


def borehole(p: NDArray[np.complex128]) -> list[complex]:
    """Flow (m³/yr) through a borehole."""
    rw, r, Tu, Hu, Tl, Hl, L, Kw = p
    ratio = np.log(r / rw)
    return [2 * np.pi * Tu * (Hu - Hl) / ratio / (1 + Tu / Tl + 2 * L * Tu / (ratio * Kw * rw**2))]


def borehole_jacobian(p: ArrayLike) -> list[list[float]]:
    """Its derivatives, by complex steps."""
    step = 1e-30
    return [[(borehole(row)[0] / step).imag for row in np.asarray(p) + 1j * step * np.eye(8)]]


def oscillation(p: ArrayLike) -> float:
    """More waves than a few dozen samples show."""
    return float(np.cos(0.6 * np.pi + WAVES @ np.asarray(p)))


def late(p: ArrayLike) -> float:
    """A line that is twice as steep beyond two deviations, as where a contact begins."""
    z = float(np.asarray(p)[0])
    return z + max(z - 2, 0.0)


def event(p: ArrayLike) -> float:
    """What happens with probability 0.03: z above its quantile of 97 %."""
    return float(np.asarray(p)[0] > 1.8807936)
