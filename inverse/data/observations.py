"""Measured displacements of a specimen: their files, and what may be wrong with them.

A table of comma-separated values has the columns x, y, z (of the undeformed body), any of ux, uy, uz, and optionally
sigma, or sigma_x, sigma_y, sigma_z (standard deviations of the errors), and case (name of the load case). Empty cells
and ``nan`` mean that a component was not measured. Lines that begin with # state the source of the data, and lines
``# truth.NAME = VALUE`` the true values behind synthetic data. Other files are meshes that meshio reads, with the
displacements of a load case at their points as ``displacement_CASE``, or ``displacement`` if there is only one.

Most of the module describes what may be wrong with a table, each mistake with its line.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from glob import iglob
from itertools import count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from forward.settings import nearest, one_line
from inverse.data.approximation_error import Places
from inverse.data.neighbours import Neighbours, neighbours
from inverse.data.table import DataError, others, read_table

TABLES = (".csv", ".txt")
MESHES = (".vtu", ".vtk", ".xdmf", ".msh", ".inp", ".med", ".stl", ".ply")
POSITION, MOTION, ERRORS = ("x", "y", "z"), ("ux", "uy", "uz"), ("sigma_x", "sigma_y", "sigma_z")
COLUMNS = (*POSITION, *MOTION, "sigma", *ERRORS, "case")
SAME = 1e-9  # of the extent of all points: distance within which points coincide
TRUTH = "truth."


@dataclass(frozen=True, eq=False)
class Observations:
    """Displacements at n points.

    Attributes
    ----------
    places
        Where (n, 3) in the undeformed body (m).
    displacements
        What was measured (n, 3) there (m); NaN where it was not.
    sigma
        Standard deviations (n, 3) of the errors (m); NaN if the file does not state them.
    cases
        Names of the load cases, and `case` (n,) the number of each.
    labels
        Location (n,) of each point in its file.
    source
        Their source, line by line.
    truth
        True values by name, as text.
    """

    places: FloatArray
    displacements: FloatArray
    sigma: FloatArray
    cases: tuple[str, ...]
    case: NDArray[np.int64]
    labels: tuple[str, ...]
    source: tuple[str, ...] = ()
    truth: dict[str, str] = field(default_factory=dict)

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Which components (n, 3) were measured."""
        return np.isfinite(self.displacements)

    def with_sigma(self, sigma: float | None) -> Observations:
        """Return the same with a standard deviation (m) where the file states none.

        Raises
        ------
        DataError
            If it is needed and not given.
        """
        unknown = self.measured & ~np.isfinite(self.sigma)
        if not unknown.any():
            return self
        if sigma is None:
            at = self.labels[int(np.flatnonzero(unknown.any(axis=1))[0])]
            message = f"{at}: no sigma, expected a column sigma or data.sigma (m)"
            raise DataError(message)
        return replace(self, sigma=np.where(np.isfinite(self.sigma), self.sigma, sigma))

    def on(
        self, nearest_place: Callable[[FloatArray], FloatArray], extent: float, tolerance: float
    ) -> tuple[Observations, FloatArray]:
        """Move the points onto a body.

        Parameters
        ----------
        nearest_place
            Places (n, 3) of the body that are nearest to points (n, 3).
        extent
            Size of the body (m).
        tolerance
            Largest distance (m) from the body.

        Returns
        -------
        tuple
            The same with points that lie outside moved to the nearest place, and how far (n,) each was moved (m).

        Raises
        ------
        DataError
            If points are farther away, or displacements larger than the body.
        """
        mistakes = []
        largest = np.nanmax(np.abs(self.displacements))
        if largest > extent:
            at = self.labels[int(np.flatnonzero((np.abs(self.displacements) == largest).any(axis=1))[0])]
            mistakes.append(
                f"{at}: a displacement of {largest:g} m in a body of {extent:g} m, expected a smaller one: "
                "is data.unit right (m per unit of the file)?"
            )
        moved = nearest_place(self.places)
        distance = np.linalg.norm(moved - self.places, axis=1)
        distance[distance < SAME * extent] = 0.0
        far = np.flatnonzero(distance > tolerance)
        if far.size:
            worst = far[distance[far].argmax()]
            where = ", ".join(f"{x:g}" for x in self.places[worst])
            mistakes.append(
                f"{self.labels[worst]}: ({where}) lies {distance[worst]:.3g} m outside the body, expected at most "
                f"data.tolerance = {tolerance:.4g} m{others(far.size - 1)}"
            )
        if mistakes:
            raise DataError(*mistakes)
        return replace(self, places=moved), distance

    def data_labels(self) -> list[str]:
        """Say for each of the `components` its location in the file, place, load case and axis."""
        which, axes = self._order
        return [
            f"{self.labels[i]} at ({', '.join(f'{x:.4g}' for x in self.places[i])}) m, {self.cases[self.case[i]]}, "
            f"{MOTION[axis]}"
            for i, axis in zip(which, axes, strict=True)
        ]

    @property
    def _order(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Points and axes of what was measured, load case after load case."""
        which, axes = np.nonzero(self.measured)
        order = np.argsort(self.case[which], kind="stable")
        return which[order], axes[order]

    def components(self) -> Components:
        """Return what was measured, component by component, load case after load case."""
        which, axes = self._order
        return Components(
            self.places[which],
            axes.astype(np.int64),
            self.case[which],
            self.displacements[which, axes],
            self.sigma[which, axes],
        )


@dataclass(frozen=True, eq=False)
class Components:
    """Measured components of displacements, load case after load case.

    Attributes
    ----------
    places
        Where (m, 3), in m.
    axes
        Which component (m,): 0, 1 or 2.
    cases
        Numbers (m,) of the load cases.
    values, sigma
        What was measured (m,), and the standard deviations (m,) of the errors, in m.
    """

    places: FloatArray
    axes: NDArray[np.int64]
    cases: NDArray[np.int64]
    values: FloatArray
    sigma: FloatArray

    @property
    def which(self) -> None:
        """All outputs of a model that observes them."""
        return

    @property
    def described(self) -> dict[str, FloatArray]:
        """Places and axes, by their names in results."""
        return {"place": self.places, "datum_axis": self.axes.astype(float)}

    @property
    def spread(self) -> Places:
        """Where they are, by load case and component."""
        return Places(3 * self.cases + self.axes, self.places)

    def neighbours(self) -> Neighbours:
        """Return pairs of neighbouring data of the same component and load case."""
        return neighbours(self.places, 3 * self.cases + self.axes)


def files(patterns: Sequence[str], folders: Sequence[Path]) -> list[Path]:
    """Return the files given by names, folders (all data files in them) and patterns such as ``*.csv``.

    Missing files are included too, so that the others of a batch go on: they cannot be read.

    Parameters
    ----------
    patterns
        Names, folders and patterns.
    folders
        Where to look for them: the first folder with a match counts.

    Raises
    ------
    DataError
        If none of them means anything.
    """
    found: dict[Path, bool] = {}
    missing = []
    for pattern in patterns:
        for folder in folders:
            path = folder / pattern
            if path.is_dir():
                here = sorted(child for child in path.iterdir() if child.suffix in TABLES + MESHES)
            elif path.is_file():
                here = [path]
            else:
                here = [one for one in sorted(_matching(folder, pattern)) if one.is_file()]
            if here:
                found |= dict.fromkeys(here, True)
                break
        else:
            missing.append(f"{pattern}: no such file, expected a file, a folder of data files or a pattern")
            found |= {folders[0] / pattern: False}
    if not any(found.values()):
        raise DataError(*missing)
    return list(found)


def _matching(folder: Path, pattern: str) -> Iterator[Path]:
    """Find what a pattern means, in a folder where it does not say in full where."""
    if "\0" not in pattern and any(sign in pattern for sign in "*?["):
        # pathlib takes no pattern that begins with the root
        for found in iglob(pattern, root_dir=folder, recursive=True, include_hidden=True):  # noqa: PTH207
            yield folder / found


def distinct(paths: Sequence[Path]) -> list[str]:
    """Return a name for each of different files: without its ending; with it, and with folders, where two share one."""
    names = [path.stem for path in paths]
    ways = [path.relative_to(path.anchor).parts for path in paths]
    for depth in range(1, max(map(len, ways), default=0) + 1):
        shared = {name for name, times in Counter(names).items() if times > 1}
        names = ["-".join(way[-depth:]) if name in shared else name for way, name in zip(ways, names, strict=True)]
    for i, name in enumerate(names):  # a-b/c and a/b-c
        if name in names[:i]:
            names[i] = next(new for k in count(2) if (new := f"{name}-{k}") not in names)
    return names


def read(path: Path, cases: Sequence[str], unit: float = 1.0) -> Observations:
    """Read a file.

    Parameters
    ----------
    path
        A table, or a mesh.
    cases
        Names of the load cases.
    unit
        m per unit of the file.

    Raises
    ------
    DataError
        With every kind of mistake in the file.
    """
    if path.suffix not in TABLES + MESHES:
        message = f"{path.name}: unknown kind of file, expected one of: {', '.join(TABLES + MESHES)}"
        raise DataError(message)
    found = _table(path, tuple(cases), unit) if path.suffix in TABLES else _mesh(path, tuple(cases), unit)
    mistakes = list(_mistakes(found, path.name))
    if mistakes:
        raise DataError(*mistakes)
    return found


def _mistakes(found: Observations, name: str) -> list[str]:
    mistakes = []
    for number, case in enumerate(found.cases):
        of_case = found.case == number
        if not found.measured[of_case].any():
            mistakes.append(f"{name}: no data in load case '{case}', expected some in every load case of the model")
    bad = np.flatnonzero((found.sigma <= 0).any(axis=1))
    if bad.size:
        value = found.sigma[bad[0]][found.sigma[bad[0]] <= 0][0]
        mistakes.append(f"{found.labels[bad[0]]}: sigma = {value:g}, expected more than 0{others(bad.size - 1)}")
    step = SAME * float(np.ptp(found.places, axis=0).max() or 1.0)
    keys = np.column_stack([np.round(found.places / step), found.case])
    _, first, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    which = which.ravel()
    twice = [
        (int(first[which[i]]), i)
        for i in np.flatnonzero(first[which] != np.arange(len(which)))
        if (found.measured[i] & found.measured[first[which[i]]]).any()
    ]
    if twice:
        one, other = twice[0]
        mistakes.append(
            f"{found.labels[other]}: the point of {found.labels[one].rpartition(': ')[2]} again in load case "
            f"'{found.cases[found.case[other]]}', expected each once{others(len(twice) - 1)}"
        )
    return mistakes


def _table(path: Path, cases: tuple[str, ...], unit: float) -> Observations:
    name = path.name
    found = read_table(path)
    columns = found.columns
    wrong = [
        f"{name}: unknown column '{column}'; {nearest(column, COLUMNS)}" for column in columns if column not in COLUMNS
    ]
    wrong += [f"{name}: no column '{column}', expected x, y, z" for column in POSITION if column not in columns]
    if not any(column in columns for column in MOTION):
        wrong.append(f"{name}: no column of displacements, expected at least one of ux, uy, uz")
    if "case" not in columns and len(cases) > 1:
        wrong.append(f"{name}: no column 'case', expected one where there are several load cases: {', '.join(cases)}")
    if wrong:
        raise DataError(*wrong)
    rows = found.rows
    labels = tuple(f"{name}: line {n}" for n in found.lines)
    numbers: dict[str, FloatArray] = {}
    mistakes = []
    for column in (*POSITION, *MOTION, "sigma", *ERRORS):
        if column not in columns:
            continue
        values = [_number(row[column]) for row in rows]
        needed = column in POSITION
        bad = [i for i, v in enumerate(values) if v is None or math.isinf(v) or (needed and math.isnan(v))]
        if bad:
            given = rows[bad[0]][column]
            mistakes.append(f"{labels[bad[0]]}: {column} is {given!r}, expected a number{others(len(bad) - 1)}")
        numbers[column] = unit * np.array([math.nan if v is None else v for v in values])
    given_cases = [row["case"] if "case" in columns else cases[0] for row in rows]
    strange = [i for i, case in enumerate(given_cases) if case not in cases]
    if strange:
        word = given_cases[strange[0]]
        more = others(len(strange) - 1)
        mistakes.append(f"{labels[strange[0]]}: unknown load case '{word}'; {nearest(word, cases)}{more}")
    if mistakes:
        raise DataError(*mistakes)
    nothing = np.full(len(rows), np.nan)
    common = numbers.get("sigma", nothing)
    return Observations(
        np.column_stack([numbers[column] for column in POSITION]),
        np.column_stack([numbers.get(column, nothing) for column in MOTION]),
        np.column_stack([numbers.get(column, common) for column in ERRORS]),
        cases,
        np.array([cases.index(case) for case in given_cases]),
        labels,
        tuple(line for line in found.remarks if not line.startswith(TRUTH)),
        dict(_assignment(line) for line in found.remarks if line.startswith(TRUTH)),
    )


def _mesh(path: Path, cases: tuple[str, ...], unit: float) -> Observations:
    import contextlib
    import io

    try:
        import meshio
    except ImportError:
        message = f"{path.name}: files of this kind need meshio (pip install meshio)"
        raise DataError(message) from None
    if not path.exists():
        raise DataError(f"{path.name}: cannot be read: No such file or directory")
    said = io.StringIO()  # what meshio prints, also before it exits
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            mesh = meshio.read(path)
    except (Exception, SystemExit) as error:
        reason = said.getvalue() if isinstance(error, SystemExit) else str(error)
        raise DataError(one_line(f"{path.name}: cannot be read as {path.suffix}: {' '.join(reason.split())}")) from None
    fields = {case: f"displacement_{case}" for case in cases}
    if len(cases) == 1 and fields[cases[0]] not in mesh.point_data:
        fields[cases[0]] = "displacement"
    missing = [name for name in fields.values() if name not in mesh.point_data]
    if missing:
        raise DataError(
            *(
                f"{path.name}: no point data '{name}'; {nearest(name, tuple(mesh.point_data) or ('none',))}"
                for name in missing
            )
        )
    motions = [np.asarray(mesh.point_data[name], dtype=float) for name in fields.values()]
    points = np.asarray(mesh.points, dtype=float)
    n = len(points)
    for name, motion in zip(fields.values(), motions, strict=True):
        if motion.shape != (n, 3) or points.shape != (n, 3):
            raise DataError(f"{path.name}: '{name}' has the shape {motion.shape}, expected ({n}, 3)")
    if not np.isfinite(points).all():
        raise DataError(f"{path.name}: a point has a coordinate that is not a number")
    if any(np.isinf(motion).any() for motion in motions):
        raise DataError(f"{path.name}: a displacement is infinite, expected numbers, or nan where nothing was measured")
    return Observations(
        unit * np.tile(points, (len(cases), 1)),
        unit * np.concatenate(motions),
        np.full((n * len(cases), 3), np.nan),
        cases,
        np.repeat(np.arange(len(cases)), n),
        tuple(f"{path.name}: point {i}" for _ in cases for i in range(n)),
    )


def _number(text: str) -> float | None:
    """A number, NaN for an empty cell, None where it is neither."""
    try:
        return float(text) if text else math.nan
    except ValueError:
        return None


def _assignment(line: str) -> tuple[str, str]:
    name, _, value = line.removeprefix(TRUTH).partition("=")
    return name.strip(), value.strip().strip('"')
