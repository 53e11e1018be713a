"""Measured displacements of a specimen, with other outputs beside them, and their components one by one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from forward.readable import told
from inverse.data.approximation_error import Places
from inverse.data.neighbours import Neighbours, neighbours
from inverse.data.readings import Readings
from inverse.data.table import DataError, others

POSITION, MOTION, ERRORS = ("x", "y", "z"), ("ux", "uy", "uz"), ("sigma_x", "sigma_y", "sigma_z")
FAR = 0.02  # of the extent of a body: median distance of points from which on they may belong to another
SAME = 1e-9  # of the extent of all points: distance within which points coincide


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
    axes
        Directions (3, 3) in the body along which x, y and z of the displacements are measured, as rows.
    unit
        m per unit of the file.
    readings
        Measured outputs of the load cases.
    """

    places: FloatArray
    displacements: FloatArray
    sigma: FloatArray
    cases: tuple[str, ...]
    case: NDArray[np.int64]
    labels: tuple[str, ...]
    source: tuple[str, ...] = ()
    truth: dict[str, str] = field(default_factory=dict)
    axes: FloatArray = field(default_factory=lambda: np.eye(3))
    unit: float = 1.0
    readings: Readings = field(default_factory=Readings)

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

    def of(self, rows: NDArray[np.bool_]) -> Observations:
        """Return some of the points (n,)."""
        return replace(
            self,
            places=self.places[rows],
            displacements=self.displacements[rows],
            sigma=self.sigma[rows],
            case=self.case[rows],
            labels=tuple(label for label, kept in zip(self.labels, rows, strict=True) if kept),
        )

    def on(
        self,
        nearest_place: Callable[[FloatArray], FloatArray],
        extent: float,
        tolerance: float,
        *,
        surface: bool = False,
        leave_out: bool = False,
    ) -> Placed:
        """Move the points onto a body.

        Parameters
        ----------
        nearest_place
            Places (n, 3) of the body, or of its surface, that are nearest to points (n, 3).
        extent
            Size of the body (m).
        tolerance
            Largest distance (m) from the body, or from its surface.
        surface
            Whether the surface is meant.
        leave_out
            Whether points that are farther away are left out.

        Raises
        ------
        DataError
            If points are farther away, all of them are left out, or displacements are larger than the body.
        """
        if not len(self.places):
            return Placed(self, np.zeros(0))
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
        far = distance > tolerance
        if far.any() and not (leave_out and not far.all()):
            worst = int(distance.argmax())
            where = ", ".join(f"{x:g}" for x in self.places[worst])
            from_body = "from the surface of" if surface else "outside"
            rest = f" (and {far.sum() - 1} more of {len(far)})" if far.sum() > 1 else ""
            mistakes.append(
                f"{self.labels[worst]}: ({where}) lies {distance[worst]:.3g} m {from_body} the body, expected at most "
                f"data.tolerance = {tolerance:.4g} m{rest}{_of_another(distance, extent)}"
            )
        if mistakes:
            raise DataError(*mistakes)
        kept = replace(self, places=moved).of(~far)
        lost = np.flatnonzero(far)
        return Placed(kept, distance[~far], tuple(f"{self.labels[i]} ({told(distance[i], 'm', 3)})" for i in lost))

    def data_labels(self) -> list[str]:
        """Say for each of the `components` its location in the file, place, load case, and axis or output."""
        which, axes = np.nonzero(self.measured)
        found = [
            f"{self.labels[i]} at ({', '.join(f'{x:.4g}' for x in self.places[i])}) m, {self.cases[self.case[i]]}, "
            f"{MOTION[axis]}"
            for i, axis in zip(which, axes, strict=True)
        ]
        more = self.readings
        found += [
            f"{label}, {self.cases[case]}, {name}"
            for label, case, name in zip(more.labels, more.case, more.names, strict=True)
        ]
        return [found[i] for i in self._order]

    @property
    def _order(self) -> NDArray[np.intp]:
        """Measured components of displacements, then readings, in the order of their load cases."""
        which, _ = np.nonzero(self.measured)
        return np.argsort(np.concatenate([self.case[which], self.readings.case]), kind="stable")

    def by_datum(self, values: FloatArray) -> FloatArray:
        """Return values (n,) of the points for each of the `components`; zeros of other outputs."""
        which, _ = np.nonzero(self.measured)
        return np.asarray(np.concatenate([values[which], np.zeros(len(self.readings))])[self._order])

    def components(self) -> Components:
        """Return what was measured, load case after load case: displacements by component, then other outputs."""
        (which, axes), more, order = np.nonzero(self.measured), self.readings, self._order
        nowhere = np.zeros((len(more), 3))
        return Components(
            np.concatenate([self.places[which], nowhere + np.nan])[order],
            np.concatenate([axes.astype(np.int64), len(MOTION) + more.which])[order],
            np.concatenate([self.case[which], more.case])[order],
            np.concatenate([self.displacements[which, axes], more.values])[order],
            np.concatenate([self.sigma[which, axes], more.sigma])[order],
            None if np.array_equal(self.axes, np.eye(3)) else np.concatenate([self.axes[axes], nowhere])[order],
        )


