"""What is asked of a deformed body, as specifications; their evaluation is in `functionals`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from forward.bodies.geometry import Axis, Vector
from forward.settings import Settings


class _Output(Settings):
    name: str = Field(min_length=1)

    @property
    def unit(self) -> str:
        """SI unit of the value."""
        return "m"


class MaxDisplacement(_Output):
    """Largest |u_c| over the nodes (m), or largest |u| where `component` is "magnitude".

    Differentiable where the node that attains it is unique; derivatives are those at that node.
    """

    kind: Literal["max-displacement"] = "max-displacement"
    component: Literal["x", "y", "z", "magnitude"] = "magnitude"


class PointDisplacement(_Output):
    """Displacement component (m) at a point of the undeformed body (m)."""

    kind: Literal["displacement"] = "displacement"
    at: Vector
    component: Axis


class MeanDisplacement(_Output):
    """Mean of a displacement component (m) over a boundary."""

    kind: Literal["mean-displacement"] = "mean-displacement"
    on: str
    component: Axis


class Reaction(_Output):
    """Force component (N) that holds a boundary: the sum of the nodal reactions where it is clamped or moved."""

    kind: Literal["reaction"] = "reaction"
    on: str
    component: Axis

    @property
    def unit(self) -> str:
        """SI unit of the value."""
        return "N"


class StrainEnergy(_Output):
    """Stored energy ∫W dX (J)."""

    kind: Literal["strain-energy"] = "strain-energy"

    @property
    def unit(self) -> str:
        """SI unit of the value."""
        return "J"


class VolumeChange(_Output):
    """Relative change of volume ∫(J−1) dX / ∫dX (dimensionless)."""

    kind: Literal["volume-change"] = "volume-change"

    @property
    def unit(self) -> str:
        """SI unit of the value."""
        return "1"


class MaxVonMises(_Output):
    """Largest von Mises stress (Pa, Cauchy) over the quadrature points; derivatives are those at that point."""

    kind: Literal["max-von-mises"] = "max-von-mises"

    @property
    def unit(self) -> str:
        """SI unit of the value."""
        return "Pa"


Output = Annotated[
    MaxDisplacement | PointDisplacement | MeanDisplacement | Reaction | StrainEnergy | VolumeChange | MaxVonMises,
    Field(discriminator="kind"),
]
