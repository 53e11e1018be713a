"""Candidates and goals of a model that was linearised at draws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from forward.model import FloatArray
from inverse.designs.criteria import Information


@dataclass(frozen=True, eq=False)
class Linearised:
    """Candidates and goals at draws.

    Attributes
    ----------
    rows
        (c, k, r) of each draw, over the standard deviations of the errors.
    goals
        GᵀG (r, r) of each draw, with prior variances that add up to one.
    """

    rows: Sequence[FloatArray]
    goals: Sequence[FloatArray]

    def roots(self, chosen: Sequence[int]) -> list[FloatArray]:
        """Return roots (r, r) of the covariances once all chosen observations were made, of each draw."""
        criterion = Information(self.rows)
        for one in chosen:
            criterion.take(one)
        return criterion.roots


def scaled(goals: FloatArray) -> list[FloatArray]:
    """Return GᵀG of goals (draws, q, d), each over its prior standard deviation and √q; constants count nothing."""
    size = np.linalg.norm(goals, axis=2, keepdims=True)
    scaled = np.divide(goals, size, out=np.zeros_like(goals), where=size > 0) / np.sqrt(goals.shape[1])
    return [one.T @ one for one in scaled]
