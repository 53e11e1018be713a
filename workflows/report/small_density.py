"""Small densities beside numbers: smooth ones of samples, and what a card draws of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from forward.readable import interval

if TYPE_CHECKING:
    from forward.model import FloatArray

CURVE = 48  # points
ALIKE = 1e-12  # standard deviation over the mean up to which values are the same


@dataclass(frozen=True)
class Curve:
    """A density: heights (n,) at equal distances, the ends of an interval as parts of its range, its ends in words."""

    heights: list[float]
    inside: tuple[float, float]
    ends: tuple[str, str]

    @property
    def path(self) -> str:
        """The curve as a path of SVG, 100 wide and 20 high."""
        top = max(self.heights, default=0.0) or 1.0
        step = 100 / max(len(self.heights) - 1, 1)
        points = "L".join(f"{step * k:.2f} {20 - 19 * y / top:.2f}" for k, y in enumerate(self.heights))
        return f"M0 20L{points}L100 20Z"


def curve_of(at: FloatArray, curve: FloatArray, inside: tuple[float, float], unit: str, value: float) -> Curve:
    """Return a density at places (m,) with the 95 % interval of a value."""
    low, high = min(float(at[0]), inside[0]), max(float(at[-1]), inside[1])
    if (low, high) != (float(at[0]), float(at[-1])):  # draws of weighted points may reach less far than their interval
        lattice = np.linspace(low, high, CURVE)
        at, curve = lattice, np.interp(lattice, at, curve, left=0.0, right=0.0)
    a, b = (float(np.clip((x - low) / ((high - low) or 1.0), 0, 1)) for x in inside)
    words = interval(low, high, unit, value)
    left, _, right = words.partition(" to " if " to " in words else "–")
    return Curve([float(y) for y in curve], (a, b), (left, right))


def smooth(values: FloatArray, weights: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
    """Return places (m,) and the density (m,) of samples (n,) there, with Gaussian kernels on a lattice."""
    weights = np.ones(len(values)) if weights is None else weights
    weights = weights / weights.sum()
    mean = weights @ values
    std = float(np.sqrt(weights @ (values - mean) ** 2))
    if std <= ALIKE * abs(mean):  # one value, but for rounding: it has a place, and no density
        std = abs(mean) or 1.0
    width = 1.06 * std * float(1 / (weights**2).sum()) ** -0.2
    low, high = max(values.min(), mean - 5 * std), min(values.max(), mean + 5 * std)
    at = np.linspace(low - width, high + width, CURVE)
    counts, edges = np.histogram(values, bins=400, range=(low, high), weights=weights)
    centres = (edges[1:] + edges[:-1]) / 2
    return at, np.exp(-0.5 * ((at[:, None] - centres) / width) ** 2) @ counts
