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
    of
        Values (n, c) of output i in c versions, the first of which is that of the results, and i → the variable (c, …).
    missed
        The variable (…), the part ρ of an output's standard deviation that nothing tells, that deviation → the error
        (…) that is open.
    in_units
        Whether it is a value that the output may have.
    """

    name: str
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

        yield Consequence("quantiles", quantiles, _in_units, in_units=True)
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

        yield Consequence("density_edge", moved, _in_units, in_units=True)
    if inputs.independent:
        yield from _of_projections(dataset, inputs, points)


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


def _of_projections(dataset: xr.Dataset, inputs: Inputs, points: FloatArray) -> Iterator[Consequence]:
    """Find indices and bounds: they are looked at in polynomials, on which outputs are projected."""
    last = {**dict.fromkeys(GROUPED, ("group",)), PAIRED: ("parameter", "partner")}
    every = (*SINGLE, *GROUPED, PAIRED, *BOUNDS)
    names = [name for name in every if has(dataset, name, "output", *last.get(name, ("parameter",)))]
    if not names:
        return
    basis, members = _polynomials(dataset, inputs), np.zeros((0, len(inputs.names)), dtype=bool)
    if has(dataset, "group_members", "group", "parameter"):
        members = np.asarray(dataset["group_members"].to_numpy(), dtype=bool)
    rows, some = basis.values(points), points[:SLOPES]

    def coefficients(of: FloatArray) -> FloatArray:
        """Return coefficients (c, P) of values (n, c)."""
        return np.asarray(np.linalg.lstsq(rows, of, rcond=None)[0].T)

    def indices(name: str, of: FloatArray, _: int) -> FloatArray:
        return sobol_indices(coefficients(of), basis.indices, members, pairs=name == PAIRED)[name]

    def bounds(name: str, of: FloatArray, i: int) -> FloatArray:
        """Return mean squared derivatives (c, d), or these over the variance for bounds of total indices.

        Only their ratios by the coordinates count: constants of distributions are the same with and without the error.
        """
        c = coefficients(of)
        found = (np.einsum("nip,pc->nic", basis.derivatives(some), c.T) ** 2).mean(axis=0).T
        if name != "dgsm":
            found = shares(found, partial_variances(c**2, basis.indices, members)[0][:, None])
        stated = dataset[name].to_numpy()[i]
        return np.asarray(stated * np.divide(found, found[0], out=np.ones_like(found), where=found[0] > 0))

    for name in names:
        of, missed = (bounds, _relative) if name in BOUNDS else (indices, _share)
        yield Consequence(name, partial(of, name), missed)


def _polynomials(dataset: xr.Dataset, inputs: Inputs) -> Basis:
    if "multi_index" in dataset and dataset.sizes["term"] <= TERMS:
        return Expansion.of(dataset).basis
    d = len(inputs.names)
    order = next((order for order in (3, 2) if len(hyperbolic(d, order, 1.0)) <= ENOUGH // 2), 1) if d <= ENOUGH else 1
    return orthonormal(inputs, hyperbolic(d, order, 1.0))
