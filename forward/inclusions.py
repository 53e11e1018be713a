"""Regions that are stiffer or softer than the body around them, as specifications with their smooth indicators.

An indicator takes the operators `ops` (``tanh``, ``sqrt``), a place X and the numbers of its block, as the energies in
`materials` take their constants; it is 1 well inside, 0 well outside, and differentiable in all of them.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from annotated_types import Gt

from forward.geometry import Axis, Length
from forward.settings import Named


class Sphere(Named):
    """A ball in which the energy density is multiplied by `contrast`.

    The factor on the energy is contrast^s with s = ½(1 − tanh((|X−c| − radius)/width)): softer and stiffer
    inclusions are treated alike, and the factors of inclusions that overlap multiply. A transition that is narrower
    than a cell is seen by few quadrature points, and derivatives with respect to place and size become rough: let
    `width` be about the length of a cell.

    Parameters
    ----------
    x, y, z
        Centre c in the undeformed body (m).
    radius
        Where the indicator s is ½ (m).
    contrast
        Stiffness inside divided by that outside (1).
    width
        Half-width of the transition (m): s falls from 0.88 to 0.12 between radius − width and radius + width.
    """

    kind: Literal["sphere"] = "sphere"
    x: float
    y: float
    z: float
    radius: Length
    contrast: Annotated[float, Gt(0)]
    width: Length

    @property
    def centre(self) -> dict[Axis, float]:
        """The centre by component (m)."""
        return {"x": self.x, "y": self.y, "z": self.z}


def _sphere(ops: Any, X: Any, *, x: Any, y: Any, z: Any, radius: Any, width: Any) -> Any:
    # The tiny sphere around the centre keeps the distance differentiable there.
    distance = ops.sqrt((X[0] - x) ** 2 + (X[1] - y) ** 2 + (X[2] - z) ** 2 + 1e-12 * radius**2)
    return (1 - ops.tanh((distance - radius) / width)) / 2


Inclusion = Sphere
INDICATORS = {"sphere": _sphere}


def stiffness_factor(ops: Any, X: Any, kind: str, *, contrast: Any, **shape: Any) -> Any:
    """contrast^s at X, with s the indicator of a kind of inclusion; `shape` holds the numbers of its block."""
    return ops.exp(INDICATORS[kind](ops, X, **shape) * ops.ln(contrast))
