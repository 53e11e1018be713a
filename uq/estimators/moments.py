"""Mean and standard deviation of scalars and fields from sums over samples, with a linear control variate.

Let w = ψ − ψ̄ be the deviation of a quantity from its value at the mean parameters, and its tangent prediction
L = Σ_i ∂ψ/∂ω_i(ω̄)(ω_i − ω̄_i), with E[L] = 0 and E[L²] = V known exactly. With sample means ⟨·⟩,

    mean:            ψ̄ + ⟨w − β₁L⟩
    second moment:   ⟨w² − β₂(L² − V)⟩

β₁ = 1 is the estimator of Cao, Hussaini & Zang, AIAA J. 42 (2004) 703–710; β₂ = 0 is its published second moment (see
docs/decisions/0003-second-moment-control.md), β₁ = β₂ = 0 is plain Monte Carlo. Everything follows from the means of
w^a L^b, a + b ≤ 4, which are sums and so can be added in any grouping.

An error of a control costs efficiency but never causes bias. But if the control grows faster than the quantity (a
polynomial of a parameter with tails), its second moment comes from where no sample is, and neither the scatter nor the
estimated error is reliable. So a control that increases the scatter is dropped: β = 0, see `_helps`.

Either expectation may also be a sum of independently estimated terms (a telescoping sum over meshes): see `combine`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.estimators.estimate import Variables

if TYPE_CHECKING:
    import xarray as xr

Coefficient = Literal["one", "optimal"]
SecondMoment = Literal["quadratic", "linear"]

ESTIMATES = ("mean", "mean_error", "std", "std_error")
Sums = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
ONE_SIDED = 0.975  # probability on one side of a 95 % interval
Z = 1.96
MORE = 0.5  # over n − 1: relative increase of the scatter of n samples from which a control is dropped
FITTED = 3  # samples up to which the error of a fitted coefficient cannot be estimated
EXPONENTS = tuple((a, total - a) for total in range(1, 5) for a in range(total, -1, -1))
POWERS = [i for i, (_, b) in enumerate(EXPONENTS) if b == 0]  # of w alone


def monomials(w: FloatArray, L: FloatArray | None) -> FloatArray:
    """Return the products w^a L^b (k, …) in the order of `EXPONENTS`; only those with b = 0 if L is None."""
    if L is None:
        return np.array([w, w**2, w**3, w**4])
    powers_w, powers_l = [np.ones_like(w), w], [np.ones_like(L), L]
    for _ in range(3):
        powers_w.append(powers_w[-1] * w)
        powers_l.append(powers_l[-1] * L)
    return np.array([powers_w[a] * powers_l[b] for a, b in EXPONENTS])


@dataclass(frozen=True)
class Estimates:
    """Estimates with their standard errors, each of the shape of the quantity.

    Attributes
    ----------
    mean, mean_error, std, std_error
        In the unit of the quantity. Errors are one standard error; that of the standard deviation is by linearisation.
    coefficient, second_coefficient
        β₁ and β₂.
    """

    mean: FloatArray
    mean_error: FloatArray
    std: FloatArray
    std_error: FloatArray
    coefficient: FloatArray
    second_coefficient: FloatArray

    def variables(self, *names: str) -> Variables:
        """Return these by output, as variables of results; by default all four estimates."""
        return {name: (("output",), getattr(self, name)) for name in names or ESTIMATES}

    @property
    def named(self) -> dict[str, FloatArray]:
        """The four estimates by their names."""
        return {name: getattr(self, name) for name in ESTIMATES}

    @property
    def size(self) -> FloatArray:
        """What errors of means are relative to: the mean, or the standard deviation if that is larger; 1 for zeros."""
        found = np.maximum(np.abs(self.mean), self.std)
        return np.where(found > 0, found, 1.0)

    @property
    def relative_error(self) -> FloatArray:
        """Standard error of the mean relative to the size."""
        return np.asarray(self.mean_error / self.size)

    @property
    def relative_std_error(self) -> FloatArray:
        """Standard error of the standard deviation relative to it."""
        return ratio(self.std_error, self.std)


@dataclass(frozen=True)
class Moments(Estimates):
    """Estimates from independent samples, and the gain of the control variate.

    Attributes
    ----------
    variance_ratio
        Variance of one plain sample over that of one controlled sample (for the mean): above 1 the control helps.
    std_variance_ratio
        The same for the variance estimate.
    """

    variance_ratio: FloatArray
    std_variance_ratio: FloatArray


@dataclass(frozen=True)
class Term:
    """Estimates of a first and a second moment from n independent samples: those of ψ − ψ̄, or terms of a sum for them.

    Attributes
    ----------
    n
        Number of samples, at least 2.
    first, second
        Means of the controlled samples r₁ and r₂ of the two moments, each of the shape of the quantity.
    variance, covariance, second_variance
        Var r₁, Cov(r₁, r₂) and Var r₂.
    """

    n: int
    first: FloatArray
    second: FloatArray
    variance: FloatArray
    covariance: FloatArray
    second_variance: FloatArray


def term(first: FloatArray, second: FloatArray, controls: tuple[FloatArray, FloatArray] | None = None) -> Term:
    """Reduce samples to the moments from which estimates are computed.

    Parameters
    ----------
    first, second
        Samples (n, …) whose expectations are the first and second moment, n ≥ 2.
    controls
        Controls (n, …) of both, with expectation zero; their coefficients are 1, or 0 if they do not help.
    """
    n = len(first)
    first, second = controlled(first, second, controls)
    m1, m2 = first.mean(axis=0), second.mean(axis=0)
    covariance = ((first - m1) * (second - m2)).sum(axis=0) / (n - 1)
    return Term(n, m1, m2, _scatter(first) / (n - 1), covariance, _scatter(second) / (n - 1))


def controlled(
    first: FloatArray, second: FloatArray, controls: tuple[FloatArray, FloatArray] | None
) -> tuple[FloatArray, FloatArray]:
    """Return samples (n, …) of both moments less their controls, where these help."""
    if controls is None:
        return first, second
    n = len(first)
    left = first - controls[0]
    first = np.where(_helps(_scatter(left), _scatter(first), n), left, first)
    moved = 2 * first.mean(axis=0) * first
    left = second - controls[1]
    return first, np.where(_helps(_scatter(left - moved), _scatter(second - moved), n), left, second)


def combine(offset: FloatArray, terms: Sequence[Term]) -> Estimates:
    """Estimate mean and standard deviation from terms that sum to the moments of ψ − ψ̄, each with its own samples."""
    return _estimated(offset, _sums(terms), 1.0, 1.0)


def _sums(terms: Sequence[Term]) -> Sums:
    """Mean of ψ − ψ̄ and its variance; second moment, and the variance of its part in that of ψ, by linearisation."""
    m1 = _sum(t.first for t in terms)
    scatter = _sum(_scatter_of_variance(t, m1) / t.n for t in terms)
    return m1, _sum(t.variance / t.n for t in terms), _sum(t.second for t in terms), scatter


def _estimated(
    offset: FloatArray, sums: Sums, coefficient: float | FloatArray, second: float | FloatArray
) -> Estimates:
    """Return estimates from what `_sums` tells, with β₁ and β₂."""
    m1, mean_variance, square, scatter = sums
    # The squared mean exceeds the square of the expectation by its variance, which is added back: for plain Monte Carlo
    # this gives the usual n − 1.
    std: FloatArray = np.sqrt(np.maximum(square - m1**2 + mean_variance, 0))
    return Estimates(
        mean=offset + m1,
        mean_error=np.sqrt(mean_variance),
        std=std,
        std_error=error_of_root(std, _error_of_variance(scatter, mean_variance)),
        coefficient=np.broadcast_to(coefficient, std.shape),
        second_coefficient=np.broadcast_to(second, std.shape),
    )


def _error_of_variance(scatter: FloatArray, mean_variance: FloatArray) -> FloatArray:
    """Error of σ²: that of the square of an inaccurate mean is larger than its slope says."""
    return np.asarray(np.sqrt(np.maximum(scatter, 0) + 2 * mean_variance**2))


def _scatter_of_variance(one: Term, m1: FloatArray | None = None) -> FloatArray:
    """Variance of r₂ − 2m₁r₁, the influence of a sample on the estimate of σ²; m₁ is the term's own if None."""
    m1 = one.first if m1 is None else m1
    return np.asarray(one.second_variance - 4 * m1 * one.covariance + 4 * m1**2 * one.variance)


