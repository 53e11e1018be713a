"""Studies of what is inside: a specimen in several load cases with measured displacements."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

from pydantic import Field, ValidationError, model_validator
from pydantic.json_schema import SkipJsonSchema

from forward.bodies.inclusions import log_factor
from forward.model import Finding
from forward.registry import named
from forward.scalars import Mistake
from forward.settings import nearest
from forward.specimen import Specimen
from inverse.data.files import distinct, files
from inverse.data.table import DataError
from inverse.methods.invert import ByReduced, Invert, names_of
from uq.inputs.distributions import Distribution, Normal
from uq.inputs.random_parameters import Inputs
from workflows.config.blocks import Correlation, Parallel
from workflows.config.mistakes import StudyError, refused
from workflows.config.predict import Predict
from workflows.config.priors import findings_of_materials, mistakes_of_factor, mistakes_of_priors, ranges
from workflows.config.report import Report
from workflows.studies.measured import DataFiles, DataSet, digest_of, read_measurement
from workflows.studies.predictions import has_mesh, meshes_of
from workflows.studies.study import StudyKind, measures_outputs

if TYPE_CHECKING:
    from forward.model import FloatArray
    from forward.reduced.spec import Reduced
    from forward.spec import ModelSpec
    from inverse.data.observations import Components
    from inverse.data.shared_motion import SharedMotion
    from inverse.methods.record import Data
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from workflows.studies.job import Job
    from workflows.studies.measured import Measurement

SOLVES_OF_FIELD = 12  # for a mode
PREDICTED = "predicted"  # name of the solves for what is predicted
OF_GEOMETRY = frozenset({"m", "m²", "m³", "1"})  # units of outputs that are no forces


class InversionStudy(StudyKind):
    """What inversions of all kinds of models have in common; each kind says what its blocks mean."""

    model: Any
    parameters: dict[str, Distribution] = Field(default={})
    correlations: tuple[Correlation, ...] = ()
    data: Any
    method: Invert = Invert()
    parallel: Parallel = Parallel()
    report: Report | None = None
    predict: Predict | None = None
    measurements: SkipJsonSchema[tuple[Any, ...]] = Field(default=(), exclude=True, repr=False)

    stopped: ClassVar[str] = "all data sets inverted"
    quantity: ClassVar[str]  # what was measured

    def __eq__(self, other: object) -> bool:
        """Whether the same is asked of the same files."""
        return type(self) is type(other) and self.model_dump() == other.model_dump()

    __hash__ = None  # type: ignore[assignment]

    @property
    def field(self) -> bool:
        """Whether values of a field at the vertices are what is unknown."""
        return False

    @cached_property
    def inputs(self) -> Inputs:
        """The unknown parameters; none for a field of nodal values."""
        standard = dict.fromkeys(() if self.field else self.model.coefficients, Normal(mean=0.0, std=1.0))
        pairs = tuple((*c.between, c.value) for c in self.correlations)
        return Inputs(self.parameters | standard, pairs, self.model.materials(self.parameters))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in results."""
        return names_of(self.inputs, self.method)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the model before anything is solved."""
        raise NotImplementedError

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts of the data (load cases, outputs) for which results of each alone are given."""
        raise NotImplementedError

    @property
    def together(self) -> bool:
        """Whether all groups of ranks work on one data set, point by point."""
        return len(self.data.sets) == 1 and self.parallel.ranks_per_model == 1 and self.method.expansion is None

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
        each = method.solves(field=field) + method.chain_solves(len(self.names), field=field)
        each += SOLVES_OF_FIELD + each if field else 12 * method.starts + 2 * len(self.parameters)
        more = 0 if self.predict is None else 1 + self.predict.solves(field=field)
        count = sum(measurement is not None for measurement in self.measurements)
        return (each + more) * count + more

    @cached_property
    def predicted(self) -> ModelSpec:
        """The model of what is predicted."""
        found: ModelSpec = named("workflows.studies.predicted:spec")(self)
        return found

    @classmethod
    def forms(cls) -> Iterator[type[StudyKind]]:
        """Inversions of displacements, and of outputs."""
        yield Inversion
        yield named("workflows.studies.output_inversion:OutputInversion")

    @classmethod
    def made(cls, blocks: Mapping[str, Any], folder: Path) -> InversionStudy:
        """Check the blocks of an inversion of displacements of a specimen, or of outputs of any model."""
        if measures_outputs(blocks.get("model")):
            other: type[InversionStudy] = named("workflows.studies.output_inversion:OutputInversion")
            return other.model_validate(blocks).with_data(folder)
        return Inversion.model_validate(blocks).with_data(folder)

    def _with_finer(self, spec: Any) -> tuple[ModelSpec, ...]:
        """A model, and the same on the finer meshes that it is looked at on."""
        looked = has_mesh(spec) and self.method.treatment is not None
        beside = () if self.predict is None else (self.predicted,)
        try:
            return spec, *beside, *(meshes_of(spec) if looked else ())
        except ValueError:  # there are none, which is said elsewhere
            return spec, *beside

    @property
    def modules(self) -> tuple[str, ...]:
        """Modules that a user has written for the model."""
        found: tuple[str, ...] = self.model.modules
        return found if self.predict is None else tuple(dict.fromkeys((*found, *self.predicted.modules)))

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

    def measured(self, number: int) -> Data:
        """Return a data set that can be used."""
        raise NotImplementedError

    def labels(self, number: int) -> list[str]:
        """Say of each datum of a data set where it stands."""
        raise NotImplementedError

    def not_estimable(self, number: int) -> tuple[str, ...]:
        """Names of what was measured in a data set whose error of the mesh nothing tells: of displacements none."""
        return ()

    def read(self, path: Path) -> Any:
        """Read a file of data.

        Raises
        ------
        DataError
            With every kind of mistake in the file.
        """
        raise NotImplementedError

    @property
    def recorded(self) -> bool:
        """As in every study: its data sets are named, and not read."""
        return bool(self.data.sets) and not self.measurements

    def with_data(self, folder: Path) -> Self:
        """Return the same with its files read.

        Raises
        ------
        StudyError
            If no file can be used.
        """
        if self.data.sets:
            return self
        try:
            paths = files(self.data.files, [folder, Path()])
        except DataError as error:
            raise StudyError(*(f"data.files: {line}" for line in error.args)) from None
        sets, found, lines = [], [], []
        for path, name in zip(paths, distinct(paths), strict=True):
            try:
                measurement, wrong = self.read(path), ""
            except DataError as error:
                measurement, wrong = None, "; ".join(error.args)
                lines += [f"data: {line}" for line in error.args]
            sets.append(DataSet(name=name, file=path.name, digest=digest_of(path), refused=wrong))
            found.append(measurement)
        if all(measurement is None for measurement in found):
            raise StudyError(*lines)
        data = self.data.model_copy(update={"sets": tuple(sets)})
        return self.model_copy(update={"data": data, "measurements": tuple(found)})

    @model_validator(mode="after")
    def _check(self) -> Self:
        refused(type(self).__name__, list(self._mistakes()))
        return self

    def _mistakes(self) -> Iterator[Mistake]:
        """Find mistakes common to all inversions."""
        for package in {"pcn": ("arviz",), "emcee": ("arviz", "emcee")}.get(self.method.chains or "", ()):
            if find_spec(package) is None:
                message = f"needs {package}, which is not installed: pip install {package}"
                yield ("method", "chains"), message, self.method.chains
        yield from mistakes_of_priors(self.model, self.parameters, self.correlations, lambda: self.inputs)
        yield from mistakes_of_factor(self.method.noise, "method", "noise")
        for name, value in self.data.truth.items():
            if name not in self.model.scalars:
                message = f"not a number of the model; {nearest(name, tuple(self.model.scalars))}"
                yield ("data", "truth", name), message, value
        if self.predict is not None:
            yield from named("workflows.studies.predicted:mistakes")(self)


