"""Stored energy."""

from __future__ import annotations

from typing import ClassVar, Literal

from forward.observables.observable import Equations, Functional, Observable


class StrainEnergy(Observable):
    """Stored energy ∫W dX (J)."""

    kind: Literal["strain-energy"] = "strain-energy"
    unit: ClassVar[str] = "J"

    def functional(self, equations: Equations) -> Functional:
        """Prepare the evaluation."""
        from forward.observables.functionals import Integral

        return Integral(equations, equations.stored_energy)
