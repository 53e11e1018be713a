"""What acts on a body: gravity, tractions, pressures and prescribed displacements, as specifications."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from annotated_types import Ge
from pydantic import Field, field_validator, model_validator

from forward.bodies.geometry import AXES, Axis, Vector
from forward.settings import Named


class _Directed(Named):
    """A load along a direction, which is normalised."""

    direction: Vector

    @property
    def unit(self) -> Vector:
        """The direction, of length one."""
        x, y, z = self.direction
        length = math.sqrt(x * x + y * y + z * z)
        return x / length, y / length, z / length

    @field_validator("direction")
    @classmethod
    def _has_length(cls, direction: Vector) -> Vector:
        if not any(direction):
            message = "has length zero, expected a vector such as [0, -1, 0]"
            raise ValueError(message)
        return direction


class Gravity(_Directed):
    """Weight of the body: density (kg/m³) × acceleration (m/s²) along `direction`."""

    kind: Literal["gravity"] = "gravity"
    direction: Vector = (0.0, 0.0, -1.0)
    density: Annotated[float, Ge(0)]
    acceleration: Annotated[float, Ge(0)] = 9.81


class Traction(_Directed):
    """Dead traction of `size` (Pa, per undeformed area) along `direction` on a boundary."""

    kind: Literal["traction"] = "traction"
    on: str
    size: float


class Pressure(Named):
    """Pressure of `size` (Pa) on a boundary, normal to the *deformed* surface and pushing inwards."""

    kind: Literal["pressure"] = "pressure"
    on: str
    size: float


Load = Annotated[Gravity | Traction | Pressure, Field(discriminator="kind")]
LOAD_SIZES = {"gravity": "density", "traction": "size", "pressure": "size"}


class Displacement(Named):
    """Displacement (m) prescribed on a boundary, component by component; components left out are free."""

    on: str
    x: float | None = None
    y: float | None = None
    z: float | None = None

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
