"""Readers of data files of kinds of your own: what they read is a table, which is used as any other."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from forward.registry import Kinds, OfKind
from forward.settings import Settings, one_line
from inverse.data.table import DataError, Table, read_table


class Reader(Settings):
    """What reads data files of a kind; every kind defines `kind` and `columns`."""

    @abstractmethod
    def columns(self, path: Path) -> Mapping[str, Sequence[Any]]:
        """Return what a file holds as the columns of a table: all of one length, by their names.

        Names and units are those of tables (`inverse.data.outputs`, `inverse.data.curves`,
        `inverse.data.displacement_tables`, `workflows.data.material_tests`). Cells are numbers or texts; NaN and ""
        are empty. Any exception means that the file cannot be read, and its text is shown.
        """

    def table(self, path: Path) -> Table:
        """Return the table of a file; raises `DataError` if the file cannot be read, or its columns make no table."""
        try:
            columns = {str(name): list(values) for name, values in self.columns(path).items()}
        except OSError as error:
            raise DataError(f"{path.name}: cannot be read: {error.strerror or error}") from None
        except Exception as error:
            message = f"{path.name}: cannot be read by {type(self).__name__}: {type(error).__name__}: {error}"
            raise DataError(one_line(message)) from error
        lengths = {len(values) for values in columns.values()}
        if len(lengths) != 1 or lengths == {0}:
            told = ", ".join(f"{name} {len(values)}" for name, values in columns.items()) or "none"
            raise DataError(f"{path.name}: columns of lengths {told}, expected one length, and rows")
        rows = [dict(zip(columns, map(_cell, row), strict=True)) for row in zip(*columns.values(), strict=True)]
        return Table((), tuple(columns), rows, list(range(1, len(rows) + 1)))


def _cell(value: Any) -> str:
    """Return the text of a number, from which it is read again as it is; of a text itself."""
    if isinstance(value, str):
        return value.strip()
    number = float(value)
    return "" if math.isnan(number) else repr(number)


READERS = Kinds("reader", {}, Reader)

AnyReader = Annotated[Reader, OfKind(READERS)] | None
"""Of a field that holds what reads data files, in place of tables of comma-separated values."""


def table_of(path: Path, reader: Reader | None) -> Table:
    """Read a table, of a kind of one's own if there is a reader; a DataError if that cannot be done."""
    return read_table(path) if reader is None else reader.table(path)
