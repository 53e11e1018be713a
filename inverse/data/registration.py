"""Rigid registration of scans: where the frame of a scanner lies in that of a body, and how well that is known.

A point x of the scanner lies at Rx + t. With a small rotation ω about the centre c of the points, and a shift τ, the
point goes on to e^[ω](Rx + t − c) + c + τ: (ω, τ) are the six unknowns here.

- Landmarks p_i with known places q_i: minimal Σ |Rp_i + t − q_i|²/σ_i², in closed form (W. Kabsch, Acta Cryst. A32
  (1976) 922–923). The covariance is that of least squares, (Σ J_iᵀJ_i/σ_i²)⁻¹ with J_i = (−[x_i − c]×, I).
- Points of the surface: minimal Σ ρ(n_i·(x_i − q_i)/σ) with the nearest place q_i of the surface and its normal n_i, by
  Gauss and Newton's method (Y. Chen, G. Medioni, Image Vision Comput. 10 (1992) 145–155) with Student's errors in ρ, so
  that a few points of something else do not decide; J_i = n_iᵀ(−[x_i − c]×, I). A motion along which the surface does
  not change, such as the rotation of a ball, cannot be found so: it is left as it was at the start, and named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal, Protocol

import numpy as np
from pydantic import Field, model_validator

from forward.model import FloatArray
from forward.readable import told
from forward.settings import Settings
from inverse.data.table import DataError

ORTHONORMAL = 1e-4  # how far RᵀR may be from I: matrices are written with few digits
MOTIONS = tuple(f"{what} {axis}" for what in ("rotation about", "shift along") for axis in "xyz")
STEPS, SETTLED = 100, 1e-8
UNSEEN = 1e-2  # of the largest eigenvalue of the information, below which a motion cannot be found
LEAST = 6  # points of a surface
COLLINEAR = 1e-6
FAR = 0.1  # of the extent of a body, by which landmarks may miss their places
TURN, SHIFT = np.radians(10.0), 0.1  # standard deviations of motions that are not found: rad, and of the extent
HEAVY = 4  # degrees of freedom of errors
Vector = tuple[float, float, float]
Degrees = Annotated[float, Field(ge=0, le=30)]
Positive = Annotated[float, Field(gt=0)]


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


class _Motion(Settings):
    """A rigid motion from the frame of a file to that of the body; lengths are in the unit of the file."""

    kind: str
    rotation: Vector = (0.0, 0.0, 0.0)
    translation: Vector = (0.0, 0.0, 0.0)
    matrix: tuple[tuple[float, float, float, float], ...] | None = None

    @property
    def moves(self) -> bool:
        """Whether a motion is stated."""
        return self.matrix is not None or any(self.rotation) or any(self.translation)

    @model_validator(mode="after")
    def _check(self) -> _Motion:
        if self.matrix is None:
            return self
        if any(self.rotation) or any(self.translation):
            raise ValueError("expected either matrix, or rotation and translation")
        check_rigid(np.array(self.matrix))
        return self

    def at(self, unit: float) -> Rigid:
        """Return the motion, in m."""
        if self.matrix is None:
            return Rigid(turned(self.rotation), unit * np.array(self.translation))
        whole = np.array(self.matrix)
        U, _, Vt = np.linalg.svd(whole[:3, :3])  # nearly a rotation: the next one is taken
        return Rigid(U @ Vt, unit * whole[:3, 3])


class Given(_Motion):
    """A known rigid motion from the frame of a file to that of the body; lengths are in the unit of the file.

    Parameters
    ----------
    rotation
        Angles (degrees) about x, then y, then z.
    translation
        Shift after it.
    matrix
        Both, in place of them: three rows (R, t), or four, the last 0, 0, 0, 1.
    rotation_std, translation_std
        Standard deviations of its errors about, and along, each axis (degrees; unit of the file). Where they are not
        zero, they are among the errors of the data.
    """

    kind: Literal["given"] = "given"
    rotation_std: Degrees = 0.0
    translation_std: Annotated[float, Field(ge=0)] = 0.0

    @property
    def uncertain(self) -> bool:
        """Whether its errors are among those of the data."""
        return self.rotation_std > 0 or self.translation_std > 0

    def registered(
        self, places: FloatArray, unit: float, surface: Surface | None, extent: float, name: str
    ) -> Registered:
        """Return it, about the centre of the points; arguments as of `ToSurface.registered`."""
        motion = self.at(unit)
        std = [np.radians(self.rotation_std)] * 3 + [unit * self.translation_std] * 3
        return Registered(motion, motion(places).mean(axis=0), np.diag(std), self.uncertain)


class Landmarks(Settings):
    """The motion that takes landmarks of a file to known places of the body; lengths are in the unit of the file.

    Parameters
    ----------
    points
        Three or more landmarks in the frame of the file.
    onto
        Where they are in the body.
    sigma
        Standard deviation of their coordinates: one number, or one for each landmark. By default that of their
        distances from the body, for which four or more landmarks are needed.
    uncertain
        Whether the uncertainty of the motion is among the errors of the data.
    """

    kind: Literal["landmarks"] = "landmarks"
    points: tuple[Vector, ...] = Field(min_length=3)
    onto: tuple[Vector, ...] = Field(min_length=3)
    sigma: Positive | tuple[Positive, ...] | None = None
    uncertain: bool = False

    @model_validator(mode="after")
    def _check(self) -> Landmarks:
        n = len(self.points)
        if len(self.onto) != n:
            raise ValueError(f"{n} points onto {len(self.onto)} places, expected as many")
        sigma = np.asarray(self.sigma)
        if sigma.shape not in {(), (n,)}:
            raise ValueError(f"{sigma.size} standard deviations of {n} points, expected as many, or one number")
        if self.sigma is None and self.uncertain and n == 3:
            raise ValueError("three landmarks do not say how uncertain they are, expected sigma, or more landmarks")
        return self

    def registered(
        self, places: FloatArray, unit: float, surface: Surface | None, extent: float, name: str
    ) -> Registered:
        """Find it; arguments and errors as of `ToSurface.registered`."""
        p, q = unit * np.array(self.points), unit * np.array(self.onto)
        n = len(p)
        sigma = unit * np.broadcast_to(np.asarray(1.0 if self.sigma is None else self.sigma, dtype=float), (n,))
        w = sigma**-2 / (sigma**-2).sum()
        middle, there = w @ p, w @ q
        a, b = p - middle, q - there
        for points, which in ((a, "points"), (b, "onto")):
            if np.linalg.svd(points, compute_uv=False)[1] < COLLINEAR * np.linalg.norm(points):
                raise DataError(
                    f"{name}: registration.{which}: the landmarks lie on one line, expected three that do not"
                )
        U, sizes, Vt = np.linalg.svd((w[:, None] * a).T @ b)
        sign = np.sign(np.linalg.det(Vt.T @ U.T))
        rotation = Vt.T @ np.diag([1, 1, sign]) @ U.T
        motion = Rigid(rotation, there - rotation @ middle)
        gap = motion(p) - q
        rms = float(np.sqrt((gap**2).sum(axis=1).mean()))
        mirrored = a @ (Vt.T @ np.diag([1, 1, -sign]) @ U.T).T - b
        if sizes[2] > COLLINEAR * sizes[0] and sign < 0 and (mirrored**2).sum() < (gap**2).sum() / 4:
            less = np.sqrt((mirrored**2).sum(axis=1).mean())
            raise DataError(
                f"{name}: registration: the landmarks fit a mirror image ({told(less, 'm', 3)} against "
                f"{told(rms, 'm', 3)}): is an axis reversed, or are two landmarks exchanged?"
            )
        if rms > FAR * extent:
            raise DataError(
                f"{name}: registration: the landmarks miss their places by {told(rms, 'm', 3)} (root mean square) in a "
                f"body of {told(extent, 'm', 3)}: are they in the same order, and in the unit of the file?"
            )
        if self.sigma is None:
            sigma = np.full(n, np.sqrt((gap**2).sum() / max(3 * n - 6, 1)))
        centre = motion(p).mean(axis=0)
        J = slopes(motion(p), centre) / np.maximum(sigma, 1e-12 * extent)[:, None, None]
        root = _root(J.reshape(-1, 6), np.linalg.norm(motion(p) - centre) / np.sqrt(n), extent)[0]
        return Registered(motion, centre, root, self.uncertain, self.kind, n, rms)


class ToSurface(_Motion):
    """The motion that takes the points of a file to the surface of the body; lengths are in the unit of the file.

    Parameters
    ----------
    rotation, translation, matrix
        Where the search starts, as of a known motion; by default where the file has its points, or where the boxes
        around points and body have the same centre, if that is better.
    sigma
        Standard deviation of the distances of the points from the surface; by default as it is found.
    uncertain
        Whether the uncertainty of the motion is among the errors of the data.
    """

    kind: Literal["to-surface"] = "to-surface"
    sigma: Positive | None = None
    uncertain: bool = False

    def registered(
        self, places: FloatArray, unit: float, surface: Surface | None, extent: float, name: str
    ) -> Registered:
        """Find it.

        Parameters
        ----------
        places, unit
            Points (n, 3) of the file (m), and m per unit of the file.
        surface
            Of the body; needed for points on it only.
        extent
            Size of the body (m).
        name
            Of the file, for messages.

        Raises
        ------
        DataError
            If that is not possible.
        """
        assert surface is not None
        places = np.unique(places, axis=0)
        if len(places) < LEAST:
            raise DataError(
                f"{name}: registration: {len(places)} points, expected at least {LEAST} to fit them to a surface"
            )
        start = self.at(unit)
        starts = [start]
        if not self.moves:
            there = start(places)
            shift = surface.middle - (there.min(axis=0) + there.max(axis=0)) / 2
            starts.append(Rigid(start.rotation, start.shift + shift))
        found = min((_fitted(one, places, unit, self, surface, extent) for one in starts), key=lambda one: one.rms)
        return replace(found, uncertain=self.uncertain)


Registration = Annotated[Given | Landmarks | ToSurface, Field(discriminator="kind")]


@dataclass(frozen=True, eq=False)
class Registered:
    """A registration.

    Attributes
    ----------
    motion
        From the frame of the file (m) to that of the body.
    centre
        c (3,) (m).
    root
        (k, 6): the covariance of (ω, τ) (rad, m) is its transpose times itself.
    uncertain
        Whether that is to be among the errors of the data.
    kind, count
        How it was found, and from how many points.
    rms
        Of the distances of these, after it (m).
    unseen
        Motions that they do not determine, in words.
    """

    motion: Rigid
    centre: FloatArray
    root: FloatArray
    uncertain: bool
    kind: str = "given"
    count: int = 0
    rms: float = 0.0
    unseen: tuple[str, ...] = ()

    @property
    def described(self) -> str:
        """It in words."""
        angles = ", ".join(f"{x + 0.0:.4g}" for x in np.round(self.motion.angles, 6))
        shift = ", ".join(f"{x + 0.0:.4g}" for x in np.round(self.motion.shift, 9))
        words = f"rotated by {angles}° about x, y and z, shifted by {shift} m"
        if self.kind != "given":
            words += f"; {self.count:,} points, {told(self.rms, 'm')} off (root mean square)"
        if self.uncertain:
            turn, shift = np.degrees(self.std[:3]).max(), self.std[3:].max()
            words += f"; ± {turn:.2g}°, {told(shift, 'm')}, among the errors of the data"
        return words

    @property
    def std(self) -> FloatArray:
        """Standard deviations (6,) of (ω, τ): rad, m."""
        return np.asarray(np.linalg.norm(self.root, axis=0))


class Surface(Protocol):
    """A surface."""

    @property
    def middle(self) -> FloatArray:
        """Centre (3,) of the box around it."""

    def nearest(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the nearest places (n, 3) to points (n, 3), and the normals (n, 3) there, of either sign."""


