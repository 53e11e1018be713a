"""A study that compares models: of a specimen by displacements, or any others by their outputs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

from pydantic import BeforeValidator, Field, ValidationError, model_validator
from pydantic.json_schema import SkipJsonSchema

from forward.fem.finer import finer
from forward.findings import Finding
from forward.model import ForwardModel
from forward.scalars import Mistake
from forward.settings import one_line, shown
from forward.spec import ModelSpec
from forward.words import named
from inverse.criticism.comparison import Candidate
from inverse.criticism.doubts import not_estimable
from inverse.data.measurements import AXES, Measurements
from inverse.data.table import DataError
from inverse.methods.invert import derivable
from inverse.methods.selection import SelectSpecimens
from workflows.config.mistakes import StudyError, lines, refused
from workflows.config.priors import ranges
from workflows.config.tables import at
from workflows.data.material_tests import WHOLE, DataFile
from workflows.data.measured import DisplacementFile, as_block, data_as, digest_of, motion_of, observing
from workflows.data.measured_outputs import OutputFile
from workflows.studies.candidates import OfCandidates, changed, spec_of
from workflows.studies.predictions import has_mesh, meshes_of, never_estimable
from workflows.studies.selection import Comparison, Selection
from workflows.studies.study import StudyKind, bytes_of

if TYPE_CHECKING:
    from inverse.data.shared_motion import SharedMotion

SECONDS = 1e-3  # of a solve about which nothing is known


class ModelSelection(OfCandidates, Comparison):
    """What to compare: candidates change one model, and all are observed in the same way.

    Parameters
    ----------
    model
        The model, as far as the candidates have it in common.
    data
        What was measured.
    candidates
        Models by name.
    method
        How the candidates are compared.
    """

    data: Annotated[DisplacementFile | OutputFile, BeforeValidator(as_block)]
    method: SelectSpecimens
    measurements: SkipJsonSchema[Any] = Field(default=None, exclude=True, repr=False)

    costly: ClassVar[bool] = True

    @classmethod
    def forms(cls) -> Iterator[type[StudyKind]]:
        """Comparisons of materials, and of models."""
        yield Selection
        yield cls

    @classmethod
    def made(cls, blocks: Mapping[str, Any], folder: Path) -> Comparison:  # type: ignore[override]
        """Check the blocks of a comparison of models, whose data are read by the first one, or of material points."""
        if not isinstance(blocks.get("model", {}), Mapping):
            raise StudyError(f"model: expected a table, {{ key = value }}; given {shown(blocks['model'])}")
        if "model" not in blocks:
            return Selection.model_validate(_expanded(blocks, folder))
        return cls.model_validate(blocks).with_data(folder)

    @property
    def recorded(self) -> bool:
        """As in every study: its file is named, and not read."""
        return self.measurements is None

    def with_data(self, folder: Path) -> Self:
        """Return the same with its data, read by the model of the first candidate; a StudyError for what is wrong."""
        if self.data.digest:
            return self
        try:
            found = self.data.read(folder, next(iter(self.of_candidates.values())))
        except DataError as error:
            raise StudyError(*(f"data: {line}" for line in error.args)) from None
        source = (*found.source, *(f"truth: {name} = {value}" for name, value in found.truth.items()))
        digest = digest_of(folder / self.data.file) if self.data.file else ""
        data = self.data.model_copy(update={"digest": digest, "source": source})
        study = self.model_copy(update={"data": data, "measurements": found})
        refused(type(self).__name__, [*study._unobserved(), *study.mistakes_of_data()])
        return study

    @cached_property
    def of_candidates(self) -> Mapping[str, ModelSpec]:
        """The model of each candidate, in a form that suits all values of its parameters.

        Forms differ a little on a mesh: if one specimen needs pressures, all that can have them do.
        """
        given: dict[str, Any] = {name: spec_of(changed(self.model, one.model)) for name, one in self.candidates.items()}
        of_inputs = {name: ranges(one.parameters) for name, one in self.candidates.items()}
        free = {name: one for name, one in given.items() if one.placed and one.formulation == "auto"}
        mixed = {name: one for name, one in free.items() if one.mixable}
        if not any(one.decision(of_inputs[name]).mixed for name, one in free.items()):
            mixed = {}
        return {
            name: one.model_copy(update={"formulation": "mixed"}) if name in mixed else one.over(of_inputs[name])
            for name, one in given.items()
        }

    @property
    def specs(self) -> tuple[ModelSpec, ...]:
        """The models of all candidates, and the finer meshes that they are looked at on."""
        return *self.of_candidates.values(), *(fine for several in self._finer for fine in several)

    @property
    def memory(self) -> float:
        """Memory (bytes) of a group of ranks: of all candidates, and of the finer meshes of one of them at a time."""
        return bytes_of(self.of_candidates.values()) + max((bytes_of(several) for several in self._finer), default=0.0)

    @property
    def _finer(self) -> list[tuple[Any, ...]]:
        """The finer meshes of each candidate that is looked at on some."""
        return [meshes_of(one) for name, one in self.of_candidates.items() if not self.unchecked.get(name, "none")]

    @cached_property
    def unchecked(self) -> dict[str, str]:
        """Why each candidate is not checked on a finer mesh, empty if it is; None if there are no meshes."""
        if not any(has_mesh(spec) or spec.hidden for spec in self.of_candidates.values()):
            return {}
        return {name: self._unchecked(spec) for name, spec in self.of_candidates.items()}

    def _unchecked(self, spec: Any) -> str:
        if self.method.treatment is None:
            return self.method.unchecked
        if not has_mesh(spec):
            return spec.hidden or f"a model of kind '{spec.kind}' has no mesh"
        try:
            for body in spec.bodies:
                finer(body)
        except ValueError as error:  # a mesh that is not divided, or would be too large
            return one_line(str(error))
        return ""

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the models before anything is solved, each once."""
        return tuple(dict.fromkeys([*self.findings_of_models, *super().findings, *self._of_outputs()]))

    def _of_outputs(self) -> Iterator[Finding]:
        """Say of which measured outputs nothing tells the error of the mesh."""
        known = self.measurements is not None and self.measurements.some
        measured = self.measurements.names.tolist() if known else ()
        never = (never_estimable(spec, measured) for spec in self.of_candidates.values())
        names = tuple(dict.fromkeys(name for several in never for name in several))
        yield from not_estimable(names) if names and self.unchecked else ()

    @property
    def models(self) -> dict[str, Candidate]:
        """The candidates as the method needs them."""
        return {name: Candidate(inputs, self.candidates[name].weight) for name, inputs in self.priors.items()}

    @property
    def data_groups(self) -> dict[str, Measurements]:
        """Data by group."""
        return {WHOLE: self.measurements}

    def measured_in(self, test: str) -> str:
        """Say what was measured in a test, in the unit of the first candidate."""
        if self.data.quantity == DisplacementFile.quantity:
            return "displacement (m)"
        outputs = next(iter(self.of_candidates.values())).returned
        return next(named(output.name, output.unit) for output in outputs if output.name == test)

    @property
    def seconds_of_solves(self) -> float:
        """Processor time of all solves and their derivatives, roughly: searches for modes have no reference."""
        seconds = 0.0
        for name, spec in self.of_candidates.items():
            cost, solves = spec.cost(), self.searches(name) + self.method.samples
            if cost is None:
                seconds += SECONDS * solves
                continue
            derivatives = cost.tangents_of_sample(len(self.candidates[name].parameters))
            seconds += self.searches(name) * (cost.textbook if spec.placed else cost.sample)
            seconds += self.method.samples * cost.sample + solves * derivatives
        return seconds * self.evidences / len(self.of_candidates)

    def described(self, name: str) -> str:
        """A candidate in words: of a specimen its material and mesh."""
        spec: Any = self.of_candidates[name]
        if not spec.placed:
            return str(spec.description)
        body, loaded = spec.body, spec.loaded(spec.cases[0])
        mixed = ", mixed" if loaded.mixed else ""
        return f"{loaded.energy} on {body.cells_in_words} cells ({body.cell}, degree {body.degree}{mixed})"

    def build(self, name: str, group: str, comm: Any = None) -> ForwardModel:
        """Make the model of a candidate; collective."""
        spec = self.of_candidates[name]
        model = spec.build(comm, tuple(self.candidates[name].parameters))
        derivable(model, spec.kind)
        return observing(model, self._data_of(spec))

    def _data_of(self, spec: Any) -> Measurements:
        """Return the data as a candidate numbers what it has in its load cases."""
        found: Measurements = self.measurements
        return found if found.some else found.in_model(spec.observable)

    def shared(self, name: str, group: str) -> SharedMotion | None:
        """Return the errors that the data share, as a candidate sees them; None if they are independent."""
        spec: Any = self.of_candidates[name]
        return None if self.measurements.some else motion_of(self._data_of(spec), spec.body)

    @model_validator(mode="before")
    @classmethod
    def _data_of_model(cls, blocks: Any) -> Any:
        """Choose the block of the data by the model."""
        if at(blocks, "data", "measured") is not None:  # results of earlier versions hold all numbers
            source = blocks["data"].get("source", ())
            blocks = {**blocks, "data": {"file": "none", "digest": "none", "source": source}}
        return data_as(blocks, DisplacementFile, OutputFile)

    def mistakes(self) -> Iterator[Mistake]:
        """Find what cannot be asked together."""
        if self.data.quantity == DisplacementFile.quantity and self.method.check is not None:
            message = "nested sampling takes ten thousand solves for each candidate, expected none of finite elements"
            yield ("method", "check"), message, self.method.check
        for _, spec, mistakes in self.models_and_mistakes():
            yield from mistakes
            if spec is not None:
                yield from self.mistakes_of_ranks(spec)
        yield from self.mistakes_of_method()

    def _unobserved(self) -> Iterator[Mistake]:
        """Find what candidates do not have of what was measured."""
        found = self.measurements
        spec: Any
        for name, spec in self.of_candidates.items():
            place = ("candidates", name, "model")
            if found.some:
                known = [output.name for output in spec.returned]
                lost = next((output for output in found.names.tolist() if output not in known), None)
                if lost is not None:
                    yield (*place, "outputs"), f"no output '{lost}', of which there are data", known
            elif spec.placed:
                has = spec.observable
                pairs = dict.fromkeys(zip(found.tests.tolist(), found.names.tolist(), strict=True))
                case, what = next(((one, what) for one, what in pairs if what not in has.get(one, ())), ("", ""))
                if case and case not in has:
                    yield (*place, "cases"), f"no load case '{case}', of which there are data", list(has)
                elif case:
                    message = f"load case '{case}' has no output '{what}', of which there are data"
                    yield (*place, "cases"), message, list(has[case][len(AXES) :])
            else:
                yield (*place, "kind"), "displacements were measured, expected 'specimen'", spec.kind


def _expanded(document: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return a document whose table of tests, if it names one, has been read; a StudyError if that cannot be done."""
    if at(document, "data", "file") is None:
        return dict(document)
    try:
        return {**document, "data": DataFile.model_validate(dict(document["data"])).read(folder)}
    except ValidationError as error:
        raise StudyError(*lines(error, "data")) from None
    except DataError as error:
        raise StudyError(*error.args) from None
