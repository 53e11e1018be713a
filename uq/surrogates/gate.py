"""Whether an expansion may stand for samples: one gate for all that take it as a control, or in their place.

E[f] = E[c] + E[f − c]: what the samples do not see of f − c is in no scatter of theirs, and the leave-one-out error of
a choice of functions is the least of many. So the *whole* fit, with its choice, is repeated without each part of its
samples in turn (`repeated`), and an expansion c counts

- by what these fits c_k miss at the samples that they have not seen (`Trial.relative`), where c is to be chosen;
- by how well samples integrate c_k − c, which is like f − c, and whose moments are known (`wrong`): where they are
  further off than their scatter says, they do not see the places that matter, and that is claimed;
- by how much of the norm of c_k − c they do not show in bounded ranges, as next to a corner (`Trial.scaled`);
- where there are no samples but those of the fit, by the moments of the c_k (`Trial.spread`);
- with what it has beyond all samples (`uq.surrogates.outside_samples`): there it is a guess;
- only if its mean and standard deviation are those of the plain samples, within their errors
  (`uq.estimators.tails.agree`).

No solve is taken for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from forward.model import FloatArray, SolveError
from uq.estimators.indices import coefficient_moments, shares
from uq.surrogates.basis import Basis
from uq.surrogates.least_squares import fit_best
from uq.surrogates.regression import Regression

PARTS = 5  # of the samples, each predicted by a fit to the others
EXPLAINED = 3.0  # times their squared standard errors: differences up to there are explained by chance
LEAST = 2  # fits that tell what others would be


@dataclass(frozen=True)
class Trial:
    """Fits to all but a part of the samples each, with functions that were chosen without it.

    Attributes
    ----------
    points
        Of the samples (n, d).
    relative
        What the fits miss at the samples that they have not seen: root mean square (m,) over the standard deviation.
    fits
        Functions and coefficients (P, m) of each.
    basis, apart
        Functions, and the coefficients (K, P, m) of what each of them differs from the fit to all samples.
    whole
        Moments (2, m) by the fit to all samples: mean and standard deviation.
    gained
        Leave-one-out error (m,) of that fit over what these miss.
    """

    points: FloatArray
    relative: FloatArray
    fits: tuple[tuple[Basis, FloatArray], ...]
    basis: Basis
    apart: FloatArray
    whole: FloatArray
    gained: FloatArray

    @property
    def spread(self) -> FloatArray:
        """Errors (2, m) of mean and standard deviation: by the jackknife, whose estimate of the bias counts too.

        What a pole next to a corner has where no sample is, all fits miss, but the smaller ones miss more of it. With
        errors that fall by a factor q from these to the whole fit, q/(1 − q) of the difference is left; by 1/n, K − 1.
        """
        K = len(self.fits)
        if K < LEAST:  # nothing is known
            return np.full_like(self.whole, np.inf)
        apart = np.array([_moments(basis, c) for basis, c in self.fits]) - self.whole
        q = np.minimum(self.gained, 1 - 1 / K)
        return np.asarray(np.hypot(np.maximum(q / (1 - q), 1) * apart.mean(axis=0), np.sqrt(K - 1) * apart.std(axis=0)))

    def scaled(self, points: FloatArray, left: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Scale these differences to what the fit leaves (n, m) of values at points (n, d).

        Returns the factors (K, m), and the norms (m,) of what the points do not show, where of most differences it is
        more than half.
        """
        shown = ((self.basis.values(points) @ self.apart) ** 2).mean(axis=1)
        size = np.sqrt((left**2).mean(axis=0))
        beyond = np.median(shares((self.apart**2).sum(axis=1), shown), axis=0) - 2
        return shares(size, np.sqrt(shown)), size * np.sqrt(np.maximum(beyond, 0.0))


def repeated(of: Regression) -> Trial:
    """Repeat a fit without each part of its samples in turn; where the others do not determine any, there is none."""
    data, largest = of.data, of.candidates.basis
    part = np.arange(len(data.points)) % min(PARTS, len(data.points))
    errors = np.empty_like(data.values)
    fits: list[tuple[Basis, FloatArray]] = []
    apart = np.zeros((PARTS, len(largest.indices), data.values.shape[1]))
    for k in np.unique(part):
        rest, own = np.flatnonzero(part != k), np.flatnonzero(part == k)
        try:
            fit = fit_best(of.candidates, data.some(rest))
        except SolveError:
            errors[own] = data.values[own] - data.values[rest].mean(axis=0)
        else:
            basis = largest.subset(fit.chosen.which)
            errors[own] = data.values[own] - basis.values(data.points[own]) @ fit.coefficients
            apart[len(fits), fit.chosen.which] = fit.coefficients
            apart[len(fits), of.fit.chosen.which] -= of.fit.coefficients
            fits.append((basis, fit.coefficients))
    relative = np.sqrt(shares((errors**2).mean(axis=0), data.values.var(axis=0)))
    gained = shares(of.fit.relative, relative)
    used = np.flatnonzero(apart.any(axis=(0, 2)))
    differences = largest.subset(used), apart[: len(fits)][:, used]
    whole = _moments(of.basis, of.fit.coefficients)
    return Trial(data.points, relative, tuple(fits), *differences, whole, gained)


def _moments(basis: Basis, coefficients: FloatArray) -> FloatArray:
    found = coefficient_moments(coefficients.T, basis.indices)
    return np.array([found["mean"], found["std"]])


def wrong(differences: FloatArray, sizes: FloatArray | None = None) -> FloatArray:
    """Return errors (…) of means over scrambles, as those of functions show whose expectations are zero.

    Infinite where there are fewer than two functions: then nothing is known.

    Parameters
    ----------
    differences
        Means (K, R, …) over each of R scrambles of K such functions.
    sizes
        Factors (K, …) that make each as large as what is in question: then all count, as large as they are.
    """
    K = len(differences)
    if K < LEAST:
        return np.asarray(np.inf)
    R = differences.shape[1]
    off, scatter = differences.mean(axis=1), differences.var(axis=1, ddof=1) / R
    # Medians, since a fit may have lost just the sample that decided: of each by its own scatter, and of all.
    size = np.median(off**2, axis=0)
    apart = np.median(off**2 - EXPLAINED * scatter, axis=0)
    explained = np.maximum(apart, size - EXPLAINED * np.median(scatter, axis=0)) <= 0
    found = np.hypot(np.sqrt(size), (K - 1) * np.median(off, axis=0))
    if sizes is not None:
        off = sizes * off
        found = np.maximum(found, np.hypot(np.sqrt((off**2).mean(axis=0)), (K - 1) * off.mean(axis=0)))
    return np.where(explained, 0.0, found)
