"""Candidates for a field of thousands of values: rows of A in the span of the directions that they tell together.

All candidates together tell AᵀA ≈ UΛUᵀ (`inverse.fields.low_rank`); the row of a candidate in the coordinates U is a
column of AU, which the search for the pairs has formed anyway. A set S of candidates has A_SᵀA_S ≤ AᵀA, so that what is
left out of the rows, A⊥, adds at most ½ tr((I + AAᵀ)⁻¹A⊥A⊥ᵀ) to what S tells, which a few random probes z estimate by
A⊥z (M. F. Hutchinson, Comm. Statist. Simulation Comput. 19 (1990) 433–450). No row of A itself is needed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray, Solution
from inverse.data.noise import Noise
from inverse.fields.field_posterior import FieldPosterior, Point, Prior
from inverse.fields.low_rank import leading_pairs

if TYPE_CHECKING:
    import xarray as xr

    from forward.model import ForwardModel

PROBES = 16


def left_out(rows: FloatArray, beyond: FloatArray) -> float:
    """Return what observations tell at most (nat) beyond their rows (n, r), given A⊥z (probes, n) of random z."""
    inside = np.eye(len(rows)) + rows @ rows.T
    return float((beyond.T * np.linalg.solve(inside, beyond.T)).sum(axis=0).mean() / 2)


def of_field(
    model: ForwardModel,
    solution: Solution,
    whitened: FloatArray,
    prior: Prior,
    mass: FloatArray,
    sigma: FloatArray,
    goals: NDArray[np.bool_],
    errors: FloatArray,
    rank: int,
    seed: int,
) -> xr.Dataset:
    """Linearise a model, whose parameters are the N values of a field, at one draw.

    Parameters
    ----------
    solution, whitened
        At the draw ξ (N,).
    mass
        Volume (N,) of each vertex.
    sigma, goals
        Standard deviations (m,) of the errors of the outputs, and which of these (m,) are not measured but predicted.
    errors
        What is uncertain beside the field (g, m), a row for a standard deviation of each: the last directions.
    rank, seed
        Largest number of directions, and seed of the search for them.

    Returns
    -------
    xarray.Dataset
        `output` (m,), `sigma`, `row` (m, r + g), zero for goals; `field_goal` (r + g, r + g), what the directions add
        to the mean variance of the field, over that of the prior; `goal_row` (q, r + g) of goals over their prior
        standard deviation; and `beyond` (`PROBES`, m), what is left out of the rows along random directions.
    """
    import xarray as xr

    data = np.where(goals, np.nan, 0.0)
    posterior = FieldPosterior(model, data, Noise(sigma), prior)
    point = Point(posterior, whitened, posterior.values(whitened), solution)
    spectrum = leading_pairs(point.jvp, point.vjp, posterior.size, rank=rank, seed=seed)
    directions = prior.root(spectrum.vectors)
    units = np.eye(len(sigma))[goals]
    slopes = prior.root_transposed(solution.adjoint(units)) if len(units) else np.zeros((0, posterior.size))
    slopes = np.hstack([slopes, errors[:, goals].T])
    sizes = np.linalg.norm(slopes, axis=1, keepdims=True)
    slopes = np.divide(slopes, sizes, out=np.zeros_like(slopes), where=sizes > 0)
    rows = np.hstack([slopes[:, : posterior.size] @ spectrum.vectors.T, slopes[:, posterior.size :]])
    of_field = (directions * mass) @ directions.T / (mass @ prior.variance)
    probes = np.random.default_rng([seed, 3]).standard_normal((PROBES, posterior.size))
    probes -= probes @ spectrum.vectors.T @ spectrum.vectors
    return xr.Dataset(
        {
            "output": ("value", np.array(solution.outputs)),
            "sigma": ("value", sigma),
            "row": (("value", "direction"), np.hstack([spectrum.images.T, (errors * ~goals / sigma).T])),
            "field_goal": (("direction", "other"), np.pad(of_field, (0, len(errors)))),
            "goal_row": (("goal", "direction"), rows),
            "beyond": (("probe", "value"), point.jvp(probes)),
        }
    )
