"""Tables of measured displacements.

A table of comma-separated values has the columns x, y, z (of the undeformed body), any of ux, uy, uz, and optionally
sigma, or sigma_x, sigma_y, sigma_z (standard deviations of the errors), and case (name of the load case). Heads may
state the unit of all lengths: ``x [mm]``, ``ux [mm]``. Empty cells and ``nan`` mean that a component was not measured.
Lines that begin with # state the source of the data, and lines ``# truth.NAME = VALUE`` the true values behind
synthetic data. Rows may hold measured outputs of load cases, such as forces of tools, in place of displacements:
`inverse.data.readings`. Other files: `inverse.data.scans`.

Most of the module describes what may be wrong with a table, each mistake with its line.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from forward.model import FloatArray
from forward.settings import nearest
from inverse.data.measurements import AXES, SAME, Measurements
from inverse.data.reader import Reader, table_of
from inverse.data.readings import Units, split
from inverse.data.table import DataError, Table, needed, numeric, others
from inverse.data.units import factor

MOTION, ERRORS = ("ux", "uy", "uz"), ("sigma_x", "sigma_y", "sigma_z")
COLUMNS = (*AXES, *MOTION, "sigma", *ERRORS, "case")


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
    wrong = [
        f"{name}: unknown column '{column}'; {nearest(column, COLUMNS)}" for column in columns if column not in COLUMNS
    ]
    wrong += [f"{name}: no column '{column}', expected x, y, z" for column in AXES if column not in columns]
    if not any(column in columns for column in MOTION):
        wrong.append(f"{name}: no column of displacements, expected at least one of ux, uy, uz")
    if "case" not in columns and len(cases) > 1:
        wrong.append(f"{name}: no column 'case', expected one where there are several load cases: {', '.join(cases)}")
    if wrong:
        raise DataError(*wrong)
    labels = tuple(f"{name}: line {n}" for n in table.lines)
    numbers: dict[str, FloatArray] = {}
    mistakes = []
    for column in (*AXES, *MOTION, "sigma", *ERRORS):
        if column not in columns:
            continue
        values, bad = np.full(len(rows), math.nan), []
        for i, row in enumerate(rows):
            try:
                values[i] = _number(row[column], column)
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


def _number(text: str, column: str) -> float:
    """Return a number; where none has to be, an empty cell or NaN is one that was not measured."""
    if column in AXES:
        return needed(text, column)
    return numeric("" if text.lower() == "nan" else text, column, positive=column not in MOTION)
