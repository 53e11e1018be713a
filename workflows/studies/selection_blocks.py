"""What stands in a study that compares models, and what follows from it before anything is solved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field, model_validator
from pydantic.json_schema import SkipJsonSchema

from forward.finer_meshes import finer
from forward.material_tests import CandidateTests
from forward.materials.material import splits
from forward.materials.material_point import MaterialTest
from forward.model import ForwardModel
from forward.readable import named
from forward.settings import one_line
from forward.spec import SPECIMEN, ModelSpec, usual_kind
from inverse.criticism.comparison import Candidate
from inverse.data.measurements import Measurements
from inverse.methods.invert import derivable
from inverse.methods.model_error import LearntError
from inverse.methods.selection import Select
from workflows.config.blocks import AS_DECIDED, decided
from workflows.config.priors import ranges
from workflows.config.tables import at
from workflows.data.material_tests import WHOLE, MeasuredTests
from workflows.data.measured import DisplacementFile, motion_of, observing
from workflows.data.measured_outputs import OutputFile
from workflows.studies.assumptions import TakenForGranted, Uncertain
from workflows.studies.candidates import UNSEEN, CandidateModel, OfCandidates, truth_of
from workflows.studies.study import meshes_of

if TYPE_CHECKING:
    from inverse.data.shared_motion import SharedMotion

Pair = tuple[str, str]  # a candidate, and a group of data


class ComparedModel(CandidateModel):
    """A candidate of a comparison by data; other settings as of any candidate.

    Parameters
    ----------
    model_error
        Another model, given by what it changes of that of the study, against which the errors of the candidate are
        learnt; they are then among those of the data.
    """

    model_error: LearntError | None = None


class SelectionBlocks(OfCandidates):
    """The blocks of a comparison, as `workflows.studies.selection.Selection` explains them."""

    data: Annotated[MeasuredTests | DisplacementFile | OutputFile, AS_DECIDED]
    candidates: Annotated[dict[str, ComparedModel], Field(min_length=1)]
    predict: tuple[MaterialTest, ...] = ()
    uncertain: dict[str, Uncertain] = Field(default={})
    method: Select
    measurements: SkipJsonSchema[Any] = Field(default=None, exclude=True, repr=False)

    @model_validator(mode="before")
    @classmethod
    def _data_of_model(cls, blocks: Any) -> Any:
        """Choose the block of the data by the model."""
        model = at(blocks, "model")
        if model is None:
            return decided(blocks, data=MeasuredTests)
        return decided(blocks, data=DisplacementFile if usual_kind(model) == SPECIMEN else OutputFile)

    # --- the candidates ----------------------------------------------------------------------------------------------

    @property
    def models(self) -> dict[str, Candidate]:
        """The candidates as the method needs them."""
        return {name: Candidate(inputs, self.candidates[name].weight) for name, inputs in self.priors.items()}

    def whole(self, name: str) -> ModelSpec:
        """Return the model of a candidate; of a material with one test of each kind, as its tests are those of data."""
        if self.model is not None:
            return super().whole(name)
        data: Any = self.data
        one, tests = self.candidates[name], (*data.tests, *self.predict)
        kinds = {(test.mode, test.component): test.model_copy(update={"name": ""}) for test in tests}
        own = {"tests": tuple(kinds.values()), "parameters": tuple(one.parameters)}
        return CandidateTests.model_validate(one.model_dump(include={"material"}, exclude_none=True) | own)

    @cached_property
    def of_candidates(self) -> Mapping[str, ModelSpec]:
        """The model of each candidate, in a form that suits all values of its parameters.

        Forms differ a little on a mesh: if one specimen needs pressures, all that can have them do.
        """
        given: dict[str, Any] = {name: self.whole(name) for name in self.candidates}
        of_inputs = {name: ranges(one.parameters) for name, one in self.candidates.items()}
        free = {name: one for name, one in given.items() if one.placed and one.formulation == "auto"}
        mixed = {name: one for name, one in free.items() if one.body.degree > 1 and splits(one.energy)}
        if not any(one.decision(of_inputs[name]).mixed for name, one in free.items()):
            mixed = {}
        return {
            name: one.model_copy(update={"formulation": "mixed"}) if name in mixed else one.over(of_inputs[name])
            for name, one in given.items()
        }

    def described(self, name: str) -> str:
        """A candidate in words: its material, and the mesh of a specimen."""
        spec: Any = self.of_candidates[name]
        if not spec.placed:
            return str(spec.description)
        body, loaded = spec.body, spec.loaded(spec.cases[0])
        mixed = ", mixed" if loaded.mixed else ""
        return f"{loaded.energy} on {body.cells_in_words} cells ({body.cell}, degree {body.degree}{mixed})"

    def build(self, name: str, group: str, comm: Any = None) -> ForwardModel:
        """Make the model of a candidate in a group of data on a communicator; collective."""
        spec, parameters = self.of_candidates[name], tuple(self.candidates[name].parameters)
        if self.model is None:
            return spec.model_copy(update={"tests": self.tests_in(group)}).build(comm, parameters)
        model = spec.build(comm, parameters)
        derivable(model, spec.kind)
        return observing(model, self.data_as_in(spec))

    def build_truth(self, name: str, comm: Any = None) -> ForwardModel:
        """Make the model against which the errors of a candidate are learnt, which has the same outputs; collective."""
        spec = self.truth(name)
        return observing(spec.build(comm, tuple(self.candidates[name].parameters)), self.data_as_in(spec))

    def build_wider(self, name: str, group: str, comm: Any = None) -> ForwardModel:
        """Make the model of a candidate of which what is uncertain can be sampled; collective."""
        taken = self.taken(name, group)
        return taken.sampling(observing(taken.build(comm), taken.data), self.models[name].inputs)

    def truth(self, name: str) -> ModelSpec:
        """The model against which the errors of a candidate are learnt; a ValidationError says no."""
        one = self.candidates[name]
        assert one.model_error is not None
        return truth_of(self.model, one.model_error, one.parameters)

    @property
    def learnt(self) -> dict[str, LearntError]:
        """How the errors of candidates are learnt, of those where they are."""
        return {name: one.model_error for name, one in self.candidates.items() if one.model_error is not None}

    def shared(self, name: str, group: str) -> SharedMotion | None:
        """Return the errors that the data share, as a candidate sees them; None if they are independent."""
        spec: Any = self.of_candidates[name]
        return motion_of(self.data_as_in(spec), spec.body) if spec.placed else None

    def takes(self, name: str, found: Sequence[Measurements]) -> TakenForGranted:
        """Return what a candidate and data take for granted."""
        return TakenForGranted(self.of_candidates[name], tuple(self.candidates[name].parameters), found, self.uncertain)

    def taken(self, name: str, group: str) -> TakenForGranted:
        """Return the same of a group of data."""
        data = self.data_groups[group] if self.model is None else self.data_as_in(self.of_candidates[name])
        return self.takes(name, [data.seen()])

    # --- the data ----------------------------------------------------------------------------------------------------

    @cached_property
    def data_groups(self) -> dict[str, Measurements]:
        """Data by group, with what is only predicted last."""
        if self.model is not None:
            return {WHOLE: self.measurements}
        data: Any = self.data
        return {group: data.measurements(group, self.predict) for group in data.data_groups}

    def tests_in(self, group: str) -> tuple[MaterialTest, ...]:
        """Return the tests of materials of a group, those that are only predicted last."""
        data: Any = self.data
        return (*data.of(group), *self.predict)

    def data_as_in(self, spec: Any) -> Measurements:
        """Return the data as a candidate numbers what it has in its load cases."""
        found: Measurements = self.measurements
        return found if found.some else found.in_model(spec.observable)

    def tests(self, group: str) -> tuple[str, ...]:
        """Names of the tests that were measured in a group."""
        return self.data_groups[group].measured_tests

    def measured_in(self, test: str) -> str:
        """Say what was measured in a test of a model, in the unit of the first candidate."""
        if self.data.quantity == DisplacementFile.quantity:
            return "displacement (m)"
        outputs = next(iter(self.of_candidates.values())).returned
        return next(named(output.name, output.unit) for output in outputs if output.name == test)

    @property
    def pairs(self) -> list[Pair]:
        """Candidates and groups, in the order of the models."""
        return [(name, group) for name in self.candidates for group in self.data_groups]

    @property
    def finer_meshes(self) -> list[tuple[Any, ...]]:
        """The finer meshes of each candidate that is looked at on some."""
        return [meshes_of(one) for name, one in self.of_candidates.items() if not self.unchecked.get(name, "none")]

    @cached_property
    def unchecked(self) -> dict[str, str]:
        """Why each candidate is not checked on a finer mesh, empty if it is; None if there are no meshes."""
        if not any(spec.bodies or spec.hidden for spec in self.of_candidates.values()):
            return {}
        learnt = self.learnt
        return {name: UNSEEN if name in learnt else self._unchecked(spec) for name, spec in self.of_candidates.items()}

    def _unchecked(self, spec: Any) -> str:
        method: Any = self.method
        if method.treatment is None:
            return str(method.unchecked)
        if not spec.bodies:
            return spec.hidden or f"a model of kind '{spec.kind}' has no mesh"
        try:
            for body in spec.bodies:
                finer(body)
        except ValueError as error:  # a mesh that is not divided, or would be too large
            return one_line(str(error))
        return ""