def _helps(left: FloatArray, whole: FloatArray, n: int) -> NDArray[np.bool_]:
    """Whether a control does not increase the scatter of n samples, with a margin for small n."""
    return np.asarray(left <= (1 + MORE / (n - 1)) * whole)


def _sum(arrays: Iterable[FloatArray]) -> FloatArray:
    return np.asarray(sum(arrays))


def estimate(
    sums: FloatArray,
    n: int,
    offset: FloatArray,
    control_variance: FloatArray | None = None,
    coefficient: Coefficient = "one",
    second_moment: SecondMoment = "quadratic",
) -> Moments:
    """Estimate mean and standard deviation from the sums of `monomials` over n samples.

    Parameters
    ----------
    sums
        Sums (k, …) of w^a L^b over the samples.
    n
        Number of samples, at least 2.
    offset
        ψ̄ (…).
    control_variance
        V = E[L²] (…); without it the estimators are those of plain Monte Carlo.
    coefficient
        β₁ = 1, or 0 for a control that does not help; or the one that is optimal on these samples.
    second_moment
        Whether L² − V controls the second moment ("quadratic") or not ("linear", as published).
    """
    controlled = control_variance is not None
    exponents = EXPONENTS if controlled else tuple((a, 0) for a in range(1, 5))
    means = {e: s / n for e, s in zip(exponents, sums, strict=True)}
    zero: FloatArray = np.zeros_like(offset)

    def mean_of(a: int, b: int) -> FloatArray:
        return np.asarray(means.get((a, b), zero))

    V = control_variance if control_variance is not None else zero
    if not controlled:
        beta1, beta2 = zero, zero
    elif coefficient == "one":
        beta1, beta2 = zero + 1, zero + 1
    else:
        beta1 = ratio(mean_of(1, 1) - mean_of(1, 0) * mean_of(0, 1), mean_of(0, 2) - mean_of(0, 1) ** 2)
        beta2 = ratio(mean_of(2, 2) - mean_of(2, 0) * mean_of(0, 2), mean_of(0, 4) - mean_of(0, 2) ** 2)
    if second_moment == "linear":
        beta2 = zero

    def reduced(beta1: FloatArray, beta2: FloatArray) -> Term:
        bessel = n / (n - 1)
        m1 = mean_of(1, 0) - beta1 * mean_of(0, 1)  # of r1 = w − β₁L
        q = mean_of(2, 0) - beta2 * mean_of(0, 2)  # of r2 = w² − β₂L²
        m11 = mean_of(2, 0) - 2 * beta1 * mean_of(1, 1) + beta1**2 * mean_of(0, 2)
        m12 = mean_of(3, 0) - beta1 * mean_of(2, 1) - beta2 * mean_of(1, 2) + beta1 * beta2 * mean_of(0, 3)
        m22 = mean_of(4, 0) - 2 * beta2 * mean_of(2, 2) + beta2**2 * mean_of(0, 4)
        var1 = np.maximum(m11 - m1**2, 0) * bessel
        return Term(n, m1, q + beta2 * V, var1, (m12 - m1 * q) * bessel, np.maximum(m22 - q**2, 0) * bessel)

    plain = reduced(zero, zero)
    beta1 = np.where(_helps(reduced(beta1, zero).variance, plain.variance, n), beta1, 0.0)
    left, whole = (_scatter_of_variance(reduced(beta1, beta)) for beta in (beta2, zero))
    beta2 = np.where(_helps(left, whole, n), beta2, 0.0)
    one = reduced(beta1, beta2)
    found = _sums([one])
    _, mean_variance, _, scatter = found
    claimed = n * _error_of_variance(scatter, mean_variance) ** 2
    return Moments(
        **vars(_estimated(offset, found, beta1, beta2)),
        variance_ratio=ratio(plain.variance, one.variance, empty=1.0),
        std_variance_ratio=ratio(_scatter_of_variance(plain), claimed, empty=1.0),
    )


