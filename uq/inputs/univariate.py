"""What a distribution of one parameter can say: moments, quantiles, the rule and the coordinate of its polynomials.

Quantiles are computed from the nearer end, p = F(ω) or 1 − p, so that neither tail is lost to rounding; moments are
closed forms, or Gauss rules around a point of the distribution, so that none is a difference of large numbers.
Chaospy's own are accurate to six digits if there is no closed form, and wrong for beta(a, b) with a + b = 2, a ≠ b,
and for normals that are truncated beyond eight standard deviations.

Polynomials are of the coordinate in which they converge (`logarithmic`), see docs/decisions/0009-coordinates.md.
"""

from __future__ import annotations

import inspect
from abc import abstractmethod
from functools import cache, cached_property
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import ConfigDict, model_validator

from forward.model import FloatArray
from forward.settings import Settings, nearest
from uq.inputs.quadrature import panels

RARE = 1e-4  # probability beyond the range, for a distribution with a tail
TAIL = 1e-16  # smallest distance to 0 and 1 of a probability for which a quantile is computed
EXTREME = 1e60  # fourth powers of numbers above it, or below its inverse, leave the range of doubles
NARROW = 1e-10  # standard deviation over the mean below which rounding of the parameter affects results
WIDE = 10.0  # ratio of the quantiles at 10⁻⁴ and 1 − 10⁻⁴ from which polynomials are of the logarithm
SIX_DIGITS = 1e-6  # to which chaospy's quantiles have to be those of its distribution function
FAR = 7.0  # standard normal value beyond which hardly anything of a variance may lie


