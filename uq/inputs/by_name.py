"""Distributions of chaospy by their names there, as blocks of a study."""

from __future__ import annotations

import inspect
from functools import cache, cached_property
from typing import Any, Literal

import numpy as np
from pydantic import ConfigDict

from forward.model import FloatArray
from forward.settings import nearest
from uq.inputs.quadrature import panels
from uq.inputs.univariate import RARE, WIDE, Univariate

SIX_DIGITS = 1e-6  # to which chaospy's quantiles have to be those of its distribution function
FAR = 7.0  # standard normal value beyond which hardly anything of a variance may lie


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
        """Chaospy's own.

        Raises
        ------
        ValueError
            If there is none of this name, or not with these numbers.
        """
        import chaospy

        known = {
            name: one
            for name, one in vars(chaospy).items()
            if isinstance(one, type) and one.__module__.startswith("chaospy.distributions.collection")
        }
        if self.name not in known:
            message = f"chaospy has no distribution '{self.name}'; {nearest(self.name, sorted(known))}"
            raise ValueError(message)
        numbers, wanted = dict(self.model_extra or {}), inspect.signature(known[self.name]).parameters
        for number in numbers:
            if number not in wanted:
                message = f"chaospy's {self.name} has no number '{number}'; {nearest(number, list(wanted))}"
                raise ValueError(message)
        for number, one in wanted.items():
            if one.default is one.empty and number not in numbers:
                message = f"chaospy's {self.name} needs a number '{number}', expected {', '.join(wanted)}"
                raise ValueError(message)
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
        """As of every distribution."""
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

    @property
    def _frame(self) -> tuple[float, float]:
        return 0.0, 1.0

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
            message = f"chaospy's quantiles of this {self.name} are not those of its distribution function"
            raise ValueError(message)
        squares = weights * (values - weights @ values) ** 2
        if squares[np.abs(z) > FAR].sum() > SIX_DIGITS * squares.sum():
            message = (
                f"the tails of this {self.name} are too heavy: its standard deviation rests on what has a "
                "probability of 1e-12"
            )
            raise ValueError(message)


@cache
def _normals() -> tuple[FloatArray, FloatArray]:
    """Standard normal values and weights of a rule for functions of them, whose tails are panels of their own."""
    z, weights = panels([-8.0, -FAR, -4.0, -2.0, 0.0, 2.0, 4.0, FAR, 8.0])
    weights = weights * np.exp(-(z**2) / 2)
    return z, weights / weights.sum()
