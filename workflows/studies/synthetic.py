"""What is measured of a model that synthetic data are of, and how their files begin."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import xarray as xr

    from forward.model import ForwardModel
    from forward.spec import ModelSpec
    from inverse.methods.synthesize import Synthesize

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
    labelled
        Adds to the results what else is known.
    files
        The name of the study and its results → the texts of files, by their names.
    """

    model: ForwardModel
    groups: NDArray[np.int64]
    points: NDArray[np.int64]
    labelled: Callable[[xr.Dataset], xr.Dataset]
    files: Callable[[str, xr.Dataset], dict[str, str]]


def head(model: ModelSpec, method: Synthesize) -> str:
    """Return the first line of a file: of what the data are."""
    noise = method.noise.model_dump(exclude_none=True)
    errors = f"errors {', '.join(f'{key} {value:g}' for key, value in noise.items())}, seed {method.seed}"
    body = getattr(model, "body", None)
    if body is None:
        return f"# Synthetic: {model.description}, {errors}.\n"
    return f"# Synthetic: {body.cells_in_words} cells ({body.cell}, degree {body.degree}), {errors}.\n"
