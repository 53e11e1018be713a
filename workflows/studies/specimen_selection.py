"""A study that compares models of a specimen: materials, meshes or elements as candidates, displacements as data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
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
from workflows.config.priors import ranges
from workflows.studies.material_tests import WHOLE
from workflows.studies.measured import check_readings, onto, read_on
from workflows.studies.model_selection import ModelSelection, Positive, changed

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
        measurable = specimen.measurable
        cases = tuple(measurable)
        try:
            placed, registered, scan = read_on(folder / self.file, measurable, specimen.body, self)
            check_readings(placed.observations.readings, specimen)
        except DataError as error:
            raise StudyError(*(f"data: {line}" for line in error.args)) from None
        motion = UncertainMotion.of(registered, scan.moved_between(placed.observations.unit))
        found, moved = placed.observations, placed.distances
        data = found.components()
        known = bool(np.isfinite(data.sigma).all())
        truth = [f"truth: {name} = {value}" for name, value in found.truth.items()]
        return {
            "source": [*found.source, *truth],
            "places": np.nan_to_num(data.places).tolist(),
            "components": [
                (*AXES, *measurable[cases[case]])[axis] for axis, case in zip(data.axes, data.cases, strict=True)
            ],
            **({} if registered is None else {"axes": found.axes.tolist()}),
            **({} if motion is None else {"motion": motion.model_dump(exclude_none=True), "on_surface": scan.surface}),
            "cases": [cases[case] for case in data.cases],
            "measured": data.values.tolist(),
            **({"sigma": data.sigma.tolist()} if known else {}),
            **({"points_moved": int((moved > 0).sum()), "largest_move": float(moved.max())} if moved.any() else {}),
        }


class MeasuredDisplacements(Settings):
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
    def _check_sizes(self) -> MeasuredDisplacements:
        for name in ("components", "cases", "measured", "sigma"):
            values = getattr(self, name)
            if values is not None and len(values) != len(self.places):
                message = f"{name}: {len(values)} values, expected as many as places: {len(self.places)}"
                raise ValueError(message)
        return self


class SpecimenSelection(ModelSelection):
    """What to compare: models of a specimen, by displacements.

    Parameters
    ----------
    model, candidates, method, parallel, report
        As of `ModelSelection`; the model is a specimen.
    data
        Displacements that were measured.
    """

    data: MeasuredDisplacements

    data_in_file: ClassVar[type[Settings] | None] = DisplacementFile
    listed_by: ClassVar[str] = "places"
    quantity: ClassVar[str] = "displacement"

    @classmethod
    def spec_of(cls, block: Mapping[str, Any]) -> Specimen:
        """Return the specimen that a block describes; errors as of every comparison."""
        return Specimen.model_validate(block)

    @cached_property
    def of_candidates(self) -> dict[str, Specimen]:
        """The specimen of each candidate, in a form that is the same for all where that is possible."""
        given = {
            name: self.spec_of(changed(self.model, candidate.model)) for name, candidate in self.candidates.items()
        }
        of_inputs = {name: ranges(candidate.parameters) for name, candidate in self.candidates.items()}
        # The forms differ a little on a mesh: if one candidate needs pressures, all that can have them do.
        mixed = any(one.formulation == "auto" and one.decision(of_inputs[name]).mixed for name, one in given.items())
        return {
            name: one.model_copy(update={"formulation": "mixed"})
            if mixed and one.formulation == "auto" and one.mixable
            else one.over(of_inputs[name])
            for name, one in given.items()
        }

    @property
    def data_groups(self) -> dict[str, Data]:
        """Data by group; load cases are tests, whose data are distinguished by their number."""
        data, cases = self.data, list(dict.fromkeys(self.data.cases))
        pairs = list(zip(data.cases, data.components, strict=True))
        numbers = {pair: i for i, pair in enumerate(dict.fromkeys(pairs))}
        kinds = np.array([numbers[pair] for pair in pairs])
        counted: dict[str, int] = dict.fromkeys(cases, 0)
        at = []
        for case in data.cases:
            at.append(float(counted[case]))
            counted[case] += 1
        sigma = None if data.sigma is None else np.array(data.sigma)
        return {WHOLE: Data(np.array(data.measured), sigma, data.cases, np.array(at), np.array(data.places), kinds)}

    def _axes(self, specimen: Specimen) -> NDArray[np.int64]:
        """Components, and numbers of other outputs, as a specimen observes them; -1 of those that it does not have."""
        known = {name: (*AXES, *outputs) for name, outputs in specimen.measurable.items()}
        found = [known.get(case, AXES) for case in self.data.cases]
        pairs = zip(found, self.data.components, strict=True)
        return np.array([of.index(one) if one in of else -1 for of, one in pairs], dtype=np.int64)

    def tests(self, group: str) -> tuple[str, ...]:
        """Names of the tests in a group."""
        return tuple(dict.fromkeys(self.data.cases))

    @property
    def seconds_of_solves(self) -> float:
        """Processor time of all solves and their derivatives, roughly: searches for modes have no reference."""
        seconds = 0.0
        for name, specimen in self.of_candidates.items():
            cost = specimen.cost()
            derivatives = cost.tangents_of_sample(len(self.candidates[name].parameters))
            seconds += self.searches(name) * (cost.textbook + derivatives)
            seconds += self.method.samples * (cost.corrected + derivatives)
        return seconds * self.evidences / len(self.of_candidates)

    def described(self, name: str) -> str:
        """Material and mesh of a candidate."""
        specimen = self.of_candidates[name]
        body = specimen.body
        mixed = ", mixed" if specimen.loaded(specimen.cases[0]).mixed else ""
        energy = specimen.loaded(specimen.cases[0]).energy
        return f"{energy} on {body.cells_in_words} cells ({body.cell}, degree {body.degree}{mixed})"

    def build(self, name: str, group: str, comm: Any = None) -> SpecimenModel:
        """Make the model of a candidate; collective."""
        specimen = self.of_candidates[name]
        model: SpecimenModel = specimen.build(comm, tuple(self.candidates[name].parameters))
        cases, along = self._cases(specimen), self._along(specimen)
        return model.observing(np.array(self.data.places), self._axes(specimen).tolist(), cases.tolist(), along)

    def shared(self, name: str, group: str) -> SharedMotion | None:
        """Return the uncertain motions of the scan on the body of a candidate; None if there are none."""
        from inverse.data.shared_motion import SharedMotion

        data, specimen = self.data, self.of_candidates[name]
        if data.motion is None:
            return None
        axes = self._axes(specimen)
        places = np.where((axes < len(AXES))[:, None], data.places, np.nan)
        project = onto(specimen.body) if data.on_surface else None
        return SharedMotion.of(places, self._along(specimen), self._cases(specimen), data.motion, project)

    def moved(self, model: ForwardModel, motion: SharedMotion) -> ForwardModel:
        """Return the model, on the mesh of a candidate, that tells what uncertain motions do; collective."""
        return cast("SpecimenModel", model).observing(*motion.observed)  # type: ignore[arg-type]

    def _cases(self, specimen: Specimen) -> NDArray[np.int64]:
        """Numbers of the load cases of the data."""
        numbers = {case.name: i for i, case in enumerate(specimen.cases)}
        return np.array([numbers[case] for case in self.data.cases], dtype=np.int64)

    def _along(self, specimen: Specimen) -> FloatArray:
        """Directions in the body of what was measured; zeros of other outputs."""
        rows: FloatArray = np.vstack([self.data.axes, np.zeros(3)])
        found: FloatArray = rows[np.minimum(self._axes(specimen), len(AXES))]
        return found

    def _mistakes(self) -> Iterator[Mistake]:
        if self.method.check is not None:
            message = "nested sampling takes ten thousand solves for each candidate, expected none of finite elements"
            yield ("method", "check"), message, self.method.check
        yield from super()._mistakes()

    def unobserved(self, spec: ModelSpec) -> Iterator[Mistake]:
        """Find load cases of the data that a candidate does not have."""
        known = tuple(case.name for case in cast("Specimen", spec).cases)
        strange = next((case for case in self.data.cases if case not in known), None)
        if strange is not None:
            yield ("cases",), f"no load case '{strange}', of which there are data", known
            return
        units = cast("Specimen", spec).measurable
        for case, name in dict.fromkeys(zip(self.data.cases, self.data.components, strict=True)):
            if name not in (*AXES, *units[case]):
                message = f"load case '{case}' has no output '{name}', of which there are data"
                yield ("cases",), message, list(units[case])
                return
