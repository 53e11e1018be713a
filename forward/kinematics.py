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


def von_mises(ops: ModuleType | SimpleNamespace, stress: Any, identity: Any) -> Any:
    """Von Mises stress √(3/2 s:s), with s the deviator of a symmetric `stress` in the current configuration.

    The tiny constant keeps the root differentiable in an unloaded body.
    """
    deviator = stress - ops.tr(stress) / 3 * identity
    return ops.sqrt(3 / 2 * ops.tr(deviator * deviator.T) + 1e-30)
