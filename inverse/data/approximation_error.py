"""The error of a mesh in data: corrected where it is known, an error of theirs where it is not.

A model on a mesh predicts ψ_h(ω). With what finer meshes say of its error,

    y = ψ_h(ω) + δ(ω) + Uz + e,   δ(ω) = δ̂ + T (ω − ω̂),   z ~ N(0, I),   e ~ N(0, diag (σ² + τ²)),

where U and τ are what remains uncertain of δ: approximation errors as in J. Kaipio, E. Somersalo, J. Comput. Appl.
Math. 198 (2007) 493–504, and S. R. Arridge et al., Inverse Problems 22 (2006) 175–195, linearised at the mode in place
of the mean of the prior. With τ in σ, the errors have the covariance σ(I + ŨŨᵀ)σ, Ũ = U/σ = VSQᵀ, and residuals over σ
become independent again by W = (I + ŨŨᵀ)^(−1/2) = I − V (1 − (1 + S²)^(−1/2)) Vᵀ, symmetric and of low rank: whatever
knows independent errors only goes on with W r and W A.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from inverse.data.errors import NormalErrors, StudentErrors
from inverse.data.measurements import Measurements

# Standard deviations of what finer meshes still miss: of the pattern of the difference between them and of the error
# itself, over these, and datum by datum, over the difference (chosen by `python -m benchmarks meshes`).
OF_DIFFERENCE, OF_ERROR, OF_DATUM = 0.35, 0.1, 0.3
# And along each direction of a field that the data determine (chosen by `python -m benchmarks meshes_of_fields`).
OF_DIRECTION = 0.5


@dataclass(frozen=True, eq=False)
class ApproximationError:
    """What a mesh takes away from m data, in their units.

    Attributes
    ----------
    point
        Parameters ω̂ (d,) where it was found.
    error
        δ̂ (m,).
    slopes
        T (m, d), or none (m, 0): then δ is taken to be the same everywhere.
    root
        Uᵀ (k, m).
    apart
        τ (m,).
    scale
        Factor on σ at which it counts, where that is unknown.
    """

    point: FloatArray
    error: FloatArray
    slopes: FloatArray
    root: FloatArray
    apart: FloatArray
    scale: float = 1.0

    def at(self, points: FloatArray) -> FloatArray:
        """Return δ (n, m) at parameters (n, d)."""
        if not self.slopes.size:
            return np.broadcast_to(self.error, (len(points), len(self.error)))
        return self.error + (points - self.point) @ self.slopes.T

    def of(self, rows: NDArray[np.intp]) -> ApproximationError:
        """Return that of some of the data, by number."""
        return ApproximationError(
            self.point, self.error[rows], self.slopes[rows], self.root[:, rows], self.apart[rows], self.scale
        )


def uncertain(error: FloatArray, between: FloatArray, data: Measurements) -> FloatArray:
    """Return Uᵀ (k, m): what finer meshes still miss, of the patterns of the error and of the difference between them.

    The rest is extrapolated by one factor; in truth the factor is another in each load case, for each component, and
    varies slowly over the body.

    Parameters
    ----------
    error
        δ (m,).
    between
        Difference (m,) between the two finer meshes.
    data
        What the data are, and where.
    """
    somewhere, points, groups = np.isfinite(data.places).all(axis=1), data.places, data.kinds
    seen = points[somewhere] if somewhere.any() else np.zeros((1, 3))
    low, high = seen.min(axis=0), seen.max(axis=0)
    across = np.zeros((len(between), 3))
    across[somewhere] = 2 * (points[somewhere] - low) / np.where(high > low, high - low, 1.0) - (high > low)
    shapes = [np.ones(len(between)), *across.T]
    patterns = (OF_DIFFERENCE * between, OF_ERROR * error)
    rows = [
        pattern * shape * (groups == group) for pattern in patterns for group in np.unique(groups) for shape in shapes
    ]
    found = np.array(rows).reshape(-1, len(between))
    return np.asarray(found[np.abs(found).max(axis=1, initial=0.0) > 0])


def along(images: FloatArray, between: FloatArray, whitening: Whitening) -> FloatArray:
    """Return rows (r, m) of what is uncertain along the directions of a field, in addition to `uncertain`.

    What the data determine best is what few patterns of all data determine, and a rest that is small in every datum may
    lie along these: there it counts as much as the difference between the finer meshes.

    Parameters
    ----------
    images
        A u (r, m) of orthogonal directions u of the field: orthogonal patterns in independent errors.
    between
        Difference (m,) between the two finer meshes.
    whitening
        What makes errors independent without those of the mesh.
    """
    patterns = images / np.maximum(np.linalg.norm(images, axis=1, keepdims=True), 1e-300)
    seen = OF_DIRECTION * np.abs(patterns @ whitening(between / whitening.sigma))
    return np.asarray(seen[:, None] * whitening.undone(patterns) * whitening.sigma)


@dataclass(frozen=True, eq=False)
class Whitening:
    """What makes errors independent.

    Attributes
    ----------
    sigma
        Standard deviations (m,) that residuals are divided by before.
    basis
        Vᵀ (r, m), orthonormal rows.
    less
        1 − (1 + S²)^(−1/2) (r,).
    log_determinant
        ½ ln det(I + ŨŨᵀ), which −ln of the likelihood has more.
    """

    sigma: FloatArray
    basis: FloatArray
    less: FloatArray
    log_determinant: float

    @classmethod
    def of(
        cls,
        sigma: FloatArray,
        mesh: ApproximationError | None,
        errors: NormalErrors | StudentErrors,
        shared: FloatArray | None = None,
    ) -> Whitening:
        """Make it for standard deviations (m,), what a mesh adds to them, and other errors (k, m) that data share.

        Errors with heavy tails are no multivariate ones: of those the scales only become larger.
        """
        m = len(sigma)
        roots = [np.zeros((0, m))] if shared is None else [shared]
        more = np.zeros(m)
        if mesh is not None:
            roots.append(mesh.root / mesh.scale)
            more = more + (mesh.apart / mesh.scale) ** 2
        root = np.concatenate(roots)
        if errors.kind != "normal":
            more, root = more + (root**2).sum(axis=0), root[:0]
        wider = np.sqrt(sigma**2 + more) if mesh is not None or more.any() else sigma
        if not len(root):
            return cls(wider, root, np.zeros(0), 0.0)
        _, sizes, basis = np.linalg.svd(root / wider, full_matrices=False)
        return cls(wider, basis, 1 - 1 / np.sqrt(1 + sizes**2), float(np.log1p(sizes**2).sum() / 2))

    def undone(self, rows: FloatArray) -> FloatArray:
        """Return W⁻¹r (…, m)."""
        return np.asarray(rows + ((rows @ self.basis.T) * (self.less / (1 - self.less))) @ self.basis)

    def __call__(self, rows: FloatArray) -> FloatArray:
        """Return W r (…, m) of rows over σ (…, m); W is symmetric."""
        if not len(self.less):
            return rows
        return np.asarray(rows - ((rows @ self.basis.T) * self.less) @ self.basis)