class Inversion(InversionStudy):
    """What to invert.

    Parameters
    ----------
    model
        The specimen: body, material, inclusions or a field, load cases.
    parameters
        Priors by the paths of the unknown numbers of the specimen; none for a field of nodal values.
    correlations
        Correlations between them.
    data
        What was measured.
    method
        How it is inverted.
    parallel
        Use of ranks.
    report
        Your own sections of the report.
    predict
        What else is to be known by the posterior; by default nothing.
    """

    model: Specimen
    data: DataFiles

    quantity: ClassVar[str] = "displacement"

    @cached_property
    def specimen(self) -> Specimen:
        """The specimen, in the formulation that suits all values of its parameters."""
        specimen: Specimen = self.model.over(ranges(self.parameters))
        return specimen

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the specimen before anything is solved."""
        return (
            *self.model.findings,
            *self.model.locking(ranges(self.parameters)),
            *findings_of_materials(self.inputs),
            *self._ratios_alone(),
        )

    def _ratios_alone(self) -> Iterator[Finding]:
        """Find that no force acts or is measured: then displacements do not change if all stiffnesses are doubled."""
        pressed = any(not load.contact for case in self.model.cases for load in case.loads)
        units = self.model.measurable
        seen = [found.observations.readings for found in self.measurements if found is not None]
        names = {(self.parts[case], name) for one in seen for case, name in zip(one.case, one.names, strict=True)}
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
        yield Finding(
            "warning",
            "No force acts on the specimen or is among the data, so displacements tell ratios of stiffnesses only: "
            f"the absolute size of {sought} comes from {source}. Measure a force too (outputs of a load case).",
        )

    @cached_property
    def reduced(self) -> tuple[Reduced, ...]:
        """The reduced models that stand for the load cases; none where the specimen is asked itself.

        Raises
        ------
        pydantic.ValidationError
            If a file cannot be used.
        """
        asked = self.method.reduced
        if asked is None:
            return ()
        assert isinstance(asked.file, dict)
        digests = asked.digest if isinstance(asked.digest, dict) else {}
        made: Any = named("forward.reduced.spec:Reduced")
        return tuple(made(file=asked.file[name], digest=digests.get(name)) for name in self.parts)

    @property
    def field(self) -> bool:
        """Whether values of a field at the vertices are what is unknown."""
        return any(field.basis == "nodes" for field in self.model.fields)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in results; for a field, its mean."""
        if self.field:
            label = f"fields.{self.model.fields[0].label}.mean"
            return names_of(Inputs({label: Normal(mean=0.0, std=1.0)}), self.method)
        return super().names

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the load cases."""
        return tuple(case.name for case in self.model.cases)

    @property
    def together(self) -> bool:
        """Whether all groups of ranks work on one data set, point by point."""
        return super().together and not self.model.fields

    @property
    def specs(self) -> tuple[ModelSpec, ...]:
        """The specimen, and the same on the finer meshes that it is looked at on."""
        return self._with_finer(self.specimen)

    def measured(self, number: int) -> Components:
        """Return a data set that can be used."""
        found: Components = self.measurements[number].observations.components()
        return found

    def motion(self, number: int) -> SharedMotion | None:
        """Return the uncertain motions of a data set; None if there are none."""
        found: SharedMotion | None = self.measurements[number].motion(self.model.body)
        return found

    def labels(self, number: int) -> list[str]:
        """Say of each datum of a data set where it stands."""
        found: list[str] = self.measurements[number].observations.data_labels()
        return found

    def read(self, path: Path) -> Measurement:
        """Read a file of displacements; errors as in every inversion."""
        return read_measurement(path, self.model, self.data)

    def plan(self, rank_groups: int) -> list[str]:
        """Say what is inverted, and how long that will take."""
        found: list[str] = named("workflows.studies.inversion_plan:plan")(self)
        return found

    def stiffness(self, places: FloatArray, points: FloatArray) -> FloatArray:
        """Return ln of the factor (n, k) of the inclusions on the stiffness at places (k, 3) and parameters (n, d)."""
        return log_factor(self.model.inclusions, self.inputs.names, points, places)

    def _mistakes(self) -> Iterator[Mistake]:
        nodal = [i for i, field in enumerate(self.model.fields) if field.basis == "nodes"]
        if nodal and (len(self.model.fields) > 1 or self.parameters):
            message = "a field of nodal values is inverted alone, expected no other fields and no parameters"
            yield ("model", "fields", nodal[0], "basis"), message, "nodes"
        if nodal and self.model.fields[nodal[0]].of != "stiffness":
            yield ("model", "fields", nodal[0], "of"), "expected stiffness", self.model.fields[nodal[0]].of
        if nodal and self.method.chains == "emcee":
            yield ("method", "chains"), "expected 'pcn', the chains for fields", "emcee"
        if nodal and self.method.noise is not None and self.data.errors.kind != "normal":
            message = "the size of such errors is not inferred with a field, expected { kind = 'normal' } or no noise"
            yield ("data", "errors"), message, self.data.errors.kind
        if not self.parameters and not self.model.fields:
            yield ("parameters",), "nothing is unknown, expected at least one prior, or one of model.fields", {}
        if self.method.expansion is not None:
            message = "data sets of a specimen are observed at places of their own, expected outputs of another model"
            yield ("method", "expansion"), message, self.method.expansion
        if self.method.reduced is not None:
            yield from self._mistakes_of_reduced(self.method.reduced)
        yield from super()._mistakes()

    def _mistakes_of_reduced(self, given: ByReduced) -> Iterator[Mistake]:
        if self.field:
            message = "a field of nodal values has no reduced model, expected few parameters, or the modes of a field"
            yield ("method", "reduced"), message, given.files
            return
        if not isinstance(given.file, dict) or set(given.file) != set(self.parts):
            example = ", ".join(f'{name} = "FILE"' for name in self.parts)
            message = f"a specimen has a reduced model for each load case, expected file = {{ {example} }}"
            yield ("method", "reduced", "file"), message, given.file
            return
        try:
            found = dict(zip(self.parts, self.reduced, strict=True))
        except ValidationError as error:
            yield ("method", "reduced"), str(error.errors()[0]["msg"]), given.files
            return
        object.__setattr__(given, "digest", {name: one.digest for name, one in found.items()})
        unknown = (*self.parameters, *self.model.coefficients)
        for case in self.specimen.cases:
            body = self.specimen.loaded(case)
            known = {*body.scalars, *body.coefficients}
            for said in found[case.name].differences(body, [path for path in unknown if path in known]):
                yield ("method", "reduced", "file", case.name), said, given.file[case.name]
