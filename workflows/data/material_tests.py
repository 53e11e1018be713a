"""Material tests with their data: written out in a study, or in a table beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator

from forward.materials.material_point import HELD, Component, MaterialTest, Mode, named
from forward.settings import Settings, nearest
from inverse.data.measurements import Measurements
from inverse.data.table import AnyReader, DataError, Table, needed, table_of
from workflows.config.mistakes import StudyError, lines
from workflows.config.tables import at

COMPONENTS: tuple[Component, ...] = ("P1", "P2", "P1-P2")
MODES: tuple[Mode, ...] = ("uniaxial", "equibiaxial", "biaxial", "pure-shear", "simple-shear")
WHOLE = "all"  # name of the group if there is only one
SHORTENED = 0.9  # stretch below which no error of measurement makes a compression a tension
LARGEST_STRETCH = 20.0  # larger values mean that a column holds per cent or lengths


class MeasuredTest(MaterialTest):
    """A test with what was measured.

    Parameters
    ----------
    measured
        Stresses (Pa) at each stretch or amount of shear.
    sigma
        Standard deviations (Pa) of their errors, where they are known.
    group
        Specimen, region, …: each group has its own constants.
    """

    measured: tuple[float, ...]
    sigma: tuple[Annotated[float, Field(gt=0)], ...] | None = None
    group: str = WHOLE

    @model_validator(mode="after")
    def _check_sizes(self) -> MeasuredTest:
        for name, values in (("measured", self.measured), ("sigma", self.sigma)):
            if values is not None and len(values) != len(self.at):
                raise ValueError(f"{name}: {len(values)} values, expected as many as in at: {len(self.at)}")
        return self

    @model_validator(mode="after")
    def _check_signs(self) -> MeasuredTest:
        """Refuse that what is shortened pulls, as strains do that are read as stretches; not for an error near rest."""
        if self.mode == "simple-shear" or self.component != "P1":
            return self
        # Tension is along the longer sides (M. Baker, J. L. Ericksen, J. Wash. Acad. Sci. 44 (1954) 33): here along 1.
        across = self.across or ()
        along = [(x * x * z) ** (1 / 3) for x, z in zip(self.at, across, strict=True)] if across else self.at
        shortest, at, stress = min(zip(along, self.at, self.measured, strict=True))
        if shortest < SHORTENED and stress > 0:
            message = (
                f"at: {at:g} with a tension of {stress:.4g} Pa: is it a strain? Expected stretches, 1 + strain "
                "(1 is undeformed); if it is one, the stress of a compression is negative"
            )
            raise ValueError(message)
        return self


class DataFile(Settings):
    """Tests in a table of comma-separated values; lines that begin with # state their source.

    Parameters
    ----------
    file
        The table, beside the study.
    mode, at, across, measured, sigma, group
        Names of the columns: kind of test, stretch or amount of shear, second stretch (of biaxial tests), stress and,
        if there are any, its standard deviation and the group. Where rows hold both stresses, or their difference,
        `measured` (and `sigma`) name a column for each: ``{ P1 = "force_x", P2 = "force_y" }``; empty cells are left
        out. Each stress is a separate test: "biaxial", "biaxial P2", "biaxial P1-P2".
    component
        Column that says which stress a row holds, if each row has one: P1, P2 or P1-P2.
    modes
        Meaning of the words in the column of modes, if they are not names of modes.
    unit
        Pa in the unit of stresses.
    stress
        "nominal" or "cauchy".
    where
        Rows to keep: by column, the word that must be there.
    between
        Smallest and largest stretch or amount of shear to keep.
    reader
        What reads a file of a kind of your own, as a table.
    """

    file: str
    mode: str = "mode"
    at: str = "stretch"
    across: str | None = None
    measured: str | dict[Component, str] = "stress"
    sigma: str | dict[Component, str] | None = None
    component: str | None = None
    group: str | None = None
    modes: dict[str, Mode] = Field(default={})
    unit: Annotated[float, Field(gt=0)] = 1.0
    stress: Literal["nominal", "cauchy"] = "nominal"
    where: dict[str, str] = Field(default={})
    between: tuple[float, float] | None = None
    reader: AnyReader = None

    def read(self, folder: Path) -> dict[str, Any]:
        """Return the block `data` with the tests themselves.

        A DataError says that the table cannot be read, lacks a column, or holds something that is not a number.
        """
        path = folder / self.file
        table = self._table(path)
        tests = self._tests(table, path)
        if not tests:
            raise DataError(f"data: {path}: no row is left; data.where and data.between say which ones are kept")
        found = [
            {"mode": self.modes.get(word, word), "name": named(word, component), "stress": self.stress}
            | {"group": group, "component": component, **columns}
            for (group, word, component), columns in tests.items()
        ]
        return {"source": list(table.remarks), "tests": found}

    def _table(self, path: Path) -> Table:
        """Read the table, which must have all columns that are named, and no row twice."""
        try:
            table = table_of(path, self.reader)
        except DataError as error:
            raise DataError(*(f"data.file: {line}" for line in error.args)) from None
        columns = [self.mode, self.at, self.across, self.component, self.group, *self.where]
        columns += [column for pair in self.stresses.values() for column in pair]
        for column in columns:
            if column is not None and column not in table.columns:
                raise DataError(f"data: {path} has no column '{column}'; {nearest(column, table.columns)}")
        seen: dict[tuple[str, ...], int] = {}
        for line, row in zip(table.lines, table.rows, strict=True):
            before = seen.setdefault(tuple(row.values()), line)
            if before != line:
                raise DataError(f"data: {path}: lines {before} and {line} are the same, expected each measurement once")
        return table

    def _tests(self, table: Table, path: Path) -> dict[tuple[str, str, Component], dict[str, list[float]]]:
        """Return the columns of each test, by its group, the word for its mode and the stress that was measured."""
        tests: dict[tuple[str, str, Component], dict[str, list[float]]] = {}
        for line, row in zip(table.lines, table.rows, strict=True):
            if any(row[column] != word for column, word in self.where.items()):
                continue
            word = row[self.mode]
            mode = self.modes.get(word, word)
            place = f"{path}, line {line}"
            at = _stretch(row[self.at], place, self.at, positive=mode != "simple-shear")
            if self.between is not None and not self.between[0] <= at <= self.between[1]:
                continue
            if mode not in MODES:
                raise DataError(f"data: {place}: unknown mode '{word}'; {nearest(word, (*MODES, *self.modes))}")
            across = None
            if self.across is not None and mode == "biaxial":
                across = _stretch(row[self.across], place, self.across, positive=True)
            for component, (measured, sigma) in self._in_row(row, place, held=mode in HELD).items():
                test = tests.setdefault((row[self.group] if self.group else WHOLE, word, component), {})
                test.setdefault("at", []).append(at)
                if across is not None:
                    test.setdefault("across", []).append(across)
                value = _number(row[measured], place, measured)
                test.setdefault("measured", []).append(self.unit * value)
                if sigma is not None:
                    width = _number(row[sigma], place, sigma, positive=True)
                    test.setdefault("sigma", []).append(self.unit * width)
        return tests

    @property
    def stresses(self) -> dict[Component, tuple[str, str | None]]:
        """Columns of each stress and of its standard deviation."""
        measured = self.measured if isinstance(self.measured, dict) else {COMPONENTS[0]: self.measured}
        sigma = self.sigma if isinstance(self.sigma, dict) else dict.fromkeys(measured, self.sigma)
        return {component: (column, sigma.get(component)) for component, column in measured.items()}

    def _in_row(self, row: Mapping[str, str], place: str, *, held: bool) -> dict[Component, tuple[str, str | None]]:
        """Columns of the stresses that a row holds; modes with a load across may have two."""
        stresses = self.stresses
        if self.component is not None:
            word = row[self.component] or "P1"
            component = next((name for name in COMPONENTS if name == word), None)
            if component is None:
                raise DataError(f"data: {place}, {self.component}: '{word}'; {nearest(word, COMPONENTS)}")
            return {component: next(iter(stresses.values()))}
        found = {c: pair for c, pair in stresses.items() if len(stresses) == 1 or row[pair[0]].strip()}
        strange = next((pair[0] for c, pair in found.items() if c != "P1" and not held), None)
        if strange is not None:
            message = f"data: {place}, {strange}: a stress across, expected an empty cell: nothing acts across there"
            raise DataError(message)
        if not found:
            message = f"data: {place}: no stress, expected one in {' or '.join(c for c, _ in stresses.values())}"
            raise DataError(message)
        return found

    @model_validator(mode="after")
    def _check_stresses(self) -> DataFile:
        stresses = self.stresses
        if not stresses:
            raise ValueError("measured: no column, expected one for each stress: { P1 = ..., P2 = ... }")
        if self.component is not None and len(stresses) > 1:
            raise ValueError("component: stands beside several columns of stresses, expected one column of them")
        lacking = [c for c, (_, sigma) in stresses.items() if sigma is None]
        if self.sigma is not None and lacking:
            raise ValueError(f"sigma: no column for {', '.join(lacking)}, expected one for each stress")
        return self


class MeasuredTests(Settings):
    """What was measured.

    Parameters
    ----------
    tests
        Material tests with their data.
    source
        Their source, line by line.
    """

    quantity: ClassVar[str] = "stress"

    tests: tuple[MeasuredTest, ...] = Field(min_length=1)
    source: tuple[str, ...] = ()

    @property
    def data_groups(self) -> tuple[str, ...]:
        """Names of the groups."""
        return tuple(dict.fromkeys(test.group for test in self.tests))

    def of(self, group: str) -> list[MeasuredTest]:
        """Return the tests of a group."""
        return [test for test in self.tests if test.group == group]

    def measurements(self, group: str, predicted: Sequence[MaterialTest]) -> Measurements:
        """Return what was measured in a group, and then what is only predicted."""
        measured, unknown = self.of(group), [(math.nan,) * len(test.at) for test in predicted]
        sigma, tests = [test.sigma or (math.nan,) * len(test.at) for test in measured], [*measured, *predicted]
        return Measurements.of_tests(
            np.concatenate([*(test.measured for test in measured), *unknown]),
            np.concatenate([*sigma, *unknown]),
            [test.label for test in tests for _ in test.at],
            np.concatenate([test.at for test in tests]),
            np.array([(x, z) for test in tests for x, z in zip(test.at, test.across or test.at, strict=True)]),
        )


def expanded(document: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return a document whose table of tests, if it names one, has been read; a StudyError if that cannot be done."""
    if "model" in document or at(document, "data", "file") is None:
        return dict(document)
    try:
        return {**document, "data": DataFile.model_validate(dict(document["data"])).read(folder)}
    except ValidationError as error:
        raise StudyError(*lines(error, "data")) from None
    except DataError as error:
        raise StudyError(*error.args) from None


def _stretch(text: str, place: str, column: str, *, positive: bool) -> float:
    value = _number(text, place, column)
    if positive and value <= 0:
        raise DataError(f"data: {place}: {column} is {text!r}, expected a number more than 0: stretches, 1 + strain")
    if abs(value) > LARGEST_STRETCH:
        message = f"data: {place}: {column} is {text!r}, expected a stretch (1 is undeformed), or an amount of shear"
        raise DataError(message)
    return value


def _number(text: str, place: str, column: str, *, positive: bool = False) -> float:
    try:
        return needed(text, column, positive=positive)
    except ValueError as error:
        raise DataError(f"data: {place}: {error}") from None
