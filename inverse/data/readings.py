"""Measured outputs of load cases, such as the forces of tools: rows of the tables of displacements.

Such a row names its output in the column `output` and gives its `value`; where it stands among displacements, its cells
x, y, z and ux, uy, uz are empty. The standard deviation of its error is in `sigma_value`, or else in `sigma`, in the
unit of the output. Heads may state units, ``value [mN]`` with ``sigma_value [mN]``, where all outputs have the same.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from forward.settings import nearest
from inverse.data.table import DataError, Table, numeric, others
from inverse.data.units import factor, split_head

DISPLACED = ("x", "y", "z", "ux", "uy", "uz")  # columns of displacements
OUTPUT, VALUE, ERROR, COMMON = "output", "value", "sigma_value", "sigma"
Units = Mapping[str, str]  # SI units of the outputs of a load case, by their names, in its order


@dataclass(frozen=True, eq=False)
class Readings:
    """Measured outputs of load cases (m,).

    Attributes
    ----------
    values, sigma
        What was measured (m,), and the standard deviations (m,) of the errors, NaN if unknown; in SI units.
    case
        Number (m,) of the load case.
    which
        Number (m,) of the output in its load case.
    names, labels
        Name (m,) of the output, and location (m,) in the file.
    """

    values: FloatArray = field(default_factory=lambda: np.zeros(0))
    sigma: FloatArray = field(default_factory=lambda: np.zeros(0))
    case: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    which: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    names: tuple[str, ...] = ()
    labels: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Return their number."""
        return len(self.values)

    def with_sigma(self, given: Mapping[str, float]) -> Readings:
        """Return the same with standard deviations, by output, where the file states none.

        Raises
        ------
        DataError
            If one is still unknown.
        """
        found = self.stated(given)
        lost = np.flatnonzero(~np.isfinite(found.sigma))
        if lost.size:
            name = self.names[lost[0]]
            raise DataError(
                f"{self.labels[lost[0]]}: the standard deviation of the error of '{name}' is not known"
                f"{others(lost.size - 1)}, expected a column {ERROR} or data.sigma_of.{name}"
            )
        return found

    def stated(self, given: Mapping[str, float]) -> Readings:
        """Return the same with standard deviations, by output, where the file states none and they are given."""
        values = np.array([given.get(name, math.nan) for name in self.names])
        return replace(self, sigma=np.where(np.isfinite(self.sigma), self.sigma, values))


def split(table: Table, name: str, cases: Mapping[str, Units]) -> tuple[Table, Readings]:
    """Take the rows of outputs out of a table.

    Parameters
    ----------
    table
        A table of displacements, of outputs, or of both.
    name
        Of its file.
    cases
        Load cases, by name, with what is measured in them.

    Returns
    -------
    tuple
        The table of the displacements alone, which may have no rows, and the outputs.

    Raises
    ------
    DataError
        With every kind of mistake in rows of outputs, and in what their columns are called.
    """
    heads = {split_head(head)[0]: head for head in table.columns}
    if OUTPUT not in heads:
        return table, Readings()
    if VALUE not in heads:
        raise DataError(f"{name}: a column '{OUTPUT}' and none '{VALUE}', expected both")
    error = next((column for column in (ERROR, COMMON) if column in heads), None)
    if error is not None and split_head(heads[VALUE])[1] is not None and split_head(heads[error])[1] is None:
        raise DataError(f"{name}: '{VALUE}' states a unit and '{error}' does not, expected '{ERROR}' with its unit")
    mine = [i for i, row in enumerate(table.rows) if row[heads[OUTPUT]]]
    rest = [i for i in range(len(table.rows)) if i not in set(mine)]
    wrong = _astray(table, rest, name, heads)
    rows = [_Row(f"{name}: line {table.lines[i]}", table.rows[i], heads) for i in mine]
    readings = [_reading(row, cases, wrong) for row in rows]
    if not wrong:
        wrong += _repeated(rows, [one for one in readings if one is not None])
    if wrong:
        raise DataError(*wrong)
    known = [one for one in readings if one is not None]
    found = Readings(
        np.array([one.value for one in known]),
        np.array([one.sigma for one in known]),
        np.array([one.case for one in known], dtype=np.int64),
        np.array([one.which for one in known], dtype=np.int64),
        tuple(one.name for one in known),
        tuple(row.label for row in rows),
    )
    dropped = {heads[column] for column in (OUTPUT, VALUE, ERROR) if column in heads}
    columns = tuple(head for head in table.columns if head not in dropped)
    kept = [{head: table.rows[i][head] for head in columns} for i in rest]
    return Table(table.remarks, columns, kept, [table.lines[i] for i in rest]), found


