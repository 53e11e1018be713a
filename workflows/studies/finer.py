"""Models on finer meshes, as inversions and selections look at them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.combine import Rows
from forward.model import SolveError
from forward.settings import one_line
from inverse.criticism.finer import Finer, Solved
from uq.evaluation.request import Request

if TYPE_CHECKING:
    from forward.fem.finer import FinerMeshes
    from forward.model import FloatArray, ForwardModel
    from uq.evaluation.request import Evaluate

FINER = "finer mesh"  # in names of models


def finer_meshes(model: Any, start: FloatArray) -> tuple[FinerMeshes | None, str]:
    """Return a body on finer meshes, which are first solved on at `start` (d,), or why there are none."""
    from forward.fem.finer import extrapolated

    try:
        return extrapolated(model, start), ""
    except ValueError as error:  # a mesh that is not divided, or would be too large
        return None, one_line(str(error))


def once_on_finer_meshes(make: Callable[[], ForwardModel], start: FloatArray) -> ForwardModel:
    """Return the model on finer meshes of a specimen, or of the measured outputs of a body."""
    from forward.fem.finer import extrapolated

    own = make()
    body: Any = own.model if isinstance(own, Rows) else own
    return extrapolated(body, start).of(own)


def solved_on(model: ForwardModel) -> Finer:
    """Let this group of ranks solve on finer meshes."""

    def solve(point: FloatArray, tangents: bool) -> Solved:
        found = model.solve(point)
        slopes = found.tangent(np.eye(len(point))).T if tangents else None
        return np.asarray(found.outputs), slopes

    return Finer(solve)


def solved_by(evaluate: Evaluate) -> Finer:
    """Let all groups of ranks solve on finer meshes."""

    def solve(point: FloatArray, tangents: bool) -> Solved:
        found = evaluate(Request(point[None], tangents=tangents))
        for failure in found.failures:
            raise SolveError(failure.reason)
        return np.asarray(found.outputs[0]), None if found.tangents is None else found.tangents[0]

    return Finer(solve)
