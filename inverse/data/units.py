"""Units in the heads of tables: ``force [mN]``, ``depth (mm)``."""

from __future__ import annotations

import re

PREFIXES = {
    "": 1.0,
    "n": 1e-9,
    "u": 1e-6,
    "µ": 1e-6,
    "μ": 1e-6,
    "m": 1e-3,
    "c": 1e-2,
    "d": 1e-1,
    "k": 1e3,
    "M": 1e6,
    "G": 1e9,
}
_HEAD = re.compile(r"(?P<name>[^\[\]()]*[^\[\]()\s])\s*[\[(](?P<unit>[^\[\]()]*)[\])]$")
_POWERS = {"²": 2, "^2": 2, "2": 2, "³": 3, "^3": 3, "3": 3}


def split_head(head: str) -> tuple[str, str | None]:
    """Return the name of a column and its unit; None where the head states none."""
    found = _HEAD.match(head.strip())
    return (head, None) if found is None else (found["name"], found["unit"].strip())


def factor(unit: str, si: str) -> float:
    """Return how many of an SI unit (m, N, Pa, J, m³, 1) a unit is: 1e-3 for mm and m.

    Raises `ValueError` if it is none of that quantity; the message says what is expected.
    """
    base, power = _powered(si)
    given, given_power = _powered(unit)
    if si == "1" and unit in {"", "1", "-", "%"}:
        return 0.01 if unit == "%" else 1.0
    prefix = given.removesuffix(base)
    if given_power != power or not given.endswith(base) or prefix not in PREFIXES or base == "1":
        examples = {"m": "m, mm or µm", "N": "N, mN or µN", "Pa": "Pa or kPa", "J": "J or mJ", "1": "1 or %"}
        raise ValueError(f"the unit '{unit}', expected {examples.get(si, si)}")
    scale: float = PREFIXES[prefix] ** power
    return scale


def _powered(unit: str) -> tuple[str, int]:
    for sign, power in _POWERS.items():
        if unit.endswith(sign) and unit != sign:
            return unit.removesuffix(sign), power
    return unit, 1
