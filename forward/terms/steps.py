"""Loads and prescribed displacements with a list in place of a number: values for several steps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from forward.bodies.geometry import AXES
from forward.registry import KindError
from forward.scalars import numbers
from forward.terms.displacement import Displacement
from forward.terms.term import LOADS

Block = Literal["loads", "displacements"]


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
