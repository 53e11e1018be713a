"""Least squares with values and gradients: the choice of functions, the fit and its leave-one-out errors.

The expansion Σ_a c_a ψ_a(ω) is fitted to the samples. A sample gives one row for its value, ψ(ω_z)·c =
f(ω_z), and with derivatives one row more for each parameter, ∂ψ/∂t_i(ω_z)·c = ∂f/∂t_i(ω_z) along the coordinates t of
the polynomials (`uq.inputs.coordinates`): d + 1 rows for little more than the cost of one solve. All rows have the same
weight: for five test functions of two to four parameters, weights of 1/4 to 3/2 for the gradients gave errors within
the scatter of the designs.

The error of a fit is measured by leaving samples out, each with all of its rows. With the rows A_z of sample z, its
residuals r_z, and H_z = A_z (AᵀA)⁻¹ A_zᵀ, the fit without sample z has the error (I − H_z)⁻¹ r_z there, and its
coefficients differ by −(AᵀA)⁻¹ A_zᵀ (I − H_z)⁻¹ r_z: no fit is repeated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray, SolveError
from forward.phases import phase
from uq.evaluation.request import Evaluations
from uq.inputs.random_parameters import Inputs
from uq.surrogates.basis import FULL, ROWS_PER_TERM, Basis, Candidate, Candidates, IntArray

FOLDS = 10  # parts of the samples that are left out in turn to choose the functions
ROUNDING = 1e-13  # relative error below which no function is added
LIKELY = 24  # functions whose inner products are computed together
NOTHING = 0.8  # relative leave-one-out error above which a fit tells nothing about which parameters matter
PATIENCE = 30  # functions selected without a gain before the selection ends


@dataclass(frozen=True)
class Data:
    """Samples that have an answer: points (n, d), values (n, m), slopes (n, d, m) along the coordinates or None.

    `weights` (n,) are those of the samples in sums of squares; `why` says why others have no answer, if there are any.
    """

    points: FloatArray
    values: FloatArray
    slopes: FloatArray | None
    weights: FloatArray
    why: str = ""

    @classmethod
    def of(cls, evaluations: Evaluations, inputs: Inputs, weights: FloatArray | None) -> Data:
        """Take the evaluations that have an answer; `weights` default to one."""
        ok = evaluations.ok
        tangents = None if evaluations.tangents is None else evaluations.tangents[ok]
        counted = None if weights is None else weights[ok]
        found = cls.at(evaluations.points[ok], evaluations.outputs[ok], tangents, inputs, counted)
        return replace(found, why=evaluations.why)

    @classmethod
    def at(
        cls,
        points: FloatArray,
        values: FloatArray,
        tangents: FloatArray | None,
        inputs: Inputs,
        weights: FloatArray | None = None,
    ) -> Data:
        """Take values (n, m) and, if given, tangents (n, m, d) at points; `weights` as in `of`."""
        slopes = None
        if tangents is not None:
            slopes = np.swapaxes(inputs.coordinates.along(tangents, points), 1, 2)
        return cls(points, values, slopes, np.ones(len(points)) if weights is None else weights)

    def some(self, which: slice | IntArray) -> Data:
        """Return some of the samples, in the given order."""
        slopes = None if self.slopes is None else self.slopes[which]
        return Data(self.points[which], self.values[which], slopes, self.weights[which], self.why)

    @property
    def rows(self) -> int:
        """Number of rows of the regression."""
        return len(self.points) * (1 if self.slopes is None else 1 + self.slopes.shape[1])

    @property
    def right(self) -> FloatArray:
        """Right-hand sides (n, rows, m)."""
        blocks = [self.values[:, None, :]] if self.slopes is None else [self.values[:, None, :], self.slopes]
        return np.asarray(np.concatenate(blocks, axis=1) * self._roots)

    def left(self, basis: Basis) -> FloatArray:
        """Matrix (n, rows, P)."""
        rows = basis.rows(self.points, gradients=self.slopes is not None)
        rows *= self._roots
        return rows

    @property
    def _roots(self) -> FloatArray:
        return np.sqrt(self.weights)[:, None, None]

    def size(self, errors: FloatArray) -> FloatArray:
        """Root mean square (m,) of the first rows of residuals (n, rows, m): those of the values."""
        return np.asarray(np.sqrt((errors[:, 0] ** 2).sum(axis=0) / self.weights.sum()))

    def relative(self, errors: FloatArray) -> FloatArray:
        """The same over the standard deviation of the values; zero if that is rounding error."""
        constant, std = self._spread
        return np.where(constant, 0.0, self.size(errors) / np.where(constant, 1.0, std))

    @cached_property
    def _spread(self) -> tuple[NDArray[np.bool_], FloatArray]:
        """Which values (m,) are constant but for rounding, and standard deviations (m,): every step asks for them."""
        share = self.weights / self.weights.sum()
        mean = share @ self.values
        std = np.sqrt(share @ (self.values - mean) ** 2)
        return std <= 1e-13 * np.abs(mean), std


@dataclass(frozen=True)
class Fit:
    """A regression and its errors.

    Attributes
    ----------
    chosen
        The functions of the fit.
    coefficients
        (P, m).
    without
        Coefficients (g, P', m), for all functions of the largest basis, of g fits that each leave out 1/g of samples.
    sampled
        Standard errors (P, m) of the coefficients, as for a regression with independent errors of any size.
    triangle
        R (P, P) of the matrix of the regression, whose Gram matrix is RᵀR.
    loo, relative
        Root mean square (m,) of the leave-one-out errors of the values, and its ratio to their standard deviation.
    squares
        Sum of squares (m,) of the residuals of all rows.
    held
        Index (n,) of the fit in `without` that leaves the sample out.
    unseen
        Errors (n, m) of that fit in the values at each sample.
    """

    chosen: Candidate
    coefficients: FloatArray
    without: FloatArray
    sampled: FloatArray
    triangle: FloatArray
    loo: FloatArray
    relative: FloatArray
    squares: FloatArray
    held: IntArray
    unseen: FloatArray


@dataclass(frozen=True)
class _Folds:
    """Selections without some of the samples."""

    held: IntArray  # (n,): index of the selection that leaves the sample out
    which: IntArray  # (K, P): functions of each selection
    coefficients: FloatArray  # (K, P, m): those of the fit of each selection
    errors: FloatArray  # (n, rows, m): at each sample, by the fit without it


@phase("fitting polynomials")
def fit_best(candidates: Candidates, data: Data) -> Fit:
    """Choose the functions with the smallest leave-one-out error, and fit.

    Outputs that no choice explains, such as what is zero by symmetry but for rounding, have no say in it if others do.
    Raises `SolveError` if there are not enough samples.
    """
    # Samples that are left out together are next to each other.
    n = len(data.points)
    too_few = f"{n} samples have an answer, too few for an expansion of order 1" + (f": {data.why}" if data.why else "")
    if n < 2:  # nothing can be left out
        raise SolveError(too_few)
    held = np.arange(n) % min(n, FOLDS)
    order = np.argsort(held, kind="stable")
    data, held = data.some(order), held[order]
    left, right = data.left(candidates.basis), data.right
    products = _Products.of(left, right, held)
    scores, least = _scores(candidates, products, data, slice(None))
    # Few samples of what is rounding are explained by chance; outputs have many units, so it is known by size alone.
    spread = data.values.std(axis=0)
    explained = (least <= NOTHING) & (spread > ROUNDING * spread.max())
    if explained.any() and not explained.all():
        scores, _ = _scores(candidates, products, data, np.flatnonzero(explained))
    if not scores:
        raise SolveError(too_few)
    best = min(score for score, *_ in scores)
    # The smallest of those that are equally good.
    good = [(candidate, folds) for score, candidate, folds in scores if score <= 1.05 * best + 1e-13]
    fit = _regress(left, right, data, *min(good, key=lambda found: found[0].which.size))
    given = np.argsort(order)
    return replace(fit, held=fit.held[given], unseen=fit.unseen[given])


_Scores = list[tuple[float, Candidate, _Folds | None]]


def _scores(
    candidates: Candidates, products: _Products, data: Data, judged: slice | IntArray
) -> tuple[_Scores, FloatArray]:
    """Return the largest leave-one-out error of the outputs `judged` by each choice, and the least of each output (m,).

    Choices that the samples do not determine are left out.
    """
    right, d = products.right, candidates.basis.indices.shape[1]
    n, rows, m = right.shape
    scores: _Scores = []
    least = np.full(m, np.inf)
    for candidate in candidates.sets:
        terms, most = candidate.which.size, n * rows // ROWS_PER_TERM
        if candidate.sparse and (d > FULL or n * rows > d):
            score, chosen, folds, relative = _select(products, data, candidate, most, judged)
            scores.append((score, chosen, folds))
        elif (
            not candidate.sparse
            and terms <= n * rows
            and (candidate.order == 1 or len(candidates.sets) == 1 or terms <= most)
        ):
            q, r = np.linalg.qr(products.columns[:, candidate.which])
            size = np.abs(np.diag(r))
            if size.min() <= 1e-10 * size.max():
                continue
            blocks = q.reshape(n, rows, terms)
            residual = right - blocks @ np.einsum("zrp,zrm->pm", blocks, right)
            relative = data.relative(left_out(blocks, residual, products.held))
            scores.append((float(relative[judged].max()), candidate, None))
        else:
            continue
        least = np.fmin(least, relative)
    return [found for found in scores if np.isfinite(found[0])], least


def left_out(blocks: FloatArray, residual: FloatArray, held: IntArray) -> FloatArray:
    """Errors (n, rows, m) at each sample, by the fit without those that share its number in `held` (n,).

    They follow from the orthonormal columns (n, rows, P) and the residuals.
    """
    errors = np.empty_like(residual)
    order, counts = np.argsort(held, kind="stable"), np.bincount(held)
    first = np.cumsum(counts) - counts
    for count in np.unique(counts[counts > 0]):  # at once what has equally many samples
        out = order[first[counts == count, None] + np.arange(count)]
        part = blocks[out].reshape(len(out), -1, blocks.shape[2])
        found, turned = residual[out].reshape(*part.shape[:2], -1), np.swapaxes(part, 1, 2)
        # Of these two the smaller, with the same least eigenvalue: (I − QQᵀ)⁻¹ = I + Q (I − QᵀQ)⁻¹ Qᵀ.
        few = part.shape[2] < part.shape[1]
        rest = np.eye(min(part.shape[1:])) - (turned @ part if few else part @ turned)
        unknown = np.linalg.eigvalsh(rest)[:, 0] < 1e-10  # without these samples the fit is not determined
        rest[unknown] = np.eye(rest.shape[1])
        found = found + part @ np.linalg.solve(rest, turned @ found) if few else np.linalg.solve(rest, found)
        found[unknown] = np.inf
        errors[out] = found.reshape(*out.shape, *residual.shape[1:])
    return errors


@dataclass(frozen=True)
class _Products:
    """A regression, and inner products of its columns without the rows of each number in turn.

    They are computed where they are asked for, once for all dictionaries.
    """

    columns: FloatArray  # the matrix (n rows, P), samples that are left out together next to each other
    right: FloatArray  # right-hand sides (n, rows, m)
    held: IntArray  # (n,): number with which each sample is left out
    parts: tuple[slice, ...]  # rows of each number
    _known: dict[int, FloatArray] = field(default_factory=dict)

    @classmethod
    def of(cls, left: FloatArray, right: FloatArray, held: IntArray) -> _Products:
        """Take the matrix (n, rows, P) of samples with ascending numbers `held` (n,)."""
        ends = left.shape[1] * np.searchsorted(held, np.arange(held.max() + 2))
        parts = tuple(slice(*pair) for pair in pairwise(ends.tolist()))
        return cls(left.reshape(-1, left.shape[2]), right, held, parts)

    @cached_property
    def lengths(self) -> FloatArray:
        """Squared lengths (F + 1, P) of the columns without the rows of each number; the last with all rows."""
        return _without_each(np.array([np.einsum("rp,rp->p", part, part) for part in self._within]))

    def rows(self, pick: IntArray, likely: Callable[[], IntArray]) -> FloatArray:
        """Products (F + 1, P) of all columns with column `pick` (F + 1,) for each number; the last with all rows.

        They are computed for many columns at once: for those `likely` to be needed next, which are asked for only then.
        """
        missing = [j for j in dict.fromkeys(pick.tolist()) if j not in self._known]
        if missing:
            wanted = [*missing, *(j for j in likely().tolist() if j not in missing and j not in self._known)]
            found = np.stack([part[:, wanted].T @ part for part in self._within], axis=1)
            self._known.update((j, _without_each(one)) for j, one in zip(wanted, found, strict=True))
        return np.array([self._known[j][k] for k, j in enumerate(pick.tolist())])

    @property
    def _within(self) -> Iterator[FloatArray]:
        """The rows of each number."""
        return (self.columns[part] for part in self.parts)


def _without_each(parts: FloatArray) -> FloatArray:
    """Sums (F + 1, P) of parts (F, P) without each of them, and of all."""
    total = parts.sum(axis=0)
    return np.array([*(total - part for part in parts), total])


def _largest(gains: FloatArray, which: IntArray) -> IntArray:
    """Return the functions with the largest gains (F + 1, P) over all selections."""
    return np.asarray(which[np.argsort(-gains.sum(axis=0), kind="stable")[:LIKELY]])


def _select(
    products: _Products, data: Data, dictionary: Candidate, most: int, judged: slice | IntArray
) -> tuple[float, Candidate, _Folds, FloatArray]:
    """Select functions one by one, each time the one that explains most of the residuals of the outputs `judged`.

    Orthogonal least squares, from all samples and, to find when to stop, without those of each number in `held` (n,):
    a selection cannot be judged by the samples that it used. It needs only inner products (the Cholesky factor of the
    Gram matrix grows by a row for each function), so that a step does not go through all rows of all functions.

    Returns the relative error at the samples left out, the functions selected from all samples, and those without some;
    and the least relative error (m,) of each output at any step.
    """
    from scipy.linalg import solve_triangular

    right = products.right
    n, rows, m = right.shape
    which, parts, folds = dictionary.which, products.parts, len(products.parts)
    size, scale = (np.linalg.norm(one, axis=(0, 1)) for one in (right, right - right.mean(axis=0)))
    scale = np.where(scale > ROUNDING * size, scale, np.maximum(size, 1e-300))  # a constant needs no function
    rest = (right / scale).reshape(n * rows, m)
    explained = np.tile((products.columns.T @ rest)[which], (folds + 1, 1, 1))
    for k, part in enumerate(parts):
        explained[k] -= (products.columns[part].T @ rest[part])[which]
    lengths = products.lengths[:, which]
    every = np.arange(folds + 1)
    left_over = lengths.copy()
    limit = min(most, which.size)
    # By columns: memory that no function needs is never touched.
    q, triangles = np.empty((n * rows, limit), order="F"), np.empty((folds + 1, limit, which.size))
    rotated = np.empty((folds + 1, limit, m))
    taken: list[IntArray] = []
    scores: list[float] = []
    left_out: list[FloatArray] = []
    least = np.full(m, np.inf)
    while (step := len(taken)) < limit and (
        not scores or (step - int(np.argmin(scores)) <= PATIENCE and min(scores) > ROUNDING)
    ):
        usable = left_over > 1e-8 * lengths
        if not usable.any(axis=1).all():
            break
        gains = np.where(usable, (explained[:, :, judged] ** 2).sum(axis=2) / np.where(usable, left_over, 1.0), -1.0)
        # The constant comes first.
        pick = gains.argmax(axis=1) if taken else np.zeros_like(every)
        size = np.sqrt(left_over[every, pick])
        gain = explained[every, pick] / size[:, None]
        before = triangles[every, :step, pick]
        likely = partial(_largest, gains, which)
        row = products.rows(which[pick], likely)[:, which] - (before[:, None] @ triangles[:, :step])[:, 0]
        row /= size[:, None]
        triangles[:, step], rotated[:, step] = row, gain
        explained -= row[:, :, None] * gain[:, None]
        left_over -= row**2
        left_over[every, pick] = 0.0
        for k, part in enumerate(parts):
            direction = (products.columns[part, which[pick[k]]] - q[part, :step] @ before[k]) / size[k]
            rest[part] -= direction[:, None] * gain[k]
            q[part, step] = direction
        taken.append(pick)
        left_out.append(rest.reshape(n, rows, m) * scale)
        relative = data.relative(left_out[-1])
        least = np.fmin(least, relative)
        scores.append(float(relative[judged].max()))
    count = 1 + int(np.argmax(np.array(scores) <= 1.05 * min(scores) + 1e-13))
    picks = np.array(taken[:count])
    coefficients = np.array(
        [solve_triangular(triangles[k, :count, picks[:, k]].T, rotated[k, :count] * scale) for k in range(folds)]
    )
    chosen = Candidate(dictionary.order, dictionary.q, which[picks[:, -1]], sparse=True)
    without = _Folds(products.held, which[picks[:, :-1].T], coefficients, left_out[count - 1])
    return scores[count - 1], chosen, without, least


def _regress(left: FloatArray, right: FloatArray, data: Data, chosen: Candidate, folds: _Folds | None) -> Fit:
    from scipy.linalg import solve_triangular

    n, rows, m = right.shape
    q, triangle = np.linalg.qr(left[:, :, chosen.which].reshape(n * rows, -1))
    blocks = q.reshape(n, rows, -1)
    rotated = np.einsum("zrp,zrm->pm", blocks, right)
    residual = right - blocks @ rotated
    coefficients = solve_triangular(triangle, rotated)
    if folds is None:
        held = np.arange(n)
        errors = left_out(blocks, residual, held)
        terms = chosen.which.size
        moved = solve_triangular(triangle, np.einsum("zrp,zrm->pzm", blocks, errors).reshape(terms, n * m))
        without = np.zeros((n, left.shape[2], m))
        without[:, chosen.which] = coefficients - np.swapaxes(moved.reshape(terms, n, m), 0, 1)
    else:
        held, errors = folds.held, folds.errors
        without = np.zeros((len(folds.which), left.shape[2], m))
        for one, which, found in zip(without, folds.which, folds.coefficients, strict=True):
            one[which] = found
    squares = (residual**2).sum(axis=(0, 1))
    sampled = _sampled(blocks, residual, triangle)
    unseen = errors[:, 0] / np.sqrt(data.weights)[:, None]
    relative = data.relative(errors)
    return Fit(chosen, coefficients, without, sampled, triangle, data.size(errors), relative, squares, held, unseen)


def _sampled(blocks: FloatArray, residual: FloatArray, triangle: FloatArray) -> FloatArray:
    """Standard errors (P, m) of coefficients from the residuals of independent samples.

    With (I − H_z)^(−1/2) r_z for the errors of sample z (R. M. Bell, D. F. McCaffrey, Survey Methodology 28 (2002)
    169–181), whose variance is right if the errors of all rows are alike.
    """
    from scipy.linalg import solve_triangular

    n, rows, m = residual.shape
    sizes, axes = np.linalg.eigh(np.eye(rows) - blocks @ np.swapaxes(blocks, 1, 2))
    scaled = (np.swapaxes(axes, 1, 2) @ residual) / np.sqrt(np.maximum(sizes, 1e-10))[:, :, None]
    moved = np.einsum("zrp,zrm->pzm", blocks, axes @ scaled).reshape(-1, n * m)
    return np.asarray(np.sqrt((solve_triangular(triangle, moved).reshape(-1, n, m) ** 2).sum(axis=1)))
