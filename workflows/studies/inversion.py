"""Studies that infer what is unknown of a model from data: displacements of a specimen, or outputs of any model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self, cast

from pydantic import BeforeValidator, Field, ValidationError, model_validator
from pydantic.json_schema import SkipJsonSchema

from forward.bodies.inclusions import log_factor
from forward.findings import Finding
from forward.registry import named
from forward.scalars import Mistake
from forward.settings import Settings, nearest
from forward.spec import MEASURED
from forward.specimen import LoadCase, Observed, Specimen
from inverse.criticism.assessment import NEEDED
from inverse.methods.invert import ByReduced, Invert, names_of
from uq.inputs.distributions import Distribution, Normal
from uq.inputs.random_parameters import Inputs
from workflows.config.blocks import Correlation
from workflows.config.mistakes import not_installed
from workflows.config.priors import findings_of_materials, inputs_of, mistakes_of_factor, mistakes_of_priors, ranges
from workflows.run.from_python import FromPython
from workflows.studies.measured import DataFiles, as_block, data_as
from workflows.studies.measured_outputs import MeasuredOutputs
from workflows.studies.predictions import has_mesh, meshes_of, never_estimable
from workflows.studies.study import Sampled, StudyKind

if TYPE_CHECKING:
    from forward.hyperelastic import Hyperelastic
    from forward.model import FloatArray
    from forward.reduced.spec import Reduced
    from forward.spec import ModelSpec
    from inverse.data.measurements import Measurements
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from workflows.studies.job import Job

SOLVES_OF_FIELD = 12  # for a mode
PREDICTED = "predicted"  # name of the solves for what is predicted
LEAST = 8  # solves of an expansion of what is predicted
OF_GEOMETRY = frozenset({"m", "m²", "m³", "1"})  # units of outputs that are no forces


class Predict(Settings):
    """Outputs that the posterior predicts: under other loads, at other places, of another kind.

    Parameters
    ----------
    cases
        Of a specimen: load cases in which something is predicted, with what acts in them and `outputs`. One that has
        the name of a measured load case and nothing that acts is that load case. By default the measured ones.
    observed
        Of a specimen: places at which displacements are predicted, as `model.observed` has them.
    model
        Of other models: settings that replace those of the model, such as { loads = [...], outputs = [...] }; all of
        the outputs are predicted. By default the model as it is.
    samples
        Solves for the posterior, and as many for the prior: those of an expansion over draws of few parameters (by
        default 32); of a field, pairs of draws (8 pairs), without which it is not seen what derivatives leave out.
    """

    cases: tuple[LoadCase, ...] = ()
    observed: tuple[Observed, ...] = ()
    model: dict[str, Any] = Field(default={})
    samples: Annotated[int, Field(ge=0)] | None = None

    def solves(self, *, field: bool) -> int:
        """Number of solves beside the first, for the posterior as for the prior."""
        if self.samples is None:
            return 16 if field else 32
        return self.samples


class Inversion(FromPython, StudyKind):
    """What to invert: displacements of a specimen, or outputs of any other model.

    Parameters
    ----------
    model
        The specimen (body, material, inclusions or a field, load cases), or a model with outputs, of which some were
        measured.
    parameters
        Priors by the paths of the unknown numbers of the model; none for a field of nodal values.
    correlations
        Correlations between them.
    data
        What was measured.
    method
        How it is inverted.
    predict
        What else is to be known by the posterior; by default nothing.
    """

    model: Annotated[Any, MEASURED]
    parameters: dict[str, Distribution] = Field(default={})
    correlations: tuple[Correlation, ...] = ()
    data: Annotated[DataFiles | MeasuredOutputs, BeforeValidator(as_block)]
    method: Invert = Invert()
    predict: Predict | None = None
    measurements: SkipJsonSchema[tuple[Any, ...]] = Field(default=(), exclude=True, repr=False)

    stopped: ClassVar[str] = "all data sets inverted"

    # --- the model ---------------------------------------------------------------------------------------------------

    @cached_property
    def spec(self) -> ModelSpec:
        """The model, in the form that suits all values of its parameters."""
        found: ModelSpec = self.model.over(ranges(self.parameters))
        return found

    @property
    def specimen(self) -> Specimen | None:
        """The model, if it is a specimen, of which displacements were measured."""
        return self.spec if isinstance(self.spec, Specimen) else None

    @property
    def field(self) -> bool:
        """Whether values of a field at the vertices are what is unknown."""
        return self.specimen is not None and any(field.basis == "nodes" for field in self.model.fields)

    @cached_property
    def inputs(self) -> Inputs:
        """The unknown parameters; none for a field of nodal values."""
        coefficients = () if self.field else self.model.coefficients
        return inputs_of(self.parameters, self.correlations, coefficients, self.model.materials(self.parameters))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in results; for a field, its mean."""
        if self.field:
            label = f"fields.{self.model.fields[0].label}.mean"
            return names_of(Inputs({label: Normal(mean=0.0, std=1.0)}), self.method)
        return names_of(self.inputs, self.method)

    @property
    def sampled(self) -> Sampled | None:
        """A model with outputs, with its priors."""
        return None if self.specimen is not None else Sampled(self.inputs, self.spec)

    @property
    def meshes(self) -> tuple[ModelSpec, ...]:
        """The model: there are no others."""
        return (self.spec,)

    @property
    def specs(self) -> tuple[ModelSpec, ...]:
        """The model, what is predicted, and the model on the finer meshes that it is looked at on."""
        spec, beside = self.spec, () if self.predict is None else (self.predicted,)
        looked = has_mesh(spec) and self.method.treatment is not None
        try:
            return spec, *beside, *(meshes_of(spec) if looked else ())
        except ValueError:  # there are none, which is said elsewhere
            return spec, *beside

    @cached_property
    def predicted(self) -> ModelSpec:
        """The model of what is predicted."""
        found: ModelSpec = named("workflows.studies.predicted:spec")(self)
        return found

    @property
    def predicted_by(self) -> int:
        """Number of solves for what is predicted, beside the first, for the posterior as for the prior."""
        return 0 if self.predict is None else self.predict.solves(field=self.field)

    @cached_property
    def reduced(self) -> dict[str, Reduced]:
        """The reduced models that stand for the load cases of a specimen, by name, or for the model, as "".

        None where the model is asked itself.

        Raises
        ------
        pydantic.ValidationError
            If a file cannot be used.
        """
        asked = self.method.reduced
        if asked is None:
            return {}
        made: Any = named("forward.reduced.spec:Reduced")
        if not isinstance(asked.file, dict):
            return {"": made(file=asked.file, digest=asked.digest)}
        digests = asked.digest if isinstance(asked.digest, dict) else {}
        return {name: made(file=asked.file[name], digest=digests.get(name)) for name in self.parts}

    def stiffness(self, places: FloatArray, points: FloatArray) -> FloatArray:
        """Return ln of the factor (n, k) of the inclusions on the stiffness at places (k, 3) and parameters (n, d)."""
        return log_factor(self.model.inclusions, self.inputs.names, points, places)

    # --- the data ----------------------------------------------------------------------------------------------------

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts of the data (load cases, outputs) for which results of each alone are given."""
        if self.specimen is not None:
            return tuple(case.name for case in self.model.cases)
        return next((found.parts for found in self.measurements if found is not None), ())

    def measured(self, number: int) -> Measurements:
        """Return a data set that can be used."""
        found: Measurements = self.measurements[number]
        return found

    def not_estimable(self, number: int) -> tuple[str, ...]:
        """Names of what was measured in a data set whose error of the mesh nothing tells: of displacements none."""
        return (
            ()
            if self.specimen is not None
            else never_estimable(self.model, tuple(self.measurements[number].names.tolist()))
        )

    @property
    def recorded(self) -> bool:
        """As in every study: its data sets are named, and not read."""
        return bool(self.data.sets) and not self.measurements

    def with_data(self, folder: Path) -> Self:
        """Return the same with its data read; a StudyError if no file can be used."""
        if self.data.sets:
            return self
        sets, found = self.data.read(folder, self.model)
        return self.model_copy(update={"data": self.data.model_copy(update={"sets": sets}), "measurements": found})

    # --- what is done ------------------------------------------------------------------------------------------------

    @classmethod
    def made(cls, blocks: Mapping[str, Any], folder: Path) -> Inversion:
        """Check the blocks of an inversion, and read its data."""
        return cls.model_validate(blocks).with_data(folder)

    @property
    def together(self) -> bool:
        """Whether all groups of ranks work on one data set, point by point."""
        alone = self.specimen is None or not self.model.fields
        return alone and len(self.data.sets) == 1 == self.parallel.ranks_per_model and self.method.expansion is None

    @property
    def planned(self) -> int:
        """Number of evaluations: data sets, or solves if all groups work on one."""
        return self.solves if self.together else len(self.data.sets) + 1

    @property
    def solves(self) -> int:
        """Approximate number of solves for all data sets: the searches for the modes are not predictable."""
        method, field = self.method, self.field
        if method.expansion is not None:
            return method.expansion
        if method.reduced is not None:  # at the mode, and draws
            return (1 + method.reduced.solves) * sum(measurement is not None for measurement in self.measurements)
        each = method.solves(len(self.names), field=field) + method.chain_solves(len(self.names), field=field)
        each += SOLVES_OF_FIELD + each if field else 12 * method.starts + 2 * len(self.parameters)
        more = 0 if self.predict is None else 1 + self.predicted_by
        count = sum(measurement is not None for measurement in self.measurements)
        return (each + more) * count + more

    def plan(self, rank_groups: int) -> list[str]:
        """Say what is inverted, and how long that will take."""
        from workflows.studies.plans import of_inversion

        return of_inversion(self)

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        """Make the model, and what is done for each data set; collective."""
        found: Job = named("workflows.studies.inversion_job:job")(self, ensemble, directory, checkpoint)
        return found

    def parameters_of(self, label: str) -> tuple[str, ...]:
        """Names of the unknown parameters, of those that act in what is predicted."""
        if label == PREDICTED:
            found: tuple[str, ...] = named("workflows.studies.predicted:parameters")(self)
            return found
        return self.inputs.names

    def identity(self) -> dict[str, Any]:
        """Return everything that evaluations depend on; files count by their contents, not their path."""
        found = super().identity() | {"model": self.model.identity()}
        if self.method.reduced is not None:
            found["method"] = found["method"] | {"reduced": {**found["method"]["reduced"], "file": ""}}
        return found

    # --- what is said ------------------------------------------------------------------------------------------------

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the model before anything is solved."""
        reach = ranges(self.parameters)
        found = (*self.model.findings_over(reach), *findings_of_materials(self.inputs))
        if self.specimen is not None:
            return *found, *self._ratios_alone()
        return *found, *(said for one in self.reduced.values() for said in one.outside(reach))

    def _ratios_alone(self) -> Iterator[Finding]:
        """Find that no force acts or is measured: then displacements do not change if all stiffnesses are doubled."""
        pressed = any(not load.contact for case in self.model.cases for load in case.loads)
        units = self.model.measurable
        seen = [found.subset(found.points < 0) for found in self.measurements if found is not None]
        names = {(self.parts[case], name) for one in seen for case, name in zip(one.cases, one.names, strict=True)}
        if pressed or any(units[case][name] not in OF_GEOMETRY for case, name in names):
            return
        moduli = [
            path
            for path, number in self.model.scalars.items()
            if number.unit == "Pa" and path.startswith(("material.", "regions."))
        ]
        unknown = [path for path in moduli if path in self.parameters]
        fields = [field.label for field in self.model.fields if field.of == "stiffness"]
        known = [path for path in moduli if path not in self.parameters]
        if not unknown and not fields:
            return
        sought = ", ".join([*unknown, *(f"the mean of the field '{label}'" for label in fields)])
        source = f"{', '.join(known)} as stated" if known and not fields else "the prior alone"
        yield Finding("ratios-only", "warning", {"sought": sought, "source": source})

    @model_validator(mode="before")
    @classmethod
    def _data_of_model(cls, blocks: Any) -> Any:
        """Choose the block of the data by the model."""
        return data_as(blocks, DataFiles, MeasuredOutputs)

    def mistakes(self) -> Iterator[Mistake]:
        """Find what cannot be asked together."""
        if self.specimen is not None:
            yield from self._of_specimen()
        else:
            yield from self._of_outputs()
            yield from cast("MeasuredOutputs", self.data).mistakes(self.model)
        if self.method.reduced is not None:
            yield from self._of_reduced(self.method.reduced)
        if self.method.chains is not None:
            yield from not_installed("chains", self.method.chains, NEEDED[self.method.chains])
        if self.method.chains == "hmc" and self.method.reduced is not None:
            message = "follows the gradients of the body itself, expected 'pcn' or 'emcee' with a reduced model"
            yield ("method", "chains"), message, self.method.chains
        yield from mistakes_of_priors(self.model, self.parameters, self.correlations, lambda: self.inputs)
        yield from mistakes_of_factor(self.method.noise, "method", "noise")
        for name, value in self.data.truth.items():
            if name not in self.model.scalars:
                message = f"not a number of the model; {nearest(name, tuple(self.model.scalars))}"
                yield ("data", "truth", name), message, value
        if self.predict is not None:
            yield from named("workflows.studies.predicted:mistakes")(self)

    def _of_specimen(self) -> Iterator[Mistake]:
        """Find mistakes of the inversion of displacements."""
        nodal = [i for i, field in enumerate(self.model.fields) if field.basis == "nodes"]
        if nodal and (len(self.model.fields) > 1 or self.parameters):
            message = "a field of nodal values is inverted alone, expected no other fields and no parameters"
            yield ("model", "fields", nodal[0], "basis"), message, "nodes"
        if nodal and self.model.fields[nodal[0]].of != "stiffness":
            yield ("model", "fields", nodal[0], "of"), "expected stiffness", self.model.fields[nodal[0]].of
        if nodal and self.method.chains in {"emcee", "hmc"}:
            yield ("method", "chains"), "expected 'pcn', the chains for fields", self.method.chains
        if nodal and self.method.noise is not None and self.data.errors.kind != "normal":
            message = "the size of such errors is not inferred with a field, expected { kind = 'normal' } or no noise"
            yield ("data", "errors"), message, self.data.errors.kind
        if not self.parameters and not self.model.fields:
            yield ("parameters",), "nothing is unknown, expected at least one prior, or one of model.fields", {}
        if self.method.expansion is not None:
            message = "data sets of a specimen are observed at places of their own, expected outputs of another model"
            yield ("method", "expansion"), message, self.method.expansion

    def _of_outputs(self) -> Iterator[Mistake]:
        """Find mistakes of the inversion of outputs."""
        yield from self.model.mistakes_of_mesh()
        for i, field in enumerate(getattr(self.spec, "fields", ())):
            if field.basis == "nodes":
                message = "values at the vertices are inverted with the displacements of a specimen, expected 'modes'"
                yield ("model", "fields", i, "basis"), message, field.basis
        yield from self.mistakes_of_ranks(self.spec)
        if not self.parameters and not self.model.coefficients:
            yield ("parameters",), "nothing is unknown, expected at least one prior", {}

    def _of_reduced(self, given: ByReduced) -> Iterator[Mistake]:
        """Find mistakes about reduced models: one of a body, one for each load case of a specimen."""
        place = ("method", "reduced")
        if self.field:
            message = "a field of nodal values has no reduced model, expected few parameters, or the modes of a field"
            yield place, message, given.files
            return
        if self.specimen is not None:
            if not isinstance(given.file, dict) or set(given.file) != set(self.parts):
                example = ", ".join(f'{name} = "FILE"' for name in self.parts)
                message = f"a specimen has a reduced model for each load case, expected file = {{ {example} }}"
                yield (*place, "file"), message, given.file
                return
            bodies = {case.name: self.specimen.loaded(case) for case in self.specimen.cases}
        else:
            if self.method.expansion is not None:
                message = "stands for the body in place of a reduced model, expected one of both"
                yield ("method", "expansion"), message, self.method.expansion
            if not isinstance(given.file, str):
                yield (*place, "file"), "a body has one reduced model, expected a file", given.files
                return
            if self.model.kind != "hyperelastic":
                message = f"a reduced model stands for a body, expected kind 'hyperelastic', not '{self.model.kind}'"
                yield place, message, given.file
                return
            bodies = {"": cast("Hyperelastic", self.spec)}
        try:
            found = self.reduced
        except ValidationError as error:
            yield place, str(error.errors()[0]["msg"]), given.files
            return
        digests = {name: one.digest for name, one in found.items()}
        object.__setattr__(given, "digest", digests.get("", digests))
        for name, body in bodies.items():
            known = {*body.scalars, *body.coefficients}
            acting = [path for path in (*self.parameters, *self.model.coefficients) if path in known]
            for said in found[name].differences(body, acting):
                where, file = (("file", name), given.file[name]) if isinstance(given.file, dict) else ((), given.file)
                yield (*place, *where), said, file
