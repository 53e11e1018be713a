"""Measured outputs of a model: a table with a row for each measurement, numbers by name, or curves over a path's steps.

A table of comma-separated values has the columns `output` and `value`, in the unit of the output, and may have `sigma`,
the standard deviation of the error. An output may be measured several times. Lines that begin with # state the source
of the data; ``# truth.PATH = number`` gives the true value of a number of the model.

Of a curve, a column says where on the path each row is: a number that has steps (``depth``, or its whole path), or
``step``. The others are measured outputs (``force``), with ``sigma_force`` or ``sigma`` for the standard deviations of
their errors. Heads may state units, all or none: ``depth [mm]``. A cell may be empty where nothing was measured. Rows
are in the order of the path, since a table that turns back holds unloading, which a material without memory does not
tell from loading; a place may occur several times in a row, where a measurement was repeated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from forward.model import FloatArray
from forward.settings import nearest
from inverse.data.measurements import Measurements
from inverse.data.table import DataError, Reader, Table, factor, needed, numeric, others, table_of, wrong_columns

CLOSE = 1e-6  # of the largest number: rows this near to a step are at it
COLUMNS = ("output", "value", "sigma")


class Steps(NamedTuple):
    """What is computed along a path.

    Attributes
    ----------
    units
        Units of the outputs, by their names without a step.
    numbers
        By path: the unit of a number that has steps, and its values.
    """

    units: Mapping[str, str]
    numbers: Mapping[str, tuple[str, Sequence[float]]]

    @property
    def places(self) -> dict[str, tuple[str, FloatArray]]:
        """Units and values of what a column can say about the place of a row, by its possible names."""
        count = len(next(iter(self.numbers.values()))[1])
        found = {"step": ("1", np.arange(1.0, count + 1))}
        for path, (unit, values) in self.numbers.items():
            found[path] = found[path.rpartition(".")[2]] = unit, np.array(values)
        return found


def steps_of(spec: Any) -> Steps | None:
    """Return the steps of a model (`ModelSpec`); None if it has none."""
    axes = dict(spec.axes_of_outputs)
    if "output_of" not in axes:
        return None
    of, at = axes.pop("output_of")[1], axes.pop("step")[1]
    first = [at.index(step) for step in sorted(set(at))]
    units = {one: output.unit for one, output in zip(of, spec.returned, strict=True)}
    return Steps(units, {path: (unit, [values[i] for i in first]) for path, (unit, values) in axes.items()})


def as_rows(table: Table, name: str, steps: Steps) -> Table:
    """Return the table of a curve as one with a row for each datum, in SI units.

    Raises `DataError` with every kind of mistake in the heads, or in the places of the rows.
    """
    scales = _scales(table, name, steps)
    places = steps.places
    where = [column for column in table.columns if column in places]
    rows, lines, wrong = [], [], []
    before: tuple[int, int] | None = None  # step and line of the row before
    first: dict[tuple[int, str, str], int] = {}  # lines by what was measured
    for row, line in zip(table.rows, table.lines, strict=True):
        try:
            at = _step(row, where, places, scales)
        except ValueError as error:
            wrong.append(f"{name}: line {line}: {error}")
            continue
        if before is not None and at < before[0] and "step" not in table.columns:
            message = f"{where[0]} = {row[where[0]]} after that of line {before[1]}, which is farther along the path"
            wrong.append(f"{name}: line {line}: {message}; expected loading only, in order")
        before = at, line
        for output in (one for one in steps.units if row.get(one)):
            key = at, output, row[output]
            if key in first:
                message = f"'{output}' of line {first[key]} again, expected each measurement once"
                wrong.append(f"{name}: line {line}: {message}")
            first.setdefault(key, line)
            sigma = next((one for one in (f"sigma_{output}", "sigma") if one in row), None)
            rows.append(
                {
                    "output": f"{output}.{at}",
                    "value": _scaled(row[output], scales[output]),
                    "sigma": "" if sigma is None else _scaled(row[sigma], scales[sigma]),
                }
            )
            lines.append(line)
    if wrong:
        raise DataError(f"{wrong[0]}{others(len(wrong) - 1)}")
    return replace(table, columns=COLUMNS, rows=rows, lines=lines)


def _scales(table: Table, name: str, steps: Steps) -> dict[str, float]:
    """Return how many SI units a number in each column is, by its head."""
    scales, wrong, places = {}, [], steps.places
    columns = table.units.items()
    for column, unit in columns:
        of = column.removeprefix("sigma_")
        if column in places:
            si = places[column][0]
        elif of in steps.units:
            si = steps.units[of]
        elif column == "sigma":
            found = {steps.units[other] for other, _ in columns if other in steps.units}
            if len(found) != 1:
                wrong.append(f"{name}: sigma of several units, expected columns sigma_OUTPUT")
                continue
            (si,) = found
        else:
            known = [*places, *steps.units, *(f"sigma_{one}" for one in steps.units), "sigma"]
            wrong.append(f"{name}: unknown column '{column}'; {nearest(column, known)}")
            continue
        try:
            scales[column] = 1.0 if unit is None else factor(unit, si)
        except ValueError as error:
            wrong.append(f"{name}: column '{column}' has {error}")
    named = [column for column, _ in columns]
    if not set(named) & set(places):
        wrong.append(f"{name}: no column says where on the path a row is, expected one of: {', '.join(places)}")
    if not set(named) & set(steps.units):
        wrong.append(f"{name}: no column is a measured output, expected one of: {', '.join(steps.units)}")
    silent = [column for column, unit in columns if column != "step" and unit is None]
    stated = [column for column, unit in columns if column != "step" and unit is not None]
    if stated and silent:
        wrong.append(
            f"{name}: '{stated[0]}' states a unit and '{silent[0]}' does not, expected units of all columns or of none"
        )
    if wrong:
        raise DataError(*wrong)
    return scales


def _step(
    row: Mapping[str, str],
    where: Sequence[str],
    places: Mapping[str, tuple[str, FloatArray]],
    scales: Mapping[str, float],
) -> int:
    """Return the step of a row, from 1; a ValueError for what is wrong with its place."""
    near = np.ones(len(places["step"][1]), dtype=bool)
    told = []
    for column in where:
        value = needed(row[column], column) * scales[column]
        values = places[column][1]
        near &= np.abs(values - value) <= CLOSE * np.abs(values).max()
        told.append(f"{column} = {value:g}")
    if near.sum() == 1:
        return int(near.argmax()) + 1
    known = ", ".join(f"{value:g}" for value in places[where[0]][1])
    ways = "no step of the model" if not near.any() else "more than one step of the model"
    hint = ""
    for column in where:
        values, given = places[column][1], float(row[column])
        if places[column][0] == "m" and (np.abs(values - 1e-3 * given) <= CLOSE * np.abs(values).max()).any():
            hint = f" (in millimetres? then its head is '{column} [mm]', and all heads state units)"
    raise ValueError(f"{', '.join(told)} is {ways}; its steps are {where[0]} = {known}{hint}")


def _scaled(text: str, scale: float) -> str:
    """A number in SI units; what is not a number stays as it is, for the message that says so."""
    try:
        number = float(text)
    except ValueError:
        return text
    return text if scale == 1 or not math.isfinite(number) else repr(number * scale)


def read_outputs(
    path: Path, outputs: Sequence[str], steps: Steps | None = None, reader: Reader | None = None
) -> Measurements:
    """Read a table of measured outputs of a model, or of a path with these steps, where it may be a curve.

    Raises `DataError` with every kind of mistake in the file.
    """
    table = table_of(path, reader)
    name = path.name
    if steps is not None and "output" not in table.columns:
        table = as_rows(table.with_units(name), name, steps)
    wrong = wrong_columns(name, table.columns, COLUMNS, COLUMNS[:2])
    if wrong:
        raise DataError(*wrong)
    names = tuple(row["output"] for row in table.rows)
    labels = tuple(f"{name}: line {line}" for line in table.lines)
    for label, one in zip(labels, names, strict=True):
        if one not in outputs:
            wrong.append(f"{label}: the model has no output '{one}'; {nearest(one, tuple(outputs))}")

    def read(label: str, text: str, column: str, cell: Callable[..., float] = needed) -> float:
        try:
            return cell(text, column)
        except ValueError as error:
            wrong.append(f"{label}: {error}")
            return math.nan

    lines = list(zip(labels, table.rows, strict=True))
    values = np.array([read(label, row["value"], "value") for label, row in lines])
    sigma = np.full(len(lines), math.nan)
    if "sigma" in table.columns:
        sigma = np.array([read(label, row["sigma"], "sigma", partial(numeric, positive=True)) for label, row in lines])
    truth = {path_of: read(name, text, f"truth.{path_of}") for path_of, text in table.truth}
    if wrong:
        raise DataError(*wrong)
    axes = [outputs.index(one) for one in names]
    rows = (values, sigma, axes, axes, names, labels, outputs)
    return Measurements.of(*rows, some=True, source=table.source, truth=truth)


def stated(given: Mapping[str, float | Sequence[float]], outputs: Sequence[str]) -> Measurements:
    """Return measurements that a study states by name, one or several of each output; errors as of `read_outputs`."""
    wrong = [name for name in given if name not in outputs]
    if wrong:
        raise DataError(
            *(f"outputs.{one}: not an output of the model; {nearest(one, tuple(outputs))}" for one in wrong)
        )
    pairs = [(name, float(value)) for name, several in given.items() for value in np.atleast_1d(several)]
    labels = [f"data.outputs.{name}" for name, _ in pairs]
    names, axes = [name for name, _ in pairs], [outputs.index(name) for name, _ in pairs]
    values = np.array([value for _, value in pairs])
    return Measurements.of(values, np.full(len(pairs), math.nan), axes, axes, names, labels, outputs, some=True)
