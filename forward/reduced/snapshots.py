"""Solutions of a body from which its reduced model is made."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from forward.fem.model import HyperelasticModel
from forward.model import FloatArray, Solution

DIRECTIONS = 16  # parameters up to which states are differentiated by each of them
FEW = 6  # random directions otherwise


class Snapshots(NamedTuple):
    """Solutions of the full model, in canonical order.

    Attributes
    ----------
    parameters
        Where (s, d).
    states
        States (s, U).
    adjoints
        K⁻ᵀ ∂ψ/∂u (k, U) of outputs there.
    tangents
        Changes (k, U) of the states along the parameters, by about one standard deviation of these.
    outputs
        Outputs (s, m).
    """

    parameters: FloatArray
    states: FloatArray
    adjoints: FloatArray
    tangents: FloatArray
    outputs: FloatArray

    def with_others(self, others: Snapshots) -> Snapshots:
        """Return these and others."""
        return Snapshots(*map(np.concatenate, zip(self, others, strict=True)))


def solved(model: HyperelasticModel, points: FloatArray, spread: FloatArray) -> Snapshots:
    """Solve at parameters (k, d), with adjoints of all outputs and changes along parameters by about `spread` (d,).

    Raises
    ------
    SolveError
        Where the full model has no answer.
    """
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


def adjoint_states(model: HyperelasticModel, solution: Any) -> FloatArray:
    """Return K⁻ᵀ ∂ψ/∂u (m, U_local) of all outputs at a solution; collective."""
    loads = np.array(solution.loads(np.eye(len(model.outputs))))
    loads[:, model.equations.fixed] = 0
    return np.asarray(solution.solve(loads, transpose=True))


def directions(spread: FloatArray, point: FloatArray) -> FloatArray:
    """Return the directions (k, d) along which states are differentiated at a point (d,).

    Those of all parameters if they are few, otherwise a few random ones that depend on the point.
    """
    if len(spread) <= DIRECTIONS:
        return np.diag(spread)
    seed = np.frombuffer(np.ascontiguousarray(point).tobytes(), dtype=np.uint32)
    return np.asarray(np.random.default_rng(seed).standard_normal((FEW, len(spread))) * spread)
