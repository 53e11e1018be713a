"""Measured displacements by which models of a specimen are compared: materials, meshes or elements as candidates."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from forward.bodies.geometry import AXES, Vector
from forward.scalars import Mistake
from forward.settings import Settings
from forward.spec import ModelSpec
from forward.specimen import Specimen
from inverse.criticism.comparison import Data
from inverse.data.registration import UncertainMotion
from inverse.data.scans import Reading
from inverse.data.table import DataError
from workflows.config.mistakes import StudyError
from workflows.studies.measured import Positive, onto, read_on

if TYPE_CHECKING:
    from forward.fem.specimen import SpecimenModel
    from forward.model import FloatArray, ForwardModel
    from inverse.data.shared_motion import SharedMotion


class DisplacementFile(Reading):
    """A file of measured displacements, see `inverse.data.scans`.

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
    """

    file: str

    def read(self, folder: Path, specimen: Specimen) -> dict[str, Any]:
        """Return the block `data` with the displacements themselves.

        Raises
        ------
        StudyError
            If the file cannot be used.
        """
        try:
            found = read_on(folder / self.file, specimen, self)
        except DataError as error:
            raise StudyError(*(f"data: {line}" for line in error.args)) from None
        motion, moved = UncertainMotion.of(found.registered, found.between), found.moves
        known = bool(np.isfinite(found.sigma).all())
        axes = {} if found.registered is None else {"axes": found.registered.motion.rotation.T.tolist()}
        uncertain = {} if motion is None else {"motion": motion.model_dump(exclude_none=True)}
        return {
            "source": [*found.source, *(f"truth: {name} = {value}" for name, value in found.truth.items())],
            "places": np.nan_to_num(found.places).tolist(),
            "components": found.names.tolist(),
            **axes,
            **({} if motion is None else {**uncertain, "on_surface": found.on_surface}),
            "cases": [found.parts[case] for case in found.cases],
            "measured": found.values.tolist(),
            **({"sigma": found.sigma.tolist()} if known else {}),
            **({"points_moved": int((moved > 0).sum()), "largest_move": float(moved.max())} if moved.any() else {}),
        }


class ListedDisplacements(Settings):
    """What was measured, component by component.

    Parameters
    ----------
    places
        Where in the undeformed body (m); zeros of other outputs, which are measured at no place.
    components, cases
        Component, or name of the output, and load case of each.
    measured
        Displacements (m), and values of the outputs in their units.
    sigma
        Standard deviations of their errors in the same units, if known.
    axes
        Directions in the body of x, y and z, along which components were measured; by default its own.
    motion
        What is uncertain of rigid motions of the scan; by default nothing.
    on_surface
        Whether uncertain motions leave the points on the surface of the body.
    source
        Their source, line by line.
    points_moved, largest_move
        How many points lay outside the body, and the largest distance (m) by which one was moved.
    """

    quantity: ClassVar[str] = "displacement"
    in_file: ClassVar[type[Settings]] = DisplacementFile

    places: tuple[Vector, ...] = Field(min_length=1)
    components: tuple[str, ...]
    cases: tuple[str, ...]
    measured: tuple[float, ...]
    sigma: tuple[Positive, ...] | None = None
    axes: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    motion: UncertainMotion | None = None
    on_surface: bool = False
    source: tuple[str, ...] = ()
    points_moved: int = 0
    largest_move: float = 0.0

    @model_validator(mode="after")
    def _check_sizes(self) -> ListedDisplacements:
        for name in ("components", "cases", "measured", "sigma"):
            values = getattr(self, name)
            if values is not None and len(values) != len(self.places):
                message = f"{name}: {len(values)} values, expected as many as places: {len(self.places)}"
                raise ValueError(message)
        return self

    @property
    def tests(self) -> tuple[str, ...]:
        """Names of the load cases in which something was measured."""
        return tuple(dict.fromkeys(self.cases))

    @property
    def data(self) -> Data:
        """What is compared; load cases are tests, whose data are distinguished by their number."""
        pairs = list(zip(self.cases, self.components, strict=True))
        numbers = {pair: i for i, pair in enumerate(dict.fromkeys(pairs))}
        kinds = np.array([numbers[pair] for pair in pairs])
        counted: dict[str, int] = dict.fromkeys(self.tests, 0)
        at = []
        for case in self.cases:
            at.append(float(counted[case]))
            counted[case] += 1
        sigma = None if self.sigma is None else np.array(self.sigma)
        return Data(np.array(self.measured), sigma, self.cases, np.array(at), np.array(self.places), kinds)

    def measured_in(self, test: str, spec: ModelSpec) -> str:
        """Say what was measured in a load case, with its unit."""
        return "displacement (m)"

    def observed(self, spec: ModelSpec, model: ForwardModel) -> ForwardModel:
        """Return a specimen observed where something was measured; collective."""
        specimen = cast("Specimen", spec)
        cases, along = self._numbers(specimen), self._along(specimen)
        observe = cast("SpecimenModel", model).observing
        return observe(np.array(self.places), self._axes(specimen).tolist(), cases.tolist(), along)

    def shared(self, spec: ModelSpec) -> SharedMotion | None:
        """Return the uncertain motions of the scan on the body of a specimen; None if there are none."""
        from inverse.data.shared_motion import SharedMotion

        specimen = cast("Specimen", spec)
        if self.motion is None:
            return None
        axes = self._axes(specimen)
        places = np.where((axes < len(AXES))[:, None], self.places, np.nan)
        project = onto(specimen.body) if self.on_surface else None
        return SharedMotion.of(places, self._along(specimen), self._numbers(specimen), self.motion, project)

    def not_estimable(self, spec: ModelSpec) -> tuple[str, ...]:
        """None: the error of the mesh is estimated of displacements."""
        return ()

    def unobserved(self, spec: ModelSpec) -> Iterator[Mistake]:
        """Find load cases of the data that a model does not have."""
        if not isinstance(spec, Specimen):
            yield ("kind",), "displacements were measured, expected 'specimen'", spec.kind
            return
        known = tuple(case.name for case in spec.cases)
        strange = next((case for case in self.cases if case not in known), None)
        if strange is not None:
            yield ("cases",), f"no load case '{strange}', of which there are data", known
            return
        for case, name in dict.fromkeys(zip(self.cases, self.components, strict=True)):
            if name not in (*AXES, *spec.measurable[case]):
                message = f"load case '{case}' has no output '{name}', of which there are data"
                yield ("cases",), message, list(spec.measurable[case])
                return

    def _axes(self, specimen: Specimen) -> NDArray[np.int64]:
        """Components, and numbers of other outputs, as a specimen observes them; -1 of those that it does not have."""
        known = {name: (*AXES, *outputs) for name, outputs in specimen.measurable.items()}
        found = [known.get(case, AXES) for case in self.cases]
        pairs = zip(found, self.components, strict=True)
        return np.array([of.index(one) if one in of else -1 for of, one in pairs], dtype=np.int64)

    def _numbers(self, specimen: Specimen) -> NDArray[np.int64]:
        """Numbers of the load cases of the data."""
        numbers = {case.name: i for i, case in enumerate(specimen.cases)}
        return np.array([numbers[case] for case in self.cases], dtype=np.int64)

    def _along(self, specimen: Specimen) -> FloatArray:
        """Directions in the body of what was measured; zeros of other outputs."""
        rows: FloatArray = np.vstack([self.axes, np.zeros(3)])
        found: FloatArray = rows[np.minimum(self._axes(specimen), len(AXES))]
        return found
