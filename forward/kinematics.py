"""Measures of a deformation from the displacement gradient, for UFL and SymPy alike."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import ModuleType, SimpleNamespace
from typing import Any

APART = 1e-6  # gap that principal stretches keep, as a part of their size


def deformation_gradient(gradient: Any, identity: Any) -> Any:
    """F = I + ∇u."""
    return identity + gradient


def invariants(ops: ModuleType | SimpleNamespace, F: Any) -> tuple[Any, Any, Any]:
    """I1 = tr C, I2 = ½(I1² − tr C²) and J = det F, with C = FᵀF."""
    C = F.T * F
    I1 = ops.tr(C)
    return I1, (I1**2 - ops.tr(C * C)) / 2, ops.det(F)


def principal_stretches(ops: ModuleType | SimpleNamespace, F: Any, identity: Any) -> tuple[Any, Any, Any]:
    """Principal stretches √c_k of F, from the trigonometric solution of the characteristic cubic of C = FᵀF.

    With m = tr C/3, s = C − mI, q² = s:s/6 and r = det s/2,

        c_k = m + 2q cos(θ + 2πk/3),   θ = atan2(√(q⁶ − r²), r)/3.

    Where two or three c_k are equal they have no derivatives, though symmetric functions of them do. So q² is made
    larger by (εm)² with ε = `APART`: the c_k stay apart by about εm and have derivatives everywhere, of which what is
    infinite for ε → 0 cancels in symmetric functions. Of an energy, the stress is wrong by a part of the order ε², and
    ε_machine/ε of its stiffness is rounding.
    Source: O. K. Smith, Commun. ACM 4 (1961) 168.
    """
    C = F.T * F
    m = ops.tr(C) / 3
    s = C - m * identity
    square = ops.tr(s * s) / 6 + (APART * m) ** 2
    r = ops.det(s) / 2
    angle = ops.atan2(ops.sqrt(square**3 - r**2), r) / 3
    q = ops.sqrt(square)
    a, b, c = (ops.sqrt(m + 2 * q * ops.cos(angle + 2 * math.pi * k / 3)) for k in range(3))
    return a, b, c


def fibre_stretch(ops: ModuleType | SimpleNamespace, F: Any, direction: Any) -> Any:
    """I4 = a·C a, the squared stretch of fibres along a unit vector a in the undeformed body."""
    return ops.inner(F * direction, F * direction)


def nominal_stress(
    ops: ModuleType | SimpleNamespace,
    F: Any,
    slopes: tuple[Any, Any, Any],
    fibres: Sequence[tuple[Any, Any]] = (),
) -> Any:
    """P = ∂W/∂F = 2 W₁ F + 2 W₂ (I1 F − F C) + W_J J F⁻ᵀ + Σ 2 W₄ F a ⊗ a, from the slopes of W(I1, I2, J, I4).

    Compiled, it takes two thirds of the time of the derivative that UFL finds by itself.
    Source: G. A. Holzapfel, Nonlinear Solid Mechanics (2000), sections 6.2 and 6.8.

    Parameters
    ----------
    slopes
        W₁, W₂ and W_J.
    fibres
        Directions a of the families of fibres, each with its W₄.
    """
    of_I1, of_I2, of_J = slopes
    C = F.T * F
    P = 2 * of_I1 * F + 2 * of_I2 * (ops.tr(C) * F - F * C) + of_J * ops.det(F) * ops.inv(F).T
    for direction, of_I4 in fibres:
        P += 2 * of_I4 * ops.outer(F * direction, direction)
    return P


def von_mises(ops: ModuleType | SimpleNamespace, stress: Any, identity: Any) -> Any:
    """Von Mises stress √(3/2 s:s), with s the deviator of a symmetric `stress` in the current configuration.

    The tiny constant keeps the root differentiable in an unloaded body.
    """
    deviator = stress - ops.tr(stress) / 3 * identity
    return ops.sqrt(3 / 2 * ops.tr(deviator * deviator.T) + 1e-30)
