"""Tables in tables, as they are written: nothing is known of them yet, not even that they are tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

EACH = "*"  # every element of a list, on a way of keys


def at(table: Any, *way: str) -> Any:
    """Return what stands at a way of keys; None if nothing does."""
    for key in way:
        match table:
            case {**items}:
                table = items.get(key)
            case _:
                return None
    return table


def changed(table: Any, way: Sequence[str], change: Callable[[Any], Any]) -> Any:
    """Return a table in which what stands at a way of keys, if anything does, is changed."""
    if not way:
        return change(table)
    key, *rest = way
    match table:
        case [*members] if key == EACH:
            return [changed(one, rest, change) for one in members]
        case {**items} if key in items:
            return {**items, key: changed(items[key], rest, change)}
        case _:
            return table


def leaves(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Go through what is no table, with its place; lists are gone through where there are tables in them."""
    match value:
        case {**items}:
            parts = [(f"{place}.{key}" if place else str(key), item) for key, item in items.items()]
        case [*members] if any(isinstance(item, Mapping) for item in members):
            parts = [(f"{place}[{i}]", item) for i, item in enumerate(members)]
        case _:
            yield place, value
            return
    for where, part in parts:
        yield from leaves(part, where)


def deeper_than(tree: Any, most: int) -> bool:
    """Whether lists and tables are nested more deeply than this."""
    level = [tree]
    for _ in range(most):
        inside = (item for one in level for item in (one.values() if isinstance(one, dict) else one))
        level = [item for item in inside if isinstance(item, dict | list)]
    return bool(level)