def plain_moments(values: FloatArray, offset: FloatArray | None = None) -> Moments:
    """Estimate both from independent samples (n, …), by deviations from an offset (…), by default from their mean."""
    offset = values.mean(axis=0) if offset is None else offset
    return estimate(monomials(values - offset, None).sum(axis=1), len(values), offset)


def estimate_from_samples(
    w: FloatArray,
    L: FloatArray,
    offset: FloatArray,
    control_variance: FloatArray,
    coefficient: Coefficient = "one",
    second_moment: SecondMoment = "quadratic",
) -> Moments:
    """Estimate mean and standard deviation from the deviations w and controls L (n, …) of all samples, as `estimate`.

    The errors of "optimal" coefficients also count what their fit hides, which the sums over samples do not tell.
    """
    n = len(w)
    found = estimate(monomials(w, L).sum(axis=1), n, offset, control_variance, coefficient, second_moment)
    if coefficient == "one" or n <= FITTED:
        return found
    squares = L**2 if second_moment == "quadratic" else np.zeros_like(L)
    means = np.array([w, w**2, L, squares])  # every sample is a replicate of one
    expected = np.zeros_like(control_variance), squares.any() * control_variance
    fitted = estimate_from_replicates(means, offset, expected, "optimal")
    return replace(found, mean_error=fitted.mean_error, std_error=fitted.std_error)


