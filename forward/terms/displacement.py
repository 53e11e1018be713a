"""Displacements that are prescribed on a boundary; and what has a list in place of a number, for several steps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from annotated_types import Unit
from pydantic import model_validator

from forward.bodies.geometry import AXES, Axis, Body
from forward.findings import Finding
from forward.readable import told
from forward.registry import KindError
from forward.scalars import numbers
from forward.settings import Named
from forward.terms.term import LOADS

Block = Literal["loads", "displacements"]


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
            raise ValueError("prescribes nothing, expected at least one of x, y, z")
        return self


def too_far(body: Body, ranges: Mapping[str, tuple[float, float]]) -> Iterator[Finding]:
    """Find prescribed displacements, among numbers and their ranges by path, that are larger than the body."""
    extent = max(high - low for low, high in body.bounds)
    for path, ends in ranges.items():
        largest = max(ends, key=abs)
        if path.startswith("displacements.") and abs(largest) > extent:
            far, long = told(largest, "m", 3), told(extent, "m", 3)
            yield Finding("displacement-far", "warning", {"path": path, "far": far, "long": long})


def lists(block: Block, item: Any) -> dict[str, Any]:
    """Return the numbers of an item of a block, as it was written, that are lists, by the names of its fields."""
    if not isinstance(item, Mapping):
        return {}
    names: tuple[str, ...] = AXES if block == "displacements" else ()
    if block == "loads":
        try:
            names = numbers(LOADS[item.get("kind", "")])
        except (KindError, TypeError):
            return {}
    return {name: item[name] for name in names if isinstance(item.get(name), list | tuple) and item[name]}


def label(block: Block, item: Mapping[str, Any]) -> str:
    """Return the name of an item of a block in parameter paths."""
    known: Any = Displacement if block == "displacements" else LOADS[item["kind"]]
    return str(known.model_construct(**{key: item[key] for key in ("name", "kind", "on") if key in item}).label)
