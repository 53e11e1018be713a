"""Studies from Python: read from files, and their results from directories."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from workflows.results.directory import read_dataset

if TYPE_CHECKING:
    import xarray as xr


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
    FileNotFoundError
        If the directory holds no results.
    """
    return read_dataset(Path(directory))
