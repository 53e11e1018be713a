"""Answers of the full model, held by its reduced model too: what was asked once need not be asked again."""

from __future__ import annotations

from typing import cast

import numpy as np
from mpi4py import MPI

from forward.fem.model import HyperelasticModel
from forward.hyperelastic import Hyperelastic
from forward.model import FloatArray, Solution
from forward.reduced.data import ReducedData
from forward.reduced.reduction import Reduction, Sizes, Snapshots, adjoint_states, directions


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
    answers = snapshots(model, points, data.spread)
    return Reduction(model, data.nominal, data.spread).enriched(data, answers, Sizes(cubature=cubature))


def snapshots(model: HyperelasticModel, points: FloatArray, spread: FloatArray) -> Snapshots:
    """Solve at parameters (k, d), with adjoints of all outputs and changes along parameters by about `spread` (d,)."""
    rows: list[list[FloatArray]] = [[], [], []]
    outputs = []
    for point in points:
        solution: Solution = model.solve(point)
        rows[0].append(np.asarray(solution.state)[None])
        rows[1].append(adjoint_states(model, solution))
        rows[2].append(solution.state_tangent(directions(spread, point)))
        outputs.append(np.asarray(solution.outputs))
    states, adjoints, tangents = (model.space.gather(np.vstack(part)) for part in rows)
    assert states is not None and adjoints is not None and tangents is not None  # noqa: PT018
    return Snapshots(points, states, adjoints, tangents, np.array(outputs))
