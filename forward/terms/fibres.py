"""Fibres of any direction through a whole body, as a term of its energy that is linear in what describes them."""

from __future__ import annotations

from itertools import combinations_with_replacement
from typing import Annotated, Any

import numpy as np
from annotated_types import Unit
from pydantic import create_model

from forward.bodies.geometry import AXES
from forward.model import FloatArray
from forward.terms.term import Place, Term

PAIRS = list(combinations_with_replacement(range(3), 2))
QUARTICS = [f"{'x' * p}{'y' * q}{'z' * (4 - p - q)}" for p in range(5) for q in range(5 - p)]
"""Names of the 15 numbers that fibres are described by."""


class _Fibres(Term):
    """Fibres that carry tension and compression: ½ ∫ Σ_f k_f (a_f·E a_f)² dX, E = (C − I)/2.

    A fibre stretched by 1 + e has the tension k e to first order. All families together are the fourth-order tensor
    Σ k a⊗a⊗a⊗a, which is symmetric in all of its indices: its 15 components are the numbers of this load.
    """

    kind: str = "fibres"

    def potential(self, at: Place) -> Any:
        """Return its energy (J)."""
        C = at.F.T * at.F
        # Components of E, those off the diagonal twice, with the two axes of each.
        strains = [(C[a, a] - 1) / 2 if a == b else C[a, b] for a, b in PAIRS]
        named = [[at.numbers["".join(sorted(AXES[i] for i in (*one, *other)))] for other in PAIRS] for one in PAIRS]
        stresses = [sum(k * e for k, e in zip(row, strains, strict=True)) for row in named]
        return sum(s * e for s, e in zip(stresses, strains, strict=True)) / 2 * at.dx


_NUMBERS: dict[str, Any] = {name: (Annotated[float, Unit("Pa")], 0.0) for name in QUARTICS}
Fibres: type[Term] = create_model("Fibres", __base__=_Fibres, **_NUMBERS)


def quartics(direction: FloatArray) -> FloatArray:
    """Return the numbers (15,) of fibres along a unit vector (3,), of modulus one."""
    return np.array([np.prod([direction[AXES.index(axis)] for axis in name]) for name in QUARTICS])
