"""Regression of outputs on values and gradients in orthonormal polynomials.

The expansion Σ_a c_a ψ_a(ω) is fitted to the samples by least squares. A sample gives one row for its value, ψ(ω_z)·c =
f(ω_z), and with derivatives one row more for each parameter, ∂ψ/∂t_i(ω_z)·c = ∂f/∂t_i(ω_z) along the coordinates t of
the polynomials (`uq.inputs.coordinates`): d + 1 rows for little more than the cost of one solve. All rows have the same
weight: for five test functions of two to four parameters, weights of 1/4 to 3/2 for the gradients gave errors within
the scatter of the designs.

The error of a fit is measured by leaving samples out, each with all of its rows. With the rows A_z of sample z, its
residuals r_z, and H_z = A_z (AᵀA)⁻¹ A_zᵀ, the fit without sample z has the error (I − H_z)⁻¹ r_z there, and its
coefficients differ by −(AᵀA)⁻¹ A_zᵀ (I − H_z)⁻¹ r_z: no fit is repeated.

The choice of functions, the fit and the leave-one-out errors use the same factorisation, hence one file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from forward.model import Finding, FloatArray, SolveError
from uq.estimators.doubts import of_constants, of_expansion, of_reach, of_shape, of_tails
from uq.estimators.indices import Analysis, coefficient_moments, moments, shares
from uq.estimators.moments import Z, error_of_root, student
from uq.estimators.tails import influences
from uq.evaluation.evaluate import Evaluations
from uq.inputs.distributions import Normal
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.surrogates.basis import Basis, IntArray, by_degree, hyperbolic, hyperbolic_count, orthonormal, recurrence

BoolArray = NDArray[np.bool_]
TRUNCATIONS = (0.5, 0.75, 1.0)
ROWS_PER_TERM = 2  # rows of the regression for each unknown, at least
FULL = 8  # number of parameters up to which whole bases are tried; above, functions are selected one by one
DICTIONARY = 2000  # functions to select from, at most
FOLDS = 10  # parts of the samples that are left out in turn to choose the functions
ROUNDING = 1e-13  # relative error below which no function is added
LIKELY = 24  # functions whose inner products are computed together
ROUGH = 0.1  # relative leave-one-out error above which the error of the mean counts that of the samples
CLOSE = 0.03  # relative leave-one-out error above which the tails of the samples matter
TRUSTED = 0.3  # relative leave-one-out error up to which moments are those of the fit
NOTHING = 0.8  # the same, above which a fit tells nothing about which parameters matter
POINTS = 4096  # at which the origin of the variance of an expansion is computed
SYMMETRIC = 0.01  # share of even powers up to which a function is odd, and the reverse
COMMON = 2  # parameters of which what is missed in their tails adds up
PATIENCE = 30  # functions selected without a gain before the selection ends


# --- candidates ------------------------------------------------------------------------------------------------------


def rows_of(inputs: Inputs, *, gradients: bool) -> int:
    """Number of rows of one sample."""
    return 1 + len(inputs.names) if gradients else 1


@dataclass(frozen=True)
class Candidate:
    """Some functions of the largest basis, by index, with the order and q of their set.

    If `sparse`, they are a dictionary from which functions are selected.
    """

    order: int
    q: float
    which: IntArray
    sparse: bool = False


@dataclass(frozen=True)
class Candidates:
    """Sets of functions to choose from; `all` (P, d) is their union."""

    all: IntArray
    sets: tuple[Candidate, ...]


def whole(inputs: Inputs, order: int) -> Candidates:
    """Return the full basis of one order as the only choice."""
    indices = hyperbolic(len(inputs.names), order, 1.0)
    return Candidates(indices, (Candidate(order, 1.0, np.arange(len(indices))),))


def candidates_of(inputs: Inputs, max_order: int, rows: int, dictionary: int) -> Candidates:
    """Return the bases that `rows` rows may determine, and for each q a set of up to `dictionary` to select from."""
    d = len(inputs.names)
    max_order = min(max_order, inputs.largest_degree)
    most = max(rows // ROWS_PER_TERM, d + 1)
    found: dict[tuple[bool, bytes], tuple[IntArray, int, float]] = {}
    determined = False
    for q in reversed(TRUNCATIONS):
        counts = {order: hyperbolic_count(d, order, q) for order in range(1, max_order + 1)}
        if d <= FULL:
            for order, count in counts.items():
                if count <= most or order == 1:
                    indices = hyperbolic(d, order, q)
                    found.setdefault((False, indices.tobytes()), (indices, order, q))
        order = max(order for order, count in counts.items() if count <= dictionary or order == 1)
        widest = order
        while not determined and order > 0:
            indices = hyperbolic(d, order, q)
            found.setdefault((True, indices.tobytes()), (indices, order, q))
            # With fewer rows than functions, smaller dictionaries help.
            order = order - 1 if rows < counts[order] and order > 2 else 0
        # With as many rows as functions, nothing is lost by selecting from all.
        determined = determined or (widest == max_order and counts[widest] <= rows)
    union = by_degree(np.unique(np.concatenate([indices for indices, *_ in found.values()]), axis=0))
    number = {index.tobytes(): i for i, index in enumerate(union)}
    sets = [
        Candidate(order, q, np.array([number[index.tobytes()] for index in indices]), sparse)
        for (sparse, _), (indices, order, q) in found.items()
    ]
    return Candidates(union, tuple(sets))


# --- regression ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Data:
    """Samples that have an answer: points (n, d), values (n, m), slopes (n, d, m) along the coordinates or None.

    `weights` (n,) are those of the samples in sums of squares.
    """

    points: FloatArray
    values: FloatArray
    slopes: FloatArray | None
    weights: FloatArray

    @classmethod
    def of(cls, evaluations: Evaluations, inputs: Inputs, weights: FloatArray | None) -> Data:
        """Take the evaluations that have an answer; `weights` default to one."""
        ok = evaluations.ok
        tangents = None if evaluations.tangents is None else evaluations.tangents[ok]
        counted = None if weights is None else weights[ok]
        return cls.at(evaluations.points[ok], evaluations.outputs[ok], tangents, inputs, counted)

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
        return Data(self.points[which], self.values[which], slopes, self.weights[which])

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
        share = self.weights / self.weights.sum()
        mean = share @ self.values
        std = np.sqrt(share @ (self.values - mean) ** 2)
        constant = std <= 1e-13 * np.abs(mean)
        return np.where(constant, 0.0, self.size(errors) / np.where(constant, 1.0, std))


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
    """Selections without some of the samples.

    Attributes
    ----------
    held
        Index (n,) of the selection that leaves the sample out.
    which
        Functions (K, P) of each selection.
    coefficients
        Those (K, P, m) of the fit of each selection.
    errors
        Errors (n, rows, m) at each sample, by the fit without it.
    """

    held: IntArray
    which: IntArray
    coefficients: FloatArray
    errors: FloatArray


def fit_best(candidates: Candidates, largest: Basis, data: Data) -> Fit:
    """Choose the functions with the smallest leave-one-out error, and fit.

    Outputs that no choice explains, such as what is zero by symmetry but for rounding, have no say in it if others do.

    Raises
    ------
    SolveError
        If there are not enough samples.
    """
    # Samples that are left out together are next to each other.
    n = len(data.points)
    too_few = f"{n} samples have an answer, too few for an expansion of order 1"
    if not n:
        raise SolveError(too_few)
    held = np.arange(n) % min(n, FOLDS)
    order = np.argsort(held, kind="stable")
    data, held = data.some(order), held[order]
    left, right = data.left(largest), data.right
    products = _Products.of(left, held)
    scores, least = _scores(candidates, products, right, data, held, slice(None))
    explained = least <= NOTHING
    if explained.any() and not explained.all():
        scores, _ = _scores(candidates, products, right, data, held, np.flatnonzero(explained))
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
    candidates: Candidates,
    products: _Products,
    right: FloatArray,
    data: Data,
    held: IntArray,
    judged: slice | IntArray,
) -> tuple[_Scores, FloatArray]:
    """Return the largest leave-one-out error of the outputs `judged` by each choice, and the least of each output (m,).

    Choices that the samples do not determine are left out.
    """
    n, rows, m = right.shape
    d = candidates.all.shape[1]
    scores: _Scores = []
    least = np.full(m, np.inf)
    for candidate in candidates.sets:
        terms, most = candidate.which.size, n * rows // ROWS_PER_TERM
        if candidate.sparse and (d > FULL or n * rows > d):
            score, chosen, folds, relative = _select(products, right, data, candidate, held, most, judged)
            scores.append((score, chosen, folds))
        elif (
            not candidate.sparse
            and terms <= n * rows
            and (candidate.order == 1 or len(candidates.sets) == 1 or terms <= most)
        ):
            q, r = np.linalg.qr(products.columns[:, candidate.which])
            size = np.abs(np.diag(r))
            if size.min() > 1e-10 * size.max():
                blocks = q.reshape(n, rows, terms)
                residual = right - blocks @ np.einsum("zrp,zrm->pm", blocks, right)
                relative = data.relative(_left_out(blocks, residual, held))
                scores.append((float(relative[judged].max()), candidate, None))
            else:
                continue
        else:
            continue
        least = np.fmin(least, relative)
    return [found for found in scores if np.isfinite(found[0])], least


def _left_out(blocks: FloatArray, residual: FloatArray, held: IntArray) -> FloatArray:
    """Errors (n, rows, m) at each sample, by the fit without those that share its number in `held` (n,).

    They follow from the orthonormal columns (n, rows, P) and the residuals.
    """
    errors = np.empty_like(residual)
    for number in np.unique(held):
        out = held == number
        part = blocks[out].reshape(-1, blocks.shape[2])
        rest = np.eye(len(part)) - part @ part.T
        if np.linalg.eigvalsh(rest)[0] < 1e-10:  # without these samples the fit is not determined
            errors[out] = np.inf
        else:
            errors[out] = np.linalg.solve(rest, residual[out].reshape(len(part), -1)).reshape(residual[out].shape)
    return errors


@dataclass(frozen=True)
class _Products:
    """Inner products of the columns of a regression, without the rows of each number in turn.

    They are computed where they are asked for, once for all dictionaries.

    Attributes
    ----------
    columns
        The matrix (n rows, P), samples that are left out together next to each other.
    parts
        The rows of each number.
    """

    columns: FloatArray
    parts: tuple[slice, ...]
    _known: dict[int, FloatArray] = field(default_factory=dict)

    @classmethod
    def of(cls, left: FloatArray, held: IntArray) -> _Products:
        """Take the matrix (n, rows, P) of samples with ascending numbers `held` (n,)."""
        ends = left.shape[1] * np.searchsorted(held, np.arange(held.max() + 2))
        return cls(left.reshape(-1, left.shape[2]), tuple(slice(*pair) for pair in pairwise(ends.tolist())))

    def lengths(self) -> FloatArray:
        """Squared lengths (F + 1, P) of the columns without the rows of each number; the last with all rows."""
        return _without_each(np.array([np.einsum("rp,rp->p", part, part) for part in self._within]))

    def rows(self, pick: IntArray, likely: IntArray) -> FloatArray:
        """Products (F + 1, P) of all columns with column `pick` (F + 1,) for each number; the last with all rows.

        They are computed for many columns at once: for those `likely` to be needed next.
        """
        missing = [j for j in dict.fromkeys(pick.tolist()) if j not in self._known]
        if missing:
            wanted = [*missing, *(j for j in likely.tolist() if j not in missing and j not in self._known)]
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


def _select(
    products: _Products,
    right: FloatArray,
    data: Data,
    dictionary: Candidate,
    held: IntArray,
    most: int,
    judged: slice | IntArray,
) -> tuple[float, Candidate, _Folds, FloatArray]:
    """Select functions one by one, each time the one that explains most of the residuals of the outputs `judged`.

    Orthogonal least squares, from all samples and, to find when to stop, without those of each number in `held` (n,):
    a selection cannot be judged by the samples that it used. It needs only inner products (the Cholesky factor of the
    Gram matrix grows by a row for each function), so that a step does not go through all rows of all functions.

    Returns
    -------
    float, Candidate, _Folds, FloatArray
        The relative error at the samples left out, the functions selected from all samples, and those without some;
        the least relative error (m,) of each output at any step.
    """
    from scipy.linalg import solve_triangular

    n, rows, m = right.shape
    which, parts, folds = dictionary.which, products.parts, len(products.parts)
    size, scale = (np.linalg.norm(one, axis=(0, 1)) for one in (right, right - right.mean(axis=0)))
    scale = np.where(scale > ROUNDING * size, scale, np.maximum(size, 1e-300))  # a constant needs no function
    rest = (right / scale).reshape(n * rows, m)
    explained = np.tile((products.columns.T @ rest)[which], (folds + 1, 1, 1))
    for k, part in enumerate(parts):
        explained[k] -= (products.columns[part].T @ rest[part])[which]
    lengths = products.lengths()[:, which]
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
        likely = np.argsort(-gains.sum(axis=0), kind="stable")[:LIKELY]
        size = np.sqrt(left_over[every, pick])
        gain = explained[every, pick] / size[:, None]
        before = triangles[every, :step, pick]
        row = products.rows(which[pick], which[likely])[:, which] - (before[:, None] @ triangles[:, :step])[:, 0]
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
    return scores[count - 1], chosen, _Folds(held, which[picks[:, :-1].T], coefficients, left_out[count - 1]), least


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
        errors = _left_out(blocks, residual, held)
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


def _unseen_samples(fit: Fit, largest: IntArray, data: Data) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Samples (n, m) of the first two moments of deviations, each with the fit without it as control.

    Returns
    -------
    tuple of numpy.ndarray
        The samples, and the values (m,) from which they deviate.
    """
    offset = data.values.mean(axis=0)
    constant = (largest == 0).all(axis=1)
    mean = (fit.without[:, constant].sum(axis=1) - offset)[fit.held]
    square = (fit.without[:, ~constant] ** 2).sum(axis=1)[fit.held] + mean**2
    f = data.values - offset
    return mean + fit.unseen, square + f**2 - (f - fit.unseen) ** 2, offset


