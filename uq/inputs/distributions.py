"""Distributions of one parameter, as blocks of a study; `uq.inputs.univariate` is what they have in common."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, PositiveFloat

from forward.model import FloatArray
from uq.inputs.quadrature import Cut, panels
from uq.inputs.univariate import Bounded, Chaospy, Univariate


class Uniform(Bounded):
    """Uniform on [lower, upper]."""

    closed: ClassVar[bool] = True
    kind: Literal["uniform"] = "uniform"

    @cached_property
    def moments(self) -> tuple[float, float]:
        return self.lower + (self.upper - self.lower) / 2, float((self.upper - self.lower) / np.sqrt(12))

    def recurrence(self, degree: int) -> FloatArray:
        """As for every closed distribution: Legendre's polynomials."""
        k = np.arange(1, degree + 1)
        return np.array([np.zeros(degree + 1), np.append(1.0, 3 * k**2 / (4.0 * k**2 - 1))])

    def _log_density(self, u: FloatArray) -> FloatArray:
        return np.where((u >= 0) & (u <= 1), 0.0, -np.inf)

    def _cumulative(self, u: FloatArray) -> FloatArray:
        return u

    def _inverse(self, p: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.where(p <= q, p, 1 - q), np.zeros_like(p)


class LogUniform(Bounded):
    """Logarithm uniform on [ln lower, ln upper], lower > 0."""

    kind: Literal["log-uniform"] = "log-uniform"
    lower: PositiveFloat

    @cached_property
    def logarithmic(self) -> bool:
        return True

    @cached_property
    def of_coordinate(self) -> tuple[float, float]:
        return float(np.log(self.lower) + self._length / 2), float(self._length / np.sqrt(12))

    @property
    def _length(self) -> float:
        """Ln upper/lower."""
        return float(np.log1p((self.upper - self.lower) / self.lower))

    @property
    def rule(self) -> tuple[float, FloatArray, FloatArray]:
        logs, weights = panels([0.0, self._length])
        return self.lower, self.lower * np.expm1(logs), weights / weights.sum()

    def _log_density(self, u: FloatArray) -> FloatArray:
        share = (self.upper - self.lower) / self.lower
        inside = (u >= 0) & (u <= 1)
        return np.where(inside, np.log(share / self._length) - np.log1p(np.where(inside, u, 0.0) * share), -np.inf)

    def _cumulative(self, u: FloatArray) -> FloatArray:
        return np.asarray(np.log1p(np.maximum(u, 0.0) * (self.upper - self.lower) / self.lower) / self._length)

    def _inverse(self, p: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        share = (self.upper - self.lower) / self.lower
        logs = self._length * np.where(p <= q, p, 1 - q)
        return np.expm1(logs) / share, np.log(share / self._length) - logs


class Triangular(Bounded):
    """Triangular on [lower, upper] with its peak at `mode`."""

    kind: Literal["triangular"] = "triangular"
    mode: float

    @property
    def _peak(self) -> float:
        return (self.mode - self.lower) / (self.upper - self.lower)

    @property
    def rule(self) -> tuple[float, FloatArray, FloatArray]:
        unit, c = self.upper - self.lower, self._peak
        u, weights = panels([0.0, c, 1.0])
        weights = weights * np.where(u < c, u / c if c else 1.0, (1 - u) / (1 - c) if c < 1 else 1.0)
        return self.lower, unit * u, weights / weights.sum()

    def _log_density(self, u: FloatArray) -> FloatArray:
        c = self._peak
        rising = u / c if c else np.ones_like(u)
        falling = (1 - u) / (1 - c) if c < 1 else np.ones_like(u)
        height = np.where((u < 0) | (u > 1), 0.0, 2 * np.minimum(rising, falling))
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(height))

    def _cumulative(self, u: FloatArray) -> FloatArray:
        c, u = self._peak, np.clip(u, 0.0, 1.0)
        return np.where(u < c, u**2 / c if c else 0.0, 1 - ((1 - u) ** 2 / (1 - c) if c < 1 else 0.0))

    def _inverse(self, p: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        c = self._peak
        from_lower, from_upper = np.sqrt(p * c), np.sqrt(q * (1 - c))
        rising = p < c
        height = np.where(rising, from_lower / c if c else 1.0, from_upper / (1 - c) if c < 1 else 1.0)
        with np.errstate(divide="ignore"):
            return np.where(rising, from_lower, 1 - from_upper), np.log(2 * height)

    def check_numbers(self) -> None:
        super().check_numbers()
        if not self.lower <= self.mode <= self.upper:
            raise ValueError(f"mode = {self.mode:g}, expected a value between lower and upper")


class Beta(Bounded):
    """Beta(a, b) stretched to [lower, upper]."""

    closed: ClassVar[bool] = True
    kind: Literal["beta"] = "beta"
    a: Annotated[PositiveFloat, Field(le=1e9)]  # above, quantiles take minutes, and the parameter is hardly random
    b: Annotated[PositiveFloat, Field(le=1e9)]

    @cached_property
    def moments(self) -> tuple[float, float]:
        a, b, unit = self.a, self.b, self.upper - self.lower
        share = a / (a + b)
        return self.lower + unit * share, float(unit * np.sqrt(share * (b / (a + b)) / (a + b + 1)))

    def recurrence(self, degree: int) -> FloatArray:
        """As for every closed distribution: Jacobi's polynomials (Gautschi, table 1.1)."""
        a, b, both = self.a, self.b, self.a + self.b
        # Mean and standard deviation of x = 2u − 1.
        mean, std = (a - b) / both, 2 * np.sqrt(a / both * (b / both) / (both + 1))
        k = np.arange(1.0, degree + 1)
        s = 2 * k + both
        alpha = -mean * 4 * k * (k + both - 1) / (s * (s - 2)) / std  # minus the mean, without cancellation
        k, s = k[1:], s[1:]
        beta = 4 * k * (k + a - 1) * (k + b - 1) * (k + both - 2) / ((s - 2) ** 2 * (s - 1) * (s - 3)) / std**2
        return np.array([np.append(0.0, alpha), np.append(np.ones(min(degree, 1) + 1), beta)])

    def _log_density(self, u: FloatArray) -> FloatArray:
        return np.where((u < 0) | (u > 1), -np.inf, self._log(np.clip(u, 0, 1), np.clip(1 - u, 0, 1)))

    def _log(self, u: FloatArray, rest: FloatArray) -> FloatArray:
        from scipy.special import betaln, xlogy

        return np.asarray(xlogy(self.a - 1, u) + xlogy(self.b - 1, rest) - betaln(self.a, self.b))

    def _cumulative(self, u: FloatArray) -> FloatArray:
        from scipy.special import betainc

        return np.asarray(betainc(self.a, self.b, np.clip(u, 0.0, 1.0)))

    def _inverse(self, p: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        from scipy.special import betaincinv

        low = p <= q
        near = betaincinv(np.where(low, self.a, self.b), np.where(low, self.b, self.a), np.minimum(p, q))
        u, rest = np.where(low, near, 1 - near), np.where(low, 1 - near, near)
        with np.errstate(divide="ignore"):
            return u, self._log(u, rest)


class TruncatedNormal(Bounded):
    """Normal with `mean` and `std` (both before truncation), truncated to [lower, upper]."""

    kind: Literal["truncated-normal"] = "truncated-normal"
    mean: float
    std: PositiveFloat

    @property
    def rule(self) -> tuple[float, FloatArray, FloatArray]:
        nodes, weights, _ = self._cut.rule
        return self._cut.origin, self._cut.unit * nodes, weights

    @property
    def _frame(self) -> tuple[float, float]:
        return self._cut.origin, self._cut.unit

    @cached_property
    def _cut(self) -> Cut:
        ends = (self.lower - self.mean) / self.std, (self.upper - self.mean) / self.std
        if ends[0] >= 0:
            return Cut(self.lower, self.std, ends[0], 0.0, (self.upper - self.lower) / self.std)
        if ends[1] <= 0:
            return Cut(self.upper, -self.std, -ends[1], 0.0, (self.upper - self.lower) / self.std)
        return Cut(self.mean, self.std, 0.0, *ends)

    def _log_density(self, u: FloatArray) -> FloatArray:
        return self._cut.log_density(u)

    def _cumulative(self, u: FloatArray) -> FloatArray:
        share = self._cut.cumulative(u)
        return share if self._cut.unit > 0 else np.asarray(1 - share)

    def _inverse(self, p: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        u = self._cut.quantile(p, q) if self._cut.unit > 0 else self._cut.quantile(q, p)
        return u, self._cut.log_density(u)


class Normal(Univariate):
    """Normal with `mean` and standard deviation `std`."""

    closed: ClassVar[bool] = True
    kind: Literal["normal"] = "normal"
    mean: float
    std: PositiveFloat

    @cached_property
    def moments(self) -> tuple[float, float]:
        return self.mean, self.std

    def recurrence(self, degree: int) -> FloatArray:
        """As for every closed distribution: Hermite's polynomials."""
        return np.array([np.zeros(degree + 1), np.append(1.0, np.arange(1.0, degree + 1))])

    @property
    def _frame(self) -> tuple[float, float]:
        return self.mean, self.std

    def _log_density(self, u: FloatArray) -> FloatArray:
        return np.asarray(-(u**2) / 2 - np.log(2 * np.pi) / 2)

    def _cumulative(self, u: FloatArray) -> FloatArray:
        from scipy.special import ndtr

        return np.asarray(ndtr(u))

    def _inverse(self, p: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        from scipy.special import ndtri

        u = np.where(p <= q, ndtri(p), -ndtri(q))
        return u, self._log_density(u)

    def from_normal(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        z = np.asarray(z, dtype=float)
        return self.mean + self.std * z, np.full(z.shape, self.std)


class LogNormal(Univariate):
    """Log-normal, given by the `mean` and the standard deviation `std` of the parameter itself."""

    kind: Literal["log-normal"] = "log-normal"
    mean: PositiveFloat
    std: PositiveFloat

    @cached_property
    def of_coordinate(self) -> tuple[float, float]:
        variance = np.log1p((self.std / self.mean) ** 2)
        return float(np.log(self.mean) - variance / 2), float(np.sqrt(variance))

    @cached_property
    def moments(self) -> tuple[float, float]:
        return self.mean, self.std

    @cached_property
    def logarithmic(self) -> bool:
        return True

    def _log_density(self, u: FloatArray) -> FloatArray:
        mean, std = self.of_coordinate
        positive = u > 0
        logs = np.log(np.where(positive, u, 1.0))
        exponent = -(((logs - mean) / std) ** 2) / 2 - logs - np.log(std) - np.log(2 * np.pi) / 2
        return np.where(positive, exponent, -np.inf)

    def _cumulative(self, u: FloatArray) -> FloatArray:
        from scipy.special import ndtr

        mean, std = self.of_coordinate
        return np.where(u > 0, ndtr((np.log(np.where(u > 0, u, 1.0)) - mean) / std), 0.0)

    def _inverse(self, p: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        from scipy.special import ndtri

        mean, std = self.of_coordinate
        u = np.exp(mean + std * np.where(p <= q, ndtri(p), -ndtri(q)))
        return u, self._log_density(u)

    def from_normal(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        mean, std = self.of_coordinate
        value = np.exp(mean + std * np.asarray(z, dtype=float))
        return value, std * value


class Gamma(Univariate):
    """Gamma with `shape` and `scale`, starting at `shift`: mean shift + shape·scale."""

    closed: ClassVar[bool] = True
    kind: Literal["gamma"] = "gamma"
    shape: PositiveFloat
    scale: PositiveFloat
    shift: float = 0.0

    @cached_property
    def moments(self) -> tuple[float, float]:
        return self.shift + self.shape * self.scale, float(np.sqrt(self.shape) * self.scale)

    def recurrence(self, degree: int) -> FloatArray:
        """As for every closed distribution: Laguerre's polynomials."""
        k = np.arange(1.0, degree + 1)
        return np.array(
            [np.append(0.0, 2 * k / np.sqrt(self.shape)), np.append(1.0, k * (k - 1 + self.shape) / self.shape)]
        )

    @cached_property
    def logarithmic(self) -> bool:
        """As for every distribution: if 1/ω has a finite variance."""
        return self.shift == 0 and self.shape > 2

    @property
    def rule(self) -> tuple[float, FloatArray, FloatArray]:
        """As for every distribution; it integrates polynomials of the logarithm too, unlike Laguerre's rule."""
        from scipy.special import gammaincinv

        # ln u has the density exp(k ln u − u)/Γ(k), negligible below the quantile at 10⁻⁴⁰ and above k + 40 √k + 100.
        lower = float(np.log(gammaincinv(self.shape, 1e-40)))
        upper = float(np.log(self.shape + 40 * np.sqrt(self.shape) + 100))
        logs, weights = panels(np.linspace(lower, upper, 9).tolist())
        exponent = self.shape * logs - np.exp(logs)
        weights = weights * np.exp(exponent - exponent.max())
        return self.shift, self.scale * np.exp(logs), weights / weights.sum()

    @property
    def _frame(self) -> tuple[float, float]:
        return self.shift, self.scale

    def _log_density(self, u: FloatArray) -> FloatArray:
        from scipy.special import gammaln, xlogy

        inside = u >= 0
        return np.where(inside, xlogy(self.shape - 1, np.where(inside, u, 1.0)) - u - gammaln(self.shape), -np.inf)

    def _cumulative(self, u: FloatArray) -> FloatArray:
        from scipy.special import gammainc

        return np.asarray(gammainc(self.shape, np.maximum(u, 0.0)))

    def _inverse(self, p: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        from scipy.special import gammainccinv, gammaincinv

        u = np.where(p <= q, gammaincinv(self.shape, p), gammainccinv(self.shape, q))
        with np.errstate(divide="ignore"):
            return u, self._log_density(u)


Distribution = Annotated[
    Uniform | LogUniform | Triangular | Beta | TruncatedNormal | Normal | LogNormal | Gamma | Chaospy,
    Field(discriminator="kind"),
]
