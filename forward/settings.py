"""The frozen, strictly checked block of which every specification, method and study consists."""

from __future__ import annotations

import json
import re
from difflib import get_close_matches
from typing import TYPE_CHECKING, Annotated, Any, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

UNKNOWN_KIND = "unknown_kind"  # type of a mistake, whose context holds the `known` kinds


class Settings(BaseModel):
    """A frozen block of settings: a constructor call that can be written in TOML.

    Unknown keys are errors that name the nearest known key; lists become tuples, so that a block cannot change
    after it was checked.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, defer_build=True)

    @model_validator(mode="wrap")
    @classmethod
    def _checked(cls, value: Any, handler: Any) -> Self:
        try:
            found: Self = handler(_freeze(value))
        except ValidationError as error:
            raise ValidationError.from_exception_data(
                cls.__name__,
                [_explain(cls, line) for line in error.errors(include_url=False) if not _follows(line)],
            ) from None
        return found

    def __hash__(self) -> int:
        """Hash the contents of the block: the tables in it are dictionaries, which are not hashable."""
        return hash(json.dumps(self.model_dump(mode="json"), sort_keys=True))


class Named(Settings):
    """Something that parameter paths refer to by its name (by default its kind, without the module it comes from)."""

    name: str = Field(default="", pattern=r"^[^.\s]*$")

    if TYPE_CHECKING:

        @property
        def kind(self) -> str:
            """What it is; a field of every subclass."""

    @property
    def label(self) -> str:
        """The name in parameter paths."""
        return self.name or self.kind.rpartition(".")[2]


LONGEST = 80  # letters of a value in a message
LISTED = 30  # words that a message proposes


def shown(value: Any) -> str:
    """Return a value for a message, shortened if it is long."""
    try:
        text = repr(list(value) if isinstance(value, tuple) else value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, lists nested as deep
        return f"a long {type(value).__name__}"
    return cut(text, LONGEST)


def cut(text: str, most: int) -> str:
    """Cut a text that is longer than so many letters."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


def one_line(text: str, most: int = 600) -> str:
    """Return a message on one line without invisible characters; long words and long messages are shortened."""
    visible = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)
    visible = re.sub(r"\S{300,}", lambda word: cut(word[0], LONGEST), visible)
    return visible if len(visible) <= most else f"{visible[: most // 2]} ... {visible[-most // 2 :]}"


def nearest(word: str, known: list[str] | tuple[str, ...]) -> str:
    """Say which of the `known` words was probably meant, or list them: the tail of an error message."""
    close = get_close_matches(word, known, n=1, cutoff=0.5) if len(word) <= LONGEST and word not in known else []
    if close:
        return f"did you mean '{cut(close[0], LONGEST)}'?"
    more = f" and {len(known) - LISTED} others" if len(known) > LISTED else ""
    return f"expected one of: {', '.join(cut(one, LONGEST) for one in known[:LISTED])}{more}"


LARGEST = 100_000  # size of a vector


class Sized(BaseModel, extra="allow"):
    """A vector: blocks NAME.0, NAME.1, ... in one; of a list of this size, each takes its own element."""

    size: Annotated[int, Field(ge=1, le=LARGEST)]


def written_out(blocks: Any) -> Any:
    """Write out vectors (`Sized`) in a table of blocks, or in a list of blocks with names."""

    def each(name: Any, block: Any) -> dict[Any, Any]:
        if not (isinstance(block, dict) and "size" in block):
            return {name: block}
        size, rest = block["size"], {key: value for key, value in block.items() if key != "size"}
        if type(size) is not int or not 1 <= size <= LARGEST:
            raise ValueError(f"{name}.size is {shown(size)}, expected a whole number from 1 to {LARGEST}")
        own = {key for key, value in rest.items() if isinstance(value, list | tuple) and len(value) == size}
        return {f"{name}.{i}": {key: v[i] if key in own else v for key, v in rest.items()} for i in range(size)}

    match blocks:
        case {**table}:
            return {name: one for key, block in table.items() for name, one in each(key, block).items()}
        case [*listed]:
            several = (each(one.get("name"), one) if isinstance(one, dict) else {None: one} for one in listed)
            return tuple({**one, "name": name} if name else one for many in several for name, one in many.items())
        case _:
            return blocks


def usually(kind: str) -> BeforeValidator:
    """Return the annotation of a field whose blocks are of a kind unless they say another one."""
    return BeforeValidator(lambda value: {"kind": kind} | value if isinstance(value, dict) else value)


def _freeze(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_freeze(item) for item in value)
    if isinstance(value, dict):
        return {key: _freeze(item) for key, item in value.items()}
    return value


_PLAIN = {  # pydantic's types of mistakes, in words of TOML
    "tuple_type": "expected a list",
    "list_type": "expected a list",
    "dict_type": "expected a table, { key = value }",
    "model_type": "expected a table, { key = value }",
    "model_attributes_type": "expected a table, { key = value }",
    "missing": "missing",
    "invalid_key": "expected a word as key",
}
_PATTERNS = {  # of texts, by how they begin
    r"'^[^.\s]": "expected a name without dots and blanks",
    r"'^\S+$": "expected a name without blanks",
    r"'^[^\W\d]": "expected MODULE.FUNCTION",
    "'^https?": "expected an address, http://HOST:PORT",
}


def _follows(line: Any) -> bool:
    """Whether a list is too short, or a value not found out, only because there are mistakes in what it consists of."""
    if line["type"] == "default_factory_not_called":
        return True
    return line["type"] == "too_short" and len(line["input"]) >= int(
        line["ctx"].get("min_length", len(line["input"]) + 1)
    )


def _explain(cls: type[BaseModel], line: Any) -> InitErrorDetails:
    """Reword one pydantic error; for an unknown key of this block, suggest the nearest known key."""
    place, given, kind, context = line["loc"], line["input"], line["type"], {}
    message = _PLAIN.get(kind, line["msg"].removeprefix("Value error, "))
    if kind == "extra_forbidden" and len(place) == 1:
        known = [name for name in cls.model_fields if name != "kind"]
        kind, message = "unknown_key", f"unknown key; {nearest(str(place[0]), known)}"
    elif kind in {"union_tag_invalid", "union_tag_not_found"}:
        word = given.get("kind") if isinstance(given, dict) else None
        place = (*place, "kind")
        if word is None:
            kind, message = "missing", "missing"
        elif not isinstance(word, str):
            kind, message, given = "no_word", "expected a word", word
        else:
            context = {"known": re.findall(r"'([^']*)'", line["ctx"]["expected_tags"])}
            kind, message, given = UNKNOWN_KIND, f"unknown kind; {nearest(word, context['known'])}", word
    elif kind == UNKNOWN_KIND:
        context = line["ctx"]
    elif kind == "string_pattern_mismatch":
        message = next((words for start, words in _PATTERNS.items() if start in message), message)
    message = message.replace("Tuple", "List").replace(" after validation", "")
    error = PydanticCustomError(kind, "{message}", {"message": message, **context})
    return InitErrorDetails(type=error, loc=place, input=given)