@dataclass(frozen=True)
class _Row:
    """A row of an output: where it stands, its cells, and the heads of the columns by their names."""

    label: str
    cells: Mapping[str, str]
    heads: Mapping[str, str]

    def __getitem__(self, column: str) -> str:
        return self.cells[self.heads[column]] if column in self.heads else ""

    def number(self, column: str, si: str) -> float:
        """Return a number in SI units; NaN for an empty cell.

        Raises
        ------
        ValueError
            If it is none, or has a unit of something else.
        """
        text, unit = self[column], split_head(self.heads.get(column, column))[1]
        try:
            scale = 1.0 if unit is None else factor(unit, si)
        except ValueError as error:
            message = f"column '{column}' has {error} for '{self[OUTPUT]}'"
            if column == COMMON:
                message += f", in a column {ERROR}"
            raise ValueError(message) from None
        return scale * numeric(text, column, positive=column in (ERROR, COMMON))


@dataclass(frozen=True)
class _Reading:
    name: str
    case: int
    which: int
    value: float
    sigma: float


def _reading(row: _Row, cases: Mapping[str, Units], wrong: list[str]) -> _Reading | None:
    """Read a row; what is wrong with it is added to the list."""
    name, names = row[OUTPUT], tuple(cases)
    case = row["case"] or (names[0] if len(names) == 1 else "")
    if case not in cases:
        message = f"unknown load case '{case}'" if case else "no load case"
        wrong.append(f"{row.label}: {message}; {nearest(case, names)}")
        return None
    units = cases[case]
    if name not in units:
        known = f"; {nearest(name, tuple(units))}" if units else ", which states no outputs (model.cases: outputs = …)"
        wrong.append(f"{row.label}: no output '{name}' is measured in load case '{case}'{known}")
        return None
    filled = [column for column in DISPLACED if row[column]]
    if filled:
        message = f"the row of an output has a number in {filled[0]}, expected displacements in a row of their own"
        wrong.append(f"{row.label}: {message}")
        return None
    try:
        value = row.number(VALUE, units[name])
        column = ERROR if ERROR in row.heads else COMMON
        sigma = row.number(column, units[name]) if column in row.heads else math.nan
    except ValueError as error:
        wrong.append(f"{row.label}: {error}")
        return None
    if math.isnan(value):
        wrong.append(f"{row.label}: no {VALUE} of '{name}', expected a number")
        return None
    return _Reading(name, names.index(case), list(units).index(name), value, sigma)


def _repeated(rows: Sequence[_Row], readings: Sequence[_Reading]) -> list[str]:
    """Find rows that repeat another one, number by number: a measurement that was copied, not one made again."""
    first: dict[tuple[int, int, float], str] = {}
    found = []
    for row, one in zip(rows, readings, strict=True):
        key = one.case, one.which, one.value
        if key in first:
            found.append((row.label, first[key].rpartition(": ")[2], one.name))
        first.setdefault(key, row.label)
    if not found:
        return []
    label, line, name = found[0]
    return [f"{label}: '{name}' of {line} again, expected each measurement once{others(len(found) - 1)}"]


def _astray(table: Table, rest: Sequence[int], name: str, heads: Mapping[str, str]) -> list[str]:
    """Find rows of displacements that have a value: of which output is not said."""
    bad = [table.lines[i] for i in rest if table.rows[i][heads[VALUE]]]
    return [f"{name}: line {bad[0]}: a {VALUE} of no output, expected its name{others(len(bad) - 1)}"] if bad else []
