"""What is measured of a model that synthetic data are of, and their files: how they begin, and tables of outputs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from inverse.data.curves import steps_of

if TYPE_CHECKING:
    import xarray as xr

    from forward.spec import ModelSpec
    from inverse.methods.synthesize import Synthesize
    from uq.inputs.random_parameters import Inputs

OF_TRUTH = ("inclusions.", "material.", "regions.")  # numbers that files state in any case


class Synthetic(NamedTuple):
    """What is measured of a model.

    Attributes
    ----------
    model
        The model.
    groups
        Number (m,) of the group of each output, whose root mean square relative errors are shares of.
    points
        Number (m,) of the point, or step, of each output; -1 of those that every data set has.
    files
        The name of a data set, its results, what is true by path, and the first lines of a table → the texts of files,
        by their names.
    labelled
        Adds to the results what else is known.
    """

    model: Any
    groups: NDArray[np.int64]
    points: NDArray[np.int64]
    files: Callable[[str, xr.Dataset, dict[str, float], str], dict[str, str]]
    labelled: Callable[[xr.Dataset], xr.Dataset] = lambda found: found


def files_of(
    made: Synthetic, spec: ModelSpec, method: Synthesize, inputs: Inputs, name: str, found: xr.Dataset
) -> dict[str, str]:
    """Return the texts of the files of all data sets, by their names."""
    scalars = {path: scalar.value for path, scalar in spec.scalars.items()}
    stated = [path for path in scalars if path.startswith(OF_TRUTH) or path in inputs.names]
    texts: dict[str, str] = {}
    count = found.sizes["data_set"]
    for k in range(count):
        one = found.isel(data_set=k)
        every = scalars | dict(zip(map(str, found.parameter.values), one["truth"].values.tolist(), strict=True))
        truth = {path: every[path] for path in stated}
        lines = (f"# truth.{path} = {value!r}\n" for path, value in truth.items())
        label = name if count == 1 else f"{name}-{k + 1}"
        texts |= made.files(label, one, truth, "".join([_head(spec, method), *lines]))
    return texts


def _head(model: ModelSpec, method: Synthesize) -> str:
    """Return the first line of a file: of what the data are."""
    noise = method.noise.model_dump(exclude_none=True)
    errors = f"errors {', '.join(f'{key} {value:g}' for key, value in noise.items())}, seed {method.seed}"
    if len(model.bodies) != 1:
        return f"# Synthetic: {model.description}, {errors}.\n"
    body = model.bodies[0].body
    return f"# Synthetic: {body.cells_in_words} cells ({body.cell}, degree {body.degree}), {errors}.\n"


def outputs(spec: ModelSpec, model: Any) -> Synthetic:
    """Return what is measured of the outputs of a model: each is a group, and each step of a path a point."""
    steps, m = steps_of(spec), len(spec.returned)
    n = m if steps is None else len(steps.units)

    def files(label: str, one: xr.Dataset, truth: dict[str, float], head: str) -> dict[str, str]:
        return {f"{label}.csv": head + "".join(f"{','.join(row)}\n" for row in _rows(spec, one))}

    return Synthetic(model, np.arange(m) % n, np.arange(m) // n, files)


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
