"""A study that compares models: of a specimen by displacements, or any others by their outputs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, cast

from pydantic import BeforeValidator, ValidationError, model_validator

from forward.fem.finer import finer
from forward.findings import Finding
from forward.model import ForwardModel
from forward.scalars import Mistake
from forward.settings import Settings, one_line, shown
from forward.spec import SPECIMEN, ModelSpec, usual_kind
from forward.specimen import Specimen
from inverse.criticism.comparison import Candidate, Data
from inverse.criticism.doubts_of_meshes import not_estimable
from inverse.methods.selection import SelectSpecimens
from workflows.config.mistakes import StudyError, lines
from workflows.config.priors import ranges
from workflows.studies.candidates import OfCandidates, changed, spec_of
from workflows.studies.listed_displacements import ListedDisplacements
from workflows.studies.listed_outputs import ListedOutputs
from workflows.studies.material_tests import WHOLE, expanded
from workflows.studies.measured import as_block, data_as
from workflows.studies.predictions import has_mesh, mesh_check, meshes_of, of_file
from workflows.studies.selection import Comparison, Selection
from workflows.studies.solves import of_answers
from workflows.studies.study import StudyKind, bytes_of

if TYPE_CHECKING:
    from forward.fem.specimen import SpecimenModel
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

    data: Annotated[ListedDisplacements | ListedOutputs, BeforeValidator(as_block)]
    method: SelectSpecimens

    costly: ClassVar[bool] = True
    data_in_file: ClassVar[tuple[type[Settings], ...]] = (ListedDisplacements.in_file, ListedOutputs.in_file)

    @classmethod
    def forms(cls) -> Iterator[type[StudyKind]]:
        """Comparisons of materials, and of models."""
        yield Selection
        yield cls

    @classmethod
    def made(cls, blocks: Mapping[str, Any], folder: Path) -> Comparison:  # type: ignore[override]
        """Check the blocks of a comparison of models, whose data are read by the first one, or of material points."""
        if not isinstance(blocks.get("model", {}), Mapping):
            message = f"model: expected a table, {{ key = value }}; given {shown(blocks['model'])}"
            raise StudyError(message)
        if "model" not in blocks:
            return Selection.model_validate(expanded(blocks, folder))
        return cls.model_validate(cls._expanded(blocks, folder))

    @classmethod
    def _expanded(cls, blocks: Mapping[str, Any], folder: Path) -> dict[str, Any]:
        data, candidates, listed = blocks.get("data"), blocks.get("candidates"), block_of(blocks.get("model"))
        if not isinstance(data, Mapping) or not isinstance(candidates, Mapping) or not candidates:
            return dict(blocks)
        if next(iter(listed.model_fields)) in data:  # nothing is to be read any more
            return dict(blocks)
        try:
            file: Any = listed.in_file.model_validate(dict(data))
        except ValidationError as error:
            raise StudyError(*lines(error, "data")) from None
        name, first = next(iter(candidates.items()))
        changes = first.get("model", {}) if isinstance(first, Mapping) else {}
        try:
            spec = spec_of(changed(blocks["model"], changes))
        except ValidationError as error:
            raise StudyError(*lines(error, f"candidates.{name}.model")) from None
        return {**blocks, "data": file.read(folder, spec)}

    @cached_property
    def of_candidates(self) -> Mapping[str, ModelSpec]:
        """The model of each candidate, in a form that suits all values of its parameters.

        Forms differ a little on a mesh: if one specimen needs pressures, all that can have them do.
        """
        given = {name: spec_of(changed(self.model, one.model)) for name, one in self.candidates.items()}
        of_inputs = {name: ranges(one.parameters) for name, one in self.candidates.items()}
        free = {name: one for name, one in given.items() if isinstance(one, Specimen) and one.formulation == "auto"}
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
            finer(spec)
        except ValueError as error:  # a mesh that is not divided, or would be too large
            return one_line(str(error))
        return ""

    @property
    def of_files(self) -> frozenset[str]:
        """Candidates whose meshes are those of files."""
        return frozenset(name for name, spec in self.of_candidates.items() if of_file(spec))

    @property
    def mesh_checks(self) -> list[tuple[float, str]]:
        """Processor time (s) of the solves on finer meshes of each candidate, and what is solved."""
        checked: list[Any] = [one for one in self.of_candidates.values() if has_mesh(one)]
        return [mesh_check(one) for one in checked]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the models before anything is solved, each once."""
        return tuple(dict.fromkeys([*self.findings_of_models, *super().findings, *self._of_outputs()]))

    def _of_outputs(self) -> Iterator[Finding]:
        """Say of which measured outputs nothing tells the error of the mesh."""
        never = (self.data.not_estimable(spec) for spec in self.of_candidates.values())
        names = tuple(dict.fromkeys(name for several in never for name in several))
        yield from not_estimable(names) if names and self.unchecked else ()

    @property
    def models(self) -> dict[str, Candidate]:
        """The candidates as the method needs them."""
        return {name: Candidate(inputs, self.candidates[name].weight) for name, inputs in self.priors.items()}

    @property
    def data_groups(self) -> dict[str, Data]:
        """Data by group."""
        return {WHOLE: self.data.data}

    def measured_in(self, test: str) -> str:
        """Say what was measured in a test, in the unit of the first candidate."""
        return self.data.measured_in(test, next(iter(self.of_candidates.values())))

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
            seconds += self.searches(name) * (cost.textbook if isinstance(spec, Specimen) else cost.sample)
            seconds += self.method.samples * cost.sample + solves * derivatives
        return seconds * self.evidences / len(self.of_candidates)

    def described(self, name: str) -> str:
        """A candidate in words: of a specimen its material and mesh."""
        spec = self.of_candidates[name]
        if not isinstance(spec, Specimen):
            return spec.description
        body, loaded = spec.body, spec.loaded(spec.cases[0])
        mixed = ", mixed" if loaded.mixed else ""
        return f"{loaded.energy} on {body.cells_in_words} cells ({body.cell}, degree {body.degree}{mixed})"

    def build(self, name: str, group: str, comm: Any = None) -> ForwardModel:
        """Make the model of a candidate; collective."""
        spec = self.of_candidates[name]
        return self.data.observed(spec, spec.build(comm, tuple(self.candidates[name].parameters)))

    def shared(self, name: str, group: str) -> SharedMotion | None:
        """Return the errors that the data share, as a candidate sees them; None if they are independent."""
        return self.data.shared(self.of_candidates[name])

    def moved(self, make: Callable[[], ForwardModel], motion: SharedMotion) -> ForwardModel:
        """Return the model, on the mesh of a candidate, that tells what uncertain motions do; collective."""
        return cast("SpecimenModel", make()).observing(*motion.observed)

    def contradictions(self, name: str, make: Callable[[], ForwardModel]) -> list[Finding]:
        """Find that another program contradicts itself, or states derivatives that are not of its values; on rank 0."""
        if self.of_candidates[name].shareable:
            return []
        return [one.of(f"Candidate '{name}'") for one in of_answers(make(), self.candidates[name].inputs)]

    @model_validator(mode="before")
    @classmethod
    def _data_of_model(cls, blocks: Any) -> Any:
        """Choose the block of the data by the model."""
        return data_as(blocks, block_of(blocks.get("model"))) if isinstance(blocks, Mapping) else blocks

    def mistakes(self) -> Iterator[Mistake]:
        """Find what cannot be asked together."""
        if isinstance(self.data, ListedDisplacements) and self.method.check is not None:
            message = "nested sampling takes ten thousand solves for each candidate, expected none of finite elements"
            yield ("method", "check"), message, self.method.check
        for place, spec, mistakes in self.models_and_mistakes():
            yield from mistakes
            if spec is None:
                continue
            for where, message, given in self.data.unobserved(spec):
                yield (*place, "model", *where), message, given
            yield from self.mistakes_of_ranks(spec)
        yield from self.mistakes_of_method()


def block_of(model: Any) -> type[ListedDisplacements | ListedOutputs]:
    """Return the block of the data of a model."""
    return ListedDisplacements if usual_kind(model) == SPECIMEN else ListedOutputs
