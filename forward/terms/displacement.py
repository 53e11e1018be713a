"""Displacements that are prescribed on a boundary, and with them what holds a body.

That says whether it can move freely, and whether loads can do what they say. Numbers of loads and displacements may be
lists, for several steps.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Unit
from pydantic import model_validator

from forward.bodies.geometry import AXES, Axis, Body, Vector, unit_vector
from forward.findings import Finding
from forward.readable import told
from forward.registry import KindError
from forward.scalars import Mistake, Scalar, numbers
from forward.settings import Named
from forward.terms.term import LOADS, Load

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

    @property
    def scalars(self) -> dict[str, Scalar]:
        """Its numbers by name."""
        return {axis: Scalar(value, Displacement, axis) for axis, value in self.components.items()}

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


@dataclass(frozen=True)
class Support:
    """Clamps, prescribed displacements and loads of a body; arguments as in `forward.hyperelastic.Hyperelastic`."""

    body: Body
    clamp: tuple[str, ...]
    displacements: tuple[Displacement, ...]
    loads: tuple[Load, ...]

    def contradictions(self) -> Iterator[Mistake]:
        """Find boundaries that are both clamped and moved, and components that are prescribed twice."""
        times = Counter((item.on, axis) for item in self.displacements for axis in item.components)
        for i, item in enumerate(self.displacements):
            twice = [axis for axis in item.components if times[item.on, axis] > 1]
            if item.on in self.clamp:
                yield ("displacements", i, "on"), "this boundary is clamped, expected one that is not", item.on
            elif twice:
                message = f"{', '.join(twice)} prescribed more than once on this boundary"
                yield ("displacements", i, "on"), message, item.on

    def mistakes(self, *, complete: bool) -> Iterator[Mistake]:
        """Find loads that cannot act on the body, and that it can move freely.

        It is `complete` if all boundaries that are named exist: otherwise one of them may hold the body.
        """
        moved = any(value for item in self.displacements for value in item.components.values())
        alone = not moved and len(self.loads) == 1
        for i, load in self._on_boundaries:
            for field, said, given in load.mistakes(self.body, alone=alone):
                yield ("loads", i, field), said, given
            if load.contact and not self._gives_way(load):
                message = "this boundary is held where the tool presses on it, expected one that can move"
                yield ("loads", i, "on"), message, load.on
        if free := self._free:
            message = f"nothing holds the body along {', '.join(free)}, expected a clamp or prescribed displacements"
            yield ("clamp",), message, ()
        elif complete and not self._held_against_turning():
            message = "nothing stops the body from turning, expected a clamp or more prescribed displacements"
            yield ("displacements",), message, ()

    @property
    def _on_boundaries(self) -> list[tuple[int, Any]]:
        """Loads that act on a boundary of the body, or on none, with their numbers."""
        known = {None, *self.body.boundaries}
        return [one for one in enumerate(self.loads) if getattr(one[1], "on", None) in known]

    def _gives_way(self, tool: Any) -> bool:
        """Whether the boundary that a tool may touch can move along its direction."""
        held = {axis for item in self.displacements if item.on == tool.on for axis in item.components}
        free = [d for d, axis in zip(unit_vector(tool.direction), "xyz", strict=True) if axis not in held]
        return tool.on not in self.clamp and any(free)

    @cached_property
    def _touched(self) -> list[tuple[Vector, Vector]]:
        """Points (m) of the body and the directions in which tools hold them against what presses them there."""
        found = [one for _, load in self._on_boundaries for one in load.holds(self.body)]
        pressed = any(not load.contact for load in self.loads)
        return [one for one in found if pressed or any(np.dot(one[1], other) < 0 for _, other in found)]

    @property
    def _prescribed(self) -> list[tuple[str, Axis]]:
        """Boundaries with the axes along which they are held or moved."""
        moved = [(item.on, axis) for item in self.displacements for axis in item.components]
        return [(on, axis) for on in self.clamp for axis in AXES] + moved

    @property
    def _free(self) -> list[str]:
        """Axes along which nothing holds the body."""
        units = dict(zip(AXES, np.eye(3), strict=True))
        held = [np.zeros(3), *(units[axis] for _, axis in self._prescribed), *(along for _, along in self._touched)]
        rank = np.linalg.matrix_rank(held)
        return [axis for axis in AXES if np.linalg.matrix_rank([*held, units[axis]]) > rank]

    def _held_against_turning(self) -> bool:
        """Whether each of the 6 small rigid motions t + r × x moves something that is held."""
        extent = np.ptp(self.body.vertices, axis=0).max()
        middle = np.mean(self.body.vertices, axis=0)
        units = np.eye(3)
        held = [(p, units[AXES.index(axis)]) for on, axis in self._prescribed for p in self.body.corners_of(on)]
        rows = [  # the part of t + r × x along a direction e: t·e + r·(x × e)
            np.concatenate([direction, np.cross(np.subtract(place, middle), direction) / extent])
            for place, direction in [*held, *self._touched]
        ]
        return int(np.linalg.matrix_rank(rows)) == 6
