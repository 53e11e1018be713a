"""Models by what they change of another: candidates, with their priors, and those against which errors are learnt."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError

from forward.material_tests import Constants
from forward.scalars import Mistake
from forward.settings import Settings
from forward.spec import MEASURED, ModelSpec
from inverse.methods.model_error import LearntError
from uq.inputs.random_parameters import Inputs
from workflows.config.blocks import Correlation
from workflows.config.one_model import Priors
from workflows.config.priors import inputs_of, mistakes_of_materials, mistakes_of_parameters, ranges

if TYPE_CHECKING:
    from forward.findings import Finding

TRUTH = "other model"  # against which errors are learnt, in names of models
UNSEEN = "the errors of the model are learnt against another one, whose mesh is taken as it is"
SPEC: TypeAdapter[ModelSpec] = TypeAdapter(Annotated[ModelSpec, MEASURED])


class CandidateModel(Settings):
    """A candidate model, with what is known of it before the data.

    Parameters
    ----------
    model
        What it changes of the model: blocks and values that replace those there; a block with a kind replaces the whole
        block.
    material
        Short for a model's material, for comparisons of materials in tests, which have no model beside: its kind, and
        the constants that do not vary; without those of the volume (D1) an energy is incompressible. Fibres, where it
        has them, by their components along the first stretch, along the second one and across both.
    parameters
        Priors of the numbers that vary: constants of a material by name, others by path.
    correlations
        Correlations between them.
    weight
        Its probability before the data, up to a common factor.
    """

    parameters: Priors = Field(min_length=1)
    correlations: tuple[Correlation, ...] = ()
    weight: float = Field(default=1.0, gt=0)
    model: dict[str, Any] = Field(default={})
    material: Constants | None = None

    @property
    def changes(self) -> dict[str, Any]:
        """What it changes of the model."""
        return self.model if self.material is None else changed({"material": self.material}, self.model)

    @property
    def inputs(self) -> Inputs:
        """The random parameters."""
        return inputs_of(self.parameters, self.correlations)

    def restricted(self, spec: ModelSpec) -> Inputs:
        """The random parameters, restricted to those that make materials of a model, where there are some."""
        materials = spec.materials(self.inputs.names)
        return self.inputs if materials is None else self.inputs.within(materials)

    def mistakes(self, spec: ModelSpec) -> Iterator[Mistake]:
        """Find what of the priors does not fit the model."""
        materials = spec.materials(self.parameters)
        yield from mistakes_of_parameters(spec, self.parameters)
        if materials is not None and all(path in spec.scalars for path in self.parameters):
            with suppress(ValueError):  # correlations, which are reported elsewhere
                yield from mistakes_of_materials(self.restricted(spec), materials)


class OfCandidates(Settings):
    """A study of candidates that each change one model.

    Parameters
    ----------
    model
        The model, as far as the candidates have it in common.
    candidates
        Models by name.
    """

    model: Any = None
    candidates: Any

    def whole(self, name: str) -> ModelSpec:
        """Return the model of a candidate; a ValidationError for mistakes in its block."""
        return SPEC.validate_python(changed(self.model, self.candidates[name].changes))

    @cached_property
    def of_candidates(self) -> Mapping[str, ModelSpec]:
        """The model of each candidate, in the form that suits all values of its parameters."""
        return {name: self.whole(name).over(ranges(one.parameters)) for name, one in self.candidates.items()}

    @property
    def priors(self) -> dict[str, Inputs]:
        """The unknowns of each candidate, restricted to those for which there is a material."""
        return {name: self.candidates[name].restricted(spec) for name, spec in self.of_candidates.items()}

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
        spec = self.of_candidates[label.partition("/")[0]]
        return {path: number.unit for path, number in spec.scalars.items()}

    def models_and_mistakes(self) -> Iterator[tuple[ModelSpec | None, list[Mistake]]]:
        """Find the model of each candidate (None if it is none), and what is wrong with it."""
        for name, candidate in self.candidates.items():
            place = ("candidates", name)
            try:
                spec = self.whole(name)
            except ValidationError as error:
                where = place if self.model is None else (*place, "model")
                lines = error.errors(include_url=False)
                yield None, [((*where, *line["loc"]), line["msg"], line["input"]) for line in lines]
                continue
            wrong = [*candidate.mistakes(spec), *spec.mistakes_of_mesh()]
            if spec.coefficients:
                message = "random fields, expected numbers only: candidates have few parameters"
                wrong.append((("model", "fields"), message, len(spec.coefficients)))
            yield spec, [((*place, *where), message, given) for where, message, given in wrong]


def changed(block: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a block with changed values; a block with a kind replaces what was there."""
    found = dict(block)
    for key, value in changes.items():
        here = found.get(key)
        inside = isinstance(value, Mapping) and isinstance(here, Mapping) and "kind" not in value
        found[key] = changed(here, value) if inside else value  # type: ignore[arg-type]
    return found


# --- models against which the errors of cheaper ones are learnt -------------------------------------------------------


def truth_of(model: Mapping[str, Any] | ModelSpec, learnt: LearntError, parameters: Mapping[str, Any]) -> ModelSpec:
    """Return the other model, in the form that suits all values of its parameters; a ValidationError if it is none."""
    own = model.model_dump(mode="json", exclude_none=True) if isinstance(model, ModelSpec) else model
    made = SPEC.validate_python(changed({"model": own}, {"model": learnt.against})["model"])
    return made.over(ranges({name: one for name, one in parameters.items() if name in made.scalars}))


def mistakes_of_truth(make: Callable[[], ModelSpec], own: Any, unknown: Collection[str]) -> Iterator[Mistake]:
    """Find what the other model lacks, or that it is the model itself; places begin with "against"."""
    place = ("against",)
    try:
        truth: Any = make()
    except ValidationError as error:
        for one in error.errors(include_url=False):
            yield (*place, *one["loc"]), one["msg"], one["input"]
        return
    if truth.placed != own.placed:
        yield place, f"expected a model of kind '{own.kind}', which is observed as this one is", truth.kind
        return
    if truth.identity() == own.identity():
        yield place, "is the model itself, expected another one", truth.kind
    has = {*truth.scalars, *truth.coefficients}
    lost = [name for name in unknown if name not in has]
    if lost:
        yield (*place, "parameters"), f"has no {', '.join(lost[:3])}, expected all unknown numbers", list(has)[:8]
    seen, needed = (_observable(one) for one in (truth, own))
    missing = [name for name in needed if name not in seen]
    if missing:
        yield (*place, "outputs"), f"has no {', '.join(missing[:3])}, expected all that the model has", list(seen)[:8]


def _observable(spec: Any) -> list[str]:
    """Return the names of what can be observed of a model, of a specimen by load case."""
    if spec.placed:
        return [f"{case}.{name}" for case, names in spec.observable.items() for name in names]
    return [output.name for output in spec.returned]
