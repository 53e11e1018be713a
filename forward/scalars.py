"""Numbers of a model that can be made parameters, and mistakes with their places."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from typing import Annotated, Any, NamedTuple

from annotated_types import Unit
from pydantic import Field, TypeAdapter, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from forward.settings import Settings

Mistake = tuple[tuple[str | int, ...], str, Any]  # place, what is wrong, what was given
Ranges = Mapping[str, tuple[float, float]]  # of parameters, by their paths


def repeated(block: str, names: Iterable[str]) -> Iterator[Mistake]:
    """Find names that several items of a block have."""
    for name, count in Counter(names).items():
        if count > 1:
            yield (block,), f"{count} of them are called '{name}', expected different names", name


def refuse(title: str, mistakes: Iterable[Mistake]) -> None:
    """Raise pydantic's exception if there are mistakes in a model."""
    found = [
        InitErrorDetails(type=PydanticCustomError("model", "{message}", {"message": message}), loc=place, input=given)
        for place, message, given in mistakes
    ]
    if found:
        raise ValidationError.from_exception_data(title, found)


class Scalar(NamedTuple):
    """A number of the model that can be made a parameter.

    Its unit, and what it may be, are among the annotations of a field of a block, and those that are given besides. By
    the name of the field it is known as a coordinate or as part of a direction, where there is no block too.
    """

    value: float
    block: type[Settings] | None = None
    field: str = ""
    besides: tuple[Any, ...] = ()

    def objection(self, value: float) -> str | None:
        """Say why the number cannot be `value`, or None if it can."""
        try:
            _admissible(*self[1:]).validate_python(value)
        except ValidationError as error:
            return str(error.errors()[0]["msg"]).lower()
        return None

    @property
    def unit(self) -> str:
        """SI unit among the annotations; "1" without."""
        return unit_of(_annotations(*self[1:])) or "1"


def numbers(block: type[Settings]) -> tuple[str, ...]:
    """Return the fields of a block that are annotated with a unit: these can be parameters."""
    return tuple(name for name, field in block.model_fields.items() if unit_of(field.metadata))


def unit_of(annotations: Iterable[Any]) -> str | None:
    """Return the SI unit among what a number is annotated with; None if none is."""
    return next((item.unit for item in annotations if isinstance(item, Unit)), None)


def _annotations(block: type[Settings] | None, field: str, besides: tuple[Any, ...]) -> tuple[Any, ...]:
    return besides if block is None else (*block.model_fields[field].metadata, *besides)


@cache
def _admissible(block: type[Settings] | None, field: str, besides: tuple[Any, ...]) -> TypeAdapter[float]:
    return TypeAdapter(Annotated[(float, Field(), *_annotations(block, field, besides))])
