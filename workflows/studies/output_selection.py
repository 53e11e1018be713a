"""A study that compares models by measured outputs: bodies, Python functions, models behind servers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError, model_validator

from forward.registry import OfKind
from forward.scalars import Mistake
from forward.settings import Settings, one_line
from forward.spec import MODELS, ModelSpec
from inverse.criticism.comparison import Candidate, Data
from inverse.data.measured_model import MeasuredModel
from inverse.data.observations import DataError
from inverse.data.outputs import read_outputs, stated
from inverse.methods.selection import SelectSpecimens
from uq.inputs.random_parameters import Inputs
from workflows.config.blocks import Parallel
from workflows.config.mistakes import StudyError, lines, refused
from workflows.config.priors import mistakes_of_materials, mistakes_of_parameters, ranges
from workflows.config.report import Report
from workflows.studies.material_tests import WHOLE
from workflows.studies.output_inversion import derivable
from workflows.studies.selection import Comparison
from workflows.studies.specimen_selection import SpecimenCandidate, changed

if TYPE_CHECKING:
    from forward.model import Finding, ForwardModel

Positive = Annotated[float, Field(gt=0)]
SECONDS = 1e-3  # of a solve about which nothing is known
_SPEC: TypeAdapter[ModelSpec] = TypeAdapter(Annotated[ModelSpec, OfKind(MODELS, "hyperelastic")])


class OutputFile(Settings):
    """Measured outputs, in a table or stated by name.

    Parameters
    ----------
    file
        A table with the columns output, value and, where it is known, sigma, beside the study.
    outputs
        Instead of a file: measurements by output, a number or a list of repeated measurements.
    sigma
        Standard deviations of the errors by output, if the table does not state them.
    """

    file: str | None = None
    outputs: dict[str, float | Annotated[tuple[float, ...], Field(min_length=1)]] = Field(default={})
    sigma: dict[str, Positive] = Field(default={})

    @model_validator(mode="after")
    def _check(self) -> OutputFile:
        if (self.file is None) == (not self.outputs):
            message = "expected either a file or outputs"
            raise ValueError(message)
        return self

    def read(self, folder: Path, outputs: tuple[str, ...]) -> dict[str, Any]:
        """Return the block `data` with the outputs themselves.

        Raises
        ------
        StudyError
            If the file cannot be used.
        """
        try:
            found = stated(self.outputs) if self.file is None else read_outputs(folder / self.file, outputs)
        except DataError as error:
            raise StudyError(*(f"data: {line}" for line in error.args)) from None
        given = np.array([self.sigma.get(name, np.nan) for name in found.names])
        sigma = np.where(np.isnan(found.sigma), given, found.sigma)
        truth = [f"truth: {name} = {value!r}" for name, value in found.truth.items()]
        return {
            "names": list(found.names),
            "measured": found.values.tolist(),
            "source": [*found.source, *truth],
            **({"sigma": sigma.tolist()} if np.isfinite(sigma).all() else {}),
        }


class ListedOutputs(Settings):
    """What was measured, value by value.

    Parameters
    ----------
    names
        Output to which each value belongs.
    measured
        The values, in the units of the outputs.
    sigma
        Standard deviations of their errors, where they are known.
    source
        Their source, line by line.
    """

    names: tuple[str, ...] = Field(min_length=1)
    measured: tuple[float, ...]
    sigma: tuple[Positive, ...] | None = None
    source: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _check_sizes(self) -> ListedOutputs:
        for name in ("measured", "sigma"):
            values = getattr(self, name)
            if values is not None and len(values) != len(self.names):
                message = f"{name}: {len(values)} values, expected as many as names: {len(self.names)}"
                raise ValueError(message)
        return self


class OutputCandidate(SpecimenCandidate):
    """A model that may be the right one, with its prior: what it changes of the model, and its random parameters."""

    def restricted(self, spec: ModelSpec) -> Inputs:
        """The random parameters, restricted to those that make materials, where there are some."""
        materials = spec.materials(self.inputs.names)
        return self.inputs if materials is None else self.inputs.within(materials)


class OutputSelection(Comparison):
    """What to compare.

    Parameters
    ----------
    model
        The model, as far as the candidates have it in common.
    data
        Outputs that were measured.
    candidates
        Models by name.
    method
        How the candidates are compared.
    parallel
        Use of ranks.
    report
        Your own sections of the report.
    """

    model: dict[str, Any]
    data: ListedOutputs
    candidates: dict[str, OutputCandidate] = Field(min_length=1)
    method: SelectSpecimens
    parallel: Parallel = Parallel()
    report: Report | None = None

    quantity: ClassVar[str] = "output"
    costly: ClassVar[bool] = True

    @cached_property
    def of_candidates(self) -> dict[str, ModelSpec]:
        """The model of each candidate, in the form that suits all values of its parameters."""
        return {
            name: spec_of(changed(self.model, one.model)).over(ranges(one.parameters))
            for name, one in self.candidates.items()
        }

    @property
    def specs(self) -> tuple[ModelSpec, ...]:
        """The models of all candidates."""
        return tuple(self.of_candidates.values())

    @property
    def modules(self) -> tuple[str, ...]:
        """Modules that a user has written for them."""
        return tuple(dict.fromkeys(module for spec in self.specs for module in spec.modules))

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the models before anything is solved, each once."""
        of_models = (
            finding
            for name, one in self.of_candidates.items()
            for finding in one.findings_over(ranges(self.candidates[name].parameters))
        )
        return tuple(dict.fromkeys([*of_models, *super().findings]))

    @cached_property
    def unchecked(self) -> dict[str, str]:
        """Why each candidate is not checked on a finer mesh, empty if it is; None if there are no meshes."""
        if not any(spec.meshed for spec in self.of_candidates.values()):
            return {}
        return {name: self._unchecked(spec) for name, spec in self.of_candidates.items()}

    def _unchecked(self, spec: ModelSpec) -> str:
        if not self.method.mesh_check:
            return "method.mesh_check = false"
        try:
            spec.refined(1)
        except ValueError as error:  # without a mesh, with one that is not divided, or that would be too large
            return one_line(str(error))
        return ""

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
        return self.data.source

    @property
    def group_names(self) -> tuple[str, ...]:
        """Names of the groups: there is one."""
        return (WHOLE,)

    @property
    def data_groups(self) -> dict[str, Data]:
        """Data by group; outputs are tests, whose data are told apart by their number."""
        names = self.data.names
        at = np.array([float(names[:k].count(name)) for k, name in enumerate(names)])
        kinds = np.array([self.tests(WHOLE).index(name) for name in names])
        sigma = None if self.data.sigma is None else np.array(self.data.sigma)
        return {WHOLE: Data(np.array(self.data.measured), sigma, names, at, np.zeros((len(names), 1)), kinds)}

    def tests(self, group: str) -> tuple[str, ...]:
        """Names of the outputs that were measured."""
        return tuple(dict.fromkeys(self.data.names))

    @property
    def seconds_of_solves(self) -> float:
        """Processor time of all solves and their derivatives, roughly."""
        seconds = 0.0
        for name, spec in self.of_candidates.items():
            cost, d = spec.cost(), len(self.candidates[name].parameters)
            each = SECONDS if cost is None else cost.sample + cost.tangents_of_sample(d)
            seconds += (self.searches(name) + self.method.samples) * each
        return seconds * self.evidences / len(self.of_candidates)

    def described(self, name: str) -> str:
        """A candidate in words."""
        return self.of_candidates[name].description

    def build(self, name: str, group: str, comm: Any = None) -> ForwardModel:
        """Make the model of a candidate; collective."""
        return self._measured(name, self.of_candidates[name], comm)

    def build_finer(self, name: str, make: Callable[[], ForwardModel], comm: Any = None) -> ForwardModel:
        """Make the same on a mesh with halved cells; collective."""
        return self._measured(name, self.of_candidates[name].refined(1), comm)

    def _measured(self, name: str, spec: ModelSpec, comm: Any) -> ForwardModel:
        model = spec.build(comm, tuple(self.candidates[name].parameters))
        derivable(model, spec.kind)
        return MeasuredModel(model, tuple(model.outputs.index(output) for output in self.data.names))

    @model_validator(mode="after")
    def _check(self) -> OutputSelection:
        refused("OutputSelection", list(self._mistakes()))
        return self

    def _mistakes(self) -> Iterator[Mistake]:
        for name, candidate in self.candidates.items():
            place = ("candidates", name)
            try:
                spec = spec_of(changed(self.model, candidate.model))
            except ValidationError as error:
                for line in error.errors(include_url=False):
                    yield (*place, "model", *line["loc"]), line["msg"], line["input"]
                return
            for where, message, given in _of_candidate(spec, candidate):
                yield (*place, *where), message, given
            if spec.coefficients:
                message = "random fields, expected numbers only: evidences are of few parameters"
                yield (*place, "model", "fields"), message, len(spec.coefficients)
            known = tuple(output.name for output in spec.outputs)
            strange = next((output for output in self.data.names if output not in known), None)
            if strange is not None:
                yield (*place, "model", "outputs"), f"no output '{strange}', of which there are data", list(known)
            if self.parallel.ranks_per_model > 1 and not spec.shareable:
                message = f"a model of kind '{spec.kind}' is not shared by ranks, expected 1"
                yield ("parallel", "ranks_per_model"), message, self.parallel.ranks_per_model
        yield from self.mistakes_of_method()


