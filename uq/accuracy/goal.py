"""One tolerance for everything: what errors estimates may have, and how they add up against it.

With ε the tolerance, s the standard error of sampling and δ that of what is not known of the error of the mesh, for an
estimate of size S (`Goal.sizes`), the goal is

    √((h s)² + (Z δ)²) + η ≤ ε S

for mean and standard deviation of every output: h and Z are the standard errors on either side of a 95 % interval, η is
what the tolerance of the solver leaves. It is held by corrected values, to which the estimated error of the mesh is
added (`uq.accuracy.effects`); without such an estimate δ counts as zero, and it has to be said.

Relative to what: a mean to itself, or to the standard deviation where that is larger; a standard deviation to itself.
What is zero by symmetry, or does not vary, would need infinitely many samples. So no size is less than `SMALL` of the
largest mean of the same unit (numbers without a unit need not be alike: for them of the mean itself), and that of a
standard deviation not less than `SMALL` of its mean's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from forward.model import FloatArray
from uq.estimators.moments import ESTIMATES, Z

SMALL = 1e-3  # of the largest estimate of a kind: smaller ones are held to a tolerance of this
LEFT = 1 / 3  # of the error of a mesh that takes more than all: sampling need not be better


@dataclass(frozen=True)
class Goal:
    """The tolerance, and what of it is taken before anything is sampled.

    Attributes
    ----------
    tolerance
        ε, relative.
    units
        Of the outputs, by their order.
    most
        Largest number of solves.
    mesh
        δ (2, m) of means and standard deviations; zero where nothing is known.
    solver
        η over the size.
    """

    tolerance: float
    units: tuple[str, ...]
    most: int
    mesh: FloatArray
    solver: float = 0.0

    @classmethod
    def of(cls, tolerance: float, units: Sequence[str], most: int, solver: float = 0.0) -> Goal:
        """Return the goal of a model without a mesh."""
        return cls(tolerance, tuple(units), most, np.zeros((2, len(units))), solver)

    def sizes(self, mean: FloatArray, std: FloatArray) -> FloatArray:
        """Return what errors of means and standard deviations (m,) are relative to (2, m)."""
        own = np.maximum(np.abs(mean), std)
        kin = np.array(
            [max(own[[other == unit for other in self.units]]) if unit != "1" else 0.0 for unit in self.units]
        )
        of_mean = np.maximum(own, SMALL * kin)
        of_std = np.maximum(std, SMALL * of_mean)
        return np.array([of_mean, of_std])

    def parts(self, found: Mapping[str, FloatArray], half_width: float = Z) -> dict[str, FloatArray]:
        """Return the errors (2, m) by source, and in all, over the tolerance: 1 is as much as is allowed."""
        mean, mean_error, std, std_error = (np.asarray(found[name], dtype=float) for name in ESTIMATES)
        allowed = self.tolerance * self.sizes(mean, std)
        errors = {"sampling": half_width * np.array([mean_error, std_error]), "mesh": Z * self.mesh}
        # Where all is zero, so is the error.
        shares = {name: np.divide(e, allowed, out=np.zeros_like(e), where=e != 0) for name, e in errors.items()}
        shares["solver"] = np.full_like(allowed, self.solver / self.tolerance)
        shares["total"] = np.hypot(shares["sampling"], shares["mesh"]) + shares["solver"]
        return shares

    def reached(self, found: Mapping[str, FloatArray], half_width: float = Z) -> float:
        """Return the largest error of sampling over what is left for it: up to 1 there are enough samples."""
        parts = self.parts(found, half_width)
        left = 1 - parts["solver"]
        room = np.sqrt(np.maximum(np.maximum(left, 0.1) ** 2 - parts["mesh"] ** 2, (LEFT * parts["mesh"]) ** 2))
        return float(np.nan_to_num(parts["sampling"] / room, nan=np.inf).max())
