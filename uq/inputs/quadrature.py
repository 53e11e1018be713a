"""Integrals against densities without closed forms: composite Gauss rules, and a truncated normal density."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise

import numpy as np

from forward.model import FloatArray

Function = Callable[[FloatArray], FloatArray]
PANEL = 200  # Gauss points of a panel on which a density is smooth
NOTHING = 100.0  # exponent x from which exp(−x) is negligible beside 1
FLAT = 4.0  # largest exponent by which a density falls where one rule of few points integrates it
STEPS = 60  # of Newton's method, at most


@cache
def gauss_legendre(count: int) -> tuple[FloatArray, FloatArray]:
    """Points and weights of the Gauss–Legendre rule on [−1, 1]; to find those of 200 takes milliseconds each time."""
    x, w = np.polynomial.legendre.leggauss(count)  # type: ignore[no-untyped-call]
    x.flags.writeable = w.flags.writeable = False  # all share them
    return x, w


def panels(breaks: list[float]) -> tuple[FloatArray, FloatArray]:
    """Composite Gauss–Legendre rule between breakpoints."""
    x, w = gauss_legendre(PANEL)
    parts = [(a + (b - a) * (x + 1) / 2, w * (b - a) / 2) for a, b in pairwise(breaks) if b > a]
    return np.concatenate([nodes for nodes, _ in parts]), np.concatenate([weights for _, weights in parts])


@dataclass(frozen=True)
class Cut:
    """The density ∝ exp(−u (t + u/2)) on [lower, upper]: a standard normal one around its largest value inside.

    With t ≥ 0, lower = 0 the normal is truncated t standard deviations from its mean; with t = 0 the mean is inside.
    Nothing here is a difference of two probabilities that are both nearly 0 or nearly 1.

    Attributes
    ----------
    origin, unit
        Of the parameter: ω = origin + unit u. A negative unit mirrors it.
    t, lower, upper
        Numbers in the density.
    """

    origin: float
    unit: float
    t: float
    lower: float
    upper: float

    @cached_property
    def rule(self) -> tuple[FloatArray, FloatArray, float]:
        """Points u of a rule that integrates smooth functions, its weights (of sum 1), and ln of what they had."""
        # exp(−NOTHING) is reached at u with u (t + u/2) = NOTHING.
        reach = 2 * NOTHING / (self.t + np.sqrt(self.t**2 + 2 * NOTHING))
        lower, upper = max(self.lower, -reach), min(self.upper, reach)
        nodes, weights = panels(np.linspace(lower, upper, 9).tolist())
        weights = weights * np.exp(-nodes * (self.t + nodes / 2))
        return nodes, weights / weights.sum(), float(np.log(weights.sum()))

    def log_density(self, u: FloatArray) -> FloatArray:
        """Ln of the density of u."""
        slack = 1e-12 * (self.upper - self.lower)
        inside = (u >= self.lower - slack) & (u <= self.upper + slack)
        return np.where(inside, -u * (self.t + u / 2) - self.rule[2], -np.inf)

    def cumulative(self, u: FloatArray) -> FloatArray:
        """Distribution function of u."""
        from scipy.special import ndtr

        u = np.clip(u, self.lower, self.upper)
        if self._flat:
            return np.asarray(self._integral(u) / self._integral(np.array(self.upper)))
        if self.t > 0 or self.lower == 0:
            return np.asarray(np.expm1(self._log_tail(u)) / np.expm1(self._log_tail(np.array(self.upper))))
        return np.asarray((ndtr(u) - ndtr(self.lower)) / (ndtr(self.upper) - ndtr(self.lower)))

    def quantile(self, p: FloatArray, q: FloatArray) -> FloatArray:
        """Quantile at p = 1 − q."""
        if self._flat:
            start = self.lower + (self.upper - self.lower) * p
            whole = self._integral(np.array(self.upper))
            return self._newton(start, lambda u: self._integral(u) - p * whole, lambda u: np.exp(-u * (self.t + u / 2)))
        if self.t > 0 or self.lower == 0:
            # The tail beyond u is q of the whole, plus that beyond the upper end.
            last = np.exp(self._log_tail(np.array(self.upper)))
            near = p < 0.5
            beyond = np.log(np.clip(last + q * (1 - last), np.finfo(float).tiny, 1.0))
            wanted = np.where(near, np.log1p(-np.where(near, p, 0.0) * (1 - last)), beyond)
            start = -2 * wanted / (self.t + np.sqrt(self.t**2 - 2 * wanted))
            return self._newton(start, lambda u: wanted - self._log_tail(u), self._hazard)
        below, above = self._of_normal(self.lower, self.upper, p, q), -self._of_normal(-self.upper, -self.lower, q, p)
        return np.clip(np.where(below < 0, below, above), self.lower, self.upper)

    @property
    def _flat(self) -> bool:
        """Whether the density falls by little over the range."""
        ends = np.array([self.lower, self.upper])
        return bool(np.abs(ends * (self.t + ends / 2)).max() < FLAT)

    def _integral(self, u: FloatArray) -> FloatArray:
        """∫ exp(−v (t + v/2)) dv from the lower end to u, for a flat density."""
        x, w = gauss_legendre(24)
        half = (np.asarray(u)[..., None] - self.lower) / 2
        v = self.lower + half * (x + 1)
        return np.asarray((np.exp(-v * (self.t + v / 2)) * half) @ w)

    def _log_tail(self, u: FloatArray) -> FloatArray:
        """Ln of the probability beyond t + u given that beyond t, for the normal before truncation."""
        from scipy.special import erfcx

        return np.asarray(-u * (self.t + u / 2) + np.log(erfcx((self.t + u) / np.sqrt(2)) / erfcx(self.t / np.sqrt(2))))

    def _hazard(self, u: FloatArray) -> FloatArray:
        from scipy.special import erfcx

        return np.asarray(np.sqrt(2 / np.pi) / erfcx((self.t + u) / np.sqrt(2)))

    def _newton(self, u: FloatArray, value: Function, slope: Function) -> FloatArray:
        for _ in range(STEPS):
            before, u = u, np.clip(u - value(u) / slope(u), self.lower, self.upper)
            if (np.abs(u - before) <= 1e-15 * np.abs(u)).all():
                break
        return u

    @staticmethod
    def _of_normal(lower: float, upper: float, p: FloatArray, q: FloatArray) -> FloatArray:
        """Quantile of a normal truncated to [lower, upper], exact in its lower half."""
        from scipy.special import log_ndtr, ndtri_exp

        with np.errstate(divide="ignore"):
            return np.asarray(ndtri_exp(np.logaddexp(log_ndtr(lower) + np.log(q), log_ndtr(upper) + np.log(p))))