def _fitted(
    start: Rigid, places: FloatArray, unit: float, how: ToSurface, surface: Surface, extent: float
) -> Registered:
    """Move points to the surface by Gauss and Newton's method, until they move no more."""
    motion, n = start, len(places)
    for _ in range(STEPS):
        here = motion(places)
        centre = here.mean(axis=0)
        size = np.linalg.norm(here - centre) / np.sqrt(n)
        near, normal = surface.nearest(here)
        gap = ((here - near) * normal).sum(axis=1)
        # The scale of the distances, from their median, while they are large.
        spread = max(1.4826 * float(np.median(np.abs(gap))), 1e-9 * extent)
        weight = 1 / (1 + (gap / spread) ** 2 / HEAVY)
        J = np.einsum("na,nak->nk", normal, slopes(here, centre))
        scaled = J / np.repeat([size, 1.0], 3)
        values, vectors = np.linalg.eigh((weight[:, None] * scaled).T @ scaled)
        seen = values > UNSEEN * values[-1]
        step = -(vectors[:, seen] / values[seen]) @ (vectors[:, seen].T @ (scaled.T @ (weight * gap)))
        step = step / np.repeat([size, 1.0], 3)
        largest = max(np.linalg.norm(step[:3]) * size, np.linalg.norm(step[3:]))
        motion = motion.moved(step * min(1.0, 0.2 * extent / max(largest, 1e-300)), centre)
        if largest < SETTLED * extent:
            break
    here = motion(places)
    near, normal = surface.nearest(here)
    gap = np.linalg.norm(here - near, axis=1)
    J = np.einsum("na,nak->nk", normal, slopes(here, centre)) * np.sqrt(weight)[:, None]
    sigma = spread * np.sqrt(n / max(n - 6, 1)) if how.sigma is None else unit * how.sigma
    root, unseen = _root(J / sigma, size, extent)
    return Registered(motion, centre, root, False, how.kind, n, float(np.sqrt((gap**2).mean())), unseen)


def _root(J: FloatArray, size: float, extent: float) -> tuple[FloatArray, tuple[str, ...]]:
    """Return the root (6, 6) of the covariance (JᵀJ)⁻¹, and motions that the points do not determine.

    These have wide errors of their own, a prior of the rotation and of the shift.
    """
    scale = np.repeat([1 / size, 1.0], 3)
    scaled = J * scale
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    seen = values > UNSEEN * values[-1]
    wide = 1 / np.maximum(np.minimum(TURN * size, SHIFT * extent), 1e-300)
    root = scale * (vectors / np.sqrt(np.where(seen, values, 0.0) + wide**2)).T
    names = []
    for vector in vectors[:, ~seen].T:
        share = np.abs(vector)
        names.append(MOTIONS[int(share.argmax())] if share.max() > 0.9 else "a mixture of rotations and shifts")
    return root, tuple(dict.fromkeys(names))