class Beyond(NamedTuple):
    """What an expansion has where no samples are.

    Attributes
    ----------
    share
        Of its variance (m,).
    mean
        √(b p) (m,), with the share b of the variance and the probability p of these places: a bound of the mean over
        them, over the norms. It adds up what is missed of all parameters as if it had one sign; where these are many,
        of `COMMON` of them, and no sign is common to the others.
    """

    share: FloatArray
    mean: FloatArray


def beyond(
    inputs: Inputs, functions: Callable[[FloatArray], FloatArray], coefficients: FloatArray, points: FloatArray
) -> Beyond:
    """Return what an expansion (P, m) has in tails beyond all points (n, d)."""
    m = coefficients.shape[1]
    tails = _tails(inputs)
    if not tails.any():
        return Beyond(np.zeros(m), np.zeros(m))
    drawn = inputs.points(sobol_points(0, 0, 0, POINTS, len(tails)))
    each = ((drawn < points.min(axis=0)) | (drawn > points.max(axis=0))) & tails
    outside = each.any(axis=1)
    values = functions(drawn) @ coefficients
    squares = (values - values.mean(axis=0)) ** 2
    total = squares.sum(axis=0)
    share = shares(squares[outside].sum(axis=0), total)
    apart = COMMON * each.mean(axis=0) @ shares(each.T.astype(float) @ squares, total)
    return Beyond(share, np.sqrt(np.minimum(share * outside.mean(), apart)))


