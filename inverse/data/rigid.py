"""Rigid motions, and their derivatives by the six numbers of a small one.

With a small rotation ω about a centre c, and a shift τ, a point x goes on to e^[ω](x − c) + c + τ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from forward.model import FloatArray

ORTHONORMAL = 1e-4  # how far RᵀR may be from I: matrices are written with few digits


@dataclass(frozen=True, eq=False)
class Rigid:
    """A rigid motion x ↦ Rx + t.

    Attributes
    ----------
    rotation
        R (3, 3).
    shift
        t (3,) (m).
    """

    rotation: FloatArray = field(default_factory=lambda: np.eye(3))
    shift: FloatArray = field(default_factory=lambda: np.zeros(3))

    def __call__(self, points: FloatArray) -> FloatArray:
        """Return where points (n, 3) go."""
        return np.asarray(points @ self.rotation.T + self.shift)

    def moved(self, motion: FloatArray, centre: FloatArray) -> Rigid:
        """Return this motion, followed by a rotation ω about a centre (3,) and a shift τ, (ω, τ) being given (6,)."""
        more = exponential(motion[:3])
        return Rigid(more @ self.rotation, more @ (self.shift - centre) + centre + motion[3:])

    @property
    def angles(self) -> FloatArray:
        """Angles (3,) about x, then y, then z, in degrees."""
        R = self.rotation
        return np.degrees(
            [np.arctan2(R[2, 1], R[2, 2]), -np.arcsin(np.clip(R[2, 0], -1, 1)), np.arctan2(R[1, 0], R[0, 0])]
        )


def turned(degrees: Sequence[float]) -> FloatArray:
    """Return the rotation (3, 3) by angles (degrees) about x, then y, then z."""
    found = np.eye(3)
    for axis, angle in enumerate(np.radians(degrees)):
        found = exponential(angle * np.eye(3)[axis]) @ found
    return found


def exponential(turn: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) about a vector (3,), whose length is the angle (Rodrigues)."""
    angle = float(np.linalg.norm(turn))
    if angle == 0:
        return np.eye(3)
    K = crosses(turn[None] / angle)[0]
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)


def crosses(vectors: FloatArray) -> FloatArray:
    """Return the matrices (n, 3, 3) of v × for vectors v (n, 3)."""
    found = np.zeros((len(vectors), 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        found[:, j, i], found[:, i, j] = vectors[:, k], -vectors[:, k]
    return found


def slopes(points: FloatArray, centre: FloatArray) -> FloatArray:
    """Return the derivatives (n, 3, 6) of moved points (n, 3) by (ω, τ) at zero."""
    turn = -crosses(points - centre)
    return np.concatenate([turn, np.broadcast_to(np.eye(3), turn.shape)], axis=2)


def check_rigid(matrix: FloatArray) -> None:
    """Refuse a matrix that is none of a rigid motion."""
    if matrix.shape not in {(3, 4), (4, 4)} or (len(matrix) == 4 and (matrix[3] != [0, 0, 0, 1]).any()):
        raise ValueError("expected three rows of four numbers, or four rows of which the last is 0, 0, 0, 1")
    R = matrix[:3, :3]
    determinant = float(np.linalg.det(R))
    off = float(np.abs(R.T @ R - np.eye(3)).max())
    if determinant < 0 and off < 0.1:
        raise ValueError("the matrix mirrors (determinant −1), expected a rotation: is an axis reversed?")
    if off > ORTHONORMAL:
        raise ValueError(
            f"the matrix is not rigid: RᵀR differs from I by {off:.2g} (determinant {determinant:.4g}), expected a "
            f"rotation; a scale belongs into data.unit"
        )


def orthonormal(R: FloatArray) -> FloatArray:
    """Return the rotation next to a matrix (3, 3) that is nearly one."""
    U, _, Vt = np.linalg.svd(R)
    return np.asarray(U @ Vt)
