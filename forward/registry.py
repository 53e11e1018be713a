"""Kinds of blocks by name: each is imported on demand, also from outside the program.

A kind is one of the program's own, or one that an installed package declares by an entry point of the group ``tissuq``
(named ``FAMILY.KIND``, such as ``material.fung``), or a dotted path (``my_tissue.fung``) to a module beside the study
or wherever else Python finds it.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import pkgutil
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError, core_schema

from forward.errors import Error
from forward.machine import modified
from forward.settings import UNKNOWN_KIND, Settings, nearest

ENTRY_POINTS = "tissuq"


class KindError(Error, ValueError):
    """There is no such kind, or it cannot be used; the message is one line for the user."""


@dataclass(frozen=True)
class Kinds:
    """The kinds of one family of blocks.

    Parameters
    ----------
    family
        What they are, in a word, such as "material".
    own
        Those of the program: ``MODULE:NAME`` by kind.
    expected
        The class of which every kind must be a subclass.
    objection
        For kinds that are not classes: returns why something is not of this family, or None if it is.
    """

    family: str
    own: Mapping[str, str]
    expected: type = Settings
    objection: Callable[[Any], str | None] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Kinds whose name has no dots: the program's own, and those of installed packages."""
        return (*self.own, *(name for name in self._installed() if name not in self.own))

    def __getitem__(self, kind: str) -> Any:
        """Import the object of a kind.

        Raises
        ------
        KindError
            If there is none.
        """
        if kind in self.own:
            return named(self.own[kind])
        if "." in kind:
            module, _, name = kind.rpartition(".")
            return self._imported(kind, module, name)
        found = self._installed().get(kind)
        if found is None:
            raise KindError(f"unknown kind; {nearest(kind, self.names)}")
        return self._imported(kind, found.module, found.attr)

    def __contains__(self, kind: str) -> bool:
        """Whether there is such a kind; what is not the program's own is imported."""
        try:
            self[kind]
        except KindError:
            return False
        return True

    def __iter__(self) -> Iterator[str]:
        """Iterate over the program's own."""
        return iter(self.own)

    def _installed(self) -> dict[str, EntryPoint]:
        """Kinds that installed packages declare, by name."""
        prefix = f"{self.family}."
        return {point.name.removeprefix(prefix): point for point in _declared() if point.name.startswith(prefix)}

    def _imported(self, kind: str, module: str, name: str) -> Any:
        from forward.external.own_modules import imported

        refused = f"the {self.family} '{kind}' cannot be imported"
        try:
            loaded = imported(module) if "." in kind else importlib.import_module(module)
        except ImportError as error:
            raise KindError(f"{refused}: {error}") from error
        except (Exception, SystemExit) as error:
            raise KindError(f"{refused}: {type(error).__name__}: {error}") from error
        try:
            found = getattr(loaded, name)
        except AttributeError:
            known = tuple(word for word in dir(loaded) if not word.startswith("_"))
            raise KindError(f"the module '{module}' has no {self.family} '{name}'; {nearest(name, known)}") from None
        if self.objection is not None:
            objection = self.objection(found)
            if objection is not None:
                raise KindError(f"'{module}.{name}' cannot be used as {self.family}: {objection}")
            return found
        if not (isinstance(found, type) and issubclass(found, self.expected)):
            raise KindError(
                f"'{module}.{name}' cannot be used as {self.family}: expected a subclass of {self.expected.__name__}"
            )
        if issubclass(found, Settings) and "kind" not in found.model_fields:
            raise KindError(f"the {self.family} '{module}.{name}' has no field called kind, expected kind: str")
        return found


def _declared() -> tuple[EntryPoint, ...]:
    folders = ((folder, modified(folder)) for folder in sys.path)
    return _read_again(tuple(one for one in folders if _holds_packages(*one)))


@lru_cache(maxsize=1024)
def _holds_packages(folder: str, changed: int) -> bool:
    """Whether a folder of the path may tell of installed packages: those of studies, which change often, do not."""
    if not changed:
        return False
    try:
        return any(one.name.lower().endswith("-info") for one in Path(folder).iterdir())
    except OSError:  # an archive
        return True


@lru_cache(maxsize=8)
def _read_again(_folders: tuple[tuple[str, int], ...]) -> tuple[EntryPoint, ...]:
    """Read those of every installed package: hundreds of files, which shared file systems are slow to open.

    A solve asks for its energy many times. A package that is installed meanwhile changes a folder of the path.
    """
    return tuple(importlib.metadata.entry_points(group=ENTRY_POINTS))