@dataclass(frozen=True)
class Regression:
    """A fit to samples and the sets from which it was chosen.

    Attributes
    ----------
    inputs
        The parameters.
    candidates, largest
        The sets of functions that were tried, and the basis of all of them.
    data
        The samples that have an answer.
    fit
        The fit.
    """

    inputs: Inputs
    candidates: Candidates
    largest: Basis
    data: Data
    fit: Fit

    @classmethod
    def of(
        cls, inputs: Inputs, points: FloatArray, values: FloatArray, tangents: FloatArray | None, max_order: int
    ) -> Regression:
        """Fit values (n, m) and, if given, tangents (n, m, d) at points (n, d).

        Raises
        ------
        SolveError
            If there are not enough samples.
        """
        data = Data.at(points, values, tangents, inputs)
        rows = len(points) * rows_of(inputs, gradients=tangents is not None)
        candidates = candidates_of(inputs, max_order, rows, DICTIONARY)
        largest = orthonormal(inputs, candidates.all)
        return cls(inputs, candidates, largest, data, fit_best(candidates, largest, data))

    def first(self, count: int) -> Regression:
        """Return the fit to the first `count` samples that have an answer; errors as in `of`."""
        data = self.data.some(slice(count))
        return replace(self, data=data, fit=fit_best(self.candidates, self.largest, data))

    @property
    def basis(self) -> Basis:
        """The P functions of the fit."""
        return self.largest.subset(self.fit.chosen.which)

    def estimates(self, of: Analysis | None = None) -> dict[str, FloatArray]:
        """Return estimates from the coefficients, by output, with standard errors.

        Without another analysis these are moments and Sobol' indices, or Shapley effects where parameters depend on
        each other.
        """
        if of is None and not self.inputs.independent:
            return self._dependent()
        return _estimates(self.fit, self.largest.indices, self.data, self.rest(), of or coefficient_moments)

    def _dependent(self) -> dict[str, FloatArray]:
        """Moments and, of few parameters, Shapley effects."""
        from uq.estimators.shapley import MOST, Shapley

        draws = self.inputs.draws
        assert draws is not None
        if len(draws.names) > MOST:
            return _estimates(self.fit, self.largest.indices, self.data, self.rest(), moments)
        of = Shapley.of(self.largest, draws)
        found = _estimates(self.fit, self.largest.indices, self.data, self.rest(), of.analysis)
        of_draws = of.error(self.fit.coefficients.T, self.basis.indices)
        return found | {"shapley_error": np.hypot(found["shapley_error"], of_draws)}

    def rest(self) -> FloatArray | None:
        """Return the norms (m,) of what a fit leaves of outputs; None if no parameter has a tail."""
        missing = self.missing()
        return None if missing is None else np.maximum(self.fit.loo, missing)

    def missing(self) -> FloatArray | None:
        """Return the norms (m,) of what the basis misses in outputs; None if no parameter has a tail.

        On a bounded range samples reach the ends, and the leave-one-out error shows what is missing. In tails they do
        not: above all, the next power of a parameter with a tail is missing, or that after it, and it grows beyond the
        samples. If the residuals of such a function ψ of norm 1, fitted at these samples, have the sum of squares r²,
        then outputs whose residuals have the sum of squares s² miss a function of norm s/r.
        """
        tails = _tails(self.inputs)
        if not tails.any():
            return None
        basis, data = self.basis, self.data
        left = data.left(basis)
        q, _ = np.linalg.qr(left.reshape(left.shape[0] * left.shape[1], -1))
        joint = np.isin(np.arange(tails.size), self.inputs.joint)
        least = np.full(self.fit.loo.size, np.inf)
        for places in map(np.flatnonzero, (tails & ~joint, tails & joint)):
            if places.size:
                least = np.minimum(least, self._left_of_following(places, q))
        return np.sqrt(shares(self.fit.squares, least))

    def _left_of_following(self, places: IntArray, q: FloatArray) -> FloatArray:
        """Least square r² (m,) of a function of the next powers of parameters at these places, see `rest`."""
        basis, data = self.basis, self.data
        degrees = basis.indices[:, places]
        powers = np.zeros((2, places.size, basis.indices.shape[1]), dtype=np.int64)
        following = degrees.max(axis=0) + 1
        powers[:, np.arange(places.size), places] = following, following + 1
        functions, norms = _following(self.inputs, basis, powers.reshape(-1, powers.shape[2]))
        columns = data.left(functions).reshape(len(q), -1)
        found = ((columns - q @ (q.T @ columns)) ** 2).sum(axis=0)
        found = np.where(norms > 0, found / np.where(norms > 0, norms, 1.0) ** 2, np.inf)
        next_one, after = found.reshape(2, places.size, 1)
        # An odd function, or one beside a slope, has no even powers, and lacks the one after the next.
        squares = self.fit.coefficients**2
        alike = ((degrees > 1) & (degrees % 2 == following % 2)).T @ squares
        lacks = alike <= SYMMETRIC * ((degrees > 1).T @ squares)
        return np.asarray(np.minimum(next_one, np.where(lacks, after, np.inf)).min(axis=0))

    @property
    def beyond(self) -> FloatArray:
        """Share (m,) of the variance of the fit that comes from where there are no samples."""
        return beyond(self.inputs, self.basis.values, self.fit.coefficients, self.data.points).share

    @property
    def controlled(self) -> BoolArray:
        """Whether the moments of outputs (m,) are those of the samples, with the fit as control."""
        return self.fit.relative > TRUSTED

    def doubts(self, names: Sequence[str]) -> Iterator[Finding]:
        """Find reasons to doubt the estimates of these outputs."""
        n = len(self.data.points)
        yield from of_constants(names, self.data.values)
        yield from of_expansion(names, self.fit.relative, TRUSTED, NOTHING, n)
        rest = self.rest()
        whole = self.fit.relative if rest is None else shares(rest, self.data.values.std(axis=0))
        yield from of_reach(names, self.beyond, self.fit.relative, whole, n)
        trusted = np.flatnonzero(self.fit.relative <= TRUSTED)
        drawn = self.inputs.points(sobol_points(0, 0, 0, POINTS, len(self.inputs.names)))
        values = self.basis.values(drawn) @ self.fit.coefficients[:, trusted]
        yield from of_shape([names[i] for i in trusted], values, self.fit.relative[trusted], n)
        if np.ptp(self.data.weights) == 0:
            which = np.flatnonzero(self.fit.relative > CLOSE)
            first, second, _ = _unseen_samples(self.fit, self.largest.indices, self.data)
            yield from of_tails(
                [names[i] for i in which],
                self.data.values[:, which],
                1.0 * self.controlled[which],  # of others the shape tells more than so few samples
                influences(first, second)[:, which],
                expanded=True,
            )


