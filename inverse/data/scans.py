"""Scans: files of points and displacements, what they do not say themselves, and files that belong together.

Besides tables (`inverse.data.displacement_tables`), data files are meshes, surfaces and clouds of points: VTU, VTP,
legacy VTK, PLY, XDMF (also as DOLFINx writes it), gmsh's .msh, Abaqus's .inp, and what else meshio reads. Their arrays
at the points are ``displacement_CASE``, or ``displacement`` if there is only one load case (or those that ``field``
names), or numbers ``ux``, ``uy``, ``uz`` (``ux_CASE`` …), and optionally ``sigma`` or ``sigma_CASE`` of one or three
components, or ``sigma_x``, ``sigma_y``, ``sigma_z``. NaN means that a component was not measured. Points that coincide
and say the same count once.

STL and PLY surfaces, and whatever else has no displacements, come in pairs with the same numbering, the undeformed and
the deformed surface, whose difference is the displacement. A file in TOML says which, and anything else about a scan::

    reference = "rest.ply"
    deformed = { press = "pressed.ply" }      # by load case
    units = "mm"
    registration = { kind = "to-surface", uncertain = true }

Such a file is one data set; ``file = "scan.vtu"`` in it names a single file in place of a pair.

A deformed surface with another numbering is refused. The distance to it along the normal is the normal displacement to
first order only; what the tangential displacement adds is of second order, but larger than the errors of a scan.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from forward.model import FloatArray
from forward.settings import Settings, nearest
from inverse.data.displacement_tables import ERRORS, MOTION, Units, of_table
from inverse.data.files import MESHES, TABLES
from inverse.data.measurements import SAME, Measurements
from inverse.data.registration import Registration
from inverse.data.scan_files import Points, points_of
from inverse.data.table import AnyReader, DataError, factor

SURFACES = (".stl", ".ply")  # of which the points lie on the surface of the body


class Between(Settings):
    """Rigid motions between scans, unknown but for their size.

    Parameters
    ----------
    rotation_std, translation_std
        Standard deviations about, and along, each axis (degrees; unit of the file).
    """

    rotation_std: Annotated[float, Field(ge=0, le=30)] = 0.0
    translation_std: Annotated[float, Field(ge=0)] = 0.0


class Reading(Settings):
    """What files of displacements do not say themselves.

    Parameters
    ----------
    sigma
        Standard deviation (m) of the errors, if a file does not state it.
    sigma_of
        The same of other outputs, such as forces, by their names and in their units.
    unit
        m per unit of the files.
    units
        In place of it: the name of the unit of the files, such as "mm".
    field
        Name of the array of displacements in meshes; {case} in it stands for the name of the load case.
    on_surface
        Whether the points lie on the surface of the body, and are moved to it from inside too; by default for STL and
        PLY files and pairs of surfaces only.
    tolerance
        How far (m) points may lie outside the body, or from its surface, by default a thousandth of its diagonal; they
        are moved to its nearest point, and counted.
    beyond
        What is done about points that are farther away: "refuse" the file, or "leave-out" the points, which are listed.
    registration
        The rigid motion from the frame of the files to that of the body; by default they are the same.
    between
        How uncertain it is that neither specimen nor scanner moved as a whole between the undeformed scan and that of
        each load case.
    reader
        What reads files of a kind of your own, as tables; by default they are of the kinds above.
    """

    sigma: Annotated[float, Field(gt=0)] | None = None
    sigma_of: dict[str, Annotated[float, Field(gt=0)]] = Field(default={})
    unit: Annotated[float, Field(gt=0)] | None = None
    units: str | None = None
    field: str | None = None
    on_surface: bool | None = None
    tolerance: Annotated[float, Field(ge=0)] | None = None
    beyond: Literal["refuse", "leave-out"] = "refuse"
    registration: Registration | None = None
    between: Between | None = None
    reader: AnyReader = None

    def moved_between(self, unit: float) -> tuple[float, float]:
        """Return standard deviations (rad, m) of the motions between scans, given m per unit of the file."""
        if self.between is None:
            return (0.0, 0.0)
        return float(np.radians(self.between.rotation_std)), unit * self.between.translation_std

    @property
    def metres(self) -> float | None:
        """How many m the unit of the files is; None if they have to say."""
        return factor(self.units, "m") if self.units is not None else self.unit

    @model_validator(mode="after")
    def _check_unit(self) -> Reading:
        if self.units is not None:
            if self.unit is not None:
                raise ValueError("expected either unit or units")
            factor(self.units, "m")
        return self


class Scan(Reading):
    """A scan of one specimen: its files, and what they do not say themselves.

    Parameters
    ----------
    file
        Points with displacements: a table or a mesh.
    reference
        In place of it: the undeformed surface.
    deformed
        By load case: the deformed surface, of the same numbering.
    truth
        By path: true values behind synthetic data.
    sigma, unit, units, field, on_surface, tolerance, beyond, registration, between
        As of `Reading`.
    """

    file: str | None = None
    reference: str | None = None
    deformed: dict[str, str] = Field(default={})
    truth: dict[str, float] = Field(default={})

    @property
    def files(self) -> tuple[str, ...]:
        """All files."""
        return tuple(name for name in (self.file, self.reference, *self.deformed.values()) if name is not None)

    @property
    def surface(self) -> bool:
        """Whether the points lie on the surface of the body."""
        if self.on_surface is not None:
            return self.on_surface
        return self.reference is not None or any(Path(name).suffix in SURFACES for name in self.files)

    @model_validator(mode="after")
    def _check_files(self) -> Scan:
        if (self.file is None) != bool(self.deformed) or (self.reference is None) == bool(self.deformed):
            raise ValueError(
                "expected either file, or reference and deformed: surfaces without a common numbering do not say where "
                "a point has gone"
            )
        return self


def read(folder: Path, scan: Scan, known: Mapping[str, Units]) -> Measurements:
    """Read the files of a scan, in a folder, of known load cases with what is measured in them beside displacements.

    Raises `DataError` with every kind of mistake in the files.
    """
    cases, unit = tuple(known), scan.metres
    if scan.file is None:
        found = _pairs(folder, scan, cases, 1.0 if unit is None else unit)
    else:
        path = folder / scan.file
        if scan.reader is None and path.suffix not in TABLES + MESHES:
            raise DataError(f"{path.name}: unknown kind of file, expected one of: {', '.join(TABLES + MESHES)}")
        if scan.reader is not None or path.suffix in TABLES:
            found = of_table(path, known, unit, scan.reader)
        else:
            found = _mesh(path, scan.field, cases, 1.0 if unit is None else unit)
    mistakes = found.mistakes(Path(scan.file or scan.reference or "").name)
    if mistakes:
        raise DataError(*mistakes)
    return found


def _mesh(path: Path, named: str | None, cases: tuple[str, ...], unit: float) -> Measurements:
    found = points_of(path)
    if path.suffix == ".stl" or not (found.values or named):
        raise DataError(
            f"{path.name}: no displacements; expected data at its points, or a file in TOML with the undeformed "
            "surface as reference, and the deformed one, of the same numbering"
        )
    motions, missing = list[FloatArray](), list[str]()
    for case in cases:
        try:
            motions.append(_motion(found, path.name, named, case, alone=len(cases) == 1))
        except DataError as error:
            missing += error.args
    if missing:
        raise DataError(*missing)
    if any(np.isinf(motion).any() for motion in motions):
        raise DataError(f"{path.name}: a displacement is infinite, expected numbers, or nan where nothing was measured")
    errors = [_errors(found, path.name, case) for case in cases]
    return _joined([(found.places, *pair) for pair in zip(motions, errors, strict=True)], path.name, cases, unit)


def _motion(found: Points, name: str, named: str | None, case: str, *, alone: bool) -> FloatArray:
    """Return displacements (n, 3) in a load case; a DataError if there are none."""
    n = len(found.places)
    usual = [f"displacement_{case}", *(["displacement"] if alone else [])]
    wanted = usual if named is None else [named.replace("{case}", case)]
    for array in (one for one in wanted if one in found.values):
        values = found.values[array]
        if values.shape != (n, 3):
            raise DataError(f"{name}: '{array}' has the shape {values.shape}, expected ({n}, 3)")
        return values
    for single in ([f"{axis}_{case}" for axis in MOTION], list(MOTION) if alone else []):
        if named is None and any(array in found.values for array in single):
            return np.column_stack([np.ravel(found.values.get(array, np.full(n, np.nan))) for array in single])
    known = tuple(found.values) or ("none",)
    raise DataError(f"{name}: no point data '{wanted[-1] if alone else wanted[0]}'; {nearest(wanted[0], known)}")


def _errors(found: Points, name: str, case: str) -> FloatArray:
    """Return standard deviations (n, 3) that a file states; NaN where it does not."""
    n = len(found.places)
    values = found.values.get(f"sigma_{case}", found.values.get("sigma", np.full(n, np.nan)))
    if values.shape not in {(n,), (n, 1), (n, 3)}:
        raise DataError(f"{name}: sigma has the shape {values.shape}, expected ({n},) or ({n}, 3)")
    whole = np.array(np.broadcast_to(values.reshape(n, -1), (n, 3)))
    for axis, column in enumerate(ERRORS):
        if column in found.values:
            whole[:, axis] = found.values[column].ravel()
    return whole


def _pairs(folder: Path, scan: Scan, cases: tuple[str, ...], unit: float) -> Measurements:
    """Read pairs of surfaces, and take their differences."""
    assert scan.reference is not None
    strange = [case for case in scan.deformed if case not in cases]
    if strange:
        raise DataError(f"deformed: unknown load case '{strange[0]}'; {nearest(strange[0], cases)}")
    missing = [case for case in cases if case not in scan.deformed]
    if missing:
        raise DataError(f"deformed: no surface in load case '{missing[0]}', expected one in every load case")
    for name in scan.files:
        if Path(name).suffix not in MESHES:
            raise DataError(f"{name}: unknown kind of file, expected one of: {', '.join(MESHES)}")
    rest = points_of(folder / scan.reference)
    parts = []
    for case in cases:
        name = scan.deformed[case]
        moved = points_of(folder / name)
        n, m = len(rest.places), len(moved.places)
        same = n == m and len(rest.cells) == len(moved.cells)
        if not same or any(not np.array_equal(a, b) for a, b in zip(rest.cells, moved.cells, strict=True)):
            other = f"{m:,} points, and {n:,} in the reference" if n != m else "other cells than the reference"
            raise DataError(
                f"{name}: {other}: expected the same numbering; without it, a surface does not say where a point has "
                "gone, and its distance along the normal is not the displacement"
            )
        parts.append((rest.places, moved.places - rest.places, _errors(rest, scan.reference, case)))
    return _joined(parts, Path(scan.reference).name, cases, unit)


def _joined(
    parts: Sequence[tuple[FloatArray, FloatArray, FloatArray]], name: str, cases: tuple[str, ...], unit: float
) -> Measurements:
    """Join places, displacements and errors of the load cases, without points that coincide and say the same."""
    rows = []
    for number, (places, motion, sigma) in enumerate(parts):
        extent = float(np.ptp(places, axis=0).max() or 1.0)
        keys = np.column_stack([np.round(places / (SAME * extent)), np.isnan(motion)])
        _, first, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        gap = motion - motion[first[which.ravel()]]
        apart = (np.abs(gap) > 1e-5 * extent).any(axis=1)  # files in single precision round so
        if apart.any():
            i = int(np.flatnonzero(apart)[0])
            one, case = first[which.ravel()[i]], cases[number]
            raise DataError(
                f"{name}: points {one} and {i} coincide, but move by different displacements in load case '{case}' "
                f"(and {apart.sum() - 1} more): is the numbering the same?"
            )
        kept = np.sort(first)
        words = [f"{name}: point {i}" for i in kept]
        rows.append((places[kept], motion[kept], sigma[kept], np.full(len(kept), number), words))
    places, motions, errors, numbers = (np.concatenate([row[k] for row in rows]) for k in range(4))
    labels = [label for row in rows for label in row[4]]
    return Measurements.of_points(unit * places, unit * motions, unit * errors, numbers, labels, cases, unit=unit)
