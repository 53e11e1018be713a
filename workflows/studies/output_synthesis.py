"""Studies that make synthetic outputs: of a body, of curves over a path, of any model."""

from __future__ import annotations

import io
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from forward.registry import OfKind
from forward.scalars import Mistake
from forward.spec import MODELS, ModelSpec
from inverse.data.curves import steps_of
from uq.evaluation.evaluate import Recorder
from workflows.config.priors import ranges
from workflows.studies.job import MethodJob
from workflows.studies.predictions import duration
from workflows.studies.synthesis import SynthesisStudy, head

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import NDArray

    from forward.model import Finding
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from uq.evaluation.request import Evaluate

SHARED = ("inclusions.", "material.", "regions.")  # numbers that files state in any case


class OutputSynthesis(SynthesisStudy):
    """What synthetic outputs to make.

    Errors that are relative are so to the root mean square of an output over its steps; data sets have a share of the
    steps.

    Parameters
    ----------
    model
        The model whose outputs are measured.
    parameters, correlations, method, parallel, report
        As of `SynthesisStudy`.
    """

    model: Annotated[ModelSpec, OfKind(MODELS, "hyperelastic")]

    @cached_property
    def spec(self) -> ModelSpec:
        """The model, in the form that suits all values of its parameters."""
        return self.model.over(ranges(self.parameters))

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the model before anything is solved."""
        return self.model.findings_over(ranges(self.parameters))

    @property
    def specs(self) -> tuple[ModelSpec, ...]:
        """The model."""
        return (self.spec,)

    @property
    def modules(self) -> tuple[str, ...]:
        """Modules that a user has written for the model."""
        return self.model.modules

    def plan(self, rank_groups: int) -> list[str]:
        """Say what is made, and how long that will take."""
        sets, cost = len(self.method.fraction), self.spec.cost()
        return [
            f"method      {self.method.kind}",
            *(f"{what:10}  {found}" for what, found in self.model.described(ranges(self.parameters))),
            f"outputs     {', '.join(output.name for output in self.model.returned)}",
            f"data sets   {sets}",
            *([] if cost is None else [f"time        about {duration(sets * cost.textbook)} on 1 core (rough)"]),
        ]

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> MethodJob:
        """Make the model; collective."""
        model = self.spec.build(ensemble.group, self.inputs.names)
        recorders: dict[str, Recorder] = {}

        def task(evaluate: Evaluate) -> xr.Dataset:
            recorders["/"] = Recorder(evaluate)
            return self.method.run(self.inputs, recorders["/"], *self._places)

        def texts(found: xr.Dataset) -> dict[str, str]:
            return {f"data/{file}": text for file, text in self._files(name, found).items()}

        return MethodJob(model, {}, task, recorders, lambda found: found, texts=texts)

    @property
    def _places(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Number of the output and of the step of each value (m,); without a path each value is an output."""
        steps, m = steps_of(self.model), len(self.model.returned)
        n = m if steps is None else len(steps.units)
        return np.arange(m) % n, np.arange(m) // n

    def _files(self, name: str, found: xr.Dataset) -> dict[str, str]:
        """Return the texts of the files, by their names."""
        scalars = {path: scalar.value for path, scalar in self.model.scalars.items()}
        stated = [path for path in scalars if path.startswith(SHARED) or path in self.parameters]
        texts = {}
        for k in range(found.sizes["data_set"]):
            one = found.isel(data_set=k)
            truth = scalars | dict(zip(map(str, found.parameter.values), one["truth"].values.tolist(), strict=True))
            file = io.StringIO()
            file.write(head(self))
            file.writelines(f"# truth.{path} = {truth[path]!r}\n" for path in stated)
            file.writelines(f"{','.join(row)}\n" for row in self._rows(one))
            texts[f"{name if found.sizes['data_set'] == 1 else f'{name}-{k + 1}'}.csv"] = file.getvalue()
        return texts

    def _rows(self, one: xr.Dataset) -> Iterator[list[str]]:
        """Go through the rows of a table: a curve for a path, else an output in each."""
        steps, values, sigma = steps_of(self.model), one["values"].to_numpy(), one["sigma"].to_numpy()
        if steps is None:
            yield ["output", "value", "sigma"]
            names = one["output"].values
            yield from (
                [str(name), f"{value:.8g}", f"{error:.4e}"]
                for name, value, error in zip(names, values, sigma, strict=True)
                if np.isfinite(value)
            )
            return
        yield [*steps.numbers, *steps.units, *(f"sigma_{output}" for output in steps.units)]
        along = zip(*(numbers for _, numbers in steps.numbers.values()), strict=True)
        n = len(steps.units)
        for places, row, errors in zip(along, values.reshape(-1, n), sigma.reshape(-1, n), strict=True):
            if np.isfinite(row).any():
                shown = [f"{value:.8g}" if np.isfinite(value) else "" for value in row]
                yield [*(f"{place:.10g}" for place in places), *shown, *(f"{error:.4e}" for error in errors)]

    def _mistakes(self) -> Iterator[Mistake]:
        if self.model.kind == "specimen":
            yield ("model", "kind"), "a specimen has no outputs, but displacements that are measured", self.model.kind
            return
        yield from super()._mistakes()
