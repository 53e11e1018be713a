"""Studies that invert measured outputs: of a body, of a Python function, of a model behind a server."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Self, cast

from pydantic import Field, ValidationError, model_validator

from forward.model import ForwardModel, ModelError
from forward.registry import OfKind, named
from forward.scalars import Mistake
from forward.settings import Settings, nearest
from forward.spec import MODELS, ModelSpec
from inverse.data.curves import steps_of
from inverse.data.errors import NORMAL, Errors
from inverse.data.outputs import OutputData, read_outputs, stated
from inverse.data.table import DataError
from inverse.methods.invert import ByReduced
from workflows.config.mistakes import StudyError
from workflows.config.priors import findings_of_materials, ranges
from workflows.studies.inversion import InversionStudy
from workflows.studies.measured import DataSet, FileNames, check_signs
from workflows.studies.predictions import never_estimable
from workflows.studies.study import Sampled

if TYPE_CHECKING:
    from forward.hyperelastic import Hyperelastic
    from forward.model import Finding
    from forward.reduced.spec import Reduced

STATED = "outputs"  # name of the data set given in the study itself
Positive = Annotated[float, Field(gt=0)]


class OutputNoise(Settings):
    """Errors of measured outputs: normal, of standard deviation max(relative |value|, absolute).

    Parameters
    ----------
    relative
        In proportion to the value.
    absolute
        In the unit of the output.
    """

    relative: Annotated[float, Field(ge=0)] = 0.0
    absolute: Annotated[float, Field(ge=0)] = 0.0


class MeasuredOutputs(Settings):
    """Measured outputs of the model, in tables or in the study itself.

    Parameters
    ----------
    files
        Tables with the columns output, value and, where it is known, sigma: names of files, folders, or patterns such
        as ``data/*.csv``, beside the study or else in the working directory. Each file is a data set and is inverted
        separately.
    outputs
        Instead of files: measurements by output, a number or a list of repeated measurements.
    sigma
        Standard deviations of the errors by output, if a table does not state them.
    noise
        Errors of the other outputs: { relative = 0.05 }, { absolute = 1e-4 } or both.
    errors
        Their distribution: { kind = "normal" }, or { kind = "student-t", degrees = 4 } if a few data may be outliers.
    truth
        By path: the numbers from which the data were made, if known.
    sets
        The files as they were when the study ran; written by the run.
    """

    files: FileNames = ()
    outputs: dict[str, float | Annotated[tuple[float, ...], Field(min_length=1)]] = Field(default={})
    sigma: dict[str, Positive] = Field(default={})
    noise: OutputNoise = OutputNoise()
    errors: Errors = NORMAL
    truth: dict[str, float] = Field(default={})
    sets: tuple[DataSet, ...] = ()

    @model_validator(mode="after")
    def _check(self) -> MeasuredOutputs:
        if bool(self.files) == bool(self.outputs):
            message = "expected either files or outputs"
            raise ValueError(message)
        return self


class OutputInversion(InversionStudy):
    """What to invert.

    Parameters
    ----------
    model
        A model with outputs, of which some were measured.
    parameters
        Priors by the paths of the unknown numbers of the model.
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

    model: Annotated[ModelSpec, OfKind(MODELS, "hyperelastic")]
    data: MeasuredOutputs

    quantity: ClassVar[str] = "output"

    @cached_property
    def spec(self) -> ModelSpec:
        """The model, in the form that suits all values of its parameters."""
        return self.model.over(ranges(self.parameters))

    @cached_property
    def reduced(self) -> Reduced | None:
        """The reduced model that stands for the body.

        Raises
        ------
        pydantic.ValidationError
            If its file cannot be used.
        """
        asked = self.method.reduced
        if asked is None:
            return None
        made: Reduced = named("forward.reduced.spec:Reduced")(file=asked.file, digest=asked.digest)
        return made

    @property
    def sampled(self) -> Sampled:
        """The model with its priors."""
        return Sampled(self.inputs, self.spec)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the model before anything is solved."""
        reach = ranges(self.parameters)
        reduced = () if self.reduced is None else self.reduced.outside(reach)
        return (*self.model.findings_over(reach), *findings_of_materials(self.inputs), *reduced)

    @property
    def meshes(self) -> tuple[ModelSpec, ...]:
        """The model: there are no others."""
        return (self.spec,)

    @property
    def specs(self) -> tuple[ModelSpec, ...]:
        """The model, and the same on the finer meshes that it is looked at on."""
        return self._with_finer(self.spec)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs of the model."""
        return tuple(output.name for output in self.model.returned)

    @property
    def parts(self) -> tuple[str, ...]:
        """Outputs of which there are data, in the order of the model."""
        return next((found.parts for found in self.measurements if found is not None), ())

    def measured(self, number: int) -> OutputData:
        """Return a data set that can be used."""
        found: OutputData = self.measurements[number]
        return found

    def labels(self, number: int) -> list[str]:
        """Say of each datum of a data set where it stands."""
        return self.measured(number).data_labels()

    def not_estimable(self, number: int) -> tuple[str, ...]:
        """Names of the measured outputs of a body whose error of the mesh nothing tells."""
        return never_estimable(self.model, self.measured(number).names)

    def plan(self, rank_groups: int) -> list[str]:
        """Say what is inverted, and how long that will take."""
        found: list[str] = named("workflows.studies.inversion_plan:plan_of_outputs")(self)
        return found

    def read(self, path: Path) -> OutputData:
        """Read a table of outputs; errors as in every inversion."""
        return self._with_errors(read_outputs(path, self.outputs, steps_of(self.model)))

    def _with_errors(self, found: OutputData) -> OutputData:
        check_signs(found, self.model)
        noise = self.data.noise
        return found.with_sigma(self.data.sigma, noise.relative, noise.absolute).with_truth(self.data.truth)

    def with_data(self, folder: Path) -> Self:
        """Return the same with its data read; errors as of every inversion."""
        if self.data.sets:
            return self
        if self.data.files:
            read = super().with_data(folder)
        else:
            try:
                found = self._with_errors(stated(self.data.outputs))
            except DataError as error:
                raise StudyError(*(f"data: {line}" for line in error.args)) from None
            data = self.data.model_copy(update={"sets": (DataSet(name=STATED, file=""),)})
            read = self.model_copy(update={"data": data, "measurements": (found,)})
        seen = {name for one in read.measurements if one is not None for name in one.names}
        parts = tuple(name for name in self.outputs if name in seen)
        of_model = tuple(None if one is None else one.of(self.outputs, parts) for one in read.measurements)
        return read.model_copy(update={"measurements": of_model})

    def _mistakes(self) -> Iterator[Mistake]:
        if self.model.kind == "specimen":
            yield ("model", "kind"), "a specimen has no outputs, but displacements that are measured", self.model.kind
            return
        yield from self.model.mistakes_of_mesh()
        for i, field in enumerate(getattr(self.spec, "fields", ())):
            if field.basis == "nodes":
                message = "values at the vertices are inverted with the displacements of a specimen, expected 'modes'"
                yield ("model", "fields", i, "basis"), message, field.basis
        if self.parallel.ranks_per_model > 1 and not self.spec.shareable:
            message = f"a model of kind '{self.model.kind}' is not shared by ranks, expected 1"
            yield ("parallel", "ranks_per_model"), message, self.parallel.ranks_per_model
        if self.method.reduced is not None:
            yield from self._mistakes_of_reduced(self.method.reduced)
        if not self.parameters and not self.model.coefficients:
            yield ("parameters",), "nothing is unknown, expected at least one prior", {}
        for block, names in (("outputs", self.data.outputs), ("sigma", self.data.sigma)):
            for name in names:
                if name not in self.outputs:
                    message = f"not an output of the model; {nearest(name, self.outputs)}"
                    yield ("data", block, name), message, name
        yield from super()._mistakes()

    def _mistakes_of_reduced(self, reduced: ByReduced) -> Iterator[Mistake]:
        if self.method.expansion is not None:
            message = "stands for the body in place of a reduced model, expected one of both"
            yield ("method", "expansion"), message, self.method.expansion
        if not isinstance(reduced.file, str):
            yield ("method", "reduced", "file"), "a body has one reduced model, expected a file", reduced.files
            return
        if self.model.kind != "hyperelastic":
            message = f"a reduced model stands for a body, expected kind 'hyperelastic', not '{self.model.kind}'"
            yield ("method", "reduced"), message, reduced.file
            return
        unknown = (*self.parameters, *self.model.coefficients)
        try:
            found = self.reduced
        except ValidationError as error:
            yield ("method", "reduced"), str(error.errors()[0]["msg"]), reduced.file
            return
        assert found is not None
        object.__setattr__(reduced, "digest", found.digest)
        for said in found.differences(cast("Hyperelastic", self.spec), unknown):
            yield ("method", "reduced"), said, reduced.file


def derivable(model: ForwardModel, kind: str) -> None:
    """Refuse a model without derivatives.

    Raises
    ------
    ModelError
        If it has none.
    """
    if not model.differentiable:
        message = (
            f"this model of kind '{kind}' has no derivatives, without which the most probable parameters are not "
            "found: expected a jacobian of the Python function, or a server that has ApplyJacobian or Gradient"
        )
        raise ModelError(message)
