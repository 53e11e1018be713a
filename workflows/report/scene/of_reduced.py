"""An expansion of a reduced model: many of its cheap solves, for sliders where a study has no expansion of its own."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.reduced.data import load
from forward.reduced.model import ReducedModel
from forward.reduced.spec import Reduced
from uq.evaluation.evaluate import SerialEvaluate
from uq.methods.chaos import Chaos
from workflows.results.directory import label, with_regions

if TYPE_CHECKING:
    import xarray as xr

SOLVES = 128  # with derivatives: some seconds of processor time


def expanded(file: Path, study: Any, *, alone: bool = False) -> xr.Dataset:
    """Return the expansion of a reduced model over the inputs of a study, with its mesh, as `chaos` returns one.

    `own_error` (output,) is the root mean square error of the model itself on samples that it was not made of; NaN if
    none were solved. `alone` takes the larger model.

    Raises
    ------
    SolveError
        If the model has no answer at the means, or at too many samples.
    """
    data, inputs = load(file), study.inputs
    model = ReducedModel(data, inputs.names, alone=alone, tested=False)
    found = Chaos(samples=SOLVES, quantiles=()).run(inputs, SerialEvaluate(model))
    units = {output.name: output.unit for output in data.outputs}
    found = label(found, units, model.space.coordinates, *model.space.cells())
    found = with_regions(found, model.spec.body.regions, model.space.regions())
    own = Reduced(file=str(file)).errors
    left = data.about.get("error of the state")
    itself = "" if left is None else f", which itself errs by {100 * left:.2g} % of the displacements"
    found.attrs["source"] = f"The expansion was fitted to {SOLVES} solves of the reduced model{itself}."
    return found.assign(own_error=("output", [own.get(str(name), np.nan) for name in found["output"].to_numpy()]))
