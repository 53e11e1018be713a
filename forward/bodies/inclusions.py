"""Regions that are stiffer or softer than the body around them, as specifications with their smooth indicators.

An indicator takes the operators `ops` (``tanh``, ``sqrt``, ``sin``, ``cos``), a place X and the numbers of its block,
as the energies in `materials` take their constants; it is 1 well inside, 0 well outside, and differentiable in all of
them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from types import SimpleNamespace
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Gt, Unit
from pydantic import Field

from forward.bodies.geometry import Body, Length
from forward.findings import Finding
from forward.model import FloatArray
from forward.readable import told
from forward.settings import Named, usually

TINY = 1e-12  # of the squared radius: keeps distances from the centre, and angles, differentiable at zero
BLEND = 0.1  # squared distance from the centre, over that of the surface, up to which an ellipsoid counts as a ball


class Sphere(Named):
    """A ball in which the energy density is multiplied by `contrast`.

    The factor on the energy is contrast^s with s = ½(1 − tanh((|X−c| − radius)/width)): softer and stiffer
    inclusions are treated alike, and the factors of overlapping inclusions multiply. If the transition is narrower
    than a cell, few quadrature points see it, and derivatives with respect to position and size become rough: choose
    `width` about the length of a cell.

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
    x: Annotated[float, Unit("m")]
    y: Annotated[float, Unit("m")]
    z: Annotated[float, Unit("m")]
    radius: Annotated[Length, Unit("m")]
    contrast: Annotated[float, Gt(0), Unit("1")]
    width: Annotated[Length, Unit("m")]


class Ellipsoid(Named):
    """An ellipsoid in which the energy density is multiplied by `contrast`, as in a `Sphere`.

    s = ½(1 − tanh(distance/width)) with a smooth function of position that is zero on the surface, has nearly the slope
    of the distance there, and is the distance if all radii are equal. Permuted radii and half turns give the same
    ellipsoid: choose priors that allow only one of these.

    Parameters
    ----------
    x, y, z
        Centre in the undeformed body (m).
    a, b, c
        Radii (m) along the axes of the ellipsoid, which without rotation are those of the body.
    turn_x, turn_y, turn_z
        Rotation vector (rad): the ellipsoid is turned about this direction, by an angle that is its length.
    contrast, width
        As for a sphere.
    """

    kind: Literal["ellipsoid"] = "ellipsoid"
    x: Annotated[float, Unit("m")]
    y: Annotated[float, Unit("m")]
    z: Annotated[float, Unit("m")]
    a: Annotated[Length, Unit("m")]
    b: Annotated[Length, Unit("m")]
    c: Annotated[Length, Unit("m")]
    turn_x: Annotated[float, Unit("rad")] = 0.0
    turn_y: Annotated[float, Unit("rad")] = 0.0
    turn_z: Annotated[float, Unit("rad")] = 0.0
    contrast: Annotated[float, Gt(0), Unit("1")]
    width: Annotated[Length, Unit("m")]


def _sphere(ops: Any, X: Any, *, x: Any, y: Any, z: Any, radius: Any, width: Any) -> Any:
    # The tiny sphere around the centre keeps the distance differentiable there.
    distance = ops.sqrt((X[0] - x) ** 2 + (X[1] - y) ** 2 + (X[2] - z) ** 2 + TINY * radius**2)
    return (1 - ops.tanh((distance - radius) / width)) / 2


def _ellipsoid(
    ops: Any,
    X: Any,
    *,
    x: Any,
    y: Any,
    z: Any,
    a: Any,
    b: Any,
    c: Any,
    turn_x: Any,
    turn_y: Any,
    turn_z: Any,
    width: Any,
) -> Any:
    along = _turned(ops, (X[0] - x, X[1] - y, X[2] - z), (-turn_x, -turn_y, -turn_z))
    square = sum((X_i / r) ** 2 for X_i, r in zip(along, (a, b, c), strict=True)) + TINY
    # With q² = square and slope = q|∇q|, (q − 1) q/slope is the distance to first order (G. Taubin, IEEE Trans. Pattern
    # Anal. 13 (1991) 1115–1138). At the centre q/slope depends on the direction: there it is blended with the mean.
    slope = sum((X_i / r**2) ** 2 for X_i, r in zip(along, (a, b, c), strict=True))
    distance = (ops.sqrt(square) - 1) * ops.sqrt((square + BLEND) / (slope + (BLEND + TINY) * 3 / (a**2 + b**2 + c**2)))
    return (1 - ops.tanh(distance / width)) / 2


