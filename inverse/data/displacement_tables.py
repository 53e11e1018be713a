"""Tables of measured displacements.

A table of comma-separated values has the columns x, y, z (of the undeformed body), any of ux, uy, uz, and optionally
sigma, or sigma_x, sigma_y, sigma_z (standard deviations of the errors), and case (name of the load case). Heads may
state the unit of all lengths: ``x [mm]``, ``ux [mm]``. Empty cells and ``nan`` mean that a component was not measured.
Lines that begin with # state the source of the data, and lines ``# truth.NAME = VALUE`` the true values behind
synthetic data. Other files: `inverse.data.scans`.

Rows may hold measured outputs of load cases, such as the forces of tools, in place of displacements. Such a row names
its output in the column `output` and gives its `value`; where it stands among displacements, its cells x, y, z and ux,
uy, uz are empty. The standard deviation of its error is in `sigma_value`, or else in `sigma`, in the unit of the
output. Heads may state units, ``value [mN]`` with ``sigma_value [mN]``, where all outputs have the same.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from forward.model import FloatArray
from forward.settings import nearest
from inverse.data.measurements import AXES, SAME, Measurements
from inverse.data.table import DataError, Reader, Table, factor, needed, numeric, others, table_of, wrong_columns

OUTPUT, VALUE, ERROR, COMMON = "output", "value", "sigma_value", "sigma"
Row = Mapping[str, str]  # cells by their columns
Reading = tuple[int, int, str, float, float]  # load case and output by number, name of the output, value, σ
Units = Mapping[str, str]  # SI units of the outputs of a load case, by their names, in its order
MOTION, ERRORS = ("ux", "uy", "uz"), ("sigma_x", "sigma_y", "sigma_z")
COLUMNS = (*AXES, *MOTION, "sigma", *ERRORS, "case")


def split(table: Table, name: str, cases: Mapping[str, Units]) -> tuple[Table, Measurements]:
    """Take the rows of outputs out of a table, of displacements, of outputs or of both, in a file of some name.

    Load cases are given by name, with what is measured in them. Returned are the table of the displacements alone,
    which may have no rows, and the outputs. Raises `DataError` with every kind of mistake in rows of outputs, and in
    what their columns are called.
    """
    if OUTPUT not in table.columns:
        return table, Measurements.of(np.zeros(0), np.zeros(0), (), (), parts=tuple(cases))
    wrong, found, labels = _of_columns(table, name), [], []
    mine = [i for i, row in enumerate(table.rows) if row[OUTPUT]]
    for i in mine:
        labels.append(f"{name}: line {table.lines[i]}")
        try:
            found.append(_reading(table.rows[i], table.units, cases))
        except ValueError as error:
            wrong.append(f"{labels[-1]}: {error}")
    if not wrong:
        wrong = _repeated(labels, found)
    if wrong:
        raise DataError(*wrong)
    of, axes, names, values, sigma = zip(*found, strict=True) if found else ((),) * 5
    readings = Measurements.of(np.array(values), np.array(sigma), of, axes, names, labels, tuple(cases))
    columns = tuple(column for column in table.columns if column not in (OUTPUT, VALUE, ERROR))
    rest = [i for i in range(len(table.rows)) if i not in set(mine)]
    rows, lines = [table.rows[i] for i in rest], [table.lines[i] for i in rest]
    return replace(table, columns=columns, rows=rows, lines=lines), readings


def _of_columns(table: Table, name: str) -> list[str]:
    """Find what is wrong with the columns of outputs, which is raised, and values of which no output is named."""
    if VALUE not in table.columns:
        raise DataError(f"{name}: a column '{OUTPUT}' and none '{VALUE}', expected both")
    error = next((column for column in (ERROR, COMMON) if column in table.columns), None)
    if error is not None and table.units[VALUE] is not None and table.units[error] is None:
        raise DataError(f"{name}: '{VALUE}' states a unit and '{error}' does not, expected '{ERROR}' with its unit")
    rows = zip(table.lines, table.rows, strict=True)
    bad = [line for line, row in rows if row[VALUE] and not row[OUTPUT]]
    return [f"{name}: line {bad[0]}: a {VALUE} of no output, expected its name{others(len(bad) - 1)}"] if bad else []


def _reading(row: Row, stated: Mapping[str, str | None], cases: Mapping[str, Units]) -> Reading:
    """Read a row, whose heads state units; a ValueError for what is wrong with it."""
    name, names = row[OUTPUT], tuple(cases)
    case = row.get("case") or (names[0] if len(names) == 1 else "")
    if case not in cases:
        message = f"unknown load case '{case}'" if case else "no load case"
        raise ValueError(f"{message}; {nearest(case, names)}")
    units = cases[case]
    if name not in units:
        known = f"; {nearest(name, tuple(units))}" if units else ", which states no outputs (model.cases: outputs = …)"
        raise ValueError(f"no output '{name}' is measured in load case '{case}'{known}")
    filled = [column for column in (*AXES, *MOTION) if row.get(column)]
    if filled:
        raise ValueError(
            f"the row of an output has a number in {filled[0]}, expected displacements in a row of their own"
        )
    value, column = _number(row, VALUE, stated, units[name]), ERROR if ERROR in row else COMMON
    sigma = _number(row, column, stated, units[name]) if column in row else math.nan
    if math.isnan(value):
        raise ValueError(f"no {VALUE} of '{name}', expected a number")
    return names.index(case), len(AXES) + list(units).index(name), name, value, sigma


def _number(row: Row, column: str, stated: Mapping[str, str | None], si: str) -> float:
    """Return a number in SI units; NaN for an empty cell; a ValueError if it is none, or of another quantity."""
    unit = stated[column]
    try:
        scale = 1.0 if unit is None else factor(unit, si)
    except ValueError as error:
        more = f", in a column {ERROR}" if column == COMMON else ""
        raise ValueError(f"column '{column}' has {error} for '{row[OUTPUT]}'{more}") from None
    return scale * numeric(row[column], column, positive=column in (ERROR, COMMON))


def _repeated(labels: Sequence[str], readings: Sequence[Reading]) -> list[str]:
    """Find rows that repeat another one, number by number: a measurement that was copied, not one made again."""
    first: dict[tuple[int, int, float], str] = {}
    found = []
    for label, (case, axis, name, value, _) in zip(labels, readings, strict=True):
        before = first.setdefault((case, axis, value), label)
        if before != label:
            found.append(f"{label}: '{name}' of {before.rpartition(': ')[2]} again")
    return [f"{found[0]}, expected each measurement once{others(len(found) - 1)}"] if found else []


def of_table(
    path: Path, known: Mapping[str, Units], unit: float | None = None, reader: Reader | None = None
) -> Measurements:
    """Read a table of displacements in m, unless it or `unit` says otherwise, and of other outputs of known load cases.

    Raises `DataError` with every kind of mistake in the file.
    """
    name, cases = path.name, tuple(known)
    table, readings = split(table_of(path, reader).with_units(name), name, known)
    readings = replace(readings, source=table.source, truth={one: value.strip('"') for one, value in table.truth})
    if not table.rows:
        return readings
    unit, columns, rows = _metres(table, name, unit), table.columns, table.rows
    wrong = wrong_columns(name, columns, COLUMNS, AXES)
    if not any(column in columns for column in MOTION):
        wrong.append(f"{name}: no column of displacements, expected at least one of ux, uy, uz")
    if "case" not in columns and len(cases) > 1:
        wrong.append(f"{name}: no column 'case', expected one where there are several load cases: {', '.join(cases)}")
    if wrong:
        raise DataError(*wrong)
    labels = tuple(f"{name}: line {n}" for n in table.lines)
    numbers: dict[str, FloatArray] = {}
    mistakes = []
    for column in (one for one in COLUMNS if one in columns and one != "case"):
        values, bad = np.full(len(rows), math.nan), []
        for i, row in enumerate(rows):
            try:
                values[i] = _component(row[column], column)
            except ValueError as error:
                bad.append(f"{labels[i]}: {error}")
        mistakes += [f"{line}{others(len(bad) - 1)}" for line in bad[:1]]
        numbers[column] = unit * values
    given_cases = [row["case"] if "case" in columns else cases[0] for row in rows]
    strange = [i for i, case in enumerate(given_cases) if case not in cases]
    if strange:
        word = given_cases[strange[0]]
        more = others(len(strange) - 1)
        mistakes.append(f"{labels[strange[0]]}: unknown load case '{word}'; {nearest(word, cases)}{more}")
    if mistakes:
        raise DataError(*mistakes)
    nothing = np.full(len(rows), np.nan)
    common = numbers.get("sigma", nothing)
    return Measurements.of_points(
        np.column_stack([numbers[column] for column in AXES]),
        np.column_stack([numbers.get(column, nothing) for column in MOTION]),
        np.column_stack([numbers.get(column, common) for column in ERRORS]),
        np.array([cases.index(case) for case in given_cases]),
        labels,
        cases,
        unit=unit,
        source=readings.source,
        truth=readings.truth,
    ).with_rows(readings)


def _metres(table: Table, name: str, unit: float | None) -> float:
    """Return m per unit of the lengths of a table, which its heads state, or the study."""
    lengths = [(column, table.units[column]) for column in table.columns if column != "case"]
    said = {unit for _, unit in lengths}
    stated = sorted(one for one in said if one is not None)
    if not stated:
        return 1.0 if unit is None else unit
    if len(said) > 1:
        words = ", ".join(column if one is None else f"{column} [{one}]" for column, one in lengths)
        raise DataError(f"{name}: mixed units: {words}; expected the same unit in all heads, or in none")
    try:
        scale = factor(stated[0], "m")
    except ValueError as error:
        raise DataError(f"{name}: column '{lengths[0][0]}' has {error}") from None
    if unit is not None and abs(unit / scale - 1) > SAME:
        raise DataError(
            f"{name}: its heads state {stated[0]}, but the study says {unit:g} m per unit; expected one of them"
        )
    return scale


def _component(text: str, column: str) -> float:
    """Return a number; where none has to be, an empty cell or NaN is one that was not measured."""
    if column in AXES:
        return needed(text, column)
    return numeric("" if text.lower() == "nan" else text, column, positive=column not in MOTION)
