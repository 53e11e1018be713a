"""Measured displacements of a specimen: where their files are, and what was read from them."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError

from forward.bodies.geometry import tolerance
from forward.bodies.inclusions import Inclusion
from forward.bodies.surface import Surface
from forward.files import meshes
from forward.findings import Finding
from forward.settings import Settings, one_line
from inverse.data import signs
from inverse.data.errors import NORMAL, Errors
from inverse.data.files import SCANS, distinct, files
from inverse.data.observations import Components, Observations, Placed
from inverse.data.readings import Readings, Units
from inverse.data.registration import Registered, ToSurface, UncertainMotion, register
from inverse.data.scans import Reading, Scan, read
from inverse.data.table import DataError, needed
from workflows.config.mistakes import StudyError, lines

if TYPE_CHECKING:
    from forward.bodies.geometry import Body
    from forward.model import FloatArray
    from forward.spec import ModelSpec
    from forward.specimen import Specimen
    from inverse.data.outputs import OutputData
    from inverse.data.shared_motion import SharedMotion


Positive = Annotated[float, Field(gt=0)]
LISTED = 5  # points that do not belong to a body


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


@dataclass(frozen=True)
class _Given:
    """What stands in a study as data, and the block that it is of."""

    block: type[Settings]
    table: Any


def data_as(blocks: Mapping[str, Any], block: type[Settings]) -> dict[str, Any]:
    """Return the blocks of a study whose `data`, if it is a table, is of a block that was chosen by the model."""
    data = blocks.get("data", _Given)
    return dict(blocks) if data is _Given or isinstance(data, Settings) else {**blocks, "data": _Given(block, data)}


def as_block(data: Any) -> Any:
    """Return the block of data that `data_as` has chosen; others are returned as they are."""
    return data.block.model_validate(data.table) if isinstance(data, _Given) else data


def _one_alone(given: Any) -> Any:
    return (given,) if isinstance(given, str) else given


FileNames = Annotated[tuple[str, ...], BeforeValidator(_one_alone, json_schema_input_type=tuple[str, ...] | str)]


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

    def read(self, folder: Path, model: Specimen) -> Found:
        """Read the files, in a folder or in the working directory, of displacements of a specimen.

        Raises
        ------
        StudyError
            If no file can be used.
        """
        return read_files(self.files, folder, lambda path: read_measurement(path, model, self))


Found = tuple[tuple[DataSet, ...], tuple[Any, ...]]  # what was read, and what it holds; None of what is refused


def read_files(names: Sequence[str], folder: Path, read: Callable[[Path], Any]) -> Found:
    """Read each of some files, or folders or patterns of them, as a data set; errors as of `DataFiles.read`.

    Parameters
    ----------
    read
        Reads a file; it raises a `DataError` with every kind of mistake in it.
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
    """Return the scan that a file is, or describes; what it does not say is as usual.

    Raises
    ------
    DataError
        If a description is none.
    """
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
    left_out
        Points that do not belong to the body, and how far they are from it.
    registered
        The motion from the frame of the file to that of the body; None if they are the same.
    on_surface
        Whether its points lie on the surface.
    between
        Standard deviations (rad, m) of rigid motions between the undeformed scan and that of each load case.
    """

    observations: Observations
    moved: FloatArray
    truth: dict[str, float]
    inclusions: tuple[Any, ...]
    places: FloatArray
    stiffness: FloatArray
    left_out: tuple[str, ...] = ()
    registered: Registered | None = None
    on_surface: bool = False
    between: tuple[float, float] = (0.0, 0.0)

    @property
    def data(self) -> Components:
        """The components that were measured."""
        return self.observations.components()

    def data_labels(self) -> list[str]:
        """Say of each datum where it stands."""
        return self.observations.data_labels()

    def motion(self, body: Body) -> SharedMotion | None:
        """Return what is uncertain of rigid motions, as errors that the data share; None if nothing is."""
        from inverse.data.shared_motion import SharedMotion

        motion = UncertainMotion.of(self.registered, self.between)
        if motion is None:
            return None
        data = self.data
        project = onto(body) if self.on_surface else None
        return SharedMotion.of(data.places, data.along, data.cases, motion, project)

    @property
    def findings(self) -> Iterator[Finding]:
        """What is to be known of the points before they are used."""
        if self.left_out:
            points = "1 point does" if len(self.left_out) == 1 else f"{len(self.left_out)} points do"
            more = "" if len(self.left_out) <= LISTED else f" and {len(self.left_out) - LISTED} others"
            listed = ", ".join(self.left_out[:LISTED])
            yield Finding("points-left-out", "note", {"points": points, "listed": listed, "more": more})
        if self.registered is not None and self.registered.unseen:
            yield Finding("registration-undetermined", "note", {"what": ", ".join(self.registered.unseen)})


def onto(body: Body) -> Callable[[FloatArray], FloatArray]:
    """Return what puts points (n, 3) on the surface of a body."""
    surface = Surface.of(body)
    return lambda points: surface.nearest(points)[0]


def check_signs(found: OutputData, spec: ModelSpec) -> None:
    """Refuse measured outputs of a model whose sign cannot be right, over all steps of each.

    Raises
    ------
    DataError
        With a line for each.
    """
    of = {one.name: (getattr(one, "of", one.name), getattr(one, "negative", True)) for one in spec.returned}
    there = [of.get(name, (name, True)) for name in found.names]
    signs.check([name for name, _ in there], found.values, found.labels, [negative for _, negative in there])


def check_readings(found: Readings, model: Specimen) -> None:
    """Refuse measured outputs of load cases whose sign cannot be right; raises as `check_signs`."""
    outputs = [model.cases[case].outputs[which] for case, which in zip(found.case, found.which, strict=True)]
    signs.check(found.names, found.values, found.labels, [output.negative for output in outputs])


def read_on(
    path: Path, cases: Mapping[str, Units], body: Body, usual: Reading
) -> tuple[Placed, Registered | None, Scan]:
    """Read a scan, and put it on a body.

    Parameters
    ----------
    path
        Its file, or its description.
    cases
        Names of the load cases, and what is measured in them beside displacements.
    body
        The body.
    usual
        What is so where the description says nothing else.

    Raises
    ------
    DataError
        With every kind of mistake in the files.
    """
    scan = scan_of(path, usual)
    found = read(path.parent, scan, cases)
    if scan.sigma is not None:
        found = found.with_sigma(scan.sigma)
    found = replace(found, readings=found.readings.stated(scan.sigma_of))
    extent = max(high - low for low, high in body.bounds)
    surface = Surface.of(body) if scan.surface or isinstance(scan.registration, ToSurface) else None
    registered = None
    if scan.registration is not None:
        registered = register(scan.registration, found.places, found.unit, surface, extent, path.name)
        found = replace(found, places=registered.motion(found.places), axes=registered.motion.rotation.T)
    allowed = tolerance(body) if scan.tolerance is None else scan.tolerance
    nearest_place = (lambda points: surface.nearest(points)[0]) if scan.surface and surface else body.nearest
    leave_out = scan.beyond == "leave-out"
    return found.on(nearest_place, extent, allowed, surface=scan.surface, leave_out=leave_out), registered, scan


def read_measurement(path: Path, model: Specimen, data: DataFiles) -> Measurement:
    """Read a file of displacements of a specimen.

    Raises
    ------
    DataError
        With every kind of mistake in the file.
    """
    placed, registered, scan = read_on(path, model.measurable, model.body, data)
    check_readings(placed.observations.readings, model)
    found = placed.observations.with_sigma(None)
    found = replace(found, readings=found.readings.with_sigma({}))
    truth, places, stiffness = scan.truth | data.truth, np.zeros((0, 3)), np.zeros(0)
    for name, text in found.truth.items():
        if name not in {"stiffness", "inclusions"}:
            truth.setdefault(name, _known(name, text, path))
    inclusions = _true_inclusions(found.truth["inclusions"], path) if "inclusions" in found.truth else ()
    if "stiffness" in found.truth:
        places, stiffness = _true_stiffness(path.parent / found.truth["stiffness"])
    return Measurement(
        found,
        placed.distances,
        truth,
        inclusions,
        places,
        stiffness,
        placed.left_out,
        registered,
        scan.surface,
        scan.moved_between(found.unit),
    )


def _known(name: str, text: str, path: Path) -> float:
    try:
        return needed(text, f"truth.{name}")
    except ValueError as error:
        raise DataError(f"{path.name}: {error}") from None


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
