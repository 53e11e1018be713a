"""Tables of measured numbers: files of comma-separated values, or of kinds of your own, and units in their heads."""

from __future__ import annotations

import csv
import math
import re
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from forward.errors import Error
from forward.registry import Kinds, OfKind
from forward.settings import Settings, nearest, one_line

PREFIXES = {
    "": 1.0,
    "n": 1e-9,
    "u": 1e-6,
    "µ": 1e-6,
    "μ": 1e-6,
    "m": 1e-3,
    "c": 1e-2,
    "d": 1e-1,
    "k": 1e3,
    "M": 1e6,
    "G": 1e9,
}
_HEAD = re.compile(r"(?P<name>[^\[\]()]*[^\[\]()\s])\s*[\[(](?P<unit>[^\[\]()]*)[\])]$")
_POWERS = {"²": 2, "^2": 2, "2": 2, "³": 3, "^3": 3, "3": 3}
TRUTH = "truth."  # begins remarks that state true values behind synthetic data


def split_head(head: str) -> tuple[str, str | None]:
    """Return the name of a column and its unit; None where the head states none."""
    found = _HEAD.match(head.strip())
    return (head, None) if found is None else (found["name"], found["unit"].strip())


def factor(unit: str, si: str) -> float:
    """Return how many of an SI unit (m, N, Pa, J, m³, 1) a unit is: 1e-3 for mm and m.

    Raises `ValueError` if it is none of that quantity; the message says what is expected.
    """
    base, power = _powered(si)
    given, given_power = _powered(unit)
    if si == "1" and unit in {"", "1", "-", "%"}:
        return 0.01 if unit == "%" else 1.0
    prefix = given.removesuffix(base)
    if given_power != power or not given.endswith(base) or prefix not in PREFIXES or base == "1":
        examples = {"m": "m, mm or µm", "N": "N, mN or µN", "Pa": "Pa or kPa", "J": "J or mJ", "1": "1 or %"}
        raise ValueError(f"the unit '{unit}', expected {examples.get(si, si)}")
    scale: float = PREFIXES[prefix] ** power
    return scale


def _powered(unit: str) -> tuple[str, int]:
    for sign, power in _POWERS.items():
        if unit.endswith(sign) and unit != sign:
            return unit.removesuffix(sign), power
    return unit, 1


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


def needed(text: str, name: str, *, positive: bool = False) -> float:
    """Return the number in a cell, by the name of its column, maybe a positive one only.

    Raises `ValueError` if it is none, or not finite.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or (positive and value <= 0):
        expected = "a number more than 0" if positive else "a number"
        raise ValueError(f"{name} is {text!r}, expected {expected}")
    return value


def numeric(text: str, name: str, *, positive: bool = False) -> float:
    """Return the number in a cell; NaN for an empty one, otherwise as `needed`."""
    return needed(text, name, positive=positive) if text else math.nan


def others(count: int) -> str:
    """Say how many more there are of the same mistake."""
    return f" (and {count} more)" if count else ""


def wrong_columns(name: str, columns: Sequence[str], known: tuple[str, ...], wanted: Sequence[str]) -> list[str]:
    """Say which columns of a file have no known name, and which wanted ones it lacks."""
    unknown = [
        f"{name}: unknown column '{column}'; {nearest(column, known)}" for column in columns if column not in known
    ]
    expected = ", ".join(wanted)
    return unknown + [f"{name}: no column '{one}', expected {expected}" for one in wanted if one not in columns]


class Reader(Settings):
    """What reads data files of a kind; every kind defines `kind` and `columns`."""

    @abstractmethod
    def columns(self, path: Path) -> Mapping[str, Sequence[Any]]:
        """Return what a file holds as the columns of a table: all of one length, by their names.

        Names and units are those of tables (`inverse.data.outputs`, `inverse.data.displacement_tables`,
        `workflows.data.material_tests`). Cells are numbers or texts; NaN and ""
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
