"""Measured outputs by which models are compared: bodies, Python functions, models behind servers."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import Field, model_validator

from forward.combine import selected
from forward.scalars import Mistake
from forward.settings import Settings
from forward.spec import ModelSpec
from forward.words import named
from inverse.criticism.comparison import Data
from inverse.data.curves import steps_of
from inverse.data.outputs import read_outputs, stated
from inverse.data.table import DataError
from inverse.methods.invert import derivable
from workflows.config.mistakes import StudyError
from workflows.studies.measured import Positive
from workflows.studies.measured_outputs import check_signs
from workflows.studies.predictions import never_estimable

if TYPE_CHECKING:
    from forward.model import ForwardModel


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
                stated(self.outputs, outputs)
                if self.file is None
                else read_outputs(folder / self.file, outputs, steps_of(spec))
            )
            check_signs(found, spec)
        except DataError as error:
            raise StudyError(*(f"data: {line}" for line in error.args)) from None
        sigma = found.with_sigma(np.array([self.sigma.get(name, np.nan) for name in found.names])).sigma
        truth = [f"truth: {name} = {value!r}" for name, value in found.truth.items()]
        return {
            "names": found.names.tolist(),
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

    quantity: ClassVar[str] = "output"
    in_file: ClassVar[type[Settings]] = OutputFile

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

    @property
    def tests(self) -> tuple[str, ...]:
        """Names of the outputs that were measured."""
        return tuple(dict.fromkeys(self.names))

    @property
    def data(self) -> Data:
        """What is compared; outputs are tests, whose data are told apart by their number."""
        at = np.array([float(self.names[:k].count(name)) for k, name in enumerate(self.names)])
        kinds = np.array([self.tests.index(name) for name in self.names])
        sigma = None if self.sigma is None else np.array(self.sigma)
        return Data(np.array(self.measured), sigma, self.names, at, np.zeros((len(self.names), 1)), kinds)

    def measured_in(self, test: str, spec: ModelSpec) -> str:
        """Name an output with its unit, which is that of a model."""
        return next(named(output.name, output.unit) for output in spec.returned if output.name == test)

    def observed(self, spec: ModelSpec, model: ForwardModel) -> ForwardModel:
        """Return a model restricted to what was measured."""
        derivable(model, spec.kind)
        return selected(model, tuple(model.outputs.index(output) for output in self.names))

    def shared(self, spec: ModelSpec) -> None:
        """Return None: errors of outputs are independent."""
        return

    def not_estimable(self, spec: ModelSpec) -> tuple[str, ...]:
        """Names of outputs whose error of the mesh nothing tells."""
        return never_estimable(spec, self.names)

    def unobserved(self, spec: ModelSpec) -> Iterator[Mistake]:
        """Find outputs of the data that a model does not have."""
        known = tuple(output.name for output in spec.returned)
        strange = next((output for output in self.names if output not in known), None)
        if strange is not None:
            yield ("outputs",), f"no output '{strange}', of which there are data", list(known)
