"""A study that compares models of a specimen: materials, meshes or elements as candidates, displacements as data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator

from forward.bodies.geometry import AXES, Vector, tolerance
from forward.bodies.mesh_file import MeshFile
from forward.fem.finer import finer
from forward.scalars import Mistake
from forward.settings import Settings
from forward.specimen import Specimen
from inverse.criticism.comparison import Candidate, Data
from inverse.data.observations import DataError, read
from inverse.methods.selection import SelectSpecimens
from uq.inputs.distributions import Distribution
from uq.inputs.random_parameters import Inputs
from workflows.config.blocks import Correlation, Parallel
from workflows.config.mistakes import StudyError, lines, refused
from workflows.config.priors import mistakes_of_materials, mistakes_of_parameters, ranges
from workflows.config.report import Report
from workflows.studies.material_tests import WHOLE
from workflows.studies.selection import Comparison

if TYPE_CHECKING:
    from forward.fem.specimen import SpecimenModel
    from forward.model import Finding

Positive = Annotated[float, Field(gt=0)]


class DisplacementFile(Settings):
    """A file of measured displacements, see `inverse.data.observations`.

    Parameters
    ----------
    file
        The file, beside the study.
    sigma
        Standard deviation (m) of the errors, if the file does not state it; not needed if the method's noise is given
        otherwise.
    unit
        m per unit of the file.
    tolerance
        How far (m) points may lie outside the body, by default a thousandth of its diagonal; they are moved to its
        nearest point.
    """

    file: str
    sigma: Positive | None = None
    unit: Positive = 1.0
    tolerance: Annotated[float, Field(ge=0)] | None = None

    def read(self, folder: Path, specimen: Specimen) -> dict[str, Any]:
        """Return the block `data` with the displacements themselves.

        Raises
        ------
        StudyError
            If the file cannot be used.
        """
        cases = tuple(case.name for case in specimen.cases)
        extent = max(high - low for low, high in specimen.body.bounds)
        try:
            found = read(folder / self.file, cases, self.unit)
            if self.sigma is not None:
                found = found.with_sigma(self.sigma)
            allowed = tolerance(specimen.body) if self.tolerance is None else self.tolerance
            found, moved = found.on(specimen.body.nearest, extent, allowed)
        except DataError as error:
            raise StudyError(*(f"data: {line}" for line in error.args)) from None
        data = found.components()
        known = bool(np.isfinite(data.sigma).all())
        truth = [f"truth: {name} = {value}" for name, value in found.truth.items()]
        return {
            "source": [*found.source, *truth],
            "places": data.places.tolist(),
            "components": [AXES[axis] for axis in data.axes],
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
        Where in the undeformed body (m).
    components, cases
        Component and load case of each.
    measured
        Displacements (m).
    sigma
        Standard deviations (m) of their errors, if known.
    source
        Their source, line by line.
    points_moved, largest_move
        How many points lay outside the body, and the largest distance (m) by which one was moved.
    """

    places: tuple[Vector, ...] = Field(min_length=1)
    components: tuple[Literal["x", "y", "z"], ...]
    cases: tuple[str, ...]
    measured: tuple[float, ...]
    sigma: tuple[Positive, ...] | None = None
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


class SpecimenCandidate(Settings):
    """A candidate model of the specimen, with its prior.

    Parameters
    ----------
    model
        What it changes of the model: blocks and values that replace those there; a material is replaced completely.
    parameters
        Priors by the paths of the numbers that vary.
    correlations
        Correlations between them.
    weight
        Its probability before the data, up to a common factor.
    """

    model: dict[str, Any] = Field(default={})
    parameters: dict[str, Distribution] = Field(min_length=1)
    correlations: tuple[Correlation, ...] = ()
    weight: Positive = 1.0

    @property
    def inputs(self) -> Inputs:
        """The random parameters."""
        return Inputs(self.parameters, tuple((*c.between, c.value) for c in self.correlations))

    def within(self, specimen: Specimen) -> Inputs:
        """The random parameters, restricted to those that make materials."""
        return self.inputs.within(specimen.materials(self.inputs.names))


