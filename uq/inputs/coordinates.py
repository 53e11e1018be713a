"""The coordinates in which outputs are approximated by polynomials: parameters, or logarithms of some, standardised.

Polynomials of a log-normal ω are not even dense in the functions of ω with finite variance (O. G. Ernst, A. Mugler,
H.-J. Starkloff, E. Ullmann, ESAIM: M2AN 46 (2012) 317–339), and the moments of fitted ones depend on their values where
no sample is. In ln ω they are Hermite's, and converge. Each distribution says whether its polynomials are of the
logarithm (`uq.inputs.distributions`).

With x_i = ω_i or ln ω_i, t = (x − E x)/std x has mean 0 and variance 1, and derivatives along t follow by the chain
rule: ∂ψ/∂t_i = (∂ω_i/∂t_i) ∂ψ/∂ω_i, with the `steps` ∂ω_i/∂t_i = std x_i, times ω_i where x_i is its logarithm.

Of dependent parameters given by draws (`uq.inputs.draws`) t is uncorrelated too: (x − E x)/std x = M t, with the
symmetric root M of their correlation matrix, so that each t_i is as close to its parameter as can be.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray


@dataclass(frozen=True)
class Coordinates:
    """The map between d parameters ω and their standardised coordinates t.

    Attributes
    ----------
    logarithmic
        Which x (d,) are the logarithm of the parameter.
    centre, scale
        Expected values and standard deviations (d,) of x.
    mixing
        M (d, d), symmetric; None where it is the identity.
    """

    logarithmic: NDArray[np.bool_]
    centre: FloatArray
    scale: FloatArray
    mixing: FloatArray | None = None

    @classmethod
    def linear(cls, centre: FloatArray, scale: FloatArray) -> Coordinates:
        """Return those without logarithms."""
        return cls(np.zeros(len(centre), dtype=bool), centre, scale)

    def of(self, points: FloatArray) -> FloatArray:
        """Return t (…, d) at points (…, d)."""
        x = np.asarray(points, dtype=float)
        if self.logarithmic.any():
            x = np.where(self.logarithmic, np.log(np.where(self.logarithmic, x, 1.0)), x)
        t = (x - self.centre) / self.scale
        return np.asarray(t if self._parting is None else t @ self._parting)

    def points(self, t: FloatArray) -> FloatArray:
        """Return ω (…, d) at coordinates t (…, d)."""
        x = self.centre + self.scale * (t if self.mixing is None else t @ self.mixing)
        return np.asarray(np.where(self.logarithmic, np.exp(np.where(self.logarithmic, x, 0.0)), x))

    def steps(self, points: FloatArray) -> FloatArray:
        """Return ∂ω_i/∂t_i (…, d) at points (…, d), of coordinates that are not mixed."""
        return np.asarray(self.scale * np.where(self.logarithmic, points, 1.0))

    def directions(self, point: FloatArray) -> FloatArray:
        """Return ∂ω/∂t_i (d, d) at a point (d,): row i is the direction in which only t_i changes."""
        steps = self.steps(point)
        return np.diag(steps) if self.mixing is None else np.asarray(self.mixing * steps)

    def along(self, tangents: FloatArray, points: FloatArray) -> FloatArray:
        """Return derivatives ∂ψ/∂t (…, m, d) along the coordinates from dψ/dω (…, m, d) at points (…, d)."""
        found = tangents * self.steps(points)[..., None, :]
        return np.asarray(found if self.mixing is None else found @ self.mixing)

    def tangents(self, slopes: FloatArray, points: FloatArray) -> FloatArray:
        """Return dψ/dω (…, m, d) from derivatives ∂ψ/∂t (…, m, d) along the coordinates at points (…, d)."""
        parted = slopes if self._parting is None else slopes @ self._parting
        return np.asarray(parted / self.steps(points)[..., None, :])

    @cached_property
    def _parting(self) -> FloatArray | None:
        """The inverse of M."""
        return None if self.mixing is None else np.linalg.inv(self.mixing)
