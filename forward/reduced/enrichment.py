"""Answers of the full model, held by its reduced model too: what was asked once need not be asked again."""

from __future__ import annotations

from typing import cast

from mpi4py import MPI

from forward.fem.model import HyperelasticModel
from forward.hyperelastic import Hyperelastic
from forward.model import FloatArray
from forward.reduced.data import ReducedData
from forward.reduced.reduction import Reduction, Sizes
from forward.reduced.snapshots import solved


def enriched(data: ReducedData, points: FloatArray, cubature: float = 1e-3) -> ReducedData:
    """Solve the full model at parameters (k, d), and return a reduced model that holds these too.

    Such points are where a reduced model with a tolerance has asked the full one (`ReducedModel.asked`).

    Parameters
    ----------
    data
        The reduced model; it stays as it is.
    points
        All its parameters (k, d) at each of the solutions.
    cubature
        What the points may miss of the forces, relative.

    Raises
    ------
    SolveError
        Where the full model has no answer.
    """
    model = cast("HyperelasticModel", Hyperelastic.model_validate(data.spec).build(MPI.COMM_SELF, data.parameters))
    answers = solved(model, points, data.spread)
    return Reduction(model, data.nominal, data.spread).enriched(data, answers, Sizes(cubature=cubature))
