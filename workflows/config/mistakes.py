"""Mistakes in studies, in words: where, what was given, what was expected."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from typing import Any, get_args

from pydantic import ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from forward.errors import Error
from forward.scalars import Mistake
from forward.settings import UNKNOWN_KIND, cut, nearest, one_line, shown
from uq.inputs.distributions import Distribution

LISTED = 50  # mistakes that are shown
MANY = 3  # alike, of elements of a vector
# What pydantic adds to the locations of mistakes besides keys: the members of a union, in TOML's words.
_MEMBERS = {
    "str": "a text",
    "float": "a number",
    "int": "a whole number",
    "bool": "true or false",
    "tuple": "a list",
    "list": "a list",
    "dict": "a table",
}
_ELEMENT = re.compile(r"\.\d+\b(?=[.:])")  # of a vector
_MEMBER = re.compile(rf"({'|'.join(_MEMBERS)})(\[.*\])?$")
_INNER = re.compile(
    r"\[key\]$|(function-|tagged-union|literal|constrained|lax-or|nullable|is-instance|model|chain|json)\S*\["
)
_ELSEWHERE = {"mesh_error": "accuracy.mesh_error"}  # keys that are looked for in several blocks, and where they stand
_WORD = 60  # letters of a key in a message


class StudyError(Error):
    """A study that cannot be run; each argument is one line: the place, what was given and what was expected."""

    def __init__(self, *mistakes: str) -> None:
        more = [f"and {len(mistakes) - LISTED} more mistakes"] if len(mistakes) > LISTED else []
        super().__init__(*map(one_line, mistakes[:LISTED]), *more)

    def __str__(self) -> str:
        """All mistakes, a line each."""
        return "\n".join(self.args)


def refused(title: str, mistakes: Sequence[Mistake]) -> None:
    """Raise pydantic's exception if there are mistakes."""
    if mistakes:
        raise ValidationError.from_exception_data(
            title,
            [
                InitErrorDetails(type=PydanticCustomError("study", "{message}", {"message": m}), loc=place, input=given)
                for place, m, given in mistakes
            ],
        )


def not_installed(key: str, given: str, packages: Sequence[str]) -> Iterator[Mistake]:
    """Find packages that the value of a key of the method needs, and that are not installed."""
    for package in packages:
        if find_spec(package) is None:
            yield ("method", key), f"needs {package}, which is not installed: pip install {package}", given


def lines(error: ValidationError, place: str = "", apart: Sequence[str] = ()) -> list[str]:
    """Say the mistakes of a block at a place: where, what was given, what was expected.

    Kinds of studies whose files have other blocks, `apart`, may be meant where a kind of method is not known.
    """
    items = [(item, *_around_member(item["loc"], place)) for item in error.errors(include_url=False)]
    members: dict[str, list[str]] = {}  # what would have been right, by where
    for _, where, member, _ in items:
        if member is not None:
            members.setdefault(where, []).append(member)
    deeper = {where for _, where, member, rest in items if member is not None and rest}
    found = []
    for item, where, member, rest in items:
        if member is None or rest:
            found.append(_line(item, _place(item["loc"], place), apart))
        elif where not in deeper:
            words = list(dict.fromkeys(members[where]))
            found.append(f"{where}: expected {' or '.join(words)}; given {shown(item['input'])}")
    return _once_for_elements(dict.fromkeys(map(one_line, found)))


def _once_for_elements(found: Iterable[str]) -> list[str]:
    """Say once what is said of several elements of a vector, x.0 to x.63, or of a list."""
    alike: dict[str, list[str]] = {}
    for line in found:
        alike.setdefault(_ELEMENT.sub(".", line), []).append(line)
    short = ([f"{of[0]} ({len(of) - 1} more like it)"] if len(of) > MANY else of for of in alike.values())
    return [line for several in short for line in several]


def _around_member(steps: Sequence[str | int], place: str) -> tuple[str, str | None, bool]:
    """Return the location of a union on the path to a mistake, its member, and whether the mistake is inside that."""
    for i, step in enumerate(steps):
        match = _MEMBER.match(step) if isinstance(step, str) else None
        if match is not None:
            return _place(steps[:i], place), _MEMBERS[match[1]], i + 1 < len(steps)
    return _place(steps, place), None, False


def _place(steps: Sequence[str | int], place: str) -> str:
    if not place and steps and steps[0] == "source":  # where it stands in files
        steps = ("parameters", "from", *steps[1:])
    for step in steps:
        if isinstance(step, int):
            place += f"[{step}]"
        elif (step not in _kinds() or place == "candidates") and not _INNER.match(step) and not _MEMBER.match(step):
            place += f".{cut(step, _WORD)}" if place else cut(step, _WORD)
    return place


def _line(item: Any, place: str, apart: Sequence[str]) -> str:
    message, given = item["msg"], item["input"]
    elsewhere = _ELSEWHERE.get(place.rpartition(".")[2])
    if item["type"] == "unknown_key" and elsewhere is not None and elsewhere != place:
        return f"{place}: unknown key; did you mean '{elsewhere}'?"
    if item["type"] in {"missing", "unknown_key"}:
        return f"{place}: {message}"
    if item["type"] == UNKNOWN_KIND and place == "method.kind" and "." not in given:
        message = f"unknown kind; {nearest(given, [*item['ctx']['known'], *apart])}"
    message = f"{place}: {message[:1].lower()}{message[1:]}"
    if isinstance(given, Mapping) and not message.endswith(
        ("a table, { key = value }", "a word")
    ):  # a whole block, of which the message names the part
        return message
    return f"{message}; given {shown(given)}"


def _kinds() -> set[str]:
    """Return what pydantic includes in the locations of errors: kinds, and a field whose keys are in its own block."""
    from forward.bodies import geometry, inclusions

    scans = sys.modules.get("inverse.data.registration")  # others do not import inversion
    unions = [geometry.Body, inclusions.Inclusion, Distribution, *([scans.Registration] if scans else [])]
    members = [member for union in unions for member in get_args(get_args(union)[0])]
    return {member.model_fields["kind"].default for member in members} | {"sampling"}
