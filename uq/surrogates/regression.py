"""What a regression says of outputs: moments and indices, their errors, and reasons to doubt them.

The fit is that of `uq.surrogates.least_squares`. Its errors count what samples show, the functions that may be missing,
and what distributions with tails hide.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from forward.findings import Finding, entries
from forward.model import FloatArray
from uq.estimators.doubts import of_constants, of_expansion, of_gradients, of_reach, of_shape, of_tails
from uq.estimators.indices import MOST, Analysis, Shapley, coefficient_moments, moments, shares
from uq.estimators.moments import Estimates, Z, either, error_of_root, plain_moments, student
from uq.estimators.tails import agree, counted, influences
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.surrogates.basis import FULL, Basis, Candidates, IntArray, candidates_of, gaps, lacking, neighbours, orthonormal
from uq.surrogates.least_squares import NOTHING, Data, Fit, fit_best
from uq.surrogates.outside_samples import Beyond, beside, beyond, contradicted, roots, towards_ends

BoolArray = NDArray[np.bool_]
ORDER, HIGHEST = 6, 20  # orders: what is tried first, and at most
ENOUGH = 1e-4  # of the standard deviation: left by a fit of which no higher order is tried
EXPLAINS = 8.0  # times less is left of what is smooth by half as high an order again; of kinks and poles 2 or 3
ROUGH = 0.1  # relative leave-one-out error above which the error of the mean counts that of the samples
CLOSE = 0.03  # relative leave-one-out error above which the tails of the samples matter
TRUSTED = 0.3  # relative leave-one-out error up to which moments are those of the fit
FEWEST = 10  # samples of which the outermost tell how tails begin, beside an expansion
POINTS = 4096  # at which the origin of the variance of an expansion is computed
SYMMETRIC = 0.01  # share of even powers up to which a function is odd, and the reverse
PULLS = 2.0  # times the largest effect of such a function that is claimed, since others are missing too
LEAST = 1 / 3  # of the norm that is missing: claimed of 64 samples whatever the functions looked at would do


@dataclass(frozen=True)
class Regression:
    """A fit to samples and the sets from which it was chosen.

    Attributes
    ----------
    inputs
        The parameters.
    candidates
        The sets of functions that were tried.
    data
        The samples that have an answer.
    fit
        The fit.
    """

    inputs: Inputs
    candidates: Candidates
    data: Data
    fit: Fit

    @classmethod
    def fitted(cls, inputs: Inputs, candidates: Candidates, data: Data) -> Regression:
        """Fit data with the best of these sets; errors as in `of`."""
        return cls(inputs, candidates, data, fit_best(candidates, data))

    @classmethod
    def of(
        cls, inputs: Inputs, points: FloatArray, values: FloatArray, tangents: FloatArray | None, max_order: int | None
    ) -> Regression:
        """Fit values (n, m) and, if given, tangents (n, m, d) at points (n, d), as `higher` does without a `max_order`.

        Raises `SolveError` if there are not enough samples.
        """
        data = Data.at(points, values, tangents, inputs)
        found = cls.fitted(inputs, candidates_of(inputs, max_order or ORDER, data.rows), data)
        return found if max_order else found.higher()

    def first(self, count: int) -> Regression:
        """Return the fit to the first `count` samples that have an answer; errors as in `of`."""
        return Regression.fitted(self.inputs, self.candidates, self.data.some(slice(count)))

    def higher(self) -> Regression:
        """Return the fit of half as high an order again, as long as the highest is chosen, and it explains far more.

        What is left of smooth functions falls geometrically. Of kinks, or poles next to an end, it falls slowly where
        samples are and hardly between them: with higher orders 8 to 18 % of such runs missed the mean in silence.
        """
        found, data = self, self.data
        while found.at_limit and found.candidates.limit < HIGHEST and found.fit.relative.max() > ENOUGH:
            order = min(found.candidates.limit * 3 // 2, HIGHEST)
            again = Regression.fitted(self.inputs, candidates_of(self.inputs, order, data.rows), data)
            if EXPLAINS * again.fit.relative.max() > found.fit.relative.max():
                break
            found = again
        return found

    @property
    def at_limit(self) -> bool:
        """Whether functions of the highest order that may be tried are part of the fit."""
        return int(self.basis.indices.sum(axis=1).max()) == self.candidates.limit

    @property
    def basis(self) -> Basis:
        """The P functions of the fit."""
        return self.candidates.basis.subset(self.fit.chosen.which)

    def estimates(self, of: Analysis | None = None) -> dict[str, FloatArray]:
        """Return estimates from the coefficients, by output, with standard errors.

        Without another analysis these are moments and Sobol' indices, or Shapley effects where few parameters depend
        on each other.
        """
        draws = self.inputs.draws
        if of is not None or self.inputs.independent:
            return self._estimates(of or coefficient_moments)
        assert draws is not None
        if len(draws.names) > MOST:
            return self._estimates(moments)
        effects = Shapley.of(self.candidates.basis, draws)
        found = self._estimates(effects.analysis)
        of_draws = effects.error(self.fit.coefficients.T, self.basis.indices)
        return found | {"shapley_error": np.hypot(found["shapley_error"], of_draws)}

    def rest(self) -> FloatArray | None:
        """Return the norms (m,) of what a fit leaves of outputs; None if no parameter has a tail."""
        missing = self.missing()
        return None if missing is None else np.maximum(self.fit.loo, missing)

    def missing(self) -> FloatArray | None:
        """Return the norms (m,) of what the basis misses in outputs; None if no parameter has a tail.

        On a bounded range samples reach the ends, and the leave-one-out error shows what is missing. In tails they do
        not: above all, the next power of a parameter with a tail is missing, or that after it, and it grows beyond the
        samples; where few samples chose from many powers, lower ones may be missing too (`gaps`). If the residuals of
        such a function ψ of norm 1, fitted at these samples, have the sum of squares r², then outputs whose residuals
        have the sum of squares s² miss a function of norm s/r.
        """
        tails = self.inputs.tails
        if not tails.any():
            return None
        joint = np.isin(np.arange(tails.size), self.inputs.joint)
        least = np.full(self.fit.loo.size, np.inf)
        for places in map(np.flatnonzero, (tails & ~joint, tails & joint)):
            if places.size:
                least = np.minimum(least, self._left_of_following(places))
        return np.sqrt(shares(self.fit.squares, least))

    def hidden(self, missing: FloatArray) -> FloatArray:
        """Return errors (m,) of standard deviations by what a fit lacks in tails, of norms `missing` (m,).

        If a function ψ of norm 1 that the basis lacks is part of an output with the norm t, then the fit leaves it out,
        and its coefficients c take up what of ψ looks like the basis at the samples: with the columns A = QR of the
        regression they are off by t R⁻¹Qᵀψ, and the standard deviation σ by t c·R⁻¹Qᵀψ/σ (without the constant) and
        t²/(2σ). For t stands the most that the residuals allow, see `missing`.
        """
        tails, basis, data, fit = self.inputs.tails, self.basis, self.data, self.fit
        if self.inputs.draws is not None:
            return missing
        varying = (basis.indices != 0).any(axis=1)
        c = fit.coefficients[varying]
        std, d = np.linalg.norm(c, axis=0), np.arange(tails.size)
        most, partners = self._most(tails), self._most(d >= 0)
        powers = np.array(list(neighbours(basis.indices, np.isin(d, most) & tails, partners)))
        following = orthonormal(self.inputs, powers)
        moved, sizes = self._taken_up(data.left(following))
        pulls = np.abs(shares(moved[varying].T @ c, std))
        norms = np.sqrt(fit.squares * shares(np.ones_like(sizes), sizes)[:, None])
        largest = (norms * pulls).max(axis=0)
        least = LEAST * min(1.0, (64 / len(data.points)) ** 0.5)  # points integrate a product the better, the more
        return np.asarray(np.sqrt((PULLS * largest) ** 2 + (least * missing) ** 2 + shares(missing**2, std) ** 2))

    def edges(self) -> FloatArray:
        """Return errors (2, m) of means and standard deviations by what is missing in ranges, as large as may be.

        That is a root of the distance to either end of a bounded parameter, or of all of them along the slope of the
        output, or a function next to those of the basis: it goes wrong next to corners, where few samples are.
        As in `hidden`, ψ is taken up with R⁻¹Qᵀψ, and residuals allow the norm that they have over those of ψ: here
        what is left of ψ is known everywhere, and its mean and its product with the expansion are integrals.
        """
        inputs, basis, fit = self.inputs, self.basis, self.fit
        bounded, first = ~inputs.tails, basis.indices.sum(axis=1) == 1
        if not bounded.any():
            return np.zeros((2, fit.loo.size))
        directions, asked = towards_ends(bounded, basis.indices[first], fit.coefficients[first])
        drawn = inputs.points(sobol_points(0, 0, 0, POINTS, bounded.size))
        (values, slopes), (everywhere, _) = (
            roots(inputs, basis.coordinates, points, directions) for points in (self.data.points, drawn)
        )
        near = bounded & np.isin(np.arange(bounded.size), self._most(bounded))
        following = orthonormal(inputs, beside(basis.indices, near))
        columns = replace(self.data, values=values, slopes=None if self.data.slopes is None else slopes).right
        taken, sizes = self._taken_up(np.concatenate([columns, self.data.left(following)], axis=2))
        everywhere = np.hstack([everywhere, following.values(drawn)])
        asked = np.concatenate([asked, np.ones((len(following.indices), fit.loo.size))])
        functions, varying = basis.values(drawn), (basis.indices != 0).any(axis=1)
        left, c = everywhere - functions @ taken, fit.coefficients[varying]
        of_std = shares(left.T @ (functions[:, varying] @ c) / POINTS, np.linalg.norm(c, axis=0))
        norms = asked * np.sqrt(shares(fit.squares, sizes[:, None]))
        return np.array([(norms * np.abs(pull)).max(axis=0) for pull in (left.mean(axis=0)[:, None], of_std)])

    def _most(self, some: BoolArray) -> IntArray:
        """Return the parameters that matter most, `FULL` at most, of some of them (d,) first."""
        varying = (self.basis.indices != 0).any(axis=1)
        squares = self.fit.coefficients[varying] ** 2
        matter = shares(squares, squares.sum(axis=0)).sum(axis=1) @ (self.basis.indices[varying] > 0)
        return np.argsort(-np.where(some, matter, -1.0), kind="stable")[:FULL]

    @cached_property
    def _columns(self) -> tuple[FloatArray, FloatArray]:
        """Q and R of the columns of the regression."""
        left = self.data.left(self.basis)
        q, triangle = np.linalg.qr(left.reshape(-1, left.shape[2]))
        return q, triangle

    def _taken_up(self, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what fits to other functions have for coefficients (P, K), and what they leave: sums of squares (K,).

        These are given by their columns (n, rows, K), as in `Data.left`.
        """
        from scipy.linalg import solve_triangular

        q, triangle = self._columns
        columns = columns.reshape(len(q), -1)
        along = q.T @ columns
        return solve_triangular(triangle, along), ((columns - q @ along) ** 2).sum(axis=0)

    def _estimates(self, of: Analysis) -> dict[str, FloatArray]:
        """Moments and indices by output, with standard errors by the jackknife over samples and the residual variance.

        The jackknife is taken around the estimate itself, so that a bias counts too. If functions were selected, each
        of its fits selects again, since the selection is as uncertain as the samples.

        The jackknife tests a fit in the gap that a sample leaves, and its error is too large; a regression with
        independent errors takes the smooth remainder for random errors, and its error is too small. The error of the
        mean is the geometric mean of the two: in 30 settings of five functions its 95 % intervals covered 92 to 100 %,
        those of the jackknife 97 to 100 % at up to four times the length, the others 55 to 100 %. Up to two samples for
        each parameter it is the jackknife's.

        Next to the ends of ranges few samples show little: what a root there would do is an error too (`edges`).
        None of this sees what lies outside the basis. So there are other estimates too, from the samples, each with the
        fit without it as control (`_unseen`): half the distance to them counts as an error, and for the standard
        deviation the residual variance λ², λ the leave-one-out error. Above `ROUGH` their error counts for the mean,
        and above `TRUSTED` samples tell, not the fit (`_of_samples`; docs/decisions/0011-claims-of-expansions.md).

        In tails, the part of the function outside the basis is large, and no sample shows it. If distributions have
        tails, the norm of what is `missing` there is added: for the standard deviation, as |σ_f − σ_g| ≤ ‖f − g‖, or
        what this does to it (`hidden`), and over √n for the mean, whose error is the jackknife's. What the fit leaves
        where samples are, λ, is no such error of the standard deviation: it is known by samples, as of bounded
        parameters.

        Indices have the share of λ² in the variance as a further error; above `NOTHING` there are none (NaN).
        """
        fit, largest = self.fit, self.candidates.basis.indices
        indices = largest[fit.chosen.which]
        central = of(fit.coefficients.T, indices)
        left_out = of(np.swapaxes(fit.without, 1, 2), largest)
        groups, n = len(fit.without), len(fit.unseen)
        seen = self._unseen()
        sampled, trusted = self._of_samples(seen).named, ~self.controlled
        missing, nothing = self.missing(), np.zeros_like(fit.loo)
        tails, hidden = (nothing, nothing) if missing is None else (np.maximum(fit.loo, missing), self.hidden(missing))
        bias = shares(fit.loo**2, 2 * central["std"])
        whole: FloatArray = np.where(trusted, central["std"], sampled["std"])
        share = shares(fit.loo**2, whole**2)
        # The norm of what a fit may leave beyond λ, which n samples know to λ√(κ/n), κ the kurtosis of the errors at
        # samples that are left out: few of them decide λ where a function grows towards an end of a range, and there it
        # is larger still where none of few samples is.
        squares, edges = fit.unseen**2, self.edges()
        unsure = np.sqrt(shares((squares**2).mean(axis=0), squares.sum(axis=0)))
        further = {
            "mean": np.sqrt(
                np.maximum(tails, unsure) ** 2 / n
                + edges[0] ** 2
                + (seen.mean - central["mean"]) ** 2 / 4
                + np.where(fit.relative > ROUGH, seen.mean_error, 0.0) ** 2
            ),
            "std": np.sqrt(hidden**2 + unsure**2 + bias**2 + edges[1] ** 2 + (seen.std - central["std"]) ** 2 / 4),
        }
        for name, values in left_out.items():
            spread = np.sqrt((groups - 1) / groups * ((values - central[name]) ** 2).sum(axis=0))
            if name == "mean" and missing is None and n > 2 * largest.shape[1]:
                spread = np.sqrt(spread * fit.sampled[(indices == 0).all(axis=1)][0])
            if name in further:
                central[f"{name}_error"] = np.where(trusted, np.hypot(spread, further[name]), sampled[f"{name}_error"])
                central[name] = np.where(trusted, central[name], sampled[name])
            else:
                by_index = (-1, *(1,) * (spread.ndim - 1))
                something = (fit.relative <= NOTHING).reshape(by_index)
                central[f"{name}_error"] = np.where(something, np.hypot(spread, share.reshape(by_index)), np.nan)
                central[name] = np.where(something, central[name], np.nan)
        return central

    def _of_samples(self, seen: Estimates) -> Estimates:
        """Moments from samples with fits as controls, as in `_unseen`, or from plain ones, with their standard errors.

        Beyond the samples a fit may have any moments, as one of a high order in a tail does. So those with fits count
        only if they agree with the plain ones, and then the distance to these is an error too.
        """
        data = self.data
        if np.ptp(data.weights) > 0:  # of a projection there are no plain samples
            return replace(seen, std_error=np.hypot(seen.std_error, self.fit.loo))
        plain = counted(plain_moments(data.values), self.inputs, data.values)
        seen = counted(seen, self.inputs, data.values, self._unseen_samples()[:2])
        errors = np.hypot(seen.mean_error, seen.mean - plain.mean), np.hypot(seen.std_error, seen.std - plain.std)
        apart = replace(seen, mean_error=errors[0], std_error=errors[1])
        return either(agree(seen, plain), apart, plain)

    def _unseen(self) -> Estimates:
        """Moments by output from the samples, each with the fit without it as control, and their standard errors.

        With g_z for the fit without sample z, E[f] = ⟨E g_z + f(ω_z) − g_z(ω_z)⟩, and likewise for the square: unbiased
        for independent samples, however bad the fits are; with constants as fits it is plain Monte Carlo.
        """
        data = self.data
        weights = (data.weights / data.weights.sum())[:, None]
        independent = 1 / (weights**2).sum()  # samples of equal weight that are as informative
        first, second, offset = self._unseen_samples()
        mean = (weights * first).sum(axis=0)
        second = second - 2 * mean * first + mean**2
        scale = student(max(len(data.values) - 1, 1)) / Z / np.sqrt(max(independent - 1, 1))
        mean_error = scale * np.sqrt((weights * (first - mean) ** 2).sum(axis=0))
        variance = (weights * second).sum(axis=0)
        variance_error = scale * np.sqrt((weights * (second - variance) ** 2).sum(axis=0))
        std = np.sqrt(np.maximum(variance + mean_error**2, 0.0))
        one = np.ones_like(mean)
        return Estimates(offset + mean, mean_error, std, error_of_root(std, variance_error), one, one)

    def _unseen_samples(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Samples (n, m) of both moments of deviations from values (m,), each with the fit without it as control."""
        fit, data, largest = self.fit, self.data, self.candidates.basis.indices
        offset = data.values.mean(axis=0)
        constant = (largest == 0).all(axis=1)
        mean = (fit.without[:, constant].sum(axis=1) - offset)[fit.held]
        square = (fit.without[:, ~constant] ** 2).sum(axis=1)[fit.held] + mean**2
        f = data.values - offset
        return mean + fit.unseen, square + f**2 - (f - fit.unseen) ** 2, offset

    def _left_of_following(self, places: IntArray) -> FloatArray:
        """Least square r² (m,) of a function of the next powers of parameters at these places, see `rest`."""
        basis = self.basis
        degrees = basis.indices[:, places]
        powers = np.zeros((2, places.size, basis.indices.shape[1]), dtype=np.int64)
        following = degrees.max(axis=0) + 1
        powers[:, np.arange(places.size), places] = following, following + 1
        inside = [gaps(basis.indices, i) for i in places]
        functions, norms = lacking(self.inputs, basis, np.concatenate([*powers, *inside]))
        _, found = self._taken_up(self.data.left(functions))
        found = np.where(norms > 0, found / np.where(norms > 0, norms, 1.0) ** 2, np.inf)
        next_one, after = found[: 2 * places.size].reshape(2, places.size, 1)
        # An odd function, or one beside a slope, has no even powers, and lacks the one after the next.
        squares = self.fit.coefficients**2
        alike = ((degrees > 1) & (degrees % 2 == following % 2)).T @ squares
        lacks = alike <= SYMMETRIC * ((degrees > 1).T @ squares)
        least = np.minimum(next_one, np.where(lacks, after, np.inf)).min(axis=0)
        return np.asarray(np.minimum(least, found[2 * places.size :].min(initial=np.inf)))

    def beyond(self, points: FloatArray | None = None) -> Beyond:
        """Return what the fit has in tails beyond its samples, or beyond points (n, d)."""
        points = self.data.points if points is None else points
        return beyond(self.inputs, self.basis, self.fit.coefficients, points)

    @property
    def controlled(self) -> BoolArray:
        """Whether the moments of outputs (m,) are those of the samples, with the fit as control."""
        return self.fit.relative > TRUSTED

    def doubts(self, names: Sequence[str]) -> Iterator[Finding]:
        """Find reasons to doubt the estimates of these outputs."""
        n = len(self.data.points)
        yield from of_constants(names, self.data.values)
        yield from of_expansion(names, self.fit.relative, TRUSTED, NOTHING, n)
        yield from of_gradients(names, contradicted(self.basis, self.data))
        rough = [name for name, left in zip(names, self.fit.relative.tolist(), strict=True) if left > CLOSE]
        if rough and self.at_limit:
            yield Finding("expansion-order", "note", {"order": self.candidates.limit}, about=entries(rough))
        rest = self.rest()
        whole = self.fit.relative if rest is None else shares(rest, self.data.values.std(axis=0))
        yield from of_reach(names, self.beyond().share, self.fit.relative, whole, n)
        trusted = np.flatnonzero(self.fit.relative <= TRUSTED)
        drawn = self.inputs.points(sobol_points(0, 0, 0, POINTS, len(self.inputs.names)))
        values = self.basis.values(drawn) @ self.fit.coefficients[:, trusted]
        yield from of_shape([names[i] for i in trusted], values, self.fit.relative[trusted], n)
        if np.ptp(self.data.weights) == 0:
            which = np.flatnonzero(self.controlled | ((self.fit.relative > CLOSE) & (n >= FEWEST)))
            first, second, _ = self._unseen_samples()
            some, moved = [names[i] for i in which], influences(first, second)[:, which]
            relative = 1.0 * self.controlled[which]  # of others the shape tells more than so few samples
            yield from of_tails(some, self.data.values[:, which], relative, moved, expanded=True)
