"""A study that compares models by measured outputs: bodies, Python functions, models behind servers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import Field, TypeAdapter, model_validator

from forward.model import Finding
from forward.registry import OfKind
from forward.scalars import Mistake
from forward.settings import Settings
from forward.spec import MODELS, ModelSpec
from forward.words import named
from inverse.criticism.comparison import Data
from inverse.criticism.doubts_of_meshes import not_estimable
from inverse.data.curves import steps_of
from inverse.data.measured_model import MeasuredModel
from inverse.data.outputs import read_outputs, stated
from inverse.data.table import DataError
from workflows.config.mistakes import StudyError
from workflows.studies.inversion_plan import derivable
from workflows.studies.material_tests import WHOLE
from workflows.studies.measured import check_signs
from workflows.studies.model_selection import ModelSelection, Positive
from workflows.studies.predictions import never_estimable

if TYPE_CHECKING:
    from forward.model import ForwardModel

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

    def read(self, folder: Path, spec: ModelSpec) -> dict[str, Any]:
        """Return the block `data` with the outputs themselves.

        Raises
        ------
        StudyError
            If the file cannot be used.
        """
        outputs = tuple(output.name for output in spec.returned)
        try:
            found = (
                stated(self.outputs) if self.file is None else read_outputs(folder / self.file, outputs, steps_of(spec))
            )
            check_signs(found, spec)
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


class OutputSelection(ModelSelection):
    """What to compare: any models, by their outputs.

    Parameters
    ----------
    model, candidates, method, parallel, report
        As of `ModelSelection`.
    data
        Outputs that were measured.
    """

    data: ListedOutputs

    data_in_file: ClassVar[type[Settings] | None] = OutputFile
    listed_by: ClassVar[str] = "names"
    quantity: ClassVar[str] = "output"

    @classmethod
    def spec_of(cls, block: Mapping[str, Any]) -> ModelSpec:
        """Return the model that a block describes; errors as of every comparison."""
        return _SPEC.validate_python(dict(block))

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings before anything is solved, of measured outputs too whose error of the mesh nothing tells."""
        never = (never_estimable(spec, self.data.names) for spec in self.of_candidates.values())
        names = tuple(dict.fromkeys(name for several in never for name in several))
        if not names or not self.unchecked:
            return super().findings
        doubts = not_estimable(names)
        return *super().findings, *(Finding(one.severity, f"{one.text[0].upper()}{one.text[1:]}.") for one in doubts)

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

    def measured_in(self, test: str) -> str:
        """Name an output with its unit, which is that of the first candidate."""
        outputs = next(iter(self.of_candidates.values())).returned
        return next(named(output.name, output.unit) for output in outputs if output.name == test)

    def described(self, name: str) -> str:
        """A candidate in words."""
        return self.of_candidates[name].description

    def build(self, name: str, group: str, comm: Any = None) -> ForwardModel:
        """Make the model of a candidate; collective."""
        spec = self.of_candidates[name]
        model = spec.build(comm, tuple(self.candidates[name].parameters))
        derivable(model, spec.kind)
        return MeasuredModel(model, tuple(model.outputs.index(output) for output in self.data.names))

    def unobserved(self, spec: ModelSpec) -> Iterator[Mistake]:
        """Find outputs of the data that a candidate does not have."""
        known = tuple(output.name for output in spec.returned)
        strange = next((output for output in self.data.names if output not in known), None)
        if strange is not None:
            yield ("outputs",), f"no output '{strange}', of which there are data", list(known)
