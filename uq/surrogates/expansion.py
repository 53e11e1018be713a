"""The expansion of a finished study as a function of its parameters."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from forward.model import FloatArray
from uq.inputs.coordinates import Coordinates
from uq.surrogates.basis import Basis, Joint

if TYPE_CHECKING:
    import xarray as xr


class OutsideRangeWarning(UserWarning):
    """Points outside the range where an expansion was fitted."""


@dataclass(frozen=True)
class Expansion:
    """A polynomial surrogate of a model, for any number of points at once.

    Attributes
    ----------
    parameters, output_names
        Names of the d parameters and of the m outputs.
    basis
        The P functions.
    coefficients
        (P, m).
    lower, upper
        Range (d,) of the parameters: their support, or that of the samples if a distribution has tails.
    fields
        Coefficients (P, nodes, 3) of the displacement field, in m, if it was expanded.
    """

    parameters: tuple[str, ...]
    output_names: tuple[str, ...]
    basis: Basis
    coefficients: FloatArray
    lower: FloatArray
    upper: FloatArray
    fields: FloatArray | None = None
    _told: list[str] = field(default_factory=list, repr=False, compare=False)

    @classmethod
    def of(cls, results: xr.Dataset) -> Expansion:
        """Make the expansion of a finished study callable.

        Raises
        ------
        ValueError
            If these are not results of `method.kind = "chaos"` or `"multilevel-chaos"`.
        """
        if "multi_index" not in results:
            raise ValueError("these results hold no expansion, expected results of method.kind = 'chaos'")
        arrays = {str(name): variable.to_numpy() for name, variable in results.data_vars.items()}
        d, joint = len(arrays["coordinate_mean"]), None
        if "joint_index" in arrays:
            members = np.arange(d - arrays["joint_index"].shape[1], d)
            joint = Joint(members, arrays["joint_index"], arrays["joint_inverse"])
        logarithmic, mixing = arrays["coordinate_logarithmic"].astype(bool), arrays.get("coordinate_mixing")
        coordinates = Coordinates(logarithmic, arrays["coordinate_mean"], arrays["coordinate_std"], mixing)
        alpha, beta = arrays["recurrence_alpha"], arrays["recurrence_beta"]
        basis = Basis(coordinates, alpha, beta, arrays["multi_index"], joint)
        return cls(
            tuple(map(str, results["parameter"].values)),
            tuple(map(str, results["output"].values)),
            basis,
            arrays["coefficients"],
            arrays["range_lower"],
            arrays["range_upper"],
            arrays.get("field_coefficients"),
        )

    def outputs(self, points: FloatArray) -> FloatArray:
        """Return the outputs (n, m) at points (n, d)."""
        return self.basis.values(self._checked(points)) @ self.coefficients

    def tangents(self, points: FloatArray) -> FloatArray:
        """Return the derivatives dψ/dω (n, m, d) at points (n, d)."""
        points = self._checked(points)
        slopes = self.basis.derivatives(points) @ self.coefficients
        return self.basis.coordinates.tangents(np.swapaxes(slopes, 1, 2), points)

    def displacements(self, points: FloatArray) -> FloatArray:
        """Return the displacement fields (n, nodes, 3) at points (n, d), in m.

        Raises
        ------
        ValueError
            If the field was not expanded.
        """
        if self.fields is None:
            raise ValueError("the field was not expanded, expected a study with method.fields = true")
        return np.asarray(np.tensordot(self.basis.values(self._checked(points)), self.fields, axes=1))

    def _checked(self, points: FloatArray) -> FloatArray:
        points = np.asarray(points, dtype=float)
        if points.ndim != 2 or points.shape[1] != len(self.parameters):
            raise ValueError(f"points of shape {points.shape}, expected (n, {len(self.parameters)})")
        slack = 1e-12 * (self.upper - self.lower)
        outside = ((points < self.lower - slack) | (points > self.upper + slack)).any(axis=0)
        if outside.any() and not self._told:
            names = [name for name, out in zip(self.parameters, outside, strict=True) if out]
            self._told.extend(names)
            message = f"points outside the range where the expansion was fitted, in: {', '.join(names)}"
            warnings.warn(message, OutsideRangeWarning, stacklevel=3)
        return points
