"""The block of settings of a material, made from the signature of its energy.

So names, units and limits of the constants are stated in one place.
"""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any, Literal, get_args, get_origin

from annotated_types import Unit
from pydantic import Field, create_model, field_validator

from forward.bodies.geometry import Vector
from forward.materials.material import MATERIALS, Energy, constants, energy_of, measures
from forward.registry import OfKind
from forward.settings import Settings


class _Fibrous(Settings):
    """A material with one or two families of fibres, along vectors in the undeformed body."""

    fibres: tuple[Vector, ...] = Field(min_length=1, max_length=2)

    @field_validator("fibres")
    @classmethod
    def _have_lengths(cls, fibres: tuple[Vector, ...]) -> tuple[Vector, ...]:
        if not all(any(fibre) for fibre in fibres):
            message = "a direction has length zero, expected vectors such as [1, 0, 0]"
            raise ValueError(message)
        return fibres


def block(kind: str) -> type[Settings]:
    """Return the block of a kind of material."""
    return _block(kind, energy_of(kind))


@cache
def _block(kind: str, energy: Energy) -> type[Settings]:
    name = kind.rpartition(".")[2].replace("-", "_").title().replace("_", "")
    fields: dict[str, Any] = {"kind": (Literal[kind], kind)}
    fields |= {
        constant: (Annotated[(float, *(get_args(hint)[1:] if get_origin(hint) is Annotated else (Unit("1"),)))], ...)
        for constant, hint in constants(energy).items()
    }
    base: type[Settings] = _Fibrous if "i4" in measures(energy) else Settings
    made: type[Settings] = create_model(name, __base__=base, __doc__=energy.__doc__, **fields)
    return made


Material = Annotated[Settings, OfKind(MATERIALS, make=block)]