def _tails(inputs: Inputs) -> BoolArray:
    """Which parameters (d,) have values beyond those of samples: without bounds, or given by draws, which are many."""
    bounded = [marginal.support is not None for marginal in inputs.marginals.values()]
    return ~np.array(bounded, dtype=bool) | np.isin(np.arange(len(bounded)), inputs.joint)


def _following(inputs: Inputs, basis: Basis, powers: IntArray) -> tuple[Basis, FloatArray]:
    """Return the powers (K, d) of single coordinates that a basis lacks, and the norms (K,) of what is new in them."""
    if basis.joint is None or not powers[:, basis.joint.members].any():
        return orthonormal(inputs, powers), np.ones(len(powers))
    draws, start = inputs.draws, inputs.joint.start
    assert draws is not None
    alpha, beta = recurrence(Normal(mean=0.0, std=1.0), int(powers.max()))
    d = powers.shape[1]
    plain = Basis(basis.coordinates, np.tile(alpha, (d, 1)), np.tile(beta, (d, 1)), powers)
    points = np.hstack([np.tile(inputs.mean[:start], (len(draws.values), 1)), draws.values])
    alone = basis.subset(np.flatnonzero((basis.indices[:, :start] == 0).all(axis=1)))
    known, new = alone.values(points), plain.values(points)
    left = new - known @ (known.T @ (draws.weights[:, None] * new))
    return plain, np.sqrt(draws.weights @ left**2)


