"""Studies that compare models: what those by displacements and those by outputs have in common."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

from pydantic import Field, ValidationError, model_validator

from forward.fem.finer import finer
from forward.scalars import Mistake
from forward.settings import Settings, one_line
from forward.spec import ModelSpec
from inverse.criticism.comparison import Candidate
from inverse.methods.selection import SelectSpecimens
from uq.inputs.distributions import Distribution
from uq.inputs.random_parameters import Inputs
from workflows.config.blocks import Correlation, Parallel
from workflows.config.mistakes import StudyError, lines, refused
from workflows.config.priors import mistakes_of_materials, mistakes_of_parameters, ranges
from workflows.config.report import Report
from workflows.studies.material_tests import WHOLE
from workflows.studies.predictions import has_mesh, mesh_check, meshes_of, of_file
from workflows.studies.selection import Comparison

if TYPE_CHECKING:
    from forward.model import Finding

Positive = Annotated[float, Field(gt=0)]


class ModelCandidate(Settings):
    """A candidate model, with its prior.

    Parameters
    ----------
    model
        What it changes of the model: blocks and values that replace those there; a block with a kind replaces the whole
        block.
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

    def restricted(self, spec: ModelSpec) -> Inputs:
        """The random parameters, restricted to those that make materials, where there are some."""
        materials = spec.materials(self.inputs.names)
        return self.inputs if materials is None else self.inputs.within(materials)

    def mistakes(self, spec: ModelSpec) -> Iterator[Mistake]:
        """Find what of the priors does not fit the model."""
        materials = spec.materials(self.parameters)
        constants = () if materials is None else materials.names
        yield from mistakes_of_parameters(spec.scalars, self.parameters, constants, spec.unavailable)
        if materials is not None and all(path in spec.scalars for path in self.parameters):
            with suppress(ValueError):  # correlations, which are reported elsewhere
                yield from mistakes_of_materials(self.restricted(spec), materials)