@cache
def named(text: str) -> Any:
    """Import and return the object that a string "module:Name" names; a solve asks for its energy several times."""
    return pkgutil.resolve_name(text)


def dotted(document: Any) -> Iterator[str]:
    """Return the modules of all kinds in a document that are dotted paths, at any depth."""
    for kind in _kinds(document):
        if "." in kind and all(step.isidentifier() for step in kind.split(".")):
            yield kind.rpartition(".")[0]


def installed(document: Any) -> Iterator[str]:
    """Return the modules of all kinds in a document that installed packages declare, in whichever family."""
    points: dict[str, list[str]] = {}
    for point in _declared():
        points.setdefault(point.name.partition(".")[2], []).append(point.module)
    for kind in _kinds(document):
        yield from points.get(kind, ())


def _kinds(document: Any) -> Iterator[str]:
    """Return what is written as a kind anywhere in a document."""
    if isinstance(document, Mapping):
        kind = document.get("kind")
        if isinstance(kind, str):
            yield kind
        document = document.values()
    elif not isinstance(document, list | tuple):
        return
    for block in document:
        yield from _kinds(block)


@dataclass(frozen=True, eq=False)
class OfKind:
    """Annotation of a field that holds a block of one of these kinds: ``Annotated[Settings, OfKind(LOADS)]``.

    Only the kind that is named is imported. Mistakes in the block are located as in pydantic's unions.

    Parameters
    ----------
    kinds
        The kinds.
    default
        The kind if none is given, or what tells it from the block; None if it is required.
    make
        Returns the block of a kind, if the kinds are not blocks themselves.
    but
        A kind that is none here.
    """

    kinds: Kinds
    default: str | Callable[[Mapping[str, Any]], str] | None = None
    make: Callable[[str], type[Settings]] | None = None
    but: str = ""

    def block(self, kind: str) -> Any:
        """Return the class of the blocks of a kind."""
        return self.kinds[kind] if self.make is None else self.make(kind)

    def validate(self, value: Any) -> Any:
        """Return the block that a table describes; blocks are returned as they are."""
        if isinstance(value, self.kinds.expected):
            return value
        if not isinstance(value, Mapping):
            raise PydanticCustomError("model_type", "expected a table, {{ key = value }}")
        usual = self.default(value) if callable(self.default) else self.default
        kind = value.get("kind", usual)
        if kind is None:
            raise _mistake("missing", "missing", value)
        if not isinstance(kind, str):
            raise _mistake("no_word", "expected a word", kind)
        if kind == self.but:
            raise _mistake("not_here", "not here, expected another kind", kind)
        try:
            block = self.block(kind)
        except KindError as error:
            raise _mistake(UNKNOWN_KIND, str(error), kind, known=list(self.kinds.names)) from None
        return block.model_validate({**value, "kind": kind})

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        """Check by `validate`; blocks write themselves as what they are."""
        return core_schema.no_info_before_validator_function(self.validate, core_schema.any_schema())

    def __get_pydantic_json_schema__(self, core: core_schema.CoreSchema, handler: GetJsonSchemaHandler) -> Any:
        """Any of the named kinds that can be used here, or a block of a dotted kind, about which nothing is known."""
        known = [handler(_with_reference(self.block(kind))) for kind in self.kinds.own if kind != self.but]
        for kind in self.kinds.names[len(self.kinds.own) :]:
            with suppress(KindError):
                known.append(handler(_with_reference(self.block(kind))) | {"properties": {"kind": {"const": kind}}})
        other = {"type": "object", "properties": {"kind": {"type": "string", "pattern": r"\."}}}
        return {"anyOf": [*known, {**other, "required": ["kind"]}]}


def _with_reference(block: type[Settings]) -> core_schema.CoreSchema:
    """Return the schema of a block as a separate definition of a JSON Schema, to which others refer."""
    block.model_rebuild()  # where nothing was checked yet
    found: core_schema.CoreSchema = block.__pydantic_core_schema__
    name = found.get("ref")
    if not isinstance(name, str):
        return found
    return core_schema.definitions_schema(core_schema.definition_reference_schema(name), [found])


def _mistake(kind: str, message: str, given: Any, **context: Any) -> ValidationError:
    error = PydanticCustomError(kind, "{message}", {"message": message, **context})
    return ValidationError.from_exception_data("kind", [InitErrorDetails(type=error, loc=("kind",), input=given)])
