"""Change of volume."""

from __future__ import annotations

from typing import ClassVar, Literal

from forward.observables.observable import Equations, Functional, Observable


class VolumeChange(Observable):
    """Relative change of volume ∫(J−1) dX / ∫dX (dimensionless)."""

    kind: Literal["volume-change"] = "volume-change"
    unit: ClassVar[str] = "1"

    def functional(self, equations: Equations) -> Functional:
        """Prepare the evaluation."""
        from forward.observables.functionals import Integral

        return Integral(equations, equations.dilation, equations.volume)