class ModelSelection(Comparison):
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
    parallel
        Use of ranks.
    report
        Your own sections of the report.

    Attributes
    ----------
    listed_by
        The key of `data` that is there once the data are listed, and no file is to be read any more.
    """

    model: dict[str, Any]
    data: Any
    candidates: dict[str, ModelCandidate] = Field(min_length=1)
    method: SelectSpecimens
    parallel: Parallel = Parallel()
    report: Report | None = None

    costly: ClassVar[bool] = True
    listed_by: ClassVar[str]

    @classmethod
    @abstractmethod
    def spec_of(cls, block: Mapping[str, Any]) -> ModelSpec:
        """Return the model that a block describes.

        Raises
        ------
        pydantic.ValidationError
            For mistakes in it.
        """

    @classmethod
    def made(cls, blocks: Mapping[str, Any], folder: Path) -> Self:
        """Check the blocks of a study, after its data have been read by the model of the first candidate."""
        return cls.model_validate(cls._expanded(blocks, folder))

    @classmethod
    def _expanded(cls, blocks: Mapping[str, Any], folder: Path) -> dict[str, Any]:
        data, candidates = blocks.get("data"), blocks.get("candidates")
        if not isinstance(data, Mapping) or cls.listed_by in data or not isinstance(candidates, Mapping):
            return dict(blocks)
        if not candidates:
            return dict(blocks)
        of_file: Any = cls.data_in_file
        try:
            file = of_file.model_validate(dict(data))
        except ValidationError as error:
            raise StudyError(*lines(error, "data")) from None
        name, first = next(iter(candidates.items()))
        changes = first.get("model", {}) if isinstance(first, Mapping) else {}
        try:
            spec = cls.spec_of(changed(blocks["model"], changes))
        except ValidationError as error:
            raise StudyError(*lines(error, f"candidates.{name}.model")) from None
        return {**blocks, "data": file.read(folder, spec)}

    @cached_property
    def of_candidates(self) -> Mapping[str, ModelSpec]:
        """The model of each candidate, in the form that suits all values of its parameters."""
        return {
            name: self.spec_of(changed(self.model, one.model)).over(ranges(one.parameters))
            for name, one in self.candidates.items()
        }

    @property
    def specs(self) -> tuple[ModelSpec, ...]:
        """The models of all candidates, and the finer meshes that they are looked at on."""
        return *self.of_candidates.values(), *(fine for several in self._finer for fine in several)

    @property
    def memory(self) -> float:
        """Memory (bytes) of a group of ranks: of all candidates, and of the finer meshes of one of them at a time."""
        return _bytes(self.of_candidates.values()) + max((_bytes(several) for several in self._finer), default=0.0)

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
    def modules(self) -> tuple[str, ...]:
        """Modules that a user has written for the models."""
        return tuple(dict.fromkeys(module for spec in self.of_candidates.values() for module in spec.modules))

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the models before anything is solved, each once."""
        of_models = (
            finding
            for name, one in self.of_candidates.items()
            for finding in one.findings_over(ranges(self.candidates[name].parameters))
        )
        return tuple(dict.fromkeys([*of_models, *super().findings]))

    @property
    def models(self) -> dict[str, Candidate]:
        """The candidates as the method needs them."""
        return {
            name: Candidate(candidate.restricted(self.of_candidates[name]), candidate.weight)
            for name, candidate in self.candidates.items()
        }

    @property
    def source(self) -> tuple[str, ...]:
        """Where the data are from."""
        found: tuple[str, ...] = self.data.source
        return found

    @property
    def group_names(self) -> tuple[str, ...]:
        """Names of the groups: there is one."""
        return (WHOLE,)

    def units_of(self, label: str) -> dict[str, str]:
        """SI units of the numbers of a candidate's model."""
        return {path: number.unit for path, number in self.of_candidates[label.partition("/")[0]].scalars.items()}

    @model_validator(mode="after")
    def _check(self) -> Self:
        refused(type(self).__name__, list(self._mistakes()))
        return self

    def _mistakes(self) -> Iterator[Mistake]:
        for place, spec, mistakes in described(self.candidates, self.model, self.spec_of):
            yield from mistakes
            if spec is None:
                continue
            if spec.coefficients:
                message = "random fields, expected numbers only: evidences are of few parameters"
                yield (*place, "model", "fields"), message, len(spec.coefficients)
            for where, message, given in self.unobserved(spec):
                yield (*place, "model", *where), message, given
            if self.parallel.ranks_per_model > 1 and not spec.shareable:
                message = f"a model of kind '{spec.kind}' is not shared by ranks, expected 1"
                yield ("parallel", "ranks_per_model"), message, self.parallel.ranks_per_model
        yield from self.mistakes_of_method()

    @abstractmethod
    def unobserved(self, spec: ModelSpec) -> Iterator[Mistake]:
        """Find what was measured that a model does not have."""


def _bytes(specs: Iterable[Any]) -> float:
    found = 0.0
    for cost in (one.cost() for one in specs):
        found += 0.0 if cost is None else cost.bytes
    return found


def described(
    candidates: Mapping[str, ModelCandidate],
    block: Mapping[str, Any],
    spec_of: Callable[[Mapping[str, Any]], ModelSpec],
) -> Iterator[tuple[tuple[str, str], ModelSpec | None, list[Mistake]]]:
    """Find the place of each candidate in a study, its model (None if it is none), and what is wrong with it."""
    for name, candidate in candidates.items():
        place = ("candidates", name)
        try:
            spec = spec_of(changed(block, candidate.model))
        except ValidationError as error:
            lines = error.errors(include_url=False)
            yield place, None, [((*place, "model", *line["loc"]), line["msg"], line["input"]) for line in lines]
            continue
        found = (*candidate.mistakes(spec), *spec.mistakes_of_mesh())
        yield place, spec, [((*place, *where), message, given) for where, message, given in found]


def changed(block: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a block with changed values; a block with a kind replaces what was there."""
    found = dict(block)
    for key, value in changes.items():
        here = found.get(key)
        inside = isinstance(value, Mapping) and isinstance(here, Mapping) and "kind" not in value
        found[key] = changed(here, value) if inside else value  # type: ignore[arg-type]
    return found
