"""What stands in a study that compares models, and what follows from it before anything is solved."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field, model_validator
from pydantic.json_schema import SkipJsonSchema

from forward.finer_meshes import finer
from forward.materials.material_point import MaterialTest
from forward.model import ForwardModel
from forward.readable import named
from forward.settings import one_line
from forward.spec import SPECIMEN, ModelSpec, usual_kind
from inverse.criticism.comparison import Candidate
from inverse.data.measurements import Measurements
from inverse.methods.invert import derivable
from inverse.methods.selection import Select, SelectSpecimens
from workflows.config.blocks import AS_DECIDED, decided
from workflows.config.priors import ranges
from workflows.config.tables import at
from workflows.data.material_tests import WHOLE, MeasuredTests
from workflows.data.measured import DisplacementFile, motion_of, observing
from workflows.data.measured_outputs import OutputFile
from workflows.studies.candidates import CandidateModel, ModelCandidate, OfCandidates, spec_of
from workflows.studies.predictions import has_mesh, meshes_of

if TYPE_CHECKING:
    from inverse.data.shared_motion import SharedMotion

Pair = tuple[str, str]  # a candidate, and a group of data


class SelectionBlocks(OfCandidates):
    """The blocks of a comparison, as `workflows.studies.selection.Selection` explains them."""

    data: Annotated[MeasuredTests | DisplacementFile | OutputFile, AS_DECIDED]
    candidates: Annotated[dict[str, CandidateModel | ModelCandidate], Field(min_length=1), AS_DECIDED]
    predict: tuple[MaterialTest, ...] = ()
    method: Annotated[SelectSpecimens | Select, AS_DECIDED]
    measurements: SkipJsonSchema[Any] = Field(default=None, exclude=True, repr=False)

    @model_validator(mode="before")
    @classmethod
    def _by_what_is_compared(cls, blocks: Any) -> Any:
        """Choose the blocks by the model."""
        model = at(blocks, "model")
        if model is None:
            return decided(blocks, data=MeasuredTests, candidates=dict[str, CandidateModel], method=Select)
        if at(blocks, "data", "measured") is not None:  # results of earlier versions hold all numbers
            source = blocks["data"].get("source", ())
            blocks = {**blocks, "data": {"file": "none", "digest": "none", "source": source}}
        data = DisplacementFile if usual_kind(model) == SPECIMEN else OutputFile
        return decided(blocks, data=data, candidates=dict[str, ModelCandidate], method=SelectSpecimens)

    # --- the candidates ----------------------------------------------------------------------------------------------

    @property
    def models(self) -> dict[str, Candidate]:
        """The candidates as the method needs them."""
        return {name: Candidate(inputs, self.candidates[name].weight) for name, inputs in self.priors.items()}

    @cached_property
    def of_candidates(self) -> Mapping[str, ModelSpec]:
        """The model of each candidate, in a form that suits all values of its parameters; none of materials.

        Forms differ a little on a mesh: if one specimen needs pressures, all that can have them do.
        """
        given: dict[str, Any] = {name: spec_of(block) for name, block in self.changes.items()}
        of_inputs = {name: ranges(one.parameters) for name, one in self.candidates.items()}
        free = {name: one for name, one in given.items() if one.placed and one.formulation == "auto"}
        mixed = {name: one for name, one in free.items() if one.mixable}
        if not any(one.decision(of_inputs[name]).mixed for name, one in free.items()):
            mixed = {}
        return {
            name: one.model_copy(update={"formulation": "mixed"}) if name in mixed else one.over(of_inputs[name])
            for name, one in given.items()
        }

    def described(self, name: str) -> str:
        """A candidate in words: its material, and the mesh of a specimen."""
        candidate: Any = self.candidates[name]
        spec: Any = self.of_candidates.get(name)
        if spec is None or not spec.placed:
            return str(candidate.energy if spec is None else spec.description)
        body, loaded = spec.body, spec.loaded(spec.cases[0])
        mixed = ", mixed" if loaded.mixed else ""
        return f"{loaded.energy} on {body.cells_in_words} cells ({body.cell}, degree {body.degree}{mixed})"

    def build(self, name: str, group: str, comm: Any = None) -> ForwardModel:
        """Make the model of a candidate in a group of data on a communicator; collective."""
        candidate: Any = self.candidates[name]
        if self.model is None:
            tested: ForwardModel = candidate.tested(self.tests_in(group))
            return tested
        spec = self.of_candidates[name]
        model = spec.build(comm, tuple(candidate.parameters))
        derivable(model, spec.kind)
        return observing(model, self.data_as_in(spec))

    def shared(self, name: str, group: str) -> SharedMotion | None:
        """Return the errors that the data share, as a candidate sees them; None if they are independent."""
        spec: Any = self.of_candidates.get(name)
        return motion_of(self.data_as_in(spec), spec.body) if spec is not None and spec.placed else None

    # --- the data ----------------------------------------------------------------------------------------------------

    @cached_property
    def data_groups(self) -> dict[str, Measurements]:
        """Data by group."""
        if self.model is not None:
            return {WHOLE: self.measurements}
        found, predicted = {}, [(math.nan,) * len(test.at) for test in self.predict]
        data: Any = self.data
        for group in data.data_groups:
            measured, tests = data.of(group), self.tests_in(group)
            sigma = [test.sigma or (math.nan,) * len(test.at) for test in measured]
            found[group] = Measurements.of_tests(
                np.concatenate([*(test.measured for test in measured), *predicted]),
                np.concatenate([*sigma, *predicted]),
                [test.label for test in tests for _ in test.at],
                np.concatenate([test.at for test in tests]),
                np.array([(x, z) for test in tests for x, z in zip(test.at, test.across or test.at, strict=True)]),
            )
        return found

    def tests_in(self, group: str) -> list[MaterialTest]:
        """Return the tests of a group, those that are only predicted last."""
        data: Any = self.data
        return [*data.of(group), *self.predict]

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
        if not any(has_mesh(spec) or spec.hidden for spec in self.of_candidates.values()):
            return {}
        return {name: self._unchecked(spec) for name, spec in self.of_candidates.items()}

    def _unchecked(self, spec: Any) -> str:
        method: Any = self.method
        if method.treatment is None:
            return str(method.unchecked)
        if not has_mesh(spec):
            return spec.hidden or f"a model of kind '{spec.kind}' has no mesh"
        try:
            for body in spec.bodies:
                finer(body)
        except ValueError as error:  # a mesh that is not divided, or would be too large
            return one_line(str(error))
        return ""
