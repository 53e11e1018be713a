"""Measures of a deformation from the displacement gradient, for UFL and a `forward.graph` alike."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

APART = 1e-6  # relative gap kept between principal strains
LEAST = 1e-20  # principal strains of a body without strain: far below what is computed, far above what underflows
SMALL = 0.1  # |z| below which artanh z − z is its series
TERMS = 7  # of the series: the relative truncation error is SMALL¹⁴/5


class Deformation(NamedTuple):
    """The parts of measures and stresses: polynomials of ∇u that vanish with it.

    With F = I + ∇u and C = FᵀF, none of them subtracts numbers near one: they keep their digits however small the
    strains are.

    Attributes
    ----------
    strain
        C − I = ∇u + ∇uᵀ + ∇uᵀ∇u, twice Green's strain.
    trace
        tr (C − I).
    deviator
        dev C.
    cofactor
        dev cof C = dev (C − I)² − (1 + tr (C − I)) dev C, by Cayley and Hamilton.
    dilation
        J − 1 = tr ∇u + ½ ((tr ∇u)² − tr (∇u)²) + det ∇u.
    """

    strain: Any
    trace: Any
    deviator: Any
    cofactor: Any
    dilation: Any


def deformation(ops: ModuleType | SimpleNamespace, gradient: Any, identity: Any) -> Deformation:
    """Return the parts of a deformation from its displacement gradient ∇u."""
    e = gradient + gradient.T + gradient.T * gradient
    square = e * e
    trace, divergence = ops.tr(e), ops.tr(gradient)
    deviator = e - trace / 3 * identity
    cofactor = square - ops.tr(square) / 3 * identity - (1 + trace) * deviator
    dilation = divergence + (divergence**2 - ops.tr(gradient * gradient)) / 2 + ops.det(gradient)
    return Deformation(e, trace, deviator, cofactor, dilation)


def measure(ops: ModuleType | SimpleNamespace, name: str, at: Deformation, fibres: Sequence[Any] = ()) -> Any:
    """Return a measure of a deformation by its name in `forward.materials.energies`; `fibres` are unit vectors.

    Raises
    ------
    ValueError
        For an unknown measure, or one that needs `principal_strains`.
    """
    match name:
        case "i1":
            square = ops.tr(at.deviator * at.deviator) / 2
            return excess(1 + at.trace / 3, square, ops.det(at.deviator), (1 + at.dilation) ** (2 / 3))
        case "i2":
            square = ops.tr(at.cofactor * at.cofactor) / 2
            mean = 1 + (2 * at.trace + (at.trace**2 - ops.tr(at.strain * at.strain)) / 2) / 3
            return excess(mean, square, ops.det(at.cofactor), (1 + at.dilation) ** (4 / 3))
        case "j":
            return at.dilation
        case "i4":
            return tuple(ops.inner(fibre, at.strain * fibre) for fibre in fibres)
        case "trace":
            return at.trace / 2
        case "square":
            return ops.tr(at.strain * at.strain) / 4
        case _:
            raise ValueError(f"no measure of a deformation: '{name}'")


def excess(mean: Any, square: Any, product: Any, root: Any) -> Any:
    """Return tr A / (det A)^⅓ − 3 of a symmetric positive A, with all its digits if A is nearly spherical.

    With m = tr A/3, D = dev A, q = D:D/2, r = det D and s = (det A)^⅓: det A = m³ − m q + r, and so
    3 m/s − 3 = 3 (m³ − s³) / (s (m² + m s + s²)) = 3 (m q − r) / (s (m² + m s + s²)).

    Parameters
    ----------
    mean, square, product, root
        m, q, r and s.
    """
    return 3 * (mean * square - product) / (root * (mean**2 + mean * root + root**2))


class Shape(NamedTuple):
    """Invariants of a change of shape: q² and θ of the eigenvalues of D = 3 dev C / tr C.

    With m = tr C/3, of which C has the eigenvalues m (1 + D_k), and r = det D/2,

        D_k = 2q cos(θ + 2πk/3),   q² = D:D/6,   θ = atan2(y, r)/3,   y = √(q⁶ − r²).

    Where two of them are equal they are not differentiable, though symmetric functions of them are. So q² is increased
    by (εq)² with ε = `APART`: the D_k stay apart by about εq and are differentiable everywhere; the parts of the
    derivatives that diverge for ε → 0 cancel in symmetric functions. The stress then has a relative error of order ε²,
    and the stiffness a relative rounding error of ε_machine/ε, if dθ is formed before it is multiplied with anything.
    In a body without strain, the D_k are of size `LEAST`. Source: O. K. Smith, Commun. ACM 4 (1961) 168.

    Where only the volume has changed, D consists of rounding errors, which need not have a trace of zero: r² > q⁶ then.
    So the trace is taken from D once more, and y² is what q² was increased by plus the positive part of q⁶ − r².

    Attributes
    ----------
    spread
        q².
    angle
        θ.
    slopes
        ∂/∂F of both by their names, from ∂(D:D)/∂F = 4/m F (D − D:D/3 I) and ∂r/∂F = F (dev D² − 2r I)/m;
        ∂θ = (r/(2q²) ∂q² − ∂r/3)/y.
    """

    spread: Any
    angle: Any
    slopes: dict[str, Any]


def shape(ops: ModuleType | SimpleNamespace, F: Any, at: Deformation, identity: Any) -> Shape:
    """Return the invariants of the change of shape of a deformation."""
    mean = 1 + at.trace / 3
    D = (at.deviator - ops.tr(at.deviator) / 3 * identity) / mean
    square, r = ops.tr(D * D), ops.det(D) / 2
    exact, more = square / 6, square / 6 * APART**2 + LEAST**2
    spread = exact + more
    y = ops.sqrt(more * (spread**2 + spread * exact + exact**2) + ops.positive(exact**3 - r**2))
    of_spread = 2 * (1 + APART**2) / (3 * mean) * F * (D - square / 3 * identity)
    of_r = F * (D * D - (square / 3 + 2 * r) * identity) / mean
    slopes = {"spread": of_spread, "angle": (r / (2 * spread) * of_spread - of_r / 3) / y}
    return Shape(spread, ops.atan2(y, r) / 3, slopes)


def principal_strains(ops: ModuleType | SimpleNamespace, spread: Any, angle: Any) -> tuple[Any, Any, Any]:
    """Eigenvalues of 3 dev C / tr C from q² and θ of a `Shape`."""
    q = ops.sqrt(spread)
    a, b, c = (2 * q * ops.cos(angle + 2 * math.pi * k / 3) for k in range(3))
    return a, b, c


def nominal_stress(
    ops: ModuleType | SimpleNamespace,
    F: Any,
    at: Deformation,
    slopes: Mapping[str, Any],
    fibres: Sequence[tuple[Any, Any]] = (),
) -> Any:
    """P = ∂W/∂F from the derivatives of W by its measures, in a form that keeps its digits for small strains.

    With W₁, W₂, W_J by Ī1, Ī2 and J: F⁻ᵀ (2 J^(−2/3) W₁ dev C − 2 J^(−4/3) W₂ dev cof C + J W_J I), since
    ∂Ī1/∂F = 2 J^(−2/3) (F − I1/3 F⁻ᵀ) and F = F⁻ᵀ C. By tr E and E:E it is F (W_tr I + 2 W_sq E), by I4 of fibres along
    a it is 2 W₄ F a ⊗ a.
    Source: G. A. Holzapfel, Nonlinear Solid Mechanics (2000), sections 6.2, 6.4 and 6.8.

    Parameters
    ----------
    slopes
        By the names of the measures (i4 apart) that W depends on.
    fibres
        Directions a of the families of fibres, each with its W₄.
    """
    J = 1 + at.dilation
    spatial = []
    if "i1" in slopes:
        spatial.append(2 * J ** (-2 / 3) * slopes["i1"] * at.deviator)
    if "i2" in slopes:
        spatial.append(-2 * J ** (-4 / 3) * slopes["i2"] * at.cofactor)
    inverse = ops.inv(F).T
    terms = [inverse * sum(spatial[1:], spatial[0])] if spatial else []
    if "j" in slopes:
        terms.append(slopes["j"] * J * inverse)
    if "trace" in slopes:
        terms.append(slopes["trace"] * F)
    if "square" in slopes:
        terms.append(slopes["square"] * F * at.strain)
    for direction, slope in fibres:
        terms.append(2 * slope * ops.outer(F * direction, direction))
    return sum(terms[1:], terms[0])


def von_mises(ops: ModuleType | SimpleNamespace, stress: Any, identity: Any) -> Any:
    """Von Mises stress √(3/2 s:s), with s the deviator of a symmetric `stress` in the current configuration.

    The tiny constant (Pa²) keeps the root differentiable in an unloaded body.
    """
    deviator = stress - ops.tr(stress) / 3 * identity
    return ops.sqrt(3 / 2 * ops.tr(deviator * deviator.T) + 1e-60)


# --- by principal stretches ------------------------------------------------------------------------------------------


def of_stretches(
    ops: Any, less_one: tuple[Any, Any, Any], dilation: Any, fibres: tuple[Any, ...] = ()
) -> dict[str, Any]:
    """Return all measures, by name, from the principal stretches less one, J − 1, and the I4 − 1 of fibres."""
    e = [h * (2 + h) for h in less_one]
    beside = [(e[1], e[2]), (e[2], e[0]), (e[0], e[1])]
    of_cofactor = [b + c + b * c for b, c in beside]
    found = {"j": dilation, "i4": fibres, "trace": sum(e) / 2, "square": sum(x**2 for x in e) / 4}
    for name, strains, root in (("i1", e, 2 / 3), ("i2", of_cofactor, 4 / 3)):
        mean = sum(strains) / 3
        a, b, c = (x - mean for x in strains)
        found[name] = excess(1 + mean, (a**2 + b**2 + c**2) / 2, a * b * c, (1 + dilation) ** root)
    found |= zip(("l1", "l2", "l3"), isochoric([ops.log1p(h) for h in less_one]), strict=True)
    return found


def isochoric(logarithms: Sequence[Any]) -> tuple[Any, Any, Any]:
    """Return what makes a change of shape of logarithms of principal stretches: these less their mean."""
    mean = sum(logarithms) / 3
    a, b, c = (logarithm - mean for logarithm in logarithms)
    return a, b, c


def dilation_of(less_one: tuple[Any, Any, Any]) -> Any:
    """J − 1 from the principal stretches less one."""
    a, b, c = less_one
    return a + b + c + a * b + b * c + c * a + a * b * c


# --- functions that keep their digits near zero ----------------------------------------------------------------------


def atanh_rest(ops: Any, z: Any) -> Any:
    """Return artanh z − z; near zero by its series, to 17 digits."""
    square = z * z
    series = 0.0
    for k in range(TERMS, 0, -1):
        series = 1 / (2 * k + 1) + square * series
    return ops.near(z, SMALL, z * square * series, ops.ln((1 + z) / (1 - z)) / 2 - z)


def log1p_of(ops: Any) -> Callable[[Any], Any]:
    """Return ln(1 + x) = 2 artanh(x/(2 + x)) in operators that lack it."""

    def log1p(x: Any) -> Any:
        z = x / (2 + x)
        return 2 * (z + atanh_rest(ops, z))

    return log1p


def expm1_of(ops: Any) -> Callable[[Any], Any]:
    """Return eˣ − 1 = 2 sinh(x/2) e^(x/2) in operators that lack it."""
    return lambda x: 2 * ops.sinh(x / 2) * ops.exp(x / 2)