class SpecimenSelection(Comparison):
    """What to compare.

    Parameters
    ----------
    model
        The specimen, as far as the candidates have it in common.
    data
        Displacements that were measured.
    candidates
        Models by name.
    method
        How the candidates are compared.
    parallel
        Use of ranks.
    report
        Your own sections of the report.
    """

    model: dict[str, Any]
    data: MeasuredDisplacements
    candidates: dict[str, SpecimenCandidate] = Field(min_length=1)
    method: SelectSpecimens
    parallel: Parallel = Parallel()
    report: Report | None = None

    quantity: ClassVar[str] = "displacement"
    costly: ClassVar[bool] = True

    @cached_property
    def specimens(self) -> dict[str, Specimen]:
        """The specimen of each candidate."""
        given = {
            name: Specimen.model_validate(changed(self.model, candidate.model))
            for name, candidate in self.candidates.items()
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
    def specs(self) -> tuple[Specimen, ...]:
        """The specimens of all candidates, and the largest of the finer meshes that they are checked on."""
        checked = [specimen for name, specimen in self.specimens.items() if not self.unchecked[name]]
        fine = [finer(one) for one in checked if not isinstance(one.body, MeshFile)]
        return *self.specimens.values(), *sorted(fine, key=lambda one: one.unknowns)[-1:]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the specimens before anything is solved, each once."""
        of_specimens = (
            finding
            for name, one in self.specimens.items()
            for finding in (*one.findings, *one.locking(ranges(self.candidates[name].parameters)))
        )
        return tuple(dict.fromkeys([*of_specimens, *super().findings]))

    @cached_property
    def unchecked(self) -> dict[str, str]:
        """Why each candidate is not checked on a finer mesh; empty if it is."""
        return {name: self._unchecked(specimen) for name, specimen in self.specimens.items()}

    def _unchecked(self, specimen: Specimen) -> str:
        if not self.method.mesh_check:
            return "method.mesh_check = false"
        try:
            finer(specimen)
        except ValueError as error:  # a mesh that is not divided, or would be too large
            return str(error)
        return ""

    @property
    def models(self) -> dict[str, Candidate]:
        """The candidates as the method needs them."""
        return {
            name: Candidate(candidate.within(self.specimens[name]), candidate.weight)
            for name, candidate in self.candidates.items()
        }

    @property
    def source(self) -> tuple[str, ...]:
        """Where the data are from."""
        return self.data.source

    @property
    def group_names(self) -> tuple[str, ...]:
        """Names of the groups: there is one specimen."""
        return (WHOLE,)

    @property
    def data_groups(self) -> dict[str, Data]:
        """Data by group; load cases are tests, whose data are distinguished by their number."""
        data, cases = self.data, list(dict.fromkeys(self.data.cases))
        kinds = 3 * np.array([cases.index(case) for case in data.cases]) + self._axes
        counted: dict[str, int] = dict.fromkeys(cases, 0)
        at = []
        for case in data.cases:
            at.append(float(counted[case]))
            counted[case] += 1
        sigma = None if data.sigma is None else np.array(data.sigma)
        return {WHOLE: Data(np.array(data.measured), sigma, data.cases, np.array(at), np.array(data.places), kinds)}

    @property
    def _axes(self) -> Any:
        return np.array([AXES.index(axis) for axis in self.data.components])

    def tests(self, group: str) -> tuple[str, ...]:
        """Names of the tests in a group."""
        return tuple(dict.fromkeys(self.data.cases))

    @property
    def seconds_of_solves(self) -> float:
        """Processor time of all solves and their derivatives, roughly: searches for modes have no reference."""
        seconds = 0.0
        for name, specimen in self.specimens.items():
            cost = specimen.cost()
            derivatives = cost.tangents_of_sample(len(self.candidates[name].parameters))
            seconds += self.searches(name) * (cost.textbook + derivatives)
            seconds += self.method.samples * (cost.corrected + derivatives)
        return seconds * self.evidences / len(self.specimens)

    def described(self, name: str) -> str:
        """Material and mesh of a candidate."""
        specimen = self.specimens[name]
        body = specimen.body
        mixed = ", mixed" if specimen.loaded(specimen.cases[0]).mixed else ""
        energy = specimen.loaded(specimen.cases[0]).energy
        return f"{energy} on {body.cells_in_words} cells ({body.cell}, degree {body.degree}{mixed})"

    def build(self, name: str, group: str, comm: Any = None) -> SpecimenModel:
        """Make the model of a candidate; collective."""
        specimen = self.specimens[name]
        numbers = {case.name: i for i, case in enumerate(specimen.cases)}
        model: SpecimenModel = specimen.build(comm, tuple(self.candidates[name].parameters))
        return model.observing(np.array(self.data.places), self._axes, [numbers[case] for case in self.data.cases])

    @model_validator(mode="after")
    def _check(self) -> SpecimenSelection:
        refused("SpecimenSelection", list(self._mistakes()))
        return self

    def _mistakes(self) -> Iterator[Mistake]:
        if self.method.check is not None:
            message = "nested sampling takes ten thousand solves for each candidate, expected none of finite elements"
            yield ("method", "check"), message, self.method.check
        for name, candidate in self.candidates.items():
            place = ("candidates", name)
            try:
                specimen = Specimen.model_validate(changed(self.model, candidate.model))
            except ValidationError as error:
                for line in error.errors(include_url=False):
                    yield (*place, "model", *line["loc"]), line["msg"], line["input"]
                continue
            for where, message, given in _of_candidate(specimen, candidate):
                yield (*place, *where), message, given
            if specimen.fields:
                message = "random fields, expected numbers only: evidences are of few parameters"
                yield (*place, "model", "fields"), message, len(specimen.fields)
            known = tuple(case.name for case in specimen.cases)
            strange = next((case for case in self.data.cases if case not in known), None)
            if strange is not None:
                yield (*place, "model", "cases"), f"no load case '{strange}', of which there are data", known
        yield from self.mistakes_of_method()


def _of_candidate(specimen: Specimen, candidate: SpecimenCandidate) -> Iterator[Mistake]:
    materials = specimen.materials(candidate.parameters)
    yield from mistakes_of_parameters(specimen.scalars, candidate.parameters, materials.names)
    if all(path in specimen.scalars for path in candidate.parameters):
        with suppress(ValueError):  # correlations, which are reported elsewhere
            yield from mistakes_of_materials(candidate.within(specimen), materials)


def expanded(blocks: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return blocks of a study whose file of displacements, if they name one, has been read.

    Raises
    ------
    StudyError
        If that cannot be done.
    """
    data, candidates = blocks.get("data"), blocks.get("candidates")
    if not isinstance(data, Mapping) or "file" not in data or not isinstance(candidates, Mapping) or not candidates:
        return dict(blocks)
    try:
        file = DisplacementFile.model_validate(dict(data))
    except ValidationError as error:
        raise StudyError(*lines(error, "data")) from None
    name, first = next(iter(candidates.items()))
    changes = first.get("model", {}) if isinstance(first, Mapping) else {}
    try:
        specimen = Specimen.model_validate(changed(blocks["model"], changes))
    except ValidationError as error:
        place = f"candidates.{name}.model"
        raise StudyError(*lines(error, place)) from None
    return {**blocks, "data": file.read(folder, specimen)}


def changed(block: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a block with changed values; a block with a kind replaces what was there."""
    found = dict(block)
    for key, value in changes.items():
        here = found.get(key)
        inside = isinstance(value, Mapping) and isinstance(here, Mapping) and "kind" not in value
        found[key] = changed(here, value) if inside else value  # type: ignore[arg-type]
    return found
