"""Tables of comma-separated values, and what may be wrong with data."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from forward.errors import Error
from inverse.data.units import split_head

TRUTH = "truth."  # begins remarks that state true values behind synthetic data


class DataError(Error, ValueError):
    """Data that cannot be used; each argument is one line: the place, what was found and what was expected."""

    def __str__(self) -> str:
        """All mistakes, a line each."""
        return "\n".join(self.args)


@dataclass(frozen=True)
class Table:
    """A table of comma-separated values.

    Attributes
    ----------
    remarks
        Its lines that begin with #, without that.
    columns
        Their names.
    rows
        The cells of each column, row by row.
    lines
        Numbers of the lines of the rows.
    units
        What heads state, by column, where that is kept apart (`with_units`); None where one states nothing.
    """

    remarks: tuple[str, ...]
    columns: tuple[str, ...]
    rows: list[dict[str, str]]
    lines: list[int]
    units: Mapping[str, str | None] = field(default_factory=dict)

    @property
    def source(self) -> tuple[str, ...]:
        """Its remarks, without those that state true values."""
        return tuple(line for line in self.remarks if not line.startswith(TRUTH))

    @property
    def truth(self) -> Iterator[tuple[str, str]]:
        """Names of true values behind synthetic data, and what is stated of them."""
        for line in self.remarks:
            if line.startswith(TRUTH):
                name, _, value = line.removeprefix(TRUTH).partition("=")
                yield name.strip(), value.strip()

    def with_units(self, name: str) -> Table:
        """Return the same with units apart, of a file: `force [mN]` is `force`; a DataError for columns of one name."""
        heads = [split_head(head) for head in self.columns]
        columns = tuple(column for column, _ in heads)
        twice = next((column for column in columns if columns.count(column) > 1), None)
        if twice is not None:
            raise DataError(f"{name}: several columns '{twice}', expected different names")
        rows = [dict(zip(columns, row.values(), strict=True)) for row in self.rows]
        return replace(self, columns=columns, rows=rows, units=dict(heads))


def read_table(path: Path) -> Table:
    """Read a table; its first line that is not a remark names the columns, and empty rows do not count.

    Raises `DataError` if it cannot be read, is empty, or a row has other cells than there are columns.
    """
    name = path.name
    try:
        # Office programs write a byte order mark at the beginning.
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise DataError(f"{name}: not a text file in UTF-8") from None
    except OSError as error:
        raise DataError(f"{name}: cannot be read: {error.strerror}") from None
    remarks = tuple(line.lstrip("# ") for line in lines if line.startswith("#"))
    numbered = [(n, line) for n, line in enumerate(lines, start=1) if line.strip() and not line.startswith("#")]
    reader = csv.reader((line for _, line in numbered), skipinitialspace=True)
    try:
        cells = [(numbered[reader.line_num - 1][0], [cell.strip() for cell in row]) for row in reader]
    except csv.Error as error:
        raise DataError(f"{name}: line {numbered[reader.line_num - 1][0]}: {error}, expected commas") from None
    cells = [(n, row) for n, row in cells if any(row)]
    if not cells:
        raise DataError(f"{name}: empty, expected a line with the names of columns, and rows")
    (first, head), *rest = cells
    other = next((sign for sign in (";", "\t") if len(head) == 1 and sign in head[0]), None)
    if other is not None:
        raise DataError(f"{name}: line {first}: columns with {other!r} between them, expected commas")
    twice = next((column for column in head if head.count(column) > 1), None)
    if twice is not None:
        raise DataError(f"{name}: line {first}: several columns '{twice}', expected different names")
    if not rest:
        raise DataError(f"{name}: no rows, expected some below the names of the columns")
    odd = [(n, len(row)) for n, row in rest if len(row) != len(head)]
    if odd:
        n, count = odd[0]
        more = others(len(odd) - 1)
        raise DataError(f"{name}: line {n}: {count} cells, expected {len(head)}, one for each column{more}")
    return Table(remarks, tuple(head), [dict(zip(head, row, strict=True)) for _, row in rest], [n for n, _ in rest])


def numeric(text: str, name: str, *, positive: bool = False) -> float:
    """Return the number in a cell, by the name of its column, maybe a positive one only; NaN for an empty one.

    Raises `ValueError` if it is none, or not finite.
    """
    if not text:
        return math.nan
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or (positive and value <= 0):
        expected = "a number more than 0" if positive else "a number"
        raise ValueError(f"{name} is {text!r}, expected {expected}")
    return value


def needed(text: str, name: str, *, positive: bool = False) -> float:
    """Return the number in a cell that must not be empty; otherwise as `numeric`."""
    value = numeric(text, name, positive=positive)
    if math.isnan(value):
        raise ValueError(f"{name} is {text!r}, expected {'a number more than 0' if positive else 'a number'}")
    return value


def others(count: int) -> str:
    """Say how many more there are of the same mistake."""
    return f" (and {count} more)" if count else ""
