"""The contribution of tails beyond the samples to the error of a standard deviation.

The largest of n samples of a log-normal quantity is near its quantile at 1 − 1/n. A share of the variance comes from
beyond, and most sets of n samples miss it: their standard deviation is too small, and so is its estimated error, which
comes from their scatter. Samples whose logarithms are about symmetric look log-normal, and their tails follow from the
standard deviation s of all logarithms, which few samples determine much better than the tail itself.

Half the excess of this share over that of a normal quantity, which scatter covers, counts as a relative standard error
of the standard deviation. With it, 95 % intervals of plain Monte Carlo with 64 to 1 024 samples cover 89 to 97 % up to
s = 0.65, and 87 to 96 % at 0.83 (without: 84 to 96 % and 81 to 88 %); those of 64 quasi-random samples 87 to 93 %
instead of 76 to 92 %, and those of 1 024 up to 100 % instead of 79 to 97 %.

Tails on both sides, shifted ones, ends of a range and the remainders of controls look log-normal to no logarithm. What
is estimated is the mean of the influences v of the samples on the variance; what n of them do not show is the part of
its expectation beyond their quantile at 1 − 1/n, on either side. It follows from how steeply the outermost ¾ n^¾ of
them rise (`missed`), and what exceeds the same of a normal quantity, which scatter covers, is a standard error too, of
means as well.

Intervals of a mean are also too short if its samples are skewed, whether they have tails or not: see `skewed`.

Few replicates may agree by chance, and no design makes them agree where few samples carry the variance: `by_chance`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.estimators.moments import Estimates, error_of_root, plain_moments, ratio
from uq.inputs.random_parameters import Inputs

AGREE = 1e-12  # standard errors of means over the standard deviation up to which replicates are equal
APART = 4.0  # standard errors between moments with a control and without
FROM = 0.25  # standard deviation of logarithms up to which scatter suffices
CLOSER = 0.75  # skewness of logarithms over that of the values: below, the values look log-normal
SHORTER = -0.6  # skewness of logarithms below which the far tail is shorter than that of a log-normal
ENDLESS = 2.1  # kurtosis of logarithms below which they seem bounded: 1.8 for a uniform, 3 for a normal quantity
OUTERMOST = 0.75  # times n^¾: how many of the outermost influences tell what is beyond them
STEEPEST = 5.0  # slope of their logarithm against a normal quantity
GROWTH = 0.4  # limits of tails grow with n to this power
CARRIED = 2.5  # `concentration` from which few of 64 samples carry a variance: 2.1 for normal ones
CHANCE = 0.05  # probability of a scatter so much smaller than it is
ROUNDING = 1e-9  # of the variance

Found = TypeVar("Found", bound=Estimates)


def influences(first: FloatArray, second: FloatArray, mean: FloatArray | None = None) -> FloatArray:
    """Return the influence of each sample (n, m) on the variance, from samples of the first and the second moment.

    Of a part of a sum, the `mean` (m,) of the first moment is that of the sum; by default it is that of the samples.
    """
    moved = second - 2 * (first.mean(axis=0) if mean is None else mean) * first
    return np.asarray(moved - moved.mean(axis=0))


def skewed(samples: FloatArray) -> FloatArray:
    """By how much (m,) intervals of the mean of samples (n, m) are to be longer, as these are skewed.

    With the skewness γ, intervals of z = 1.96 errors on either side miss the mean more often by φ(z) z (z⁴ + 2z² − 3)
    γ²/(9n) (P. Hall, The Bootstrap and Edgeworth Expansion (1992), section 2.5), which lengthens them by 1.08 γ²/n.
    """
    deviations = samples - samples.mean(axis=0)
    deviations = ratio(deviations, np.abs(deviations).max(axis=0))  # sixth powers of small and large numbers are none
    squares = (deviations**2).sum(axis=0)
    return np.asarray(np.sqrt(1 + 2.16 * ratio((deviations**3).sum(axis=0) ** 2, squares**3)))


def kurtosis(values: FloatArray) -> FloatArray:
    """Fourth central moment of values (n, m) over the squared variance (m,); 3, as of normal ones, if all are equal."""
    centred = values - values.mean(axis=0)
    return ratio((centred**4).mean(axis=0), (centred**2).mean(axis=0) ** 2, empty=3.0)


def concentration(moved: FloatArray, variance: float) -> float:
    """Mean square of influences (n,) over the square of their mean size; 0 if all are rounding errors."""
    size = float(np.abs(moved).mean())
    return float((moved**2).mean()) / size**2 if size > ROUNDING * variance else 0.0


def shown(n: int) -> float:
    """How much larger limits of tails are for n samples than for 64: more samples show more of a tail."""
    return float(max(1.0, n / 64) ** GROWTH)


def by_chance(found: Found, moved: FloatArray, replicates: int) -> Found:
    """Return estimates from few replicates with errors of standard deviations that are not small by chance.

    The squared scatter of R replicates is as good as R − 1 degrees of freedom: two claim a quarter of the true error or
    less in 16 % of all cases, though their wide intervals hold. Where few samples carry the variance, what an even
    design gains is little, so that as many independent samples tell the error better: it is at least theirs, but for
    what chance explains (the ratio that the scatter falls short of in 5 % of all cases: 16 for 2 replicates, 2.9 for 4,
    1.4 for 16). Of 64 exponentials of half a normal quantity in two sets, errors were more than four times the claim
    in 16 % of cases, and are in 7 %.

    Parameters
    ----------
    found
        The estimates, with errors from the scatter of the replicates.
    moved
        Influences (n, m) of the samples on the variance, with controls if there are any.
    replicates
        Their number R ≥ 2.
    """
    from scipy.special import chdtri

    n, freedom = len(moved), replicates - 1
    most = np.sqrt(freedom / chdtri(freedom, 1 - CHANCE)) * found.std_error
    plain = error_of_root(found.std, moved.std(axis=0) / np.sqrt(max(n - 1, 1)))
    variances = (found.std**2).tolist()
    kappa = np.array([concentration(one, v) for one, v in zip(moved.T, variances, strict=True)])
    floor = np.where(kappa > CARRIED * shown(n), np.minimum(plain, most), 0.0)
    return replace(found, std_error=np.maximum(found.std_error, floor))


def counted(
    found: Found, inputs: Inputs, values: FloatArray, controlled: tuple[FloatArray, FloatArray] | None = None
) -> Found:
    """Return estimates from samples (n, m) with errors that include tails beyond them, and their skewness.

    Replicates may agree by chance, as those of rare events do: then the errors are those of independent samples.

    Parameters
    ----------
    found
        The estimates.
    inputs
        The parameters.
    values
        Values (n, m) of the samples.
    controlled
        Samples (n, m) of the first two moments with their controls; by default without.
    """
    n, m = values.shape
    agree = found.mean_error <= AGREE * found.std
    few = np.array([agree[i] and np.unique(values[:, i]).size <= n / 2 for i in range(m)])
    if few.any():
        plain = plain_moments(values)
        found = replace(
            found,
            mean_error=np.where(few, plain.mean_error, found.mean_error),
            std_error=np.where(few, plain.std_error, found.std_error),
        )
    if controlled is None:
        deviations = values - values.mean(axis=0)
        controlled = deviations, deviations**2
    first, moved = controlled[0], influences(*controlled)
    further = np.maximum(of_influences(found, inputs, moved), unseen(inputs, values) * found.std)
    of_mean = np.minimum(missed(first), first.std(axis=0)) if inputs.unbounded.any() else 0.0
    return replace(
        found,
        mean_error=np.hypot(found.mean_error * skewed(first), of_mean),
        std_error=np.hypot(found.std_error * skewed(moved), further),
    )


def agree(found: Estimates, plain: Estimates) -> NDArray[np.bool_]:
    """Whether moments (m,) with a control are those of the samples without, within `APART` standard errors.

    Standard deviations on a scale of logarithms: where samples show too little of one, its error is too small as well.
    """
    apart = np.abs(found.mean - plain.mean) <= APART * np.hypot(found.mean_error, plain.mean_error)
    sizes = [np.maximum(np.maximum(one.std, one.std_error), np.finfo(float).tiny) for one in (found, plain)]
    with np.errstate(invalid="ignore"):  # what is claimed to be unknown agrees with nothing
        error = np.hypot(*(one.std_error / size for one, size in zip((found, plain), sizes, strict=True)))
    return np.asarray(apart & (np.abs(np.log(sizes[0] / sizes[1])) <= APART * error))


def with_tails(
    found: Estimates, inputs: Inputs, moved: Sequence[FloatArray], values: FloatArray, of: int = 0
) -> Estimates:
    """Return estimates that are sums over parts, with errors of standard deviations that count tails beyond samples.

    Parameters
    ----------
    found, inputs
        The estimates, and the parameters.
    moved
        Influences (n, m) of the samples of each part on the variance.
    values, of
        Values (n, m) in the samples of one part, and its number.
    """
    tails = [of_influences(found, inputs, one) for one in moved]
    tails[of] = np.maximum(tails[of], unseen(inputs, values) * found.std)
    return replace(found, std_error=np.linalg.norm([found.std_error, *tails], axis=0))


def of_influences(found: Estimates, inputs: Inputs, moved: FloatArray) -> FloatArray:
    """Return the error (m,) of standard deviations due to influences beyond those (n, m) of the samples.

    Zero if no parameter has a tail: samples then reach the ends.
    """
    if not inputs.unbounded.any():
        return np.zeros_like(found.std)
    return ratio(np.minimum(missed(moved), found.std**2), 2 * found.std)


def missed(moved: FloatArray) -> FloatArray:
    """Return the part (m,) of the expectation of influences (n, m) that n samples miss and their scatter does not show.

    With z the normal quantity of the same rank, the outermost ones are assumed to follow A exp(b (z − a)), a log-normal
    tail, of which A exp(b²/2 − ba) Φ(b − a) is beyond the quantile a at 1 − 1/n. If ln v bends downwards among them (an
    end of the range, a kink), b is what its slope falls to. The slope is told from thirds of them, of two or more each,
    and not at all from fewer: of 12 samples, three single ones saw tails in one of seven sines. Of the squares of
    normal samples, `_covered` times their standard error is beyond a, which is subtracted.
    """
    from scipy.special import ndtr, ndtri

    n = len(moved)
    k = int(OUTERMOST * n**0.75)
    third = k // 3
    if third < 2:
        return np.zeros(moved.shape[1])
    z, a = -ndtri((np.arange(1, k + 1) - 0.375) / (n + 0.25)), -ndtri(1 / n)
    ordered, size = np.sort(moved, axis=0), moved.std(axis=0)
    middle = ordered[n // 2]
    outer = z[:third].mean()
    tails = []
    for distance in (ordered[::-1][:k] - middle, middle - ordered[:k]):
        top = np.maximum(distance[:third].mean(axis=0), 1e-300)
        chord, end = (
            np.log(top / np.maximum(distance[third:stop].mean(axis=0), 1e-3 * top)) / (outer - z[third:stop].mean())
            for stop in (k, 2 * third)
        )
        b = np.clip(np.minimum(chord, 2 * end - chord), 0.0, STEEPEST)
        level = top / np.exp(b * (z[:third, None] - a)).mean(axis=0)
        tails.append(level * np.exp(b**2 / 2 - b * a) * ndtr(b - a))
    # What both sides miss cancels, as in products of a control and its remainder.
    total = np.abs(tails[0] - tails[1]) - _covered(n) * size / np.sqrt(n)
    return np.where(size > 0, np.maximum(total, 0.0), 0.0)


def of_squares(found: FloatArray, error: FloatArray, moved: FloatArray, factor: float) -> FloatArray:
    """Return errors of shares of a variance (q,) that are means of squares, from their errors by scatter.

    Where few samples with large squares decide a share, sets that miss them have a small share with a small error: such
    a share is known in proportion, to factors of exp(± c e/T) for intervals of c errors e, whose upper side counts. And
    what n samples do not show of squares that seem to go on (`missed`) is no more than one of them that varies as much
    as all of the output does.

    Parameters
    ----------
    found, error
        The shares T (q,) and their errors e by scatter (q,).
    moved
        Influences (n, q) of the samples on them.
    factor
        c.
    """
    relative = factor * np.minimum(ratio(error, found, empty=1.0), 1.0)
    grown = np.where(relative > 0, np.expm1(relative) / np.where(relative > 0, relative, 1.0), 1.0)
    return np.hypot(error * grown, np.minimum(missed(moved - moved.mean(axis=0)), 1 / len(moved)))


def _covered(n: int) -> float:
    """Part of E[z²], z normal, beyond the two quantiles of probability 1/n together, over the error √(2/n) of n."""
    from scipy.special import ndtr, ndtri

    a = -ndtri(0.5 / n)
    return float(2 * (a * np.exp(-(a**2) / 2) / np.sqrt(2 * np.pi) + ndtr(-a)) / np.sqrt(2 / n))


def unseen(inputs: Inputs, values: FloatArray) -> FloatArray:
    """Return the relative error (m,) of standard deviations due to tails beyond n samples (n, m) that look log-normal.

    Zero if no parameter has a tail: samples then reach the ends.
    """
    n, m = values.shape
    if not inputs.unbounded.any():
        return np.zeros(m)
    return np.array([_share_beyond(s, n) / 2 if s > FROM else 0.0 for s in map(spread, values.T)])


def spread(values: FloatArray) -> float:
    """Standard deviation of the logarithms of values (n,) that look log-normal, beyond the median; otherwise 0.

    Logarithms may have a longer tail there than normal ones, but not a much shorter one: they would be bounded.
    """
    if not (values.min() > 0 or values.max() < 0):
        return 0.0
    logarithms = np.log(np.abs(values))
    deviations = logarithms - logarithms.mean()
    ends = (deviations**4).mean() < ENDLESS * (deviations**2).mean() ** 2
    skewness = _skewness(logarithms)
    if ends or not SHORTER < skewness < CLOSER * abs(_skewness(values)):
        return 0.0
    return float(np.sqrt(2 * (np.maximum(logarithms - np.median(logarithms), 0) ** 2).mean()))


def _share_beyond(s: float, n: int) -> float:
    """Share of the variance of exp(s z), z normal, beyond the quantile of z at 1 − 1/n, minus that of z itself.

    With w = exp(s²): E[(x − μ)²; z > a] = w²Φ(2s − a) − 2wΦ(s − a) + wΦ(−a), and Var x = w² − w.
    """
    from scipy.special import ndtr, ndtri

    a, w = -ndtri(1 / n), np.exp(s**2)
    share = (w * ndtr(2 * s - a) - 2 * ndtr(s - a) + ndtr(-a)) / (w - 1)
    normal = a * np.exp(-(a**2) / 2) / np.sqrt(2 * np.pi) + ndtr(-a)
    return float(max(share - normal, 0.0))


def _skewness(values: FloatArray) -> float:
    deviations = values - values.mean()
    return float((deviations**3).mean() / max(float((deviations**2).mean()) ** 1.5, 1e-300))
