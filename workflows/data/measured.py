"""Measured displacements of a specimen: where their files are, and what was read from them."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError

from forward.bodies.geometry import AXES, Body, tolerance
from forward.bodies.inclusions import Inclusion
from forward.bodies.surface import Surface
from forward.files import meshes
from forward.settings import Settings, one_line
from inverse.data.files import SCANS, distinct, files
from inverse.data.measurements import Measurements
from inverse.data.noise import NORMAL, Errors
from inverse.data.registration import ToSurface
from inverse.data.scans import Reading, Scan, read
from inverse.data.table import DataError, needed
from workflows.config.mistakes import StudyError, lines

if TYPE_CHECKING:
    from forward.model import FloatArray, ForwardModel
    from forward.specimen import Specimen
    from inverse.data.shared_motion import SharedMotion


Positive = Annotated[float, Field(gt=0)]


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


_one_alone = BeforeValidator(
    lambda given: (given,) if isinstance(given, str) else given, json_schema_input_type=tuple[str, ...] | str
)
FileNames = Annotated[tuple[str, ...], _one_alone]


class DataFiles(Reading):
    """Where measured displacements are.

    Parameters
    ----------
    files
        Names of files, folders of files, or patterns such as ``data/*.csv``, beside the study or else in the working
        directory; a single one may be given as a string. Each file is a data set and is inverted separately. A file in
        TOML says which files of a scan belong together, and any of what follows for it alone.
    sigma, sigma_of, unit, units, field, on_surface, tolerance, beyond, registration, between
        What the files do not say themselves (`inverse.data.scans`): standard deviations of the errors (m, and by the
        names of other outputs such as forces), unit, array
        of displacements, whether the points lie on the surface, how far (m) points may lie from the body, what is
        done about others, the rigid motion from the frame of the files to that of the body, and what is
        unknown of motions between scans.
    errors
        Distribution of the errors: { kind = "normal" }, or { kind = "student-t", degrees = 4 } if a few data may be
        outliers.
    truth
        By path: true values, if they are known in addition to those in the files.
    sets
        The files as they were when the study ran; written by the run.
    """

    quantity: ClassVar[str] = "displacement"

    files: FileNames = Field(min_length=1)
    errors: Errors = NORMAL
    truth: dict[str, float] = Field(default={})
    sets: tuple[DataSet, ...] = ()

    def read(self, folder: Path, model: Any) -> Found:
        """Read the files, in a folder or the working directory, of a specimen; a StudyError if none can be used."""

        def known(path: Path) -> Measurements:
            """Return data whose errors are known, with what is true."""
            found = read_on(path, model, self).checked()
            truth = {name: _known(name, value, path) for name, value in found.truth.items()}
            return replace(found, truth=truth | self.truth)

        return read_files(self.files, folder, known)


class DisplacementFile(Reading):
    """A file of displacements by which models of a specimen are compared (`inverse.data.scans`).

    Parameters
    ----------
    file
        The file, beside the study.
    sigma
        Standard deviation (m) of the errors, if the file does not state it; not needed if the method's noise is given
        otherwise.
    sigma_of
        The same of other outputs, such as forces, by their names.
    unit, units, field, on_surface, tolerance, beyond, registration, between
        As of an inversion.
    digest, source
        Of the file as it was when the study ran: of its bytes, and what its remarks say; written by the run.
    """

    quantity: ClassVar[str] = "displacement"

    file: str
    digest: str = ""
    source: tuple[str, ...] = ()

    def read(self, folder: Path, specimen: Any) -> Measurements:
        """Read the file; a DataError if it cannot be used."""
        return read_on(folder / self.file, specimen, self)


Found = tuple[tuple[DataSet, ...], tuple[Any, ...]]  # what was read, and what it holds; None of what is refused


def read_files(names: Sequence[str], folder: Path, read: Callable[[Path], Any]) -> Found:
    """Read each of some files, or folders or patterns of them, as a data set; errors as of `DataFiles.read`.

    What reads a file raises a `DataError` with every kind of mistake in it.
    """
    try:
        paths = files(names, [folder, Path()])
    except DataError as error:
        raise StudyError(*(f"data.files: {line}" for line in error.args)) from None
    sets, found, lines = [], [], []
    for path, name in zip(paths, distinct(paths), strict=True):
        try:
            measurement, wrong = read(path), ""
        except DataError as error:
            measurement, wrong = None, "; ".join(error.args)
            lines += [f"data: {line}" for line in error.args]
        sets.append(DataSet(name=name, file=path.name, digest=digest_of(path), refused=wrong))
        found.append(measurement)
    if all(measurement is None for measurement in found):
        raise StudyError(*lines)
    return tuple(sets), tuple(found)


def scan_of(path: Path, usual: Reading) -> Scan:
    """Return the scan that a file is, or describes, else as usual; a DataError if a description is none."""
    known = {name: getattr(usual, name) for name in Reading.model_fields if name in usual.model_fields_set}
    if path.suffix not in SCANS:
        return Scan(**known, file=path.name)
    try:
        given = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"{path.name}: cannot be read: {error.strerror}") from None
    except ValueError as error:  # of the encoding, or the syntax
        raise DataError(one_line(f"{path.name}: not a file in TOML: {error}")) from None
    if not {"unit", "units"}.isdisjoint(given):
        known = {name: value for name, value in known.items() if name not in {"unit", "units"}}
    try:
        return Scan.model_validate(known | given)
    except ValidationError as error:
        raise DataError(*(f"{path.name}: {line.removeprefix(': value error, ')}" for line in lines(error))) from None


def digest_of(path: Path) -> str:
    """Return the hash of a file and of those that belong to it, of a scan or of its numbers; empty if one is lost."""
    try:
        whole = path.read_bytes()
        if path.suffix in SCANS:
            for name in scan_of(path, Reading()).files:
                whole += _hashes(path.parent / name)
        else:
            whole += b"".join(map(_hashes, meshes.beside(path)))
        return sha256(whole).hexdigest()[:16]
    except (OSError, DataError):  # then it is refused
        return ""


def _hashes(path: Path) -> bytes:
    """Return the hashes of a file and of those that hold what it refers to."""
    return b"".join(sha256(one.read_bytes()).digest() for one in (path, *meshes.beside(path)))


def motion_of(found: Measurements, body: Body) -> SharedMotion | None:
    """Return what is uncertain of rigid motions, as errors that the data share; None if nothing is."""
    from inverse.data.shared_motion import SharedMotion

    return SharedMotion.of(found, onto(body) if found.on_surface else None)


def observing(model: Any, data: Measurements) -> ForwardModel:
    """Return what data are compared with: some outputs of a model, or what a specimen shows where they are; collective.

    A ValueError says that a place is farther from the mesh than the mesh can be from the body.
    """
    if data.some:
        from forward.combine import selected

        return selected(model, tuple(model.outputs.index(name) for name in data.names))
    found: ForwardModel = model.observing(data.places, data.axes, data.cases, data.along)
    return found


def onto(body: Body) -> Callable[[FloatArray], FloatArray]:
    """Return what puts points (n, 3) on the surface of a body."""
    surface = Surface.of(body)
    return lambda points: surface.nearest(points)[0]


def read_on(path: Path, specimen: Specimen, usual: Reading) -> Measurements:
    """Read a scan, and put it on the body of a specimen; standard deviations may still be unknown.

    What its description does not say is as usual; a DataError says every kind of mistake in the files.
    """
    scan, body = scan_of(path, usual), specimen.body
    found = read(path.parent, scan, specimen.measurable)
    sigma = dict.fromkeys(AXES, math.nan if scan.sigma is None else scan.sigma) | scan.sigma_of
    found = found.with_sigma(np.array([sigma.get(name, math.nan) for name in found.names]))
    extent = max(high - low for low, high in body.bounds)
    surface = Surface.of(body) if scan.surface or isinstance(scan.registration, ToSurface) else None
    if scan.registration is not None:
        points = found.places_of_points
        found = found.moved_by(scan.registration.registered(points, found.unit, surface, extent, path.name))
    allowed = tolerance(body) if scan.tolerance is None else scan.tolerance
    nearest_place = (lambda points: surface.nearest(points)[0]) if scan.surface and surface else body.nearest
    leave_out = scan.beyond == "leave-out"
    found = found.on(nearest_place, extent, allowed, surface=scan.surface, leave_out=leave_out).measured()
    forces = found.subset(found.points < 0)
    pairs = zip(forces.cases, forces.axes - len(AXES), strict=True)
    negative = [specimen.cases[case].outputs[which].negative for case, which in pairs]
    forces.check_signs(forces.names.tolist(), negative)
    truth = found.truth | {name: repr(value) for name, value in scan.truth.items()}
    return replace(found, between=scan.moved_between(found.unit), truth=truth)


def _known(name: str, said: str, path: Path) -> Any:
    """Return what is true: a number, inclusions, or places (k, 3) and ln of the true stiffness factor (k,) there."""
    wrong = f"{path.name}: truth.inclusions are not inclusions as of a study, in JSON"
    try:
        if name == "inclusions":
            return TypeAdapter(tuple[Inclusion, ...]).validate_python(tuple(json.loads(said)))
        if name == "stiffness":
            wrong = f"{Path(said).name}: the true stiffness cannot be read, expected a table x, y, z, factor"
            table = np.loadtxt(path.parent / said, delimiter=",", skiprows=1, ndmin=2)
            return table[:, :3], np.log(table[:, 3])
        return needed(said, f"truth.{name}")
    except (OSError, ValueError, TypeError, IndexError) as error:
        raise DataError(wrong if name in {"inclusions", "stiffness"} else f"{path.name}: {error}") from None
