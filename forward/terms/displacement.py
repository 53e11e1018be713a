"""Displacements that are prescribed on a boundary."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Unit
from pydantic import model_validator

from forward.bodies.geometry import AXES, Axis
from forward.settings import Named


class Displacement(Named):
    """Displacement (m) prescribed on a boundary, component by component; components left out are free."""

    on: str
    x: Annotated[float | None, Unit("m")] = None
    y: Annotated[float | None, Unit("m")] = None
    z: Annotated[float | None, Unit("m")] = None

    @property
    def label(self) -> str:
        """The name in parameter paths: by default the boundary."""
        return self.name or self.on

    @property
    def components(self) -> dict[Axis, float]:
        """The prescribed components."""
        values = {axis: getattr(self, axis) for axis in AXES}
        return {axis: value for axis, value in values.items() if value is not None}

    @model_validator(mode="after")
    def _check(self) -> Displacement:
        if not self.components:
            message = "prescribes nothing, expected at least one of x, y, z"
            raise ValueError(message)
        return self
