"""What inversions have in common, whatever was measured: displacements of a specimen, or outputs of any model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

from pydantic import Field, model_validator
from pydantic.json_schema import SkipJsonSchema

from forward.model import Finding
from forward.registry import named
from forward.scalars import Mistake
from forward.settings import nearest
from inverse.criticism.assessment import NEEDED
from inverse.data.files import distinct, files
from inverse.data.table import DataError
from inverse.methods.invert import Invert, names_of
from uq.inputs.distributions import Distribution, Normal
from uq.inputs.random_parameters import Inputs
from workflows.config.blocks import Correlation, Parallel
from workflows.config.mistakes import StudyError, not_installed, refused
from workflows.config.predict import Predict
from workflows.config.priors import mistakes_of_factor, mistakes_of_priors
from workflows.config.report import Report
from workflows.studies.measured import DataSet, digest_of
from workflows.studies.predictions import has_mesh, meshes_of
from workflows.studies.study import StudyKind, measures_outputs

if TYPE_CHECKING:
    from forward.spec import ModelSpec
    from inverse.methods.record import Data
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from workflows.studies.job import Job

SOLVES_OF_FIELD = 12  # for a mode
OF_SPECIMEN = "workflows.studies.specimen_inversion:Inversion"
OF_OUTPUTS = "workflows.studies.output_inversion:OutputInversion"
PREDICTED = "predicted"  # name of the solves for what is predicted


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
        each = method.solves(len(self.names), field=field) + method.chain_solves(len(self.names), field=field)
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
        yield named(OF_SPECIMEN)
        yield named(OF_OUTPUTS)

    @classmethod
    def made(cls, blocks: Mapping[str, Any], folder: Path) -> InversionStudy:
        """Check the blocks of an inversion of displacements of a specimen, or of outputs of any model."""
        kind: type[InversionStudy] = named(OF_OUTPUTS if measures_outputs(blocks.get("model")) else OF_SPECIMEN)
        return kind.model_validate(blocks).with_data(folder)

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
