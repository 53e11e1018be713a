"""Measured outputs of a model: where their tables are, or what the study itself states."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field, model_validator

from forward.scalars import Mistake
from forward.settings import Settings, nearest
from forward.spec import ModelSpec
from inverse.data.curves import steps_of
from inverse.data.errors import NORMAL, Errors
from inverse.data.outputs import OutputData, read_outputs, stated
from inverse.data.table import DataError
from workflows.config.mistakes import StudyError
from workflows.studies.measured import DataSet, FileNames, Found, Positive, check_signs, read_files

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


class MeasuredOutputs(Settings):
    """Measured outputs of the model, in tables or in the study itself.

    Parameters
    ----------
    files
        Tables with the columns output, value and, where it is known, sigma: names of files, folders, or patterns such
        as ``data/*.csv``, beside the study or else in the working directory. Each file is a data set and is inverted
        separately.
    outputs
        Instead of files: measurements by output, a number or a list of repeated measurements.
    sigma
        Standard deviations of the errors by output, if a table does not state them.
    noise
        Errors of the other outputs: { relative = 0.05 }, { absolute = 1e-4 } or both.
    errors
        Their distribution: { kind = "normal" }, or { kind = "student-t", degrees = 4 } if a few data may be outliers.
    truth
        By path: the numbers from which the data were made, if known.
    sets
        The files as they were when the study ran; written by the run.
    """

    quantity: ClassVar[str] = "output"

    files: FileNames = ()
    outputs: dict[str, float | Annotated[tuple[float, ...], Field(min_length=1)]] = Field(default={})
    sigma: dict[str, Positive] = Field(default={})
    noise: OutputNoise = OutputNoise()
    errors: Errors = NORMAL
    truth: dict[str, float] = Field(default={})
    sets: tuple[DataSet, ...] = ()

    @model_validator(mode="after")
    def _check(self) -> MeasuredOutputs:
        if bool(self.files) == bool(self.outputs):
            message = "expected either files or outputs"
            raise ValueError(message)
        return self

    def read(self, folder: Path, model: ModelSpec) -> Found:
        """Read the files, or what the study itself states, of a model; errors as of `DataFiles.read`."""
        names = tuple(output.name for output in model.returned)
        if self.files:
            sets, found = read_files(
                self.files, folder, lambda path: self._with_errors(read_outputs(path, names, steps_of(model)), model)
            )
        else:
            try:
                sets, found = (DataSet(name=STATED, file=""),), (self._with_errors(stated(self.outputs), model),)
            except DataError as error:
                raise StudyError(*(f"data: {line}" for line in error.args)) from None
        seen = {name for one in found if one is not None for name in one.names}
        parts = tuple(name for name in names if name in seen)
        return sets, tuple(None if one is None else one.of(names, parts) for one in found)

    def _with_errors(self, found: OutputData, model: ModelSpec) -> OutputData:
        check_signs(found, model)
        noise = self.noise
        return found.with_sigma(self.sigma, noise.relative, noise.absolute).with_truth(self.truth)

    def mistakes(self, model: ModelSpec) -> Iterator[Mistake]:
        """Find names that are no outputs of a model."""
        names = tuple(output.name for output in model.returned)
        for block, given in (("outputs", self.outputs), ("sigma", self.sigma)):
            for name in given:
                if name not in names:
                    yield ("data", block, name), f"not an output of the model; {nearest(name, names)}", name
