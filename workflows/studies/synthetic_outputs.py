"""Files of synthetic outputs: of a body, of curves over a path, of any model."""

from __future__ import annotations

import io
from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from inverse.data.curves import steps_of
from workflows.studies.synthetic import OF_TRUTH, Synthetic, head

if TYPE_CHECKING:
    import xarray as xr

    from forward.model import ForwardModel
    from forward.spec import ModelSpec
    from inverse.methods.synthesize import Synthesize
    from uq.inputs.random_parameters import Inputs


def outputs(spec: ModelSpec, method: Synthesize, inputs: Inputs, model: ForwardModel) -> Synthetic:
    """Return what is measured of the outputs of a model: each is a group, and each step of a path a point."""
    steps, m = steps_of(spec), len(spec.returned)
    n = m if steps is None else len(steps.units)
    return Synthetic(
        model, np.arange(m) % n, np.arange(m) // n, lambda found: found, partial(_files, spec, method, inputs)
    )


def _files(spec: ModelSpec, method: Synthesize, inputs: Inputs, name: str, found: xr.Dataset) -> dict[str, str]:
    """Return the texts of the files, by their names."""
    scalars = {path: scalar.value for path, scalar in spec.scalars.items()}
    stated = [path for path in scalars if path.startswith(OF_TRUTH) or path in inputs.names]
    texts = {}
    for k in range(found.sizes["data_set"]):
        one = found.isel(data_set=k)
        truth = scalars | dict(zip(map(str, found.parameter.values), one["truth"].values.tolist(), strict=True))
        file = io.StringIO()
        file.write(head(spec, method))
        file.writelines(f"# truth.{path} = {truth[path]!r}\n" for path in stated)
        file.writelines(f"{','.join(row)}\n" for row in _rows(spec, one))
        texts[f"{name if found.sizes['data_set'] == 1 else f'{name}-{k + 1}'}.csv"] = file.getvalue()
    return texts


def _rows(spec: ModelSpec, one: xr.Dataset) -> Iterator[list[str]]:
    """Go through the rows of a table: a curve for a path, else an output in each."""
    steps, values, sigma = steps_of(spec), one["values"].to_numpy(), one["sigma"].to_numpy()
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