def spec_of(block: Mapping[str, Any]) -> ModelSpec:
    """Return the model that a block describes.

    Raises
    ------
    pydantic.ValidationError
        For mistakes in it.
    """
    return _SPEC.validate_python(dict(block))


def _of_candidate(spec: ModelSpec, candidate: OutputCandidate) -> Iterator[Mistake]:
    materials = spec.materials(candidate.parameters)
    constants = () if materials is None else materials.names
    yield from mistakes_of_parameters(spec.scalars, candidate.parameters, constants)
    if materials is not None and all(path in spec.scalars for path in candidate.parameters):
        with suppress(ValueError):  # correlations, which are reported elsewhere
            yield from mistakes_of_materials(candidate.restricted(spec), materials)


def expanded(blocks: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return blocks of a study whose outputs, from a table or stated by name, are listed.

    Raises
    ------
    StudyError
        If that cannot be done.
    """
    data, candidates = blocks.get("data"), blocks.get("candidates")
    if not isinstance(data, Mapping) or "names" in data or not isinstance(candidates, Mapping) or not candidates:
        return dict(blocks)
    try:
        file = OutputFile.model_validate(dict(data))
    except ValidationError as error:
        raise StudyError(*lines(error, "data")) from None
    name, first = next(iter(candidates.items()))
    changes = first.get("model", {}) if isinstance(first, Mapping) else {}
    try:
        spec = spec_of(changed(blocks["model"], changes))
    except ValidationError as error:
        raise StudyError(*lines(error, f"candidates.{name}.model")) from None
    return {**blocks, "data": file.read(folder, tuple(output.name for output in spec.outputs))}