def estimate_from_replicates(
    means: FloatArray,
    offset: FloatArray,
    expected: tuple[FloatArray, FloatArray] | None = None,
    coefficient: Coefficient = "one",
) -> Estimates:
    """Estimate mean and standard deviation from independent replicates, with errors from their scatter.

    A replicate is a set of points, which may depend on each other, over which the mean of every function is unbiased.
    With means over all replicates ⟨·⟩, the estimators are those of the module for a control C of the deviation and D of
    its square:

        mean:            ψ̄ + ⟨w − β₁(C − E[C])⟩
        second moment:   ⟨w² − β₂(D − E[D])⟩

    Parameters
    ----------
    means
        Means (2, R, …) of w and w² over each of R replicates; (4, R, …) of w, w², C and D with a control.
    offset
        ψ̄ (…).
    expected
        E[C] and E[D] (…).
    coefficient
        β = 1, or 0 for a control that does not help; or the slope of the regression over the replicates: these, not the
        points, tell what is left for the control to explain (Hickernell, Lemieux & Owen, Statist. Sci. 20 (2005) 1–31).
        The errors count the fitted slopes and the distance of the controls from their expectations, see `_regression`;
        R > 3.

    Returns
    -------
    Estimates
        Errors are one standard error, with R − 1 degrees of freedom: a 95 % interval is ± 2.13 of them for 16
        replicates.
    """
    w, square = means[:2]
    R = len(w)
    beta1 = beta2 = np.zeros_like(offset)
    pulls: list[FloatArray | float] = [1.0, 1.0]
    if expected is not None:
        c, d = means[2] - expected[0], means[3] - expected[1]
        beta1 = beta2 = np.ones_like(offset)
        if coefficient == "optimal":
            beta1, pulls[0] = _regression(w, c)
            beta2, pulls[1] = _regression(square, d)
        helps = _helps(_scatter(w - beta1 * c), _scatter(w), R)
        beta1, pulls[0] = np.where(helps, beta1, 0.0), np.where(helps, pulls[0], 1.0)
        w = w - beta1 * c
        moved = 2 * w.mean(axis=0) * w
        helps = _helps(_scatter(square - beta2 * d - moved), _scatter(square - moved), R)
        beta2, pulls[1] = np.where(helps, beta2, 0.0), np.where(helps, pulls[1], 1.0)
        square = square - beta2 * d
    # By how much each replicate moves the means: the squares add up to the variances.
    moves1, moves2 = (
        pull * (y - y.mean(axis=0)) / np.sqrt(R * (R - 1)) for pull, y in zip(pulls, (w, square), strict=True)
    )
    m1 = w.mean(axis=0)
    scatter = ((moves2 - 2 * m1 * moves1) ** 2).sum(axis=0)
    return _estimated(offset, (m1, (moves1**2).sum(axis=0), square.mean(axis=0), scatter), beta1, beta2)


