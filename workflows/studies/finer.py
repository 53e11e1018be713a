"""Specimens on finer meshes, as models that groups of ranks can solve."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from forward.model import FunctionModel, SolveError
from inverse.criticism.finer import Finer
from uq.evaluation.evaluate import Request

if TYPE_CHECKING:
    from forward.fem.finer import FinerMesh
    from forward.fem.specimen import SpecimenModel
    from forward.model import FloatArray, ForwardModel
    from uq.evaluation.evaluate import Evaluate

FINER = "finer mesh"  # in names of models


def finer_mesh(model: SpecimenModel) -> tuple[FinerMesh | None, str]:
    """Return a specimen on a finer mesh, or why there is none."""
    from forward.fem.finer import FinerMesh

    try:
        return FinerMesh(model), ""
    except ValueError as error:  # a mesh that is not divided, or would be too large
        return None, str(error)


def on_finer_mesh(observed: ForwardModel, outputs: Callable[[FloatArray], FloatArray]) -> ForwardModel:
    """Return a model of the observations on a finer mesh; if it cannot be made, its solves fail."""

    def solve(point: FloatArray) -> FloatArray:
        try:
            return outputs(point)
        except ValueError as error:  # as on all ranks of the group
            raise SolveError(str(error)) from None

    return FunctionModel(solve, observed.parameters, observed.outputs)


def once_on_finer_mesh(make: Callable[[], ForwardModel]) -> ForwardModel:
    """Return a model on a finer mesh of a specimen, made anew for each solve: there is one for each candidate."""
    from forward.fem.finer import FinerMesh
    from forward.fem.specimen import SpecimenModel

    specimen = make()
    assert isinstance(specimen, SpecimenModel)
    return on_finer_mesh(specimen, lambda point: FinerMesh(specimen).outputs(specimen, point))


def solved_by(evaluate: Evaluate) -> Finer:
    """Let all groups of ranks solve on a finer mesh."""

    def outputs(point: FloatArray) -> FloatArray:
        found = evaluate(Request(point[None]))
        for failure in found.failures:
            raise SolveError(failure.reason)
        return np.asarray(found.outputs[0])

    return Finer(outputs)
