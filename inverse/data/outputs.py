"""Measured outputs of a model: a table with a row for each measurement, or numbers by name.

A table of comma-separated values has the columns `output` and `value`, in the unit of the output, and may have `sigma`,
the standard deviation of the error. An output may be measured several times. Lines that begin with # state the source
of the data; ``# truth.PATH = number`` gives the true value of a number of the model. Curves have tables of
their own kind (`inverse.data.curves`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from forward.settings import nearest
from inverse.data.curves import Steps, as_rows
from inverse.data.measurements import Measurements
from inverse.data.table import DataError, Reader, needed, numeric, table_of

COLUMNS = ("output", "value", "sigma")


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
    wrong = [
        f"{name}: unknown column '{column}'; {nearest(column, COLUMNS)}"
        for column in table.columns
        if column not in COLUMNS
    ]
    wrong += [
        f"{name}: no column '{column}', expected output, value" for column in COLUMNS[:2] if column not in table.columns
    ]
    if wrong:
        raise DataError(*wrong)
    names = tuple(row["output"] for row in table.rows)
    labels = tuple(f"{name}: line {line}" for line in table.lines)
    for label, one in zip(labels, names, strict=True):
        if one not in outputs:
            wrong.append(f"{label}: the model has no output '{one}'; {nearest(one, tuple(outputs))}")
    numbers: dict[str, list[float]] = {}
    for column in (one for one in COLUMNS[1:] if one in table.columns):
        for label, row in zip(labels, table.rows, strict=True):
            try:
                value = (
                    needed(row[column], column) if column == "value" else numeric(row[column], column, positive=True)
                )
            except ValueError as error:
                wrong.append(f"{label}: {error}")
            else:
                numbers.setdefault(column, []).append(value)
    truth = {}
    for path_of, text in table.truth:
        try:
            truth[path_of] = needed(text, f"truth.{path_of}")
        except ValueError as error:
            wrong.append(f"{name}: {error}")
    if wrong:
        raise DataError(*wrong)
    sigma = np.array(numbers.get("sigma", [math.nan] * len(names)))
    values, axes = np.array(numbers["value"]), [outputs.index(one) for one in names]
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