class Univariate(Settings):
    """A distribution of one parameter, in the units of that parameter."""

    closed: ClassVar[bool] = False
    """Whether the recurrence of the orthogonal polynomials is known in closed form."""

    @property
    def _frame(self) -> tuple[float, float]:
        """Origin and unit of the variable u = (ω − origin)/unit of the next three methods."""
        return 0.0, 1.0

    @abstractmethod
    def _log_density(self, u: FloatArray) -> FloatArray:
        """Ln of the density of u, −∞ outside."""

    @abstractmethod
    def _cumulative(self, u: FloatArray) -> FloatArray:
        """Distribution function of u, inside."""

    @abstractmethod
    def _inverse(self, p: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Quantile u at p = 1 − q, with ln of the density there."""

    @cached_property
    def moments(self) -> tuple[float, float]:
        """Expected value and standard deviation."""
        origin, offsets, weights = self.rule
        mean = float(weights @ offsets)
        return origin + mean, float(np.sqrt(weights @ (offsets - mean) ** 2))

    def recurrence(self, degree: int) -> FloatArray:
        """Return α and β (2, degree + 1) of the orthogonal polynomials of (ω − mean)/std, if `closed`; β_0 = 1.

        π_k+1 = (t − α_k) π_k − β_k π_k−1 (W. Gautschi, Orthogonal Polynomials (2004), theorem 1.27).
        """
        raise NotImplementedError

    @property
    def rule(self) -> tuple[float, FloatArray, FloatArray]:
        """A point of the distribution, and offsets from it with weights (of sum 1) that integrate polynomials."""
        raise NotImplementedError

    @property
    def support(self) -> tuple[float, float] | None:
        """Ends of a bounded range; None for a distribution with tails."""
        return None

    @property
    def range(self) -> tuple[float, float]:
        """Ends of the support or, for a tail, the quantile that one of ten thousand samples exceeds."""
        return self.ends(3.7190164854556804)  # −Φ⁻¹(RARE)

    @cached_property
    def logarithmic(self) -> bool:
        """Whether polynomials are of ln ω instead of ω."""
        return False

    @cached_property
    def of_coordinate(self) -> tuple[float, float]:
        """Expected value and standard deviation of the argument of polynomials: ω, or ln ω if `logarithmic`."""
        if not self.logarithmic:
            return self.moments
        origin, offsets, weights = self.rule
        logs = np.log(origin + offsets)
        mean = float(weights @ logs)
        return mean, float(np.sqrt(weights @ (logs - mean) ** 2))

    def density(self, values: FloatArray) -> FloatArray:
        """Density at values of any shape."""
        origin, unit = self._frame
        u = (np.asarray(values, dtype=float) - origin) / unit
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return np.asarray(np.exp(self._log_density(u)) / abs(unit))

    def cumulative(self, values: FloatArray) -> FloatArray:
        """Distribution function at values of any shape."""
        origin, unit = self._frame
        return np.asarray(np.clip(self._cumulative((np.asarray(values, dtype=float) - origin) / unit), 0.0, 1.0))

    def quantile(self, probability: FloatArray) -> FloatArray:
        """Inverse of the distribution function, of any shape."""
        origin, unit = self._frame
        p = np.asarray(probability, dtype=float)
        return np.asarray(origin + unit * self._inverse(p, np.asarray(1 - p))[0])

    def from_normal(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map standard normal values z, of any shape, to values of the parameter F⁻¹(Φ(z)), with the derivatives."""
        from scipy.special import ndtr

        origin, unit = self._frame
        z = np.asarray(z, dtype=float)
        u, log_density = self._inverse(np.maximum(ndtr(z), TAIL), np.maximum(ndtr(-z), TAIL))
        return origin + unit * u, abs(unit) * np.exp(-(z**2) / 2 - np.log(2 * np.pi) / 2 - log_density)

    def ends(self, z: float) -> tuple[float, float]:
        """Ends of the support or, for a tail, the values that belong to the standard normal ones −z and z."""
        if self.support is not None:
            return self.support
        lower, upper = self.from_normal(np.array([-z, z]))[0]
        return float(lower), float(upper)

    def at(self, probability: float) -> float:
        """Quantile of one probability."""
        return float(self.quantile(np.array([probability]))[0])

    def check_numbers(self) -> None:
        """Raise a ValueError if the numbers do not go together."""

    @model_validator(mode="after")
    def _sound(self) -> Univariate:
        self.check_numbers()
        mean, std = self.moments
        if np.isfinite(mean) and not (
            max(abs(mean), std) < EXTREME and std > 1 / EXTREME and std < EXTREME * abs(mean or std)
        ):
            raise ValueError(
                f"mean {mean:.6g} and standard deviation {std:.3g}: too large, small or wide for double precision, "
                f"expected numbers between {1 / EXTREME:g} and {EXTREME:g} in their own units"
            )
        if not (np.isfinite(mean) and np.isfinite(std) and std > NARROW * abs(mean)):
            raise ValueError(
                f"mean {mean:.6g} and standard deviation {std:.3g}: too narrow for double precision, expected "
                f"a standard deviation above {NARROW:g} of the mean, or a fixed value in the model"
            )
        return self


class Bounded(Univariate):
    """A distribution of one parameter within a range."""

    lower: float
    upper: float

    @property
    def support(self) -> tuple[float, float]:
        return self.lower, self.upper

    @property
    def _frame(self) -> tuple[float, float]:
        return self.lower, self.upper - self.lower

    @cached_property
    def logarithmic(self) -> bool:
        """As for every distribution: without closed forms, if it is positive and its bulk spans more than a decade."""
        return not self.closed and self.lower > 0 and self.at(1 - RARE) > WIDE * self.at(RARE)

    def quantile(self, probability: FloatArray) -> FloatArray:
        return np.clip(super().quantile(probability), self.lower, self.upper)

    def from_normal(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As for every distribution, within the range in spite of rounding."""
        values, slopes = super().from_normal(z)
        return np.clip(values, self.lower, self.upper), slopes

    def check_numbers(self) -> None:
        if not self.lower < self.upper:
            raise ValueError(f"lower = {self.lower:g} and upper = {self.upper:g}, expected lower < upper")
        if not np.isfinite(self.upper - self.lower):
            message = f"lower = {self.lower:g} and upper = {self.upper:g}, expected a range that a number can hold"
            raise ValueError(message)


class Chaospy(Univariate):
    """A distribution of chaospy, by its name there, with its numbers as chaospy calls them.

    Its quantiles are chaospy's, to about six digits of the probability and not beyond that of 1 − 10⁻¹⁶; the kinds of
    this program are exact in both tails. Where the constructor has `lower` and `upper`, the distribution is bounded.

    Parameters
    ----------
    name
        Such as "LogGamma", "Weibull" or "Kumaraswamy".
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, float]
    kind: Literal["chaospy"] = "chaospy"
    name: str

    @cached_property
    def dist(self) -> Any:
        """Chaospy's own; raises `ValueError` if there is none of this name, or not with these numbers."""
        import chaospy

        classes = inspect.getmembers(chaospy, inspect.isclass)
        known: dict[str, Any] = {
            n: one for n, one in classes if one.__module__.startswith("chaospy.distributions.collection")
        }
        if self.name not in known:
            raise ValueError(f"chaospy has no distribution '{self.name}'; {nearest(self.name, sorted(known))}")
        numbers, wanted = dict(self.model_extra or {}), inspect.signature(known[self.name]).parameters
        for number in numbers:
            if number not in wanted:
                raise ValueError(f"chaospy's {self.name} has no number '{number}'; {nearest(number, list(wanted))}")
        for number, one in wanted.items():
            if one.default is one.empty and number not in numbers:
                raise ValueError(f"chaospy's {self.name} needs a number '{number}', expected {', '.join(wanted)}")
        try:
            made = known[self.name](**numbers)
        except Exception as error:
            message = f"chaospy makes no {self.name} of these numbers: {error or type(error).__name__}"
            raise ValueError(message) from None
        if len(made) != 1 or made.interpret_as_integer:
            message = f"chaospy's {self.name} is not one continuous number, expected a distribution with a density"
            raise ValueError(message)
        return made

    @property
    def support(self) -> tuple[float, float] | None:
        if not {"lower", "upper"} <= set(inspect.signature(type(self.dist)).parameters):
            return None
        return float(self.dist.lower[0]), float(self.dist.upper[0])

    @cached_property
    def logarithmic(self) -> bool:
        """As for every distribution: if it is positive, spans more than a decade, and 1/ω has a finite variance.

        That is so where quantiles of small probabilities p fall more slowly than √p.
        """
        low = self.at(RARE)
        return self.at(RARE**3) > RARE * low > 0 and self.at(1 - RARE) > WIDE * low

    @property
    def rule(self) -> tuple[float, FloatArray, FloatArray]:
        """As for every distribution: panels of the standard normal value that belongs to a quantile."""
        z, weights = _normals()
        middle = self.at(0.5)
        return middle, self.from_normal(z)[0] - middle, weights

    def _log_density(self, u: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(self.dist.pdf(u, allow_approx=False)))

    def _cumulative(self, u: FloatArray) -> FloatArray:
        return np.asarray(self.dist.cdf(u))

    def _inverse(self, p: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        u = np.asarray(self.dist.inv(p))
        return u, self._log_density(u)

    def check_numbers(self) -> None:
        """Raise a ValueError if there is no such distribution, or if its quantiles or its tails cannot be used."""
        from scipy.special import ndtr

        z, weights = _normals()
        with np.errstate(all="ignore"):  # of chaospy's own formulas: what is no number is refused
            values, slopes = self.from_normal(z)
        off = np.abs(self.cumulative(values) - ndtr(z))
        if not (np.isfinite(values).all() and np.isfinite(slopes).all() and off.max() < SIX_DIGITS):
            raise ValueError(f"chaospy's quantiles of this {self.name} are not those of its distribution function")
        squares = weights * (values - weights @ values) ** 2
        if squares[np.abs(z) > FAR].sum() > SIX_DIGITS * squares.sum():
            raise ValueError(
                f"the tails of this {self.name} are too heavy: its standard deviation rests on what has a "
                "probability of 1e-12"
            )


@cache
def _normals() -> tuple[FloatArray, FloatArray]:
    """Standard normal values and weights of a rule for functions of them, whose tails are panels of their own."""
    z, weights = panels([-8.0, -FAR, -4.0, -2.0, 0.0, 2.0, 4.0, FAR, 8.0])
    weights = weights * np.exp(-(z**2) / 2)
    return z, weights / weights.sum()
