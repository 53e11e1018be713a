"""Measured outputs of a model: where their tables are, or what the study itself states."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import reduce
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field, model_validator

from forward.scalars import Mistake
from forward.settings import Settings, nearest
from forward.spec import ModelSpec
from inverse.data.measurements import Measurements
from inverse.data.noise import NORMAL, Errors
from inverse.data.outputs import read_outputs, stated, steps_of
from inverse.data.table import AnyReader, DataError, others
from workflows.config.mistakes import StudyError
from workflows.data.measured import DataSet, FileNames, Found, Positive, digest_of, read_files

Stated = dict[str, float | Annotated[tuple[float, ...], Field(min_length=1)]]  # one or several, by output
TABLES = "tables"  # name of the data set of several tables
STATED = "outputs"  # name of the data set given in the study itself


class OutputNoise(Settings):
    """Errors of measured outputs: normal, of standard deviation max(relative |value|, absolute).

    Parameters
    ----------
    relative
        In proportion to the value.
    absolute
        In the unit of the output.
    """

    relative: Annotated[float, Field(ge=0)] = 0.0
    absolute: Annotated[float, Field(ge=0)] = 0.0


class OutputFile(Settings):
    """Outputs by which models are compared, in a table or stated by name.

    Parameters
    ----------
    file
        A table with the columns output, value and, where it is known, sigma, beside the study.
    outputs
        Instead of a file: measurements by output, a number or a list of repeated measurements.
    sigma
        Standard deviations of the errors by output, if the table does not state them.
    reader
        What reads a file of a kind of your own, as such a table.
    digest, source
        Of the file as it was when the study ran: of its bytes, and what its remarks say; written by the run.
    """

    quantity: ClassVar[str] = "output"

    file: str | None = None
    outputs: Stated = Field(default={})
    sigma: dict[str, Positive] = Field(default={})
    reader: AnyReader = None
    digest: str = ""
    source: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _check(self) -> OutputFile:
        if (self.file is None) == (not self.outputs):
            raise ValueError("expected either a file or outputs")
        return self

    def read(self, folder: Path, model: ModelSpec) -> Measurements:
        """Read the table, or what the study itself states, of a model; a DataError if it cannot be used."""
        names = tuple(output.name for output in model.returned)
        found = (
            stated(by_element(self.outputs, names), names)
            if self.file is None
            else read_outputs(folder / self.file, names, steps_of(model), self.reader)
        )
        check_signs(found, model)
        sigma = by_element(self.sigma, names)
        return found.with_sigma(np.array([sigma.get(name, np.nan) for name in found.names]))


class MeasuredOutputs(Settings):
    """Measured outputs of the model, in tables or in the study itself.

    Parameters
    ----------
    files
        Tables with the columns output, value and, where it is known, sigma: names of files, folders, or patterns such
        as ``data/*.csv``, beside the study or else in the working directory. Each file is a data set and is inverted
        separately.
    tables
        Instead of files, of joined models: the table of each model by its name, which together are one data set. A
        table of one has the names of its own outputs, or is a curve.
    outputs
        Instead of files: measurements by output, a number or a list of repeated measurements; of a vector, a number
        for each element.
    sigma
        Standard deviations of the errors by output, if a table does not state them.
    noise
        Errors of the other outputs: { relative = 0.05 }, { absolute = 1e-4 } or both.
    errors
        Their distribution: { kind = "normal" }, or { kind = "student-t", degrees = 4 } if a few data may be outliers.
    truth
        By path: the numbers from which the data were made, if known.
    reader
        What reads files of a kind of your own, as such tables.
    sets
        The files as they were when the study ran; written by the run.
    """

    quantity: ClassVar[str] = "output"

    files: FileNames = ()
    tables: Annotated[dict[str, str], Field(min_length=1)] | None = None
    outputs: Stated = Field(default={})
    sigma: dict[str, Positive] = Field(default={})
    noise: OutputNoise = OutputNoise()
    errors: Errors = NORMAL
    truth: dict[str, float] = Field(default={})
    reader: AnyReader = None
    sets: tuple[DataSet, ...] = ()

    @model_validator(mode="after")
    def _check(self) -> MeasuredOutputs:
        if bool(self.files) + (self.tables is not None) + bool(self.outputs) != 1:
            raise ValueError("expected either files or outputs, or tables of joined models")
        return self

    def read(self, folder: Path, model: ModelSpec) -> Found:
        """Read the files, or what the study itself states, of a model; errors as of `DataFiles.read`."""

        def known(found: Measurements) -> Measurements:
            check_signs(found, model)
            return self.with_errors(found)

        names, steps = tuple(output.name for output in model.returned), steps_of(model)
        if self.files:
            sets, found = read_files(
                self.files, folder, lambda path: known(read_outputs(path, names, steps, self.reader))
            )
        else:
            try:
                if self.tables is None:
                    one, values = DataSet(name=STATED, file=""), stated(by_element(self.outputs, names), names)
                else:
                    one, values = _of_tables(self.tables, folder, model)
                sets, found = (one,), (known(values),)
            except DataError as error:
                raise StudyError(*(f"data: {line}" for line in error.args)) from None
        seen = np.unique(np.concatenate([one.axes for one in found if one is not None]))
        return sets, tuple(None if one is None else one.by_part(seen) for one in found)

    def with_errors(self, found: Measurements) -> Measurements:
        """Return data with standard deviations and what is true; a DataError if one is unknown."""
        general = np.maximum(self.noise.relative * np.abs(found.values), self.noise.absolute)
        sigma = by_element(self.sigma, found.names)
        usual = [sigma.get(name, one) for name, one in zip(found.names, general, strict=True)]
        found = found.with_sigma(np.array(usual))
        lost = found.labels[~(found.sigma > 0)]
        if lost.size:
            raise DataError(
                f"{lost[0]}: the standard deviation of the error is not known{others(lost.size - 1)}, expected a "
                "column sigma, data.sigma of this output, or data.noise that does not vanish there"
            )
        return replace(found, truth={**found.truth, **self.truth})

    def mistakes(self, model: ModelSpec) -> Iterator[Mistake]:
        """Find names that are no outputs of a model."""
        names = tuple(output.name for output in model.returned)
        for block, given in (("outputs", self.outputs), ("sigma", self.sigma)):
            for name in by_element(given, names):
                if name not in names:
                    yield ("data", block, name), f"not an output of the model; {nearest(name, names)}", name


def _of_tables(tables: Mapping[str, str], folder: Path, model: ModelSpec) -> tuple[DataSet, Measurements]:
    """Read the tables of joined models, one of each at most, as one data set."""
    names, parts, paths, wrong = tuple(output.name for output in model.returned), [], [], list[str]()
    for name, file in tables.items():
        if name not in model.parts:
            wrong.append(f"data.tables.{name}: no model of this name; {nearest(name, tuple(model.parts))}")
            continue
        own, path = model.parts[name], next((one / file for one in (folder, Path()) if (one / file).exists()), None)
        if path is None:
            wrong.append(f"data.tables.{name}: {file}: no such file")
            continue
        outputs = tuple(output.name for output in own.returned)
        try:
            found = read_outputs(path, outputs, steps_of(own))
        except DataError as error:
            wrong += [f"data: {line}" for line in error.args]
            continue
        whole = np.array([names.index(f"{name}.{output}") for output in outputs], dtype=np.int64)[found.axes]
        truth = {model.path_of(name, path): value for path, value in found.truth.items()}
        rows = {"axes": whole, "cases": whole, "names": np.array(names)[whole], "parts": names}
        parts.append(replace(found, **rows, truth=truth))
        paths.append(path)
    if wrong:
        raise StudyError(*wrong)
    digest = sha256("".join(map(digest_of, paths)).encode()).hexdigest()[:16]
    return DataSet(name=TABLES, file=", ".join(tables.values()), digest=digest), reduce(Measurements.with_rows, parts)


def by_element(given: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """Give what is stated of vectors by their elements: y = [1, 2] is y.0 = 1 and y.1 = 2, and y = 3 is so for all."""
    known, found = list(dict.fromkeys(map(str, names))), dict[str, Any]()
    for name, value in given.items():
        own = [one for one in known if one.startswith(f"{name}.") and one.rpartition(".")[2].isdigit()]
        each = value if isinstance(value, tuple) else (value,) * len(own)
        vector = own and len(own) == len(each) and name not in known
        found |= dict(zip(own, each, strict=True)) if vector else {name: value}
    return found


def check_signs(found: Measurements, model: ModelSpec) -> None:
    """Refuse measured outputs of a model whose sign cannot be right, over all steps of each."""
    outputs = [model.returned[axis] for axis in found.axes]
    _, of = model.axes_of_outputs.get("output_of", ("", [output.name for output in model.returned]))
    found.check_signs([of[axis] for axis in found.axes], [getattr(output, "negative", True) for output in outputs])
