"""Distributions of independent errors of measurement, over their scale: normal ones, and Student's with heavy tails.

With residuals r over the scale, −ln p = Σ ρ(r) + Σ ln scale. The score is ψ = ρ′; the Gauss–Newton matrix of Student's
errors is AᵀWA with the weights w(r) (ν+1)/(ν+3), w = ψ/r: of a datum that fits they have the mean of ψ′, Fisher's
information, and of one that does not belong they vanish (K. L. Lange, R. J. A. Little, J. M. G. Taylor, J. Am. Stat.
Assoc. 84 (1989) 881–896).
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from forward.model import FloatArray
from forward.settings import Settings

HALF_LOG = float(np.log(2 * np.pi) / 2)


class NormalErrors(Settings):
    """Normal errors, of which the scale is the standard deviation."""

    kind: Literal["normal"] = "normal"

    def minus_log(self, r: FloatArray) -> FloatArray:
        """Return ρ, −ln of the density, of residuals over the scale, of any shape."""
        return np.asarray(r**2 / 2 + HALF_LOG)

    def misfit(self, r: FloatArray, log_scale: FloatArray) -> FloatArray:
        """Return −ln of the likelihood (n,) of residuals (n, m) with sums (n,) of the logarithms of their scales."""
        return np.asarray((r**2).sum(axis=1) / 2 + log_scale + r.shape[1] * HALF_LOG)

    def score(self, r: FloatArray) -> FloatArray:
        """Return ψ = ρ′."""
        return r

    def information(self, r: FloatArray) -> FloatArray:
        """Return what stands for ψ′ in Gauss–Newton's matrix; never negative."""
        return np.ones_like(r)

    def turn(self, r: FloatArray) -> FloatArray:
        """Return (rψ)′, for derivatives by the logarithm of the scale."""
        return 2 * r

    def normal_scores(self, r: FloatArray) -> FloatArray:
        """Return standard normal values of the same probabilities."""
        return r


class StudentErrors(Settings):
    """Student's t errors: a few that are far larger than the others do not decide.

    Parameters
    ----------
    degrees
        Degrees of freedom ν: the smaller, the heavier the tails. Standard deviations of the data are taken as scales;
        those of the errors are √(ν/(ν−2)) times as large.
    """

    kind: Literal["student-t"] = "student-t"
    degrees: Annotated[float, Field(ge=1, le=1000)] = 4.0

    def minus_log(self, r: FloatArray) -> FloatArray:
        """Return ρ, −ln of the density, of residuals over the scale, of any shape."""
        from scipy.special import gammaln

        nu = self.degrees
        constant = gammaln(nu / 2) - gammaln((nu + 1) / 2) + np.log(nu * np.pi) / 2
        return np.asarray((nu + 1) / 2 * np.log1p(r**2 / nu) + constant)

    def misfit(self, r: FloatArray, log_scale: FloatArray) -> FloatArray:
        """Return −ln of the likelihood (n,) of residuals (n, m) with sums (n,) of the logarithms of their scales."""
        return np.asarray(self.minus_log(r).sum(axis=1) + log_scale)

    def score(self, r: FloatArray) -> FloatArray:
        """Return ψ = ρ′."""
        return np.asarray((self.degrees + 1) * r / (self.degrees + r**2))

    def information(self, r: FloatArray) -> FloatArray:
        """Return what stands for ψ′ in Gauss–Newton's matrix; never negative."""
        nu = self.degrees
        return np.asarray((nu + 1) ** 2 / ((nu + 3) * (nu + r**2)))

    def turn(self, r: FloatArray) -> FloatArray:
        """Return (rψ)′, for derivatives by the logarithm of the scale."""
        nu = self.degrees
        return np.asarray(2 * nu * (nu + 1) * r / (nu + r**2) ** 2)

    def normal_scores(self, r: FloatArray) -> FloatArray:
        """Return standard normal values of the same probabilities."""
        from scipy.special import ndtri, stdtr

        return np.asarray(-np.sign(r) * ndtri(np.maximum(stdtr(self.degrees, -np.abs(r)), 1e-300)))


Errors = Annotated[NormalErrors | StudentErrors, Field(discriminator="kind")]
NORMAL = NormalErrors()