def error_of_root(std: FloatArray, variance_error: FloatArray) -> FloatArray:
    """Error of σ given the error e of σ².

    It is e/(2σ) if that is small. If σ² is underestimated, so is its error: intervals of ln σ² are better (D. G.
    Bonett, Comput. Stat. Data Anal. 50 (2006) 775–782), whose upper side, at two errors, is used: σ (exp(e/σ²) − 1)/2.
    At most √e, the size that σ may have if the estimate of σ² is 0.
    """
    with np.errstate(over="ignore"):
        upper = std / 2 * np.expm1(np.minimum(ratio(variance_error, std**2), 100.0))
    return np.asarray(np.where(std > 0, np.minimum(upper, np.sqrt(variance_error)), np.sqrt(variance_error)))


def either(which: NDArray[np.bool_], first: Estimates, second: Estimates) -> Estimates:
    """Return the first of two estimates where `which` says so, the second elsewhere."""
    names = [one.name for one in fields(Estimates)]
    return Estimates(*(np.where(which, getattr(first, name), getattr(second, name)) for name in names))


def running(rounds: Iterable[Estimates]) -> Variables:
    """Return means and their errors, round by round, as variables of results."""
    means, errors = zip(*((one.mean, one.mean_error) for one in rounds), strict=True)
    by = ("round", "output")
    return {"running_mean": (by, np.array(means)), "running_mean_error": (by, np.array(errors))}


def _scatter(values: FloatArray) -> FloatArray:
    return np.asarray(((values - values.mean(axis=0)) ** 2).sum(axis=0))


def _regression(y: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Slope of y on x, and how much more each set (R, …) moves the mean of y at x = 0 than it moves ȳ alone.

    A line is drawn towards the sets that are far out, and misses them by less than it would without them: residuals
    are taken over 1 − h, h the leverage, as the jackknife has them (J. G. MacKinnon, H. White, J. Econometrics 29
    (1985) 305–325, there HC3). By these 95 % intervals of standard deviations cover 93 to 96 % of sets of 64 to 256
    samples of five functions, by residuals alone 87 to 94 %.
    """
    R = len(y)
    x_mean = x.mean(axis=0)
    scatter = _scatter(x)
    slope = ratio(((x - x_mean) * (y - y.mean(axis=0))).sum(axis=0), scatter)
    pulled = ratio(x - x_mean, scatter)
    seen = np.maximum(1 - 1 / R - pulled * (x - x_mean), 1e-10)  # rounding, where a set has a line of its own
    return slope, (R - 1) * (1 / R - x_mean * pulled) / seen


def ratio(a: FloatArray, b: FloatArray, empty: float = 0.0) -> FloatArray:
    """A / b, and `empty` where both vanish (a node that does not move)."""
    both = (a == 0) & (b == 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(both, empty, a / np.where(both, 1, b))


def half_width(dataset: xr.Dataset) -> float:
    """Standard errors on either side of a 95 % interval of results: more if they come from a few scrambles."""
    return Z if "scramble" not in dataset else student(int(dataset["scramble"].max()))


def student(freedom: float) -> float:
    """Return the standard errors on either side of a 95 % interval with these degrees of freedom."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, ONE_SIDED))
