"""Candidates of comparisons and designs: materials, or what each changes of one model, with their priors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError, model_validator

from forward.material_tests import TestedMaterial
from forward.materials.admissible import Materials
from forward.materials.material import units
from forward.materials.material_point import HomogeneousModel, MaterialTest
from forward.scalars import Mistake
from forward.settings import Settings
from forward.spec import MEASURED, ModelSpec
from uq.inputs.distributions import Distribution
from uq.inputs.random_parameters import Inputs
from workflows.config.blocks import Correlation
from workflows.config.priors import inputs_of, mistakes_of_materials, mistakes_of_parameters, ranges

if TYPE_CHECKING:
    from forward.findings import Finding

_SPEC: TypeAdapter[ModelSpec] = TypeAdapter(Annotated[ModelSpec, MEASURED])


class CandidateBlock(Settings):
    """What is known of a candidate before the data."""

    parameters: dict[str, Distribution] = Field(
        min_length=1, description="Priors of the numbers that vary: constants of a material by name, others by path."
    )
    correlations: tuple[Correlation, ...] = Field(default=(), description="Correlations between them.")
    weight: float = Field(default=1.0, gt=0, description="Its probability before the data, up to a common factor.")

    @property
    def inputs(self) -> Inputs:
        """The random parameters."""
        return inputs_of(self.parameters, self.correlations)

    def restricted(self, spec: ModelSpec | None) -> Inputs:
        """The random parameters, restricted to those that make materials of a model, where there are some."""
        materials = None if spec is None else spec.materials(self.inputs.names)
        return self.inputs if materials is None else self.inputs.within(materials)

    def units(self, spec: ModelSpec | None) -> dict[str, str]:
        """SI units of the numbers of its model, of which some are parameters."""
        return {} if spec is None else {path: number.unit for path, number in spec.scalars.items()}


class CandidateModel(TestedMaterial, CandidateBlock):
    """A candidate material with its prior.

    Parameters
    ----------
    material
        Its kind, and the constants that do not vary; without those of the volume (D1) an energy is
        incompressible. Fibres, where it has them, by their components along the first stretch, along the second one and
        across both.
    """

    @property
    def inputs(self) -> Inputs:
        """The random constants."""
        return inputs_of(self.parameters, self.correlations, materials=self.materials)

    @property
    def materials(self) -> Materials:
        """The material as a function of the random constants."""
        return Materials(self.energy, {"material": {**self.fixed, **{name: name for name in self.parameters}}})

    def units(self, spec: ModelSpec | None) -> dict[str, str]:
        """SI units of the constants."""
        return units(self.energy)

    def tested(self, tests: Sequence[MaterialTest]) -> HomogeneousModel:
        """Make the model of the stresses of tests."""
        return HomogeneousModel(self.energy, self.fixed, tests, tuple(self.parameters), self.fibres)

    @model_validator(mode="after")
    def _check(self) -> CandidateModel:
        wrong = next(self.mistakes_of_material(self.parameters), None)
        if wrong is not None:
            raise ValueError(wrong)
        try:
            unfit = next(mistakes_of_materials(self.inputs, self.materials), None)
        except ValueError:  # correlations, which are reported elsewhere
            return self
        if unfit is not None:
            raise ValueError(f"parameters {', '.join(unfit[2])}: {unfit[1]}")
        return self


class ModelCandidate(CandidateBlock):
    """A candidate model, with its prior.

    Parameters
    ----------
    model
        What it changes of the model: blocks and values that replace those there; a block with a kind replaces the whole
        block.
    """

    model: dict[str, Any] = Field(default={})

    def mistakes(self, spec: ModelSpec) -> Iterator[Mistake]:
        """Find what of the priors does not fit the model."""
        materials = spec.materials(self.parameters)
        yield from mistakes_of_parameters(spec, self.parameters)
        if materials is not None and all(path in spec.scalars for path in self.parameters):
            with suppress(ValueError):  # correlations, which are reported elsewhere
                yield from mistakes_of_materials(self.restricted(spec), materials)


class OfCandidates(Settings):
    """A study of candidates that each change one model, or are materials without one.

    Parameters
    ----------
    model
        The model, as far as the candidates have it in common.
    candidates
        Models by name.
    """

    model: Any = None
    candidates: Any

    @property
    def changes(self) -> Mapping[str, dict[str, Any]]:
        """The block of the model of each candidate; none of materials."""
        if self.model is None:
            return {}
        return {name: changed(self.model, one.model) for name, one in (self.candidates or {}).items()}

    @cached_property
    def of_candidates(self) -> Mapping[str, ModelSpec]:
        """The model of each candidate, in the form that suits all values of its parameters; none of materials."""
        given = {name: spec_of(block) for name, block in self.changes.items()}
        return {name: spec.over(ranges(self.candidates[name].parameters)) for name, spec in given.items()}

    @property
    def priors(self) -> dict[str, Inputs]:
        """The unknowns of each candidate, restricted to those for which there is a material."""
        return {name: one.restricted(self.of_candidates.get(name)) for name, one in self.candidates.items()}

    @property
    def findings_of_models(self) -> Iterator[Finding]:
        """Findings about the models before anything is solved."""
        for name, spec in self.of_candidates.items():
            yield from spec.findings_over(ranges(self.candidates[name].parameters))

    def parameters_of(self, label: str) -> tuple[str, ...]:
        """Names of the unknowns of a candidate."""
        found: tuple[str, ...] = self.candidates[label.partition("/")[0]].inputs.names
        return found

    def units_of(self, label: str) -> dict[str, str]:
        """SI units of the numbers of a candidate's model."""
        name, _, _ = label.partition("/")
        found: dict[str, str] = self.candidates[name].units(self.of_candidates.get(name))
        return found

    def models_and_mistakes(self) -> Iterator[tuple[ModelSpec | None, list[Mistake]]]:
        """Find the model of each candidate (None if it is none), and what is wrong with it."""
        for name, block in self.changes.items():
            place, candidate = ("candidates", name), self.candidates[name]
            try:
                spec = spec_of(block)
            except ValidationError as error:
                lines = error.errors(include_url=False)
                yield None, [((*place, "model", *line["loc"]), line["msg"], line["input"]) for line in lines]
                continue
            wrong = [*candidate.mistakes(spec), *spec.mistakes_of_mesh()]
            if spec.coefficients:
                message = "random fields, expected numbers only: candidates have few parameters"
                wrong.append((("model", "fields"), message, len(spec.coefficients)))
            yield spec, [((*place, *where), message, given) for where, message, given in wrong]


def spec_of(block: Mapping[str, Any]) -> ModelSpec:
    """Return the model that a block describes; a ValidationError for mistakes in it."""
    return _SPEC.validate_python(dict(block))


def changed(block: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a block with changed values; a block with a kind replaces what was there."""
    found = dict(block)
    for key, value in changes.items():
        here = found.get(key)
        inside = isinstance(value, Mapping) and isinstance(here, Mapping) and "kind" not in value
        found[key] = changed(here, value) if inside else value  # type: ignore[arg-type]
    return found
