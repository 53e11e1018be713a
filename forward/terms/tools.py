"""Rigid tools: how far a point is from their surface, and the pressure with which they resist it.

Distances are written once, for numbers (NumPy) and for forms (UFL). A tool points along a unit vector d; a point x is
seen from its tip q by t = (x − q)·d, positive ahead of the tip, and by its distance across from the axis through it.
Distances are positive outside the tool, which goes on behind its tip: a sphere is the end of a rod as thick as itself.
Surfaces have a continuous curvature wherever they touch, or else forces would have kinks where points pass from the
face of a punch to its edge.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

TINY = 1e-8  # of a length, which keeps slopes of roots finite
NUMPY = SimpleNamespace(
    sqrt=np.sqrt,
    sin=np.sin,
    cos=np.cos,
    positive=lambda x: np.maximum(x, 0.0),
    choose=lambda z, positive, negative: np.where(z > 0, positive, negative),
)


class Touch(NamedTuple):
    """How a tool resists penetration, in UFL: a gap (m), and pressure per penetration (Pa/m) where it closes.

    Contact sets in over a `width` of gaps (m).
    """

    gap: Any
    stiffness: Any
    width: Any


class Rub(NamedTuple):
    """How a tool rubs, in UFL.

    Attributes
    ----------
    limit
        Largest traction μp (Pa).
    slip
        What the body has slid along the tool in the increment (m): a vector.
    width
        Slip (m) over which the traction grows.
    normal
        Unit normal of the tool.
    """

    limit: Any
    slip: Any
    width: Any
    normal: Any

    @property
    def length(self) -> Any:
        """√(|slip|² + width²) (m)."""
        import ufl

        return ufl.sqrt(ufl.dot(self.slip, self.slip) + self.width**2)

    @property
    def traction(self) -> Any:
        """Traction (Pa) on the tool: μp along the slip, less where this is not large against its width."""
        return self.limit * self.slip / self.length

    def along(self, v: Any) -> Any:
        """Return the part of a vector along the surface of the tool."""
        import ufl

        return v - ufl.dot(v, self.normal) * self.normal


def distance(ops: Any, shape: str, t: Any, across: Any, numbers: Mapping[str, Any]) -> Any:
    """Return the signed distance (m) of a point from a tool.

    Parameters
    ----------
    ops
        Functions for numbers (`NUMPY`) or forms.
    shape
        As of an `Indenter`.
    t
        Distance (m) ahead of the tip.
    across
        Square (m²) of the distance from the axis; for a cylinder, from the plane through its own axis and d.
    numbers
        radius and edge, or angle (radians) and tip.
    """
    match shape:
        case "plane":
            return t
        case "sphere" | "cylinder":
            radius = numbers["radius"]
            beyond = across + t**2 + 2 * radius * t  # |x − centre|² − R², without cancellation
            ball = beyond / (ops.sqrt(beyond + (1 + TINY**2) * radius**2) + radius)
            return ops.choose(t + radius, ball, ops.sqrt(across + (TINY * radius) ** 2) - radius)
        case "flat":
            radius, edge = numbers["radius"], numbers["edge"]
            out = ops.sqrt(across + (TINY * radius) ** 2) - (radius - edge)
            ahead = t + edge
            # The third power keeps the curvature continuous where the edge begins; within 12 % of a distance there.
            corner = (ops.positive(out) ** 3 + ops.positive(ahead) ** 3 + (TINY * edge) ** 3) ** (1 / 3)
            return corner - ops.positive(-(ahead + ops.positive(out - ahead))) - edge
        case "cone":  # a hyperboloid, whose sides tend to those of a cone
            sine, cotangent = ops.sin(numbers["angle"]), ops.cos(numbers["angle"]) / ops.sin(numbers["angle"])
            ahead = numbers["tip"] * cotangent**2  # of its apex
            return sine * (t - ahead + ops.sqrt(across * cotangent**2 + ahead**2))
        case _:
            raise ValueError(f"no tool is shaped like '{shape}'")


def energy(ops: Any, gap: Any, stiffness: float, width: float) -> Any:
    """Return the contact energy (J/m²) whose negative derivative by the gap is `pressure`."""
    near = width / 2 - gap
    return stiffness / (6 * width) * (ops.positive(near) ** 3 - ops.positive(near - width) ** 3)


def pressure(ops: Any, gap: Any, stiffness: float, width: float) -> Any:
    """Return the contact pressure (Pa): stiffness × penetration, smooth where |gap| < width/2, 0 beyond.

    Its derivative is continuous, so that forces, and what follows from them, are differentiable.
    """
    near = width / 2 - gap
    return stiffness / (2 * width) * (ops.positive(near) ** 2 - ops.positive(near - width) ** 2)


def contact(ops: Any, gap: Any, width: float) -> Any:
    """Return 1 in contact and 0 outside, continuous: the derivative of the pressure relative to its stiffness."""
    near = width / 2 - gap
    return (ops.positive(near) - ops.positive(near - width)) / width


def dot(a: Any, b: Any) -> Any:
    """Return the inner product of two vectors of numbers or forms."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Any, b: Any) -> tuple[Any, Any, Any]:
    """Return the vector product of two."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
