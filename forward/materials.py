"""Strain energies of hyperelastic materials: one plain function each.

A function takes the operators `ops` (``ln``, ``exp``, ``sqrt``), the invariants I1, I2 of C = FᵀF and J = det F, and
its constants as keyword-only arguments. UFL reads it for finite elements, SymPy for closed forms. The names of the
keyword-only arguments *are* the names of the parameters in studies and results, and their annotations are the
admissible values. All energies are in J/m³ and vanish, with their stress, in the undeformed body.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Annotated, Any, get_type_hints

from annotated_types import Ge, Gt

NonNegative = Annotated[Any, Ge(0)]
Positive = Annotated[Any, Gt(0)]


def mooney_rivlin(ops: Any, I1: Any, I2: Any, J: Any, *, C1: NonNegative, C2: NonNegative, D1: Positive) -> Any:
    """Compressible Mooney–Rivlin: W = C1(Ī1−3) + C2(Ī2−3) + D1(J−1)².

    Ī1 = J^(−2/3) I1, Ī2 = J^(−4/3) I2; C1, C2, D1 in Pa. Small strain: μ = 2(C1+C2), κ = 2 D1.
    Source: R. S. Rivlin, Phil. Trans. R. Soc. A 241 (1948) 379–397.
    """
    return C1 * (J ** (-2 / 3) * I1 - 3) + C2 * (J ** (-4 / 3) * I2 - 3) + D1 * (J - 1) ** 2


def neo_hookean(ops: Any, I1: Any, I2: Any, J: Any, *, C1: Positive, D1: Positive) -> Any:
    """Neo-Hookean with isochoric split: W = C1(Ī1−3) + D1(J−1)².

    C1, D1 in Pa. Small strain: μ = 2 C1, κ = 2 D1.
    """
    return C1 * (J ** (-2 / 3) * I1 - 3) + D1 * (J - 1) ** 2


def neo_hookean_coupled(ops: Any, I1: Any, I2: Any, J: Any, *, mu: Positive, lmbda: NonNegative) -> Any:
    """Coupled compressible neo-Hookean: W = μ/2 (I1−3) − μ ln J + λ/2 (ln J)².

    mu, lmbda: the Lamé constants in Pa.
    Source: J. Bonet, R. D. Wood, Nonlinear Continuum Mechanics for Finite Element Analysis (2008), eq. 6.27.
    """
    return mu / 2 * (I1 - 3) - mu * ops.ln(J) + lmbda / 2 * ops.ln(J) ** 2


Energy = Callable[..., Any]

MATERIALS: dict[str, Energy] = {
    "mooney-rivlin": mooney_rivlin,
    "neo-hookean": neo_hookean,
    "neo-hookean-coupled": neo_hookean_coupled,
}


def constants(energy: Energy) -> dict[str, Any]:
    """Return the names of the constants of an energy, each with its annotation (the admissible values)."""
    hints = get_type_hints(energy, include_extras=True)
    keyword_only = inspect.Parameter.KEYWORD_ONLY
    return {name: hints[name] for name, p in inspect.signature(energy).parameters.items() if p.kind is keyword_only}
