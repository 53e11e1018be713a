"""Measured outputs of a model: a table with a row for each measurement, or numbers by name.

A table of comma-separated values has the columns `output` and `value`, in the unit of the output, and may have `sigma`,
the standard deviation of the error. An output may be measured several times. Lines that begin with # state the source
of the data; ``# truth.PATH = number`` gives the true value of a number of the model. Curves have tables of
their own kind (`inverse.data.curves`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from forward.settings import nearest
from inverse.data.approximation_error import Places
from inverse.data.curves import Steps, as_rows
from inverse.data.neighbours import Neighbours, neighbours
from inverse.data.table import DataError, needed, numeric, read_table

COLUMNS = ("output", "value", "sigma")


@dataclass(frozen=True, eq=False)
class OutputData:
    """Measured outputs of a model, each a separate part of the data.

    Attributes
    ----------
    names
        Measured outputs (m,); an output may occur several times.
    values, sigma
        What was measured (m,), and the standard deviations (m,) of the errors, NaN if unknown.
    labels
        Location (m,) of each in its file.
    source
        Their source, line by line.
    truth
        Numbers of the model, by path.
    outputs
        All outputs of the model, in its order.
    parts
        Outputs with data in any data set of a study, in the order of the model.
    """

    names: tuple[str, ...]
    values: FloatArray
    sigma: FloatArray
    labels: tuple[str, ...]
    source: tuple[str, ...] = ()
    truth: Mapping[str, float] = field(default_factory=dict)
    outputs: tuple[str, ...] = ()
    parts: tuple[str, ...] = ()

    @property
    def data(self) -> OutputData:
        """Itself: what is compared with a model."""
        return self

    def of(self, outputs: Sequence[str], parts: Sequence[str]) -> OutputData:
        """Return the same as data of a model with these outputs."""
        return replace(self, outputs=tuple(outputs), parts=tuple(parts))

    @property
    def which(self) -> tuple[int, ...]:
        """Numbers (m,) of the outputs of the model."""
        return tuple(self.outputs.index(name) for name in self.names)

    @property
    def cases(self) -> NDArray[np.int64]:
        """Numbers (m,) of the parts."""
        return np.array([self.parts.index(name) for name in self.names], dtype=np.int64)

    @property
    def described(self) -> dict[str, FloatArray]:
        """Nothing else: the parts are the outputs."""
        return {}

    @property
    def spread(self) -> Places:
        """At no places, by output."""
        return Places(self.cases)

    def neighbours(self) -> Neighbours:
        """Return pairs of repeated measurements."""
        return neighbours(np.zeros((len(self.names), 1)), self.cases)

    def with_sigma(self, given: Mapping[str, float], relative: float, absolute: float) -> OutputData:
        """Return the same with standard deviations of the errors where they are unknown.

        Parameters
        ----------
        given
            By output.
        relative, absolute
            For other outputs, σ = max(relative |y|, absolute).

        Raises
        ------
        DataError
            If one is still unknown.
        """
        general = np.maximum(relative * np.abs(self.values), absolute)
        general = np.array([given.get(name, one) for name, one in zip(self.names, general, strict=True)])
        sigma = np.where(np.isnan(self.sigma), general, self.sigma)
        lost = [label for label, one in zip(self.labels, sigma, strict=True) if not one > 0]
        if lost:
            more = f" (and {len(lost) - 1} more)" if len(lost) > 1 else ""
            raise DataError(
                f"{lost[0]}: the standard deviation of the error is not known{more}, expected a column sigma, "
                "data.sigma of this output, or data.noise that does not vanish there"
            )
        return replace(self, sigma=sigma)

    def with_truth(self, truth: Mapping[str, float]) -> OutputData:
        """Return the same with true numbers of the model that are known separately."""
        return replace(self, truth={**self.truth, **truth})

    def data_labels(self) -> list[str]:
        """Say for each datum its location, and its output."""
        return [f"{label}, {name}" for label, name in zip(self.labels, self.names, strict=True)]


def read_outputs(path: Path, outputs: Sequence[str], steps: Steps | None = None) -> OutputData:
    """Read a table of measured outputs.

    Parameters
    ----------
    path
        The table.
    outputs
        Names of the outputs of the model.
    steps
        Of a path, where the table may be a curve.

    Raises
    ------
    DataError
        With every kind of mistake in the file.
    """
    table = read_table(path)
    name = path.name
    if steps is not None and "output" not in table.columns:
        table = as_rows(table, name, steps)
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
    return OutputData(names, np.array(numbers["value"]), sigma, labels, table.source, truth)


def stated(values: Mapping[str, float | Sequence[float]]) -> OutputData:
    """Return measured outputs that a study states by name, one or several of each."""
    pairs = [
        (name, float(value))
        for name, given in values.items()
        for value in (given if isinstance(given, Sequence) else (given,))
    ]
    names = tuple(name for name, _ in pairs)
    labels = tuple(f"data.outputs.{name}" for name in names)
    return OutputData(names, np.array([value for _, value in pairs]), np.full(len(pairs), math.nan), labels)
