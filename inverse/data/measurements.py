"""What was measured, number by number: components of displacements, outputs of load cases or of a model."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forward.findings import Finding
from forward.model import FloatArray
from forward.readable import told
from inverse.data.neighbours import Neighbours, neighbours
from inverse.data.registration import Registered
from inverse.data.table import DataError, others

AXES = ("x", "y", "z")
FAR = 0.02  # of the extent of a body: median distance of points from which on they may belong to another
SAME = 1e-9  # of the extent of all points: distance within which points coincide
LISTED = 5  # points that do not belong to a body
COLUMNS = ("values", "sigma", "cases", "axes", "names", "labels", "places", "along", "points", "moved", "at")
STEP_OF = re.compile(r"\.\d+$")  # which step of a path an output is of
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measured numbers (m,) of one data set.

    Attributes
    ----------
    values, sigma
        What was measured (m,), and the standard deviations (m,) of the errors, in SI units; NaN if unknown, and of what
        is predicted only.
    cases
        Number (m,) of the part of the data that each belongs to, whose information is also shown separately.
    axes, names
        What it is, by number (m,) and by name (m,): x, y, z of a displacement, and then the outputs of its load case;
        or of all outputs of a model.
    labels
        Location (m,) in the file.
    parts
        Names of the parts: load cases, or outputs with data in any data set of a study.
    places, along
        Where (m, 3) in the undeformed body (m), NaN of outputs, and unit vectors (m, 3) in the body along which, zeros
        of outputs.
    points, moved
        Number (m,) of the point in its file, -1 of outputs, and how far (m,) it was moved onto the body (m).
    at
        Where (m,) in a test of a material: stretch, or amount of shear; NaN of others.
    some
        Whether these are some outputs of a model, by their numbers `axes`: a specimen is observed where they are.
    source
        Their source, line by line.
    truth
        What they were made from, by name: numbers of the model, and what else is known.
    unit
        m per unit of the file.
    left_out
        Points that do not belong to the body, and how far they are from it.
    registered
        The motion from the frame of the file to that of the body; None if they are the same.
    between
        Standard deviations (rad, m) of rigid motions between the undeformed scan and that of each load case.
    on_surface
        Whether the points lie on the surface of the body.
    """

    values: FloatArray
    sigma: FloatArray
    cases: Ints
    axes: Ints
    names: NDArray[np.str_]
    labels: NDArray[np.str_]
    parts: tuple[str, ...]
    places: FloatArray
    along: FloatArray
    points: Ints
    moved: FloatArray
    at: FloatArray
    some: bool = False
    source: tuple[str, ...] = ()
    truth: dict[str, Any] = field(default_factory=dict)
    unit: float = 1.0
    left_out: tuple[str, ...] = ()
    registered: Registered | None = None
    between: tuple[float, float] = (0.0, 0.0)
    on_surface: bool = False

    @classmethod
    def of(
        cls,
        values: FloatArray,
        sigma: FloatArray,
        cases: Sequence[int] | Ints,
        axes: Sequence[int] | Ints,
        names: str | Sequence[str] = "",
        labels: str | Sequence[str] = "",
        parts: Sequence[str] = (),
        places: FloatArray | None = None,
        points: Ints | None = None,
        at: FloatArray | None = None,
        **more: Any,
    ) -> Measurements:
        """Return numbers (m,) at places (m, 3) along the axes of the body, or outputs, which are measured at none."""
        m, of, which = len(values), np.array(cases, dtype=np.int64), np.array(axes, dtype=np.int64)
        name, label = (np.broadcast_to(np.array(one, dtype=np.str_), m) for one in (names, labels))
        along, numbers = np.eye(4, 3)[np.minimum(which, 3)], np.arange(m) if points is None else points
        if places is None:
            places, along, numbers = np.full((m, 3), np.nan), np.zeros((m, 3)), np.full(m, -1)
        rest = np.zeros(m), np.full(m, np.nan) if at is None else at
        return cls(values, sigma, of, which, name, label, tuple(parts), places, along, numbers, *rest, **more)

    @classmethod
    def of_points(
        cls,
        places: FloatArray,
        displacements: FloatArray,
        sigma: FloatArray,
        cases: Ints,
        labels: Sequence[str],
        parts: Sequence[str],
        **more: Any,
    ) -> Measurements:
        """Return displacements (n, 3) at places (n, 3), all components, of which some may be NaN: not measured."""
        n = len(places)
        points, axes = np.repeat(np.arange(n), 3), np.tile([0, 1, 2], n)
        words, names = [label for label in labels for _ in AXES], AXES * n
        rows = (displacements.ravel(), sigma.ravel(), cases[points], axes, names, words, parts, places[points], points)
        return cls.of(*rows, **more)

    @classmethod
    def of_tests(
        cls,
        values: FloatArray,
        sigma: FloatArray,
        tests: Sequence[str],
        at: FloatArray,
        places: FloatArray | None = None,
    ) -> Measurements:
        """Return stresses (m,) of tests of a material, by name, at stretches or amounts of shear `at` (m,).

        Their places (m, k) are those in which neighbours are found, by default `at`.
        """
        parts, cases = np.unique(np.array(tests, dtype=np.str_), return_inverse=True)
        where = at[:, None] if places is None else places
        return cls.of(values, sigma, cases, np.zeros_like(cases), parts=parts.tolist(), places=where, at=at)

    @classmethod
    def possible(
        cls, labels: Sequence[str], places: FloatArray, tests: Sequence[str], names: Sequence[str]
    ) -> Measurements:
        """Return what could be measured (m,), by its label: components, or outputs at NaN, in parts by name."""
        parts, cases = np.unique(np.array(tests, dtype=np.str_), return_inverse=True)
        axes, nothing = [(*AXES, name).index(name) for name in names], np.full(len(labels), np.nan)
        points = np.where(np.isfinite(places).all(axis=1), np.arange(len(labels)), -1)
        return cls.of(nothing, nothing, cases, axes, names, labels, parts.tolist(), places, points)

    def __len__(self) -> int:
        """Return their number."""
        return len(self.values)

    # --- what others need of data ------------------------------------------------------------------------------------

    @property
    def which(self) -> Ints | slice:
        """The outputs of the model that were measured: numbers (m,), or all of a slice."""
        return self.axes if self.some else slice(None)

    @property
    def tests(self) -> NDArray[np.str_]:
        """Names (m,) of the parts."""
        return np.array(self.parts, dtype=np.str_)[self.cases]

    @property
    def measured_tests(self) -> tuple[str, ...]:
        """Names of the parts in which something was measured, in the order of the data."""
        return tuple(dict.fromkeys(self.seen().tests.tolist()))

    @property
    def positions(self) -> FloatArray:
        """Where (m,) in its part each is: in a test, or else its number."""
        numbers = np.zeros(len(self))
        for case in np.unique(self.cases):
            numbers[self.cases == case] = np.arange((self.cases == case).sum())
        return np.where(np.isfinite(self.at), self.at, numbers)

    @property
    def placed(self) -> NDArray[np.bool_]:
        """Which data (m,) are at places of a body."""
        somewhere = self.places.shape[1] == len(AXES)
        return np.asarray(np.isfinite(self.places).all(axis=1) & somewhere)

    @property
    def described(self) -> dict[str, FloatArray]:
        """Places and axes, by their names in results; of outputs of a model nothing."""
        if self.some:
            return {}
        turned = not np.array_equal(self.along, np.eye(4, 3)[np.minimum(self.axes, 3)])
        more = {"datum_direction": self.along} if turned else {}
        return {"place": self.places, "datum_axis": self.axes.astype(float), **more}

    @property
    def kinds(self) -> Ints:
        """A number (m,) for each pair of a part and a component or output."""
        return kinds(self.cases, self.axes)

    @property
    def curves(self) -> Ints:
        """A number (m,) for each output, which is the same in all load cases and steps of a path; -1 of the others."""
        found, rows = np.full(len(self), -1), ~self.placed
        outputs = [STEP_OF.sub("", name) for name in self.names[rows]]
        found[rows] = np.unique(outputs, return_inverse=True)[1]
        return found

    def neighbours(self) -> Neighbours:
        """Return pairs of neighbouring data that are the same, and of repeated measurements."""
        return neighbours(np.nan_to_num(self.places), self.kinds)

    @property
    def places_of_points(self) -> FloatArray:
        """Where (n, 3) the points are, each once."""
        return self.places[self._points[0]]

    @property
    def moves(self) -> FloatArray:
        """How far (n,) the points were moved (m)."""
        return self.moved[self._points[0]]

    def data_labels(self) -> list[str]:
        """Say for each its location in the file, place, part, and component or output."""
        found = []
        for label, place, case, axis, name in zip(
            self.labels, self.places, self.cases, self.axes, self.names, strict=True
        ):
            at = f" at ({', '.join(f'{x:.4g}' for x in place)}) m" if np.isfinite(place).all() else ""
            of = "" if self.some else f" {self.parts[case]},"
            found.append(f"{label}{at},{of} {'' if self.some or axis >= len(AXES) else 'u'}{name}")
        return found

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

    # --- the same with something else --------------------------------------------------------------------------------

    def seen(self) -> Measurements:
        """Return those that were measured."""
        return self.subset(np.isfinite(self.values))

    def subset(self, rows: NDArray[Any]) -> Measurements:
        """Return some of them, by number or mask."""
        return replace(self, **{name: vars(self)[name][rows] for name in COLUMNS})

    def with_rows(self, more: Measurements) -> Measurements:
        """Return them with others of the same parts, and what is true of both."""
        rows = {name: np.concatenate([vars(one)[name] for one in (self, more)]) for name in COLUMNS}
        source = tuple(dict.fromkeys((*self.source, *more.source)))
        return replace(self, **rows, source=source, truth={**self.truth, **more.truth})

    def with_sigma(self, usual: FloatArray) -> Measurements:
        """Return the same with standard deviations (m,) where the file states none."""
        return replace(self, sigma=np.where(np.isfinite(self.sigma), self.sigma, usual))

    def in_model(self, known: Mapping[str, Sequence[str]]) -> Measurements:
        """Return displacements and outputs of load cases as a specimen numbers what it has in each of its own."""
        pairs = [(case, name) for case, name in zip(self.tests.tolist(), self.names.tolist(), strict=True)]
        order = list(known)
        cases, axes = [order.index(case) for case, _ in pairs], [known[case].index(name) for case, name in pairs]
        return replace(self, parts=tuple(order), cases=np.array(cases), axes=np.array(axes))

    def by_part(self, numbers: Ints) -> Measurements:
        """Return outputs of a model by the parts that have data in any data set: numbers (k,) of these, ascending."""
        parts = tuple(self.parts[number] for number in numbers)
        return replace(self, parts=parts, cases=np.searchsorted(numbers, self.axes))

    def measured(self) -> Measurements:
        """Return those that were measured, load case after load case."""
        seen = np.flatnonzero(np.isfinite(self.values))
        return self.subset(seen[np.argsort(self.cases[seen], kind="stable")])

    def moved_by(self, registered: Registered) -> Measurements:
        """Return the same in the frame of the body."""
        places = self._by_point(registered.motion(self.places_of_points), self.places)
        return replace(self, registered=registered, places=places, along=self.along @ registered.motion.rotation.T)

    def on(
        self,
        nearest_place: Callable[[FloatArray], FloatArray],
        extent: float,
        tolerance: float,
        *,
        surface: bool = False,
        leave_out: bool = False,
    ) -> Measurements:
        """Move the points onto a body of some extent (m), to its places (n, 3), or its surface's, that are nearest.

        Points that are farther away than the tolerance (m) may be left out. Raises `DataError` if points are farther
        away, all of them are left out, or displacements are larger than the body.
        """
        points, first = self.places_of_points, self._points[0]
        if not len(points):
            return self
        mistakes = []
        size = np.where(self.points >= 0, np.abs(np.nan_to_num(self.values)), 0.0)
        if size.max() > extent:
            mistakes.append(
                f"{self.labels[int(size.argmax())]}: a displacement of {size.max():g} m in a body of {extent:g} m, "
                "expected a smaller one: is data.unit right (m per unit of the file)?"
            )
        moved = nearest_place(points)
        distance = np.linalg.norm(moved - points, axis=1)
        distance[distance < SAME * extent] = 0.0
        far = distance > tolerance
        if far.any() and not (leave_out and not far.all()):
            worst = int(distance.argmax())
            where = ", ".join(f"{x:g}" for x in points[worst])
            from_body = "from the surface of" if surface else "outside"
            rest = f" (and {far.sum() - 1} more of {len(far)})" if far.sum() > 1 else ""
            mistakes.append(
                f"{self.labels[first[worst]]}: ({where}) lies {distance[worst]:.3g} m {from_body} the body, expected "
                f"at most data.tolerance = {tolerance:.4g} m{rest}{_of_another(distance, extent)}"
            )
        if mistakes:
            raise DataError(*mistakes)
        lost = tuple(f"{self.labels[first[i]]} ({told(distance[i], 'm', 3)})" for i in np.flatnonzero(far))
        here = replace(
            self,
            places=self._by_point(moved, self.places),
            moved=self._by_point(distance, self.moved),
            left_out=lost,
            on_surface=surface,
        )
        return here.subset(~self._by_point(far, np.zeros(len(self), dtype=np.bool_)))

    @property
    def _points(self) -> tuple[Ints, Ints]:
        """The first row (n,) of each point, and the number of the point of each row that has one."""
        rows = np.flatnonzero(self.points >= 0)
        _, first, of = np.unique(self.points[rows], return_index=True, return_inverse=True)
        return rows[first], of

    def _by_point(self, values: NDArray[Any], usual: NDArray[Any]) -> NDArray[Any]:
        """Return values (n, …) of the points by row; of outputs the usual ones (m, …)."""
        found = usual.copy()
        found[self.points >= 0] = values[self._points[1]]
        return found

    def checked(self) -> Measurements:
        """Return the same; a DataError if a standard deviation is not known where something was measured."""
        unknown = np.flatnonzero(np.isfinite(self.values) & ~np.isfinite(self.sigma))
        if not unknown.size:
            return self
        at, name = self.labels[unknown[0]], self.names[unknown[0]]
        if name in AXES:
            raise DataError(f"{at}: no sigma, expected a column sigma or data.sigma (m)")
        raise DataError(
            f"{at}: the standard deviation of the error of '{name}' is not known{others(unknown.size - 1)}, expected "
            f"a column sigma_value or data.sigma_of.{name}"
        )

    def check_signs(self, names: Sequence[str], negative: Sequence[bool]) -> None:
        """Refuse outputs, by name (m,), that are mostly below 0 though they cannot be `negative`; a few may by errors.

        A tool presses and never pulls, and many programs count forces that press as negative. Raises `DataError` with a
        line for each such output.
        """
        wrong = []
        for name in dict.fromkeys(names):
            mine = [k for k, one in enumerate(names) if one == name and not negative[k]]
            below = [k for k in mine if self.values[k] < 0]
            if 2 * len(below) > len(mine):
                wrong.append(
                    f"{self.labels[below[0]]}: '{name}' is {self.values[below[0]]:g}, and {len(below)} of {len(mine)} "
                    "are below 0, which it cannot be: a force is positive where the tool presses on the body; expected "
                    "the other sign"
                )
        if wrong:
            raise DataError(*wrong)

    # --- mistakes ----------------------------------------------------------------------------------------------------

    def mistakes(self, name: str) -> list[str]:
        """Say what is wrong with the data of a file."""
        seen = np.isfinite(self.values)
        mistakes = [
            f"{name}: no data in load case '{case}', expected some in every load case of the model"
            for number, case in enumerate(self.parts)
            if not (seen & (self.cases == number)).any()
        ]
        bad = np.flatnonzero((self.points >= 0) & (self.sigma <= 0))
        if bad.size:
            more = others(len(np.unique(self.points[bad])) - 1)
            mistakes.append(f"{self.labels[bad[0]]}: sigma = {self.sigma[bad[0]]:g}, expected more than 0{more}")
        rows = np.flatnonzero(seen & (self.points >= 0))
        if not rows.size:
            return mistakes
        step = SAME * float(np.ptp(self.places_of_points, axis=0).max() or 1.0)
        keys = np.column_stack([np.round(self.places[rows] / step), self.cases[rows], self.axes[rows]])
        _, first, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        before = rows[first[which.ravel()]]
        again = np.flatnonzero(before != rows)
        if again.size:
            one, other = before[again[0]], rows[again[0]]
            more = others(len(np.unique(self.points[rows[again]])) - 1)
            mistakes.append(
                f"{self.labels[other]}: the point of {self.labels[one].rpartition(': ')[2]} again in load case "
                f"'{self.parts[self.cases[other]]}', expected each once{more}"
            )
        return mistakes


def _of_another(distance: FloatArray, extent: float) -> str:
    """Say that a scan is of another body, or not registered, where most of its points are far away."""
    if np.median(distance) < FAR * extent:
        return ""
    return "; half of the points are far away: is it another body, another unit, or is data.registration missing?"


def kinds(cases: Ints, axes: Ints) -> Ints:
    """Return a number (m,) for each pair of a load case and a component or output."""
    return np.asarray(max(int(axes.max(initial=0)) + 1, len(AXES)) * cases + axes)
