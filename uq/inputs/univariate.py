"""What a distribution of one parameter can say: moments, quantiles, the rule and the coordinate of its polynomials.

Quantiles are computed from the nearer end, p = F(ω) or 1 − p, so that neither tail is lost to rounding; moments are
closed forms, or Gauss rules around a point of the distribution, so that none is a difference of large numbers.
Chaospy's own are accurate to six digits if there is no closed form, and wrong for beta(a, b) with a + b = 2, a ≠ b,
and for normals that are truncated beyond eight standard deviations.

Polynomials are of the coordinate in which they converge (`logarithmic`), see docs/decisions/0009-coordinates.md.
"""

from __future__ import annotations

from abc import abstractmethod
from functools import cached_property
from typing import ClassVar

import numpy as np
from pydantic import model_validator

from forward.model import FloatArray
from forward.settings import Settings

RARE = 1e-4  # probability beyond the range, for a distribution with a tail
TAIL = 1e-16  # smallest distance to 0 and 1 of a probability for which a quantile is computed
EXTREME = 1e60  # fourth powers of numbers above it, or below its inverse, leave the range of doubles
NARROW = 1e-10  # standard deviation over the mean below which rounding of the parameter affects results
WIDE = 10.0  # ratio of the quantiles at 10⁻⁴ and 1 − 10⁻⁴ from which polynomials are of the logarithm


class Univariate(Settings):
    """A distribution of one parameter, in the units of that parameter."""

    closed: ClassVar[bool] = False
    """Whether the recurrence of the orthogonal polynomials is known in closed form."""

    @property
    @abstractmethod
    def _frame(self) -> tuple[float, float]:
        """Origin and unit of the variable u = (ω − origin)/unit of the next three methods."""

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

    @cached_property
    def higher_moments(self) -> tuple[float, float]:
        """Third and fourth central moments."""
        if self.closed:
            # Of the standardised variable they are α_1 and 1 + α_1² + β_2: entries of powers of the Jacobi matrix.
            alpha, beta = self.recurrence(2)
            std = self.moments[1]
            return float(alpha[1] * std**3), float((1 + alpha[1] ** 2 + beta[2]) * std**4)
        _, offsets, weights = self.rule
        deviations = offsets - weights @ offsets
        return float(weights @ deviations**3), float(weights @ deviations**4)

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
        return self.support or (self.at(RARE), self.at(1 - RARE))

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
            message = (
                f"mean {mean:.6g} and standard deviation {std:.3g}: too large, small or wide for double precision, "
                f"expected numbers between {1 / EXTREME:g} and {EXTREME:g} in their own units"
            )
            raise ValueError(message)
        if not (np.isfinite(mean) and np.isfinite(std) and std > NARROW * abs(mean)):
            message = (
                f"mean {mean:.6g} and standard deviation {std:.3g}: too narrow for double precision, expected "
                f"a standard deviation above {NARROW:g} of the mean, or a fixed value in the model"
            )
            raise ValueError(message)
        return self


class Bounded(Univariate):
    """A distribution of one parameter within a range."""

    lower: float
    upper: float

    @property
    def support(self) -> tuple[float, float]:
        """Ends of the range."""
        return self.lower, self.upper

    @property
    def _frame(self) -> tuple[float, float]:
        return self.lower, self.upper - self.lower

    def quantile(self, probability: FloatArray) -> FloatArray:
        """Inverse of the distribution function, of any shape."""
        return np.clip(super().quantile(probability), self.lower, self.upper)

    def from_normal(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As for every distribution, within the range in spite of rounding."""
        values, slopes = super().from_normal(z)
        return np.clip(values, self.lower, self.upper), slopes

    def check_numbers(self) -> None:
        """Raise a ValueError if the numbers do not go together."""
        if not self.lower < self.upper:
            message = f"lower = {self.lower:g} and upper = {self.upper:g}, expected lower < upper"
            raise ValueError(message)
        if not np.isfinite(self.upper - self.lower):
            message = f"lower = {self.lower:g} and upper = {self.upper:g}, expected a range that a number can hold"
            raise ValueError(message)

    def _over_decades(self) -> bool:
        """Whether the bulk of the distribution is positive and spans more than a decade."""
        return self.lower > 0 and self.at(1 - 1e-4) > WIDE * self.at(1e-4)
