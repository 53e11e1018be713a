"""Values of a model that may be measured, and what is measured together as one observation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from inverse.data.measurements import Measurements

IntArray = NDArray[np.int64]
Each = Literal["value", "point", "place", "case", "output", "step"]
NEAR = 12  # decimals of coordinates (m) of points that are the same


def kinds(values: Measurements) -> list[tuple[str, str]]:
    """Return what errors may be relative to (m,): displacements in a load case, or an output."""
    where = zip(values.tests.tolist(), values.names.tolist(), values.points >= 0, strict=True)
    return [(case, "") if at else (case if case and not case.isdigit() else "", part) for case, part, at in where]


def matching(names: Iterable[str], pattern: str) -> NDArray[np.bool_]:
    """Return which names (m,) match a pattern."""
    return np.array([fnmatchcase(name, pattern) for name in names], dtype=bool)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Observations that can be chosen.

    Attributes
    ----------
    names
        Of the c candidates.
    which
        Number (m,) of the candidate that each value belongs to; -1 of values that are not measured.
    places
        Where (c, 3) they are (m); NaN of those at no point, or at several.
    cases, parts
        Load case of each, empty if in several; and what is measured, such as "xyz" or "force".
    """

    names: tuple[str, ...]
    which: IntArray
    places: FloatArray
    cases: tuple[str, ...]
    parts: tuple[str, ...]

    @classmethod
    def of(cls, values: Measurements, each: Each, goals: NDArray[np.bool_]) -> Candidates:
        """Gather values, but for goals (m,), into observations. The same value at one point counts once."""
        which, seen, of_kind = np.full(len(values), -1), set(), kinds(values)
        texts = (values.labels.tolist(), values.tests.tolist(), values.names.tolist())
        keys: dict[tuple[object, ...], list[int]] = {}
        for k, (name, case, part, at) in enumerate(zip(*texts, values.points >= 0, strict=True)):
            place = tuple((np.round(values.places[k], NEAR) + 0.0).tolist()) if at else ()
            same = (case, place, part) if at else (name,)
            if goals[k] or same in seen:
                continue
            seen.add(same)
            match each:
                case "value":
                    key: tuple[object, ...] = (name,)
                case "point":
                    key = (case, place) if at else (name,)
                case "place":
                    key = (place,) if at else (name,)
                case "output":
                    key = ("", part) if at else (of_kind[k][0], part)
                case _:
                    key = (case,)
            keys.setdefault(key, []).append(k)
        for number, rows in enumerate(keys.values()):
            which[rows] = number
        every = list(keys.values())
        return cls(
            tuple(_name(values, rows, each) for rows in every),
            which,
            np.array([_one([values.places[k] for k in rows]) for rows in every]).reshape(-1, 3),
            tuple(_common([texts[1][k] for k in rows]) for rows in every),
            tuple(_parts([texts[2][k] for k in rows]) for rows in every),
        )

    def numbers(self, given: Mapping[str, float]) -> FloatArray:
        """Return a number (c,) for each candidate, by patterns of names of which the last that matches counts; else 1.

        Raises `ValueError` if a pattern matches none.
        """
        found = np.ones(len(self.names))
        for pattern, value in given.items():
            mine = matching(self.names, pattern)
            if not mine.any():
                raise ValueError(f"'{pattern}' is the name of no candidate, such as {', '.join(self.names[:3])}")
            found[mine] = value
        return found


def _name(values: Measurements, rows: Sequence[int], each: Each) -> str:
    k = rows[0]
    first, case, displaced = str(values.labels[k]), values.parts[values.cases[k]], values.points[k] >= 0
    match each:
        case "value":
            return first
        case "point":
            return first.rpartition(".")[0] if displaced else first
        case "place":
            middle = first.partition(".")[2] if case else first
            return middle.rpartition(".")[0] if displaced else first
        case "output":
            return "displacements" if displaced else str(values.names[k])
        case "step":
            return f"step {case}" if case else first
        case _:
            return case or first


def _one(places: Sequence[FloatArray]) -> FloatArray:
    """The place of all of them, or NaN."""
    same = all(np.array_equal(np.round(one, NEAR), np.round(places[0], NEAR), equal_nan=True) for one in places)
    return places[0] if same else np.full(3, np.nan)


def _common(words: Sequence[str]) -> str:
    return words[0] if len(set(words)) == 1 else ""


def _parts(words: Sequence[str]) -> str:
    """The parts in their order, each once: "xyz" of components."""
    each = list(dict.fromkeys(words))
    return ("" if all(len(word) == 1 for word in each) else " ").join(each)
