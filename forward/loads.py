"""What acts on a body: gravity, tractions, pressures and prescribed displacements, as specifications."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Ge
from pydantic import Field, model_validator

from forward.geometry import AXES, Axis, Vector
from forward.settings import Settings


class _Named(Settings):
    """Something that parameter paths refer to by its name (by default its kind)."""

    name: str = Field(default="", pattern=r"^[^.\s]*$")

    @property
    def label(self) -> str:
        """The name in parameter paths."""
        return self.name or str(getattr(self, "kind"))  # noqa: B009 - every subclass has a kind


def _unit_vector(vector: Vector) -> Vector:
    length = sum(x * x for x in vector) ** 0.5
    if length == 0:
        message = "direction has length zero, expected a vector such as [0, -1, 0]"
        raise ValueError(message)
    x, y, z = (c / length for c in vector)
    return x, y, z


class Gravity(_Named):
    """Weight of the body: density (kg/m³) × acceleration (m/s²) along `direction`, which is normalised."""

    kind: Literal["gravity"] = "gravity"
    direction: Vector = (0.0, 0.0, -1.0)
    density: Annotated[float, Ge(0)]
    acceleration: Annotated[float, Ge(0)] = 9.81

    @property
    def unit(self) -> Vector:
        """The direction, of length one."""
        return _unit_vector(self.direction)

    @model_validator(mode="after")
    def _check(self) -> Gravity:
        assert self.unit
        return self


class Traction(_Named):
    """Dead traction of `size` (Pa, per undeformed area) along `direction`, which is normalised, on a boundary."""

    kind: Literal["traction"] = "traction"
    on: str
    direction: Vector
    size: float

    @property
    def unit(self) -> Vector:
        """The direction, of length one."""
        return _unit_vector(self.direction)

    @model_validator(mode="after")
    def _check(self) -> Traction:
        assert self.unit
        return self


class Pressure(_Named):
    """Pressure of `size` (Pa) on a boundary, normal to the *deformed* surface and pushing inwards."""

    kind: Literal["pressure"] = "pressure"
    on: str
    size: float


Load = Annotated[Gravity | Traction | Pressure, Field(discriminator="kind")]
LOAD_SIZES = {"gravity": "density", "traction": "size", "pressure": "size"}


class Displacement(_Named):
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
