"""What follows from the values of an output over the distribution: quantiles, densities, indices, bounds.

Each of them is looked at with and without the error of the mesh, at the same points and in the same polynomials, so
that what these miss is in both.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.estimators.indices import partial_variances, shares, sobol_indices
from uq.surrogates.basis import Basis, hyperbolic, orthonormal
from uq.surrogates.expansion import Expansion

if TYPE_CHECKING:
    import xarray as xr

    from uq.inputs.random_parameters import Inputs

ENOUGH = 64  # samples that say by themselves how an output depends on the parameters
SMOOTH = 3  # degree of polynomials by which the ends of the parts of a density move
SLOPES = 1024  # points at most at which derivatives are looked at
TERMS = 500  # of an expansion, at most, whose indices are looked at with and without the error
SINGLE, GROUPED, PAIRED = ("sobol_first", "sobol_total"), ("sobol_group_first", "sobol_group_total"), "sobol_second"
BOUNDS = ("dgsm", "total_bound")


@dataclass(frozen=True)
class Consequence:
    """A variable of the results that follows from values of an output.

    Attributes
    ----------
    name
        Of the variable.
    by_output
        Number of the dimension of the outputs in it.
    of
        Values (n, c) of output i in c versions, the first of which is that of the results, and i → the variable (c, …).
    missed
        The variable (…), the part ρ of an output's standard deviation that nothing tells, that deviation → the error
        (…) that is open.
    in_units
        Whether it is a value that the output may have.
    """

    name: str
    by_output: int
    of: Callable[[FloatArray, int], FloatArray]
    missed: Callable[[FloatArray, float, float], FloatArray]
    in_units: bool = False


def consequences(dataset: xr.Dataset, inputs: Inputs, points: FloatArray) -> Iterator[Consequence]:
    """Find what a method has estimated of outputs beside their moments.

    Parameters
    ----------
    points
        Points (n, d) that stand for the distribution.
    """
    if has(dataset, "quantiles", "quantile", "output"):
        probabilities = dataset["quantile"].to_numpy()

        def quantiles(of: FloatArray, _: int) -> FloatArray:
            return np.asarray(np.quantile(of, probabilities, axis=0).T)

        yield Consequence("quantiles", 1, quantiles, _in_units, in_units=True)
    if has(dataset, "density_edge", "output", "edge"):
        edges = dataset["density_edge"].to_numpy()

        def moved(of: FloatArray, i: int) -> FloatArray:
            """Move ends so that as much lies below them; smoothly, since points are few between two ends."""
            below = np.searchsorted(np.sort(of[:, 0]), edges[i]) / len(of)
            shifts = np.quantile(of, below, axis=0) - np.quantile(of[:, :1], below, axis=0)
            powers = np.vander(np.linspace(-1.0, 1.0, len(below)), SMOOTH + 1)
            weights = np.sqrt(np.convolve(np.diff(below), [0.5, 0.5]))[:, None]
            fitted = np.linalg.lstsq(weights * powers, weights * shifts, rcond=None)[0]
            return np.asarray(edges[i] + (powers @ fitted).T)

        yield Consequence("density_edge", 0, moved, _in_units, in_units=True)
    if not inputs.independent:
        return
    last = {**dict.fromkeys(GROUPED, ("group",)), PAIRED: ("parameter", "partner")}
    every = (*SINGLE, *GROUPED, PAIRED, *BOUNDS)
    names = [name for name in every if has(dataset, name, "output", *last.get(name, ("parameter",)))]
    if names:
        projected = _Projected.on(dataset, inputs, points)
        for name in names:
            analysis = projected.analysis(dataset, name)
            yield Consequence(name, 0, analysis, _relative if name in BOUNDS else _share)


def has(dataset: xr.Dataset, name: str, *dims: str) -> bool:
    """Whether there is such a variable: methods from outside may give others, or none."""
    return name in dataset and dataset[name].dims == dims


def _in_units(values: FloatArray, rho: float, std: float) -> FloatArray:
    return np.full(values.shape, rho * std)


def _share(values: FloatArray, rho: float, _: float) -> FloatArray:
    """Of a share S = cos²θ of the variance, where the output turns by ρ: |dS| = 2 √(S(1 − S)) ρ, and ρ² at its ends."""
    inside = np.clip(values, 0.0, 1.0)
    return np.asarray(2 * np.sqrt(inside * (1 - inside)) * rho + rho**2)


def _relative(values: FloatArray, rho: float, _: float) -> FloatArray:
    return np.asarray(np.abs(values) * (2 * rho + rho**2))


@dataclass(frozen=True)
class _Projected:
    """Polynomials at points (n, d) of the distribution, on which outputs are projected.

    Attributes
    ----------
    basis
        The polynomials.
    rows
        Their values (n, P).
    points
        Some of the points, where derivatives are looked at.
    members
        Which parameters (G, d) each group has.
    """

    basis: Basis
    rows: FloatArray
    points: FloatArray
    members: NDArray[np.bool_]

    @classmethod
    def on(cls, dataset: xr.Dataset, inputs: Inputs, points: FloatArray) -> _Projected:
        """Take the polynomials of an expansion, or as many of a low order as the points can tell."""
        basis = _polynomials(dataset, inputs)
        return cls(basis, basis.values(points), points[:SLOPES], _members(dataset, len(inputs.names)))

    def analysis(self, dataset: xr.Dataset, name: str) -> Callable[[FloatArray, int], FloatArray]:
        """Return the function (values (n, c), output) → a variable (c, …), for a `Consequence`."""
        if name not in BOUNDS:
            about = partial(sobol_indices, indices=self.basis.indices, members=self.members, pairs=name == PAIRED)
            return lambda of, _: about(self._coefficients(of).T)[name]
        stated = dataset[name].to_numpy()

        def scaled(of: FloatArray, i: int) -> FloatArray:
            found = self._bounds(of, name)
            return np.asarray(stated[i] * np.divide(found, found[0], out=np.ones_like(found), where=found[0] > 0))

        return scaled

    def _coefficients(self, of: FloatArray) -> FloatArray:
        """Coefficients (P, c) of values (n, c)."""
        return np.asarray(np.linalg.lstsq(self.rows, of, rcond=None)[0])

    def _bounds(self, of: FloatArray, name: str) -> FloatArray:
        """Mean squared derivatives (c, d), over the variance for bounds of total indices; by the coordinates.

        Only their ratios count: constants of the distributions are the same with and without the error.
        """
        coefficients = self._coefficients(of)
        slopes = np.einsum("nip,pc->nic", self.basis.derivatives(self.points), coefficients)
        squares: FloatArray = (slopes**2).mean(axis=0).T
        if name == "dgsm":
            return squares
        return shares(squares, partial_variances(coefficients.T**2, self.basis.indices, self.members)[0][:, None])


def _members(dataset: xr.Dataset, dimension: int) -> NDArray[np.bool_]:
    """Which parameters (G, d) each group has."""
    if not has(dataset, "group_members", "group", "parameter"):
        return np.zeros((0, dimension), dtype=bool)
    return np.asarray(dataset["group_members"].to_numpy(), dtype=bool)


def _polynomials(dataset: xr.Dataset, inputs: Inputs) -> Basis:
    if "multi_index" in dataset and dataset.sizes["term"] <= TERMS:
        return Expansion.of(dataset).basis
    d = len(inputs.names)
    order = next((order for order in (3, 2) if len(hyperbolic(d, order, 1.0)) <= ENOUGH // 2), 1) if d <= ENOUGH else 1
    return orthonormal(inputs, hyperbolic(d, order, 1.0))