def _turned(ops: Any, v: Any, t: Any) -> tuple[Any, Any, Any]:
    """Turn v by the rotation vector t: cos θ v + sin θ/θ t × v + (1 − cos θ)/θ² (t·v) t (O. Rodrigues, 1840)."""
    angle = ops.sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2 + TINY**2)
    cross = (t[1] * v[2] - t[2] * v[1], t[2] * v[0] - t[0] * v[2], t[0] * v[1] - t[1] * v[0])
    share = ops.sin(angle) / angle
    # 1 − cos θ = 2 sin²(θ/2), which keeps its digits where θ is small.
    part = 2 * (ops.sin(angle / 2) / angle) ** 2 * (t[0] * v[0] + t[1] * v[1] + t[2] * v[2])
    x, y, z = (ops.cos(angle) * v_i + share * w + part * t_i for v_i, w, t_i in zip(v, cross, t, strict=True))
    return x, y, z


Inclusion = Annotated[Sphere | Ellipsoid, Field(discriminator="kind"), usually("sphere")]
INDICATORS: dict[str, Callable[..., Any]] = {"sphere": _sphere, "ellipsoid": _ellipsoid}
RADII = {"sphere": ("radius", "radius", "radius"), "ellipsoid": ("a", "b", "c")}
OPS = SimpleNamespace(ln=np.log, exp=np.exp, sqrt=np.sqrt, tanh=np.tanh, sin=np.sin, cos=np.cos)


def stiffness_factor(ops: Any, X: Any, kind: str, *, contrast: Any, **shape: Any) -> Any:
    """contrast^s at X, with s the indicator of a kind of inclusion; `shape` holds the numbers of its block."""
    return ops.exp(INDICATORS[kind](ops, X, **shape) * ops.ln(contrast))


def too_narrow(body: Body, inclusions: Iterable[Inclusion]) -> Iterator[Finding]:
    """Find inclusions whose transition is below the size of a cell."""
    edge = body.longest_edge
    for inclusion in inclusions:
        if inclusion.width < edge:
            wide, cell = told(inclusion.width, "m", 6), told(edge, "m", 3)
            yield Finding("inclusion-narrow", "warning", {"label": inclusion.label, "wide": wide, "cell": cell})


# --- what follows from the numbers -----------------------------------------------------------------------------------


def derived(
    inclusions: Sequence[Sphere | Ellipsoid], parameters: Sequence[str], points: FloatArray
) -> dict[str, FloatArray]:
    """Return what follows from the numbers of inclusions at many parameter vectors, by path.

    Parameters
    ----------
    inclusions
        Those of a body.
    parameters
        Paths of the parameters; numbers of the inclusions that are not among them keep their values.
    points
        Parameters (n, d).

    Returns
    -------
    dict
        "inclusions.NAME.volume" (m³) of where the indicator is above ½: 4/3 π abc (n,).
    """
    found: dict[str, FloatArray] = {}
    for inclusion in inclusions:
        numbers = _numbers(inclusion, parameters, points)
        radii = [np.broadcast_to(numbers[r], (len(points), 1)) for r in RADII[inclusion.kind]]
        found[f"inclusions.{inclusion.label}.volume"] = (4 / 3 * np.pi * np.prod(radii, 0))[:, 0]
    return found


def log_factor(
    inclusions: Sequence[Sphere | Ellipsoid], parameters: Sequence[str], points: FloatArray, places: FloatArray
) -> FloatArray:
    """Return ln of what inclusions multiply the stiffness by (n, k) at places (k, 3) (m); arguments as in `derived`."""
    factor = np.ones((len(points), len(places)))
    for inclusion in inclusions:
        numbers = _numbers(inclusion, parameters, points)
        factor = factor * stiffness_factor(OPS, places.T, inclusion.kind, **numbers)
    return np.asarray(np.log(factor))


def _numbers(inclusion: Sphere | Ellipsoid, parameters: Sequence[str], points: FloatArray) -> dict[str, Any]:
    """Return the numbers of an inclusion by name: columns (n, 1) of the points where they are parameters."""
    path = f"inclusions.{inclusion.label}"
    return {
        name: points[:, [parameters.index(f"{path}.{name}")]] if f"{path}.{name}" in parameters else value
        for name, value in inclusion.model_dump(exclude={"kind", "name"}).items()
    }
