"""Measured displacements of a specimen: where their files are, and what was read from them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field, TypeAdapter, field_validator

from forward.bodies.geometry import tolerance
from forward.bodies.inclusions import Inclusion
from forward.settings import Settings
from inverse.data.errors import NORMAL, Errors
from inverse.data.observations import Observations, read
from inverse.data.table import DataError

if TYPE_CHECKING:
    from forward.bodies.geometry import Body
    from forward.model import FloatArray
    from forward.specimen import Specimen


class DataSet(Settings):
    """A data file, as recorded by a study that ran.

    Parameters
    ----------
    name
        The name of the file without its ending; with it, and with folders, where two files share one.
    file
        The name of the file.
    digest
        Of its bytes.
    refused
        What is wrong with it, if anything.
    """

    name: str
    file: str
    digest: str = ""
    refused: str = ""


class DataFiles(Settings):
    """Where measured displacements are.

    Parameters
    ----------
    files
        Names of files, folders of files, or patterns such as ``data/*.csv``, beside the study or else in the working
        directory; a single one may be given as a string. Each file is a data set and is inverted separately.
    sigma
        Standard deviation (m) of the errors, if a file does not state it.
    unit
        m per unit of the files.
    tolerance
        How far (m) points may lie outside the body, by default a thousandth of its diagonal; they are moved to its
        nearest point, and counted.
    errors
        Their distribution: { kind = "normal" }, or { kind = "student-t", degrees = 4 } if a few data may be outliers.
    truth
        By path: true values, if they are known in addition to those in the files.
    sets
        The files as they were when the study ran; written by the run.
    """

    files: tuple[str, ...] = Field(min_length=1)
    sigma: Annotated[float, Field(gt=0)] | None = None
    unit: Annotated[float, Field(gt=0)] = 1.0
    tolerance: Annotated[float, Field(ge=0)] | None = None
    errors: Errors = NORMAL
    truth: dict[str, float] = Field(default={})
    sets: tuple[DataSet, ...] = ()

    def allowed(self, body: Body) -> float:
        """How far (m) points may lie outside a body."""
        return tolerance(body) if self.tolerance is None else self.tolerance

    @field_validator("files", mode="before", json_schema_input_type=tuple[str, ...] | str)
    @classmethod
    def _one_alone(cls, given: Any) -> Any:
        return (given,) if isinstance(given, str) else given


@dataclass(frozen=True, eq=False)
class Measurement:
    """A data set that can be used.

    Attributes
    ----------
    observations
        On the body.
    moved
        How far (n,) its points were moved (m).
    truth
        Numbers from which it was made, by path.
    inclusions
        The true ones.
    places, stiffness
        Where (k, 3) ln of the true stiffness factor (k,) is known beside that.
    """

    observations: Observations
    moved: FloatArray
    truth: dict[str, float]
    inclusions: tuple[Any, ...]
    places: FloatArray
    stiffness: FloatArray


def read_measurement(path: Path, model: Specimen, data: DataFiles) -> Measurement:
    """Read a file of displacements of a specimen.

    Raises
    ------
    DataError
        With every kind of mistake in the file.
    """
    cases = tuple(case.name for case in model.cases)
    found = read(path, cases, data.unit).with_sigma(data.sigma)
    body = model.body
    extent = max(high - low for low, high in body.bounds)
    found, moved = found.on(body.nearest, extent, data.allowed(body))
    truth, places, stiffness = dict(data.truth), np.zeros((0, 3)), np.zeros(0)
    for name, text in found.truth.items():
        if name not in {"stiffness", "inclusions"}:
            truth.setdefault(name, _known(name, text, path))
    inclusions = _true_inclusions(found.truth["inclusions"], path) if "inclusions" in found.truth else ()
    if "stiffness" in found.truth:
        places, stiffness = _true_stiffness(path.parent / found.truth["stiffness"])
    return Measurement(found, moved, truth, inclusions, places, stiffness)


def _known(name: str, text: str, path: Path) -> float:
    try:
        return float(text)
    except ValueError:
        message = f"{path.name}: truth.{name} is '{text}', expected a number"
        raise DataError(message) from None


def _true_inclusions(text: str, path: Path) -> tuple[Any, ...]:
    try:
        return TypeAdapter(tuple[Inclusion, ...]).validate_python(tuple(json.loads(text)))
    except (ValueError, TypeError):
        message = f"{path.name}: truth.inclusions are not inclusions as of a study, in JSON"
        raise DataError(message) from None


def _true_stiffness(path: Path) -> tuple[FloatArray, FloatArray]:
    """Read ln of the true factor at places: a table x, y, z, factor."""
    try:
        table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
        return table[:, :3], np.log(table[:, 3])
    except (OSError, ValueError, IndexError):
        message = f"{path.name}: the true stiffness cannot be read, expected a table x, y, z, factor"
        raise DataError(message) from None
