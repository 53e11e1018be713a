"""Whether an equilibrium is stable: a cheap screen of its stiffness, with the factor of a reference at hand.

A body stays in an equilibrium only if its stiffness K is positive definite on the free unknowns. Counting the
negative eigenvalues takes a factorisation. The screen takes a few products with K and one back-substitution: of the
vectors along which the stiffness K̄ of the reference changes most as parameters change (linear buckling), and its
lowest natural modes, the combination x with the smallest Rayleigh quotient xᵀKx/xᵀK̄x is improved by one step of
inverse iteration, z = K̄⁻¹Kx, and the smallest quotient of both is an upper bound for the lowest eigenvalue of K over
that of K̄: 1 at the reference, negative if the screen has *found* an instability. It may miss one, so the negative
eigenvalues are counted at states with small quotients, at those whose stiffness does not resemble K̄ in these vectors,
and at others chosen at random (docs/decisions/0010-stability.md).

Natural modes alone see nothing of a compressed block, of an arch, or of a cantilever that buckles sideways.

In the mixed form vectors are pairs of displacements and pressures, p = C⁻¹Bᵀv of K̄ = [A B; Bᵀ −C], with which vᵀAv +
2pᵀBᵀv − pᵀCp is the energy with the pressures condensed. At other states the same pressures make it smaller than that:
the screen errs on the side of counting. Forces on pressures are ignored wherever K̄⁻¹ is applied.

Source of the linear buckling problem (dK/dω along the tangent, K̄): K.-J. Bathe, Finite Element Procedures (1996),
§6.8.2. Everything here is linear algebra on rows (k, n), of which a rank holds its part.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from forward.model import FloatArray
from forward.solvers.steps import Corrector, Steps

Rows = Callable[[FloatArray], FloatArray]  # (k, n) → (k, n), linear in each row
Total = Callable[[FloatArray], FloatArray]  # sums an array over the ranks that share the vectors

LOW = 1 / 3  # quotient below which the negative eigenvalues are counted
ALIKE = 10.0  # ratio of quotients beyond which K̄ no longer resembles the stiffness, and they are counted too
NATURAL = 3  # lowest natural modes among the vectors
EXTREMES = 2  # vectors at each end of the spectrum of a change of stiffness
WEAK = 0.1  # |μ| for one standard deviation, below which a parameter does not lead towards instability
BLOCK, STEPS = 6, 4  # of the Krylov spaces in which these vectors are looked for
SMOOTH = 1e-6  # tolerance of the solves in which they are: far below what ROUNDING tells apart
ROUNDING = 1e-10  # squared fraction of a vector that remains if it depends on others
SAME = 1e-3  # the same for vectors that are not essential


class Screened(NamedTuple):
    """The screen's result for a state.

    Attributes
    ----------
    lowest
        Smallest Rayleigh quotient xᵀKx/xᵀK̄x that it finds.
    largest
        Largest quotient of the screening vectors.
    """

    lowest: float
    largest: float

    @property
    def clear(self) -> bool:
        """Whether it shows no instability, and K resembles K̄ enough to trust the screen."""
        return self.lowest >= LOW and self.largest <= ALIKE * self.lowest

    @property
    def chance(self) -> float:
        """Probability that negative eigenvalues are counted at the state."""
        return (LOW / self.lowest) ** 3 if self.clear else 1.0


NOT_SCREENED = Screened(np.nan, np.nan)


def draw(parameters: FloatArray) -> float:
    """Return a pseudo-random number in [0, 1) that depends only on the parameters (d,)."""
    digest = hashlib.sha256(np.ascontiguousarray(parameters, dtype=float).tobytes()).digest()
    return int.from_bytes(digest[:8], "little") / 2.0**64


def screening_vectors(
    changes: Iterable[Rows], solve: Rows, forces: FloatArray, free: FloatArray, total: Total
) -> FloatArray:
    """Return rows (k, n), orthonormal in K̄, in which loss of definiteness is likely to show.

    Parameters
    ----------
    changes
        Products with the change of the stiffness for one standard deviation of each parameter, along the tangent.
    solve
        Applies K̄⁻¹.
    forces
        Forces (b, n) to begin with.
    free
        1 on free displacements, 0 on other unknowns (n,).
    total
        Sum over the ranks.
    """
    smooth = _Space(total)
    new = forces * free
    for _ in range(3):
        new = smooth.add(solve(new), new) * free
    lengths = total((smooth.rows * free) @ smooth.rows.T)
    _, turns = np.linalg.eigh(-_symmetric(lengths))
    rows, images = turns[:, :BLOCK].T @ smooth.rows, turns[:, :BLOCK].T @ smooth.images
    kept = _Space(total, SAME)
    for change in changes:
        found = _extremes(change, solve, rows, images, free, total)
        kept.add(*found)
    kept.add(rows[:NATURAL], images[:NATURAL])
    return kept.rows


def _extremes(
    change: Rows, solve: Rows, rows: FloatArray, images: FloatArray, free: FloatArray, total: Total
) -> tuple[FloatArray, FloatArray]:
    """Eigenvectors of (dK, K̄) at both ends of the spectrum, where |μ| is not small, and their products with K̄."""
    space = _Space(total)
    new = space.add(rows, images)
    changed = [change(new)]
    for _ in range(STEPS - 1):
        forces = changed[-1] * free
        new = space.add(solve(forces), forces)
        if len(new) == 0:
            break
        changed.append(change(new))
    values, vectors = np.linalg.eigh(_symmetric(total(space.rows @ np.concatenate(changed).T)))
    order = np.argsort(-np.abs(values), kind="stable")
    ends = [i for i in order if i < EXTREMES or i >= len(values) - EXTREMES]
    which = [i for i in ends if abs(values[i]) >= WEAK]
    return vectors[:, which].T @ space.rows, vectors[:, which].T @ space.images


class _Space:
    """Rows that are orthonormal in K̄, with their products with K̄."""

    def __init__(self, total: Total, tolerance: float = ROUNDING) -> None:
        self._total = total
        self._tolerance = tolerance
        self.rows = self.images = np.empty((0, 0))

    def add(self, rows: FloatArray, images: FloatArray) -> FloatArray:
        """Append the new part of rows (k, n), with its products; return it, orthonormal."""
        if self.rows.size == 0:
            self.rows = self.images = np.empty((0, rows.shape[1]))
        for tolerance in (self._tolerance, ROUNDING):
            sizes = np.sqrt(np.maximum(self._total((rows * images).sum(axis=1)), np.finfo(float).tiny))
            rows, images = rows / sizes[:, None], images / sizes[:, None]
            part = self._total(rows @ self.images.T)
            rows, images = rows - part @ self.rows, images - part @ self.images
            values, vectors = np.linalg.eigh(_symmetric(self._total(rows @ images.T)))
            good = values > tolerance
            scaled = (vectors[:, good] / np.sqrt(values[good])).T
            rows, images = scaled @ rows, scaled @ images
        self.rows, self.images = np.vstack([self.rows, rows]), np.vstack([self.images, images])
        return rows


def screen(vectors: FloatArray, multiply: Rows, solve: Corrector, free: FloatArray, total: Total) -> Steps[Screened]:
    """Look for a direction in which the stiffness K of a state is negative.

    Vectors (k, n) are orthonormal in K̄; `multiply` and `solve` apply K and K̄⁻¹.
    """
    if len(vectors) == 0:  # every displacement is held
        return Screened(1.0, 1.0)
    images = multiply(vectors)
    projected = _symmetric(total(vectors @ images.T))
    if not np.isfinite(projected).all():
        return NOT_SCREENED
    values, turns = np.linalg.eigh(projected)
    force = (turns[:, 0] @ images) * free
    z = yield from solve(force)
    *part, size = total(np.append(vectors @ force, z @ force))
    z = z - part @ vectors
    left = size - np.square(part).sum()
    if not left > ROUNDING:
        return Screened(float(values[0]), float(values[-1]))
    z /= np.sqrt(left)
    image = multiply(z[None])[0]
    *beside, corner = total(np.append((vectors @ image + images @ z) / 2, z @ image))
    row = np.array([beside])
    bordered = np.block([[projected, row.T], [row, corner]])
    if not np.isfinite(bordered).all():
        return NOT_SCREENED
    return Screened(float(np.linalg.eigvalsh(bordered)[0]), float(values[-1]))


def _symmetric(matrix: FloatArray) -> FloatArray:
    return np.asarray((matrix + matrix.T) / 2)
