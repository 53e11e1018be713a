"""The frozen, strictly checked block that every specification, method and study is made of."""

from __future__ import annotations

import json
from difflib import get_close_matches
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError


class Settings(BaseModel):
    """A frozen block of settings: a constructor call that can be written in TOML.

    Unknown keys are errors that name the nearest known key; lists become tuples, so that a block cannot change
    after it was checked.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @model_validator(mode="wrap")
    @classmethod
    def _checked(cls, value: Any, handler: Any) -> Self:
        try:
            return handler(_freeze(value))  # type: ignore[no-any-return]
        except ValidationError as error:
            raise ValidationError.from_exception_data(
                cls.__name__, [_explain(cls, line) for line in error.errors(include_url=False)]
            ) from None

    def __hash__(self) -> int:
        """Hash what the block says: tables within it are dictionaries, which have no hash of their own."""
        return hash(json.dumps(self.model_dump(mode="json"), sort_keys=True))


class Named(Settings):
    """Something that parameter paths refer to by its name (by default its kind)."""

    name: str = Field(default="", pattern=r"^[^.\s]*$")

    @property
    def label(self) -> str:
        """The name in parameter paths."""
        return self.name or str(getattr(self, "kind"))  # noqa: B009 - every subclass has a kind


def nearest(word: str, known: list[str] | tuple[str, ...]) -> str:
    """Say which of the `known` words was probably meant, or list them: the tail of an error message."""
    close = get_close_matches(word, known, n=1, cutoff=0.5)
    return f"did you mean '{close[0]}'?" if close else f"expected one of: {', '.join(known)}"


LONGEST = 80  # letters of a value in a message


def shown(value: Any) -> str:
    """Return a value for a message, cut where it is long."""
    try:
        text = repr(list(value) if isinstance(value, tuple) else value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, lists nested as deep
        return f"a long {type(value).__name__}"
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def _freeze(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_freeze(item) for item in value)
    if isinstance(value, dict):
        return {key: _freeze(item) for key, item in value.items()}
    return value


def _explain(cls: type[BaseModel], line: Any) -> InitErrorDetails:
    """Carry one pydantic error on; an unknown key of this very block gets its nearest known key."""
    if line["type"] == "extra_forbidden" and len(line["loc"]) == 1:
        hint = nearest(str(line["loc"][0]), [name for name in cls.model_fields if name != "kind"])
        kind: PydanticCustomError | str = PydanticCustomError("unknown_key", "unknown key; {hint}", {"hint": hint})
    else:
        message = line["msg"].removeprefix("Value error, ")
        kind = PydanticCustomError(line["type"], message.replace("{", "(").replace("}", ")"))
    return InitErrorDetails(type=kind, loc=line["loc"], input=line["input"])