def _estimates(fit: Fit, largest: IntArray, data: Data, rest: FloatArray | None, of: Analysis) -> dict[str, FloatArray]:
    """Moments and indices by output, with standard errors from the jackknife over samples and the residual variance.

    The jackknife is taken around the estimate itself, so that a bias counts too. If functions were selected, each of
    its fits selects again, since the selection is as uncertain as the samples.

    The jackknife tests a fit in the gap that a sample leaves, and its error is too large; a regression with independent
    errors takes the smooth remainder for random errors, and its error is too small. The error of the mean is the
    geometric mean of the two: in 30 settings of five functions its 95 % intervals covered 92 to 100 %, those of the
    jackknife 97 to 100 % at up to four times the length, the others 55 to 100 %. Up to two samples for each parameter
    it is the jackknife's.

    None of this sees what lies outside the basis. So there are other estimates too, from the samples, each with the fit
    without it as control (`_unseen`): half the distance to them counts as an error, and for the standard deviation the
    residual variance λ², λ the leave-one-out error. Above `ROUGH` their error counts for the mean, and above `TRUSTED`
    they replace those of the fit (docs/decisions/0011-claims-of-expansions.md).

    In tails, the part of the function outside the basis is large, and no sample shows it. If distributions have tails,
    its norm, the `rest`, is added: for the standard deviation, as |σ_f − σ_g| ≤ ‖f − g‖, and over √n for the mean,
    whose error is the jackknife's.

    Indices have the share of λ² in the variance as a further error; above `NOTHING` there are none (NaN).
    """
    indices = largest[fit.chosen.which]
    central = of(fit.coefficients.T, indices)
    left_out = of(np.swapaxes(fit.without, 1, 2), largest)
    groups, n = len(fit.without), len(fit.unseen)
    seen = _unseen(fit, largest, data)
    trusted = fit.relative <= TRUSTED
    cautious = rest is not None
    tails = np.zeros_like(fit.loo) if rest is None else rest
    bias = shares(fit.loo**2, 2 * central["std"])
    whole: FloatArray = np.where(trusted, central["std"], seen["std"])
    share = shares(fit.loo**2, whole**2)
    unsure = _unsure(fit)
    further = {
        "mean": np.sqrt(
            np.maximum(tails, unsure) ** 2 / n
            + (seen["mean"] - central["mean"]) ** 2 / 4
            + np.where(fit.relative > ROUGH, seen["mean_error"], 0.0) ** 2
        ),
        "std": np.sqrt(np.maximum(tails, unsure) ** 2 + bias**2 + (seen["std"] - central["std"]) ** 2 / 4),
    }
    for name, values in left_out.items():
        spread = np.sqrt((groups - 1) / groups * ((values - central[name]) ** 2).sum(axis=0))
        if name == "mean" and not cautious and n > 2 * largest.shape[1]:
            spread = np.sqrt(spread * fit.sampled[(indices == 0).all(axis=1)][0])
        if name in further:
            known = np.hypot(seen[f"{name}_error"], tails if name == "std" else 0.0)
            if name == "mean":
                known = np.maximum(known, np.hypot(spread, tails / np.sqrt(n)))
            central[f"{name}_error"] = np.where(trusted, np.hypot(spread, further[name]), known)
            central[name] = np.where(trusted, central[name], seen[name])
        else:
            by_index = (-1, *(1,) * (spread.ndim - 1))
            something = (fit.relative <= NOTHING).reshape(by_index)
            central[f"{name}_error"] = np.where(something, np.hypot(spread, share.reshape(by_index)), np.nan)
            central[name] = np.where(something, central[name], np.nan)
    return central


