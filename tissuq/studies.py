"""Studies from Python: made of blocks or read from files, and their results from directories."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from pydantic import TypeAdapter, ValidationError

import tissuq.accessor  # noqa: F401 - `data.tissuq`
from forward.external.own_modules import path_of
from forward.hyperelastic import Hyperelastic as _Hyperelastic
from forward.settings import Settings
from forward.spec import MEASURED
from forward.specimen import Specimen as _Specimen
from workflows.config.mistakes import StudyError, lines
from workflows.results.directory import read_dataset

if TYPE_CHECKING:
    import xarray as xr

T = TypeVar("T")


def Study(**blocks: Any) -> Any:
    """Make a study of any kind from its blocks, as they stand in study files.

    Parameters
    ----------
    blocks
        ``model``, ``parameters``, ``method`` and so on: dictionaries, or what `tissuq.Hyperelastic` returns; a study is
        of the kind that its ``method["kind"]`` names. Lists may be arrays of NumPy, and what names a Python function
        the function. Files are looked for in the working directory.

    Raises
    ------
    StudyError
        Lists every mistake in it.
    ModelError
        If a kind is a dotted path to a module that exists twice.
    """
    from workflows.config.study import parse

    return parse(_written(blocks))


def _written(value: Any) -> Any:
    """Return a block as files have it; models stay what they are."""
    match value:
        case Mapping():
            found = {str(key): _written(one) for key, one in value.items()}
            if isinstance(found.get("method"), Settings):  # whose kind says what the study is
                found["method"] = found["method"].model_dump(mode="json", exclude_none=True)
            return found
        case list() | tuple():
            return [_written(one) for one in value]
        case Path():
            return str(value)
        case _ if hasattr(value, "tolist"):  # arrays, columns, and their numbers
            return value.tolist()
        case _ if callable(value):
            return path_of(value)
        case _:
            return value


def checked(make: Callable[..., T], *given: Any, place: str = "", **blocks: Any) -> T:
    """Make something of blocks; mistakes in them become a `StudyError`, with the place where they stand."""
    try:
        return make(*given, **_written(blocks))
    except ValidationError as error:
        raise StudyError(*lines(error, place)) from None


def model_of(block: Any) -> Any:
    """Make the model of a block; a ValidationError lists mistakes."""
    return TypeAdapter(Annotated[Any, MEASURED]).validate_python(_written(block))


def _block(kind: type[T]) -> Callable[..., T]:
    """Return what makes a block of a kind from keyword arguments."""
    return wraps(kind, updated=())(lambda **settings: checked(kind, **settings))


Hyperelastic, Specimen = _block(_Hyperelastic), _block(_Specimen)


def load(path: str | Path, changes: Sequence[str] = ()) -> Any:
    """Read a study from a TOML file.

    Parameters
    ----------
    path
        The file.
    changes
        Assignments such as "method.samples=512", as for ``--set``.

    Raises
    ------
    StudyError
        Lists every mistake in it.
    """
    from workflows.config.study import load as from_file

    return from_file(Path(path), changes)


def read(directory: str | Path) -> xr.Dataset:
    """Read the results of a finished study.

    Raises
    ------
    Error
        If the directory holds no results; a FileNotFoundError too.
    """
    return read_dataset(Path(directory))
