"""Measured outputs of load cases, such as the forces of tools: rows of the tables of displacements.

Such a row names its output in the column `output` and gives its `value`; where it stands among displacements, its cells
x, y, z and ux, uy, uz are empty. The standard deviation of its error is in `sigma_value`, or else in `sigma`, in the
unit of the output. Heads may state units, ``value [mN]`` with ``sigma_value [mN]``, where all outputs have the same.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from forward.settings import nearest
from inverse.data.measurements import AXES, Measurements
from inverse.data.table import DataError, Table, numeric, others
from inverse.data.units import factor, split_head

DISPLACED = ("x", "y", "z", "ux", "uy", "uz")  # columns of displacements
OUTPUT, VALUE, ERROR, COMMON = "output", "value", "sigma_value", "sigma"
Units = Mapping[str, str]  # SI units of the outputs of a load case, by their names, in its order


def split(table: Table, name: str, cases: Mapping[str, Units]) -> tuple[Table, Measurements]:
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
    mine = [i for i, row in enumerate(table.rows) if OUTPUT in heads and row[heads[OUTPUT]]]
    rows, wrong, found = [_Row(f"{name}: line {table.lines[i]}", table.rows[i], heads) for i in mine], [], []
    if OUTPUT in heads:
        wrong = _of_columns(table, name, heads)
    for row in rows:
        try:
            found.append(_reading(row, cases))
        except ValueError as error:
            wrong.append(f"{row.label}: {error}")
    if not wrong:
        wrong = _repeated(rows, found)
    if wrong:
        raise DataError(*wrong)
    of, axes, names, values, sigma = zip(*found, strict=True) if found else ((),) * 5
    labels = [row.label for row in rows]
    readings = Measurements.of(np.array(values), np.array(sigma), of, axes, names, labels, tuple(cases))
    dropped = {heads[column] for column in (OUTPUT, VALUE, ERROR) if column in heads and OUTPUT in heads}
    columns = tuple(head for head in table.columns if head not in dropped)
    rest = [i for i in range(len(table.rows)) if i not in set(mine)]
    kept = [{head: table.rows[i][head] for head in columns} for i in rest]
    return Table(table.remarks, columns, kept, [table.lines[i] for i in rest]), readings


def _of_columns(table: Table, name: str, heads: Mapping[str, str]) -> list[str]:
    """Find what is wrong with the columns of outputs, which is raised, and values of which no output is named."""
    if VALUE not in heads:
        raise DataError(f"{name}: a column '{OUTPUT}' and none '{VALUE}', expected both")
    error = next((column for column in (ERROR, COMMON) if column in heads), None)
    if error is not None and split_head(heads[VALUE])[1] is not None and split_head(heads[error])[1] is None:
        raise DataError(f"{name}: '{VALUE}' states a unit and '{error}' does not, expected '{ERROR}' with its unit")
    rows = zip(table.lines, table.rows, strict=True)
    bad = [line for line, row in rows if row[heads[VALUE]] and not row[heads[OUTPUT]]]
    return [f"{name}: line {bad[0]}: a {VALUE} of no output, expected its name{others(len(bad) - 1)}"] if bad else []


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


def _reading(row: _Row, cases: Mapping[str, Units]) -> tuple[int, int, str, float, float]:
    """Return the number of the load case, number and name of what is measured there, value and σ; or a ValueError."""
    name, names = row[OUTPUT], tuple(cases)
    case = row["case"] or (names[0] if len(names) == 1 else "")
    if case not in cases:
        message = f"unknown load case '{case}'" if case else "no load case"
        raise ValueError(f"{message}; {nearest(case, names)}")
    units = cases[case]
    if name not in units:
        known = f"; {nearest(name, tuple(units))}" if units else ", which states no outputs (model.cases: outputs = …)"
        raise ValueError(f"no output '{name}' is measured in load case '{case}'{known}")
    filled = [column for column in DISPLACED if row[column]]
    if filled:
        raise ValueError(
            f"the row of an output has a number in {filled[0]}, expected displacements in a row of their own"
        )
    value = row.number(VALUE, units[name])
    column = ERROR if ERROR in row.heads else COMMON
    sigma = row.number(column, units[name]) if column in row.heads else math.nan
    if math.isnan(value):
        raise ValueError(f"no {VALUE} of '{name}', expected a number")
    return names.index(case), len(AXES) + list(units).index(name), name, value, sigma


def _repeated(rows: Sequence[_Row], readings: Sequence[tuple[int, int, str, float, float]]) -> list[str]:
    """Find rows that repeat another one, number by number: a measurement that was copied, not one made again."""
    first: dict[tuple[int, int, float], str] = {}
    found = []
    for row, (case, axis, _, value, _) in zip(rows, readings, strict=True):
        before = first.setdefault((case, axis, value), row.label)
        if before != row.label:
            found.append(f"{row.label}: '{row[OUTPUT]}' of {before.rpartition(': ')[2]} again")
    return [f"{found[0]}, expected each measurement once{others(len(found) - 1)}"] if found else []