@dataclass(frozen=True, eq=False)
class Placed:
    """Observations that were moved onto a body.

    Attributes
    ----------
    observations
        On the body.
    distances
        How far (n,) each was moved (m).
    left_out
        Labels and distances of points that were too far away.
    """

    observations: Observations
    distances: FloatArray
    left_out: tuple[str, ...] = ()


def _of_another(distance: FloatArray, extent: float) -> str:
    """Say that a scan is of another body, or not registered, where most of its points are far away."""
    if np.median(distance) < FAR * extent:
        return ""
    return "; half of the points are far away: is it another body, another unit, or is data.registration missing?"


@dataclass(frozen=True, eq=False)
class Components:
    """Measured components of displacements and other outputs, load case after load case.

    Attributes
    ----------
    places
        Where (m, 3), in m; NaN of other outputs.
    axes
        Which component (m,): 0, 1 or 2; 3 and more are the other outputs of the load case, in its order.
    cases
        Numbers (m,) of the load cases.
    values, sigma
        What was measured (m,), and the standard deviations (m,) of the errors, in m or in the unit of the output.
    directions
        Unit vectors (m, 3) in the body along which; by default its axes, and zeros of other outputs.
    """

    places: FloatArray
    axes: NDArray[np.int64]
    cases: NDArray[np.int64]
    values: FloatArray
    sigma: FloatArray
    directions: FloatArray | None = None

    @property
    def along(self) -> FloatArray:
        """Unit vectors (m, 3) in the body along which they are measured."""
        n = len(MOTION)
        return np.eye(n + 1, n)[np.minimum(self.axes, n)] if self.directions is None else self.directions

    @property
    def which(self) -> None:
        """All outputs of a model that observes them."""
        return

    @property
    def described(self) -> dict[str, FloatArray]:
        """Places and axes, by their names in results."""
        more = {} if self.directions is None else {"datum_direction": self.directions}
        return {"place": self.places, "datum_axis": self.axes.astype(float), **more}

    @property
    def spread(self) -> Places:
        """Where they are, by load case and component."""
        return Places(self._kinds, self.places)

    def neighbours(self) -> Neighbours:
        """Return pairs of neighbouring data of the same component and load case, and repeated measurements."""
        return neighbours(np.nan_to_num(self.places), self._kinds)

    @property
    def _kinds(self) -> NDArray[np.int64]:
        return kinds(self.cases, self.axes)


def kinds(cases: NDArray[np.int64], axes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return a number (m,) for each pair of a load case and a component or output."""
    return np.asarray(max(int(axes.max(initial=0)) + 1, len(MOTION)) * cases + axes)


def mistakes_of(found: Observations, name: str) -> list[str]:
    """Say what is wrong with the data of a file."""
    mistakes = []
    for number, case in enumerate(found.cases):
        of_case = found.case == number
        if not found.measured[of_case].any() and number not in found.readings.case:
            mistakes.append(f"{name}: no data in load case '{case}', expected some in every load case of the model")
    if not len(found.places):
        return mistakes
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
