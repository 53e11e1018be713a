"""Distributions of one parameter, as blocks of a study; the mathematics is chaospy's."""

from __future__ import annotations

from abc import abstractmethod
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Gt
from pydantic import Field, model_validator

from forward.model import FloatArray
from forward.settings import Settings

PositiveFloat = Annotated[float, Gt(0)]
TAIL = 1e-16  # nearest to 0 and 1 that a probability is taken to a quantile


class _Distribution(Settings):
    """A distribution of one parameter, in the units of that parameter."""

    closed: ClassVar[bool] = False
    """Whether chaospy knows the recurrence of the orthogonal polynomials in closed form."""

    @abstractmethod
    def _chaospy(self, cp: Any) -> Any:
        """Build the chaospy distribution."""

    @cached_property
    def dist(self) -> Any:
        """The chaospy distribution."""
        import chaospy

        return self._chaospy(chaospy)

    @cached_property
    def moments(self) -> tuple[float, float]:
        """Expected value and standard deviation."""
        if self.closed:
            alpha, beta = self.recurrence(1)
            return float(alpha[0]), float(np.sqrt(beta[1]))
        import chaospy

        return float(chaospy.E(self.dist)), float(chaospy.Std(self.dist))

    def recurrence(self, degree: int) -> FloatArray:
        """Return α and β (2, degree + 1) of the orthogonal polynomials, where `closed`; β_0 has no meaning.

        From π_k+1 = (x − α_k) π_k − β_k π_k−1 (W. Gautschi, Orthogonal Polynomials (2004), theorem 1.27) follow the
        expected value α_0 and the variance β_1.
        """
        return np.asarray(self.dist.ttr(np.arange(degree + 1)), dtype=float).reshape(2, degree + 1)

    @cached_property
    def higher_moments(self) -> tuple[float, float]:
        """Third and fourth central moments, by Gauss quadrature: raw moments would lose them by cancellation."""
        import chaospy

        (nodes,), weights = chaospy.generate_quadrature(3, self.dist, rule="gaussian")
        deviations = nodes - self.moments[0]
        return float(weights @ deviations**3), float(weights @ deviations**4)

    @property
    def support(self) -> tuple[float, float] | None:
        """Ends of a bounded range; nothing for a distribution with tails."""
        return None

    def quantile(self, probability: FloatArray) -> FloatArray:
        """Inverse of the distribution function, of any shape."""
        p = np.asarray(probability, dtype=float)
        return np.asarray(self.dist.inv(p.ravel()), dtype=float).reshape(p.shape)

    def from_normal(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map standard normal values z, of any shape, to values of the parameter F⁻¹(Φ(z)), with the derivatives."""
        from scipy.special import ndtr

        z = np.asarray(z, dtype=float)
        value = self.quantile(np.clip(ndtr(z), TAIL, 1 - TAIL))
        density = np.asarray(self.dist.pdf(value.ravel()), dtype=float).reshape(z.shape)
        bell = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
        return value, np.where(density > 0, bell / np.where(density > 0, density, 1.0), 0.0)

    def at(self, probability: float) -> float:
        """Quantile of one probability."""
        return float(self.quantile(np.array([probability]))[0])


class _Bounded(_Distribution):
    lower: float
    upper: float

    @property
    def support(self) -> tuple[float, float]:
        """Ends of the range."""
        return self.lower, self.upper

    @model_validator(mode="after")
    def _check_range(self) -> _Bounded:
        if not self.lower < self.upper:
            message = f"lower = {self.lower:g} and upper = {self.upper:g}, expected lower < upper"
            raise ValueError(message)
        return self


class Uniform(_Bounded):
    """Uniform on [lower, upper]."""

    closed: ClassVar[bool] = True
    kind: Literal["uniform"] = "uniform"

    def _chaospy(self, cp: Any) -> Any:
        return cp.Uniform(self.lower, self.upper)

    def from_normal(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As of every distribution, in closed form."""
        share, slope = _unit(z)
        width = self.upper - self.lower
        return self.lower + width * share, width * slope


class LogUniform(_Bounded):
    """Logarithm uniform on [ln lower, ln upper], lower > 0."""

    kind: Literal["log-uniform"] = "log-uniform"
    lower: PositiveFloat

    def _chaospy(self, cp: Any) -> Any:
        return cp.LogUniform(np.log(self.lower), np.log(self.upper))

    def from_normal(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As of every distribution, in closed form."""
        share, slope = _unit(z)
        width = np.log(self.upper / self.lower)
        value = self.lower * np.exp(width * share)
        return value, value * width * slope


class Triangular(_Bounded):
    """Triangular on [lower, upper] with its peak at `mode`."""

    kind: Literal["triangular"] = "triangular"
    mode: float

    def _chaospy(self, cp: Any) -> Any:
        return cp.Triangle(self.lower, self.mode, self.upper)

    @model_validator(mode="after")
    def _check_mode(self) -> Triangular:
        if not self.lower <= self.mode <= self.upper:
            message = f"mode = {self.mode:g}, expected a value between lower and upper"
            raise ValueError(message)
        return self


class Beta(_Bounded):
    """Beta(a, b) stretched to [lower, upper]."""

    closed: ClassVar[bool] = True
    kind: Literal["beta"] = "beta"
    a: PositiveFloat
    b: PositiveFloat

    def _chaospy(self, cp: Any) -> Any:
        return cp.Beta(self.a, self.b, self.lower, self.upper)


class TruncatedNormal(_Bounded):
    """Normal with `mean` and `std` (of the normal before the cut), cut to [lower, upper]."""

    kind: Literal["truncated-normal"] = "truncated-normal"
    mean: float
    std: PositiveFloat

    def _chaospy(self, cp: Any) -> Any:
        return cp.TruncNormal(self.lower, self.upper, self.mean, self.std)


class Normal(_Distribution):
    """Normal with `mean` and standard deviation `std`."""

    closed: ClassVar[bool] = True
    kind: Literal["normal"] = "normal"
    mean: float
    std: PositiveFloat

    def _chaospy(self, cp: Any) -> Any:
        return cp.Normal(self.mean, self.std)

    def from_normal(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As of every distribution, in closed form."""
        z = np.asarray(z, dtype=float)
        return self.mean + self.std * z, np.full(z.shape, self.std)


class LogNormal(_Distribution):
    """Log-normal, given by the `mean` and the standard deviation `std` of the parameter itself."""

    closed: ClassVar[bool] = True
    kind: Literal["log-normal"] = "log-normal"
    mean: PositiveFloat
    std: PositiveFloat

    @property
    def _of_logarithm(self) -> tuple[float, float]:
        """Mean and standard deviation of the logarithm."""
        variance = np.log1p((self.std / self.mean) ** 2)
        return float(np.log(self.mean) - variance / 2), float(np.sqrt(variance))

    def _chaospy(self, cp: Any) -> Any:
        return cp.LogNormal(*self._of_logarithm)

    def from_normal(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As of every distribution, in closed form."""
        mean, std = self._of_logarithm
        value = np.exp(mean + std * np.asarray(z, dtype=float))
        return value, std * value


class Gamma(_Distribution):
    """Gamma with `shape` and `scale`, starting at `shift`: mean shift + shape·scale."""

    closed: ClassVar[bool] = True
    kind: Literal["gamma"] = "gamma"
    shape: PositiveFloat
    scale: PositiveFloat
    shift: float = 0.0

    def _chaospy(self, cp: Any) -> Any:
        return cp.Gamma(self.shape, self.scale, self.shift)


Distribution = Annotated[
    Uniform | LogUniform | Triangular | Beta | TruncatedNormal | Normal | LogNormal | Gamma,
    Field(discriminator="kind"),
]


def _unit(z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Φ(z) and its derivative."""
    from scipy.special import ndtr

    z = np.asarray(z, dtype=float)
    return np.asarray(ndtr(z)), np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
