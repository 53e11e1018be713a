"""Numbers of a model that can be made parameters, and mistakes with their places."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Annotated, Any, NamedTuple

from annotated_types import Unit
from pydantic import Field, TypeAdapter, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from forward.settings import Settings

Mistake = tuple[tuple[str | int, ...], str, Any]  # place, what is wrong, what was given


def refuse(title: str, mistakes: Iterable[Mistake]) -> None:
    """Raise pydantic's exception if there are mistakes in a model."""
    found = [
        InitErrorDetails(type=PydanticCustomError("model", "{message}", {"message": message}), loc=place, input=given)
        for place, message, given in mistakes
    ]
    if found:
        raise ValidationError.from_exception_data(title, found)


class Scalar(NamedTuple):
    """A number of the model that can be made a parameter."""

    value: float
    block: type[Settings]
    field: str
    limits: tuple[Any, ...] = ()  # beyond those of the field

    def objection(self, value: float) -> str | None:
        """Say why the number cannot be `value`, or None if it can."""
        try:
            _admissible(self.block, self.field, self.limits).validate_python(value)
        except ValidationError as error:
            return str(error.errors()[0]["msg"]).lower()
        return None

    @property
    def unit(self) -> str:
        """SI unit from the annotation of the field; "1" without."""
        return unit_of(self.block.model_fields[self.field].metadata) or "1"


class Factor(Settings):
    """A factor on numbers of a model."""

    factor: Annotated[float, Field(gt=0), Unit("1")] = 1.0


def numbers(block: type[Settings]) -> tuple[str, ...]:
    """Return the fields of a block that are annotated with a unit: these can be parameters."""
    return tuple(name for name, field in block.model_fields.items() if unit_of(field.metadata))


def unit_of(annotations: Iterable[Any]) -> str | None:
    """Return the SI unit among what a number is annotated with; None if none is."""
    return next((item.unit for item in annotations if isinstance(item, Unit)), None)


@cache
def _admissible(block: type[Settings], field: str, limits: tuple[Any, ...]) -> TypeAdapter[float]:
    return TypeAdapter(Annotated[(float, Field(), *block.model_fields[field].metadata, *limits)])