def _unsure(fit: Fit) -> FloatArray:
    """Norm (m,) of what a fit may leave beyond its leave-one-out error λ, which n samples know to λ√(κ/n).

    κ is the kurtosis of the errors at samples that are left out: few of them decide λ where a function grows towards
    an end of a range, and there it is larger still where none of few samples is.
    """
    squares = fit.unseen**2
    return np.asarray(np.sqrt(shares((squares**2).mean(axis=0), squares.sum(axis=0))))


def _unseen(fit: Fit, largest: IntArray, data: Data) -> dict[str, FloatArray]:
    """Moments by output from the samples, each with the fit without it as control, and their standard errors.

    With g_z for the fit without sample z, E[f] = ⟨E g_z + f(ω_z) − g_z(ω_z)⟩, and likewise for the square: unbiased for
    independent samples, however bad the fits are; with constants as fits it is plain Monte Carlo.
    """
    weights = (data.weights / data.weights.sum())[:, None]
    independent = 1 / (weights**2).sum()  # samples of equal weight that are as informative
    first, second, offset = _unseen_samples(fit, largest, data)
    mean = (weights * first).sum(axis=0)
    second = second - 2 * mean * first + mean**2
    scale = student(max(len(data.values) - 1, 1)) / Z / np.sqrt(max(independent - 1, 1))
    mean_error = scale * np.sqrt((weights * (first - mean) ** 2).sum(axis=0))
    variance = (weights * second).sum(axis=0)
    variance_error = scale * np.sqrt((weights * (second - variance) ** 2).sum(axis=0))
    std = np.sqrt(np.maximum(variance + mean_error**2, 0.0))
    return {
        "mean": offset + mean,
        "mean_error": mean_error,
        "std": std,
        "std_error": error_of_root(std, variance_error),
    }
