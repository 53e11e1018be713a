"""The random parameters of a study: marginal distributions, independent or joined by a Gaussian copula, and draws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from uq.inputs.coordinates import Coordinates
from uq.inputs.distributions import Distribution, Normal
from uq.inputs.sampling import random_points, sobol_points

if TYPE_CHECKING:
    from uq.inputs.draws import Draws

CORNERS = 12  # number of parameters up to which all corners of a box are checked
FARTHEST = 6.0  # standard deviations: the probability beyond is 2e-9
POINTS = 2**16
LARGEST_DEGREE = 1000


class Restriction(Protocol):
    """A part of the space of the parameters."""

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters that it depends on."""

    def admissible(self, values: Mapping[str, FloatArray]) -> NDArray[np.bool_]:
        """Return which of these parameters, arrays (n,) by name, are in it (n,)."""


@dataclass(frozen=True)
class Inputs:
    """d random parameters.

    Parameters
    ----------
    own
        Distribution of each parameter without draws by name; the order is that of the parameter vectors.
    correlations
        Correlations ρ of the Gaussian copula by pairs of names: two standard normal variables with correlation ρ are
        mapped through the marginals. Other pairs are uncorrelated.
    admissible
        Where the model is defined. Densities are restricted to it by dividing by `admitted`; points are not restricted.
    draws
        Parameters of which there are draws, dependent as these are, and independent of the others, which they follow.

    Raises
    ------
    ValueError
        If the correlations have unknown names, or names of draws, or do not form a positive definite matrix.
    """

    own: dict[str, Distribution]
    correlations: tuple[tuple[str, str, float], ...] = ()
    admissible: Restriction | None = field(default=None, compare=False)
    draws: Draws | None = None

    def __post_init__(self) -> None:
        for a, b, rho in self.correlations:
            for name in (a, b):
                if self.draws is not None and name in self.draws.names:
                    message = f"correlation of '{name}', of which there are draws: they have correlations of their own"
                    raise ValueError(message)
                if name not in self.marginals:
                    raise ValueError(f"correlation of '{name}', expected one of: {', '.join(self.names)}")
            if a == b or not -1 < rho < 1:
                message = f"correlation {rho:g} of '{a}' and '{b}', expected two different names and −1 < value < 1"
                raise ValueError(message)
        if self.correlations and (smallest := np.linalg.eigvalsh(self._copula).min()) <= 0:
            message = f"the correlations do not form a positive definite matrix (smallest eigenvalue {smallest:.3g})"
            raise ValueError(message)

    @cached_property
    def marginals(self) -> dict[str, Distribution]:
        """Distribution of each parameter by name."""
        return self.own if self.draws is None else self.own | self.draws.marginals

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(self.marginals)

    def beside(self, names: Sequence[str], means: FloatArray | None = None) -> Inputs:
        """Return the same with further independent normal parameters of standard deviation 1, of mean 0 by default."""
        each = zip(names, np.zeros(len(names)) if means is None else means, strict=True)
        return replace(self, own=self.own | {name: Normal(mean=float(mean), std=1.0) for name, mean in each})

    @property
    def independent(self) -> bool:
        """Whether no two parameters are correlated, or given by the same draws."""
        return not any(rho for *_, rho in self.correlations) and len(self.joint) < 2

    @cached_property
    def unbounded(self) -> NDArray[np.bool_]:
        """Which parameters (d,) have distributions with tails."""
        return np.array([marginal.support is None for marginal in self.marginals.values()], dtype=bool)

    @property
    def tails(self) -> NDArray[np.bool_]:
        """Which parameters (d,) have values beyond those of samples: unbounded, or given by draws, which are many."""
        return self.unbounded | np.isin(np.arange(len(self.marginals)), self.joint)

    @property
    def joint(self) -> range:
        """Places of the parameters that are given by draws."""
        return range(len(self.own), len(self.marginals))

    @property
    def largest_degree(self) -> int:
        """Largest degree of polynomials that the parameters tell apart: without limit, unless there are few draws."""
        return LARGEST_DEGREE if self.draws is None else self.draws.largest_degree

    @cached_property
    def mean(self) -> FloatArray:
        """Expected values (d,)."""
        return np.array([m.moments[0] for m in self.marginals.values()])

    @cached_property
    def std(self) -> FloatArray:
        """Standard deviations (d,)."""
        return np.array([m.moments[1] for m in self.marginals.values()])

    @cached_property
    def _columns(self) -> dict[Distribution, list[int]]:
        """Positions of the parameters of each distribution."""
        columns: dict[Distribution, list[int]] = {}
        for i, marginal in enumerate(self.own.values()):
            columns.setdefault(marginal, []).append(i)
        return columns

    @cached_property
    def _copula(self) -> FloatArray:
        """Correlation matrix (d, d) of the underlying normal variables."""
        matrix = np.eye(len(self.marginals))
        names = list(self.marginals)
        for a, b, rho in self.correlations:
            i, j = names.index(a), names.index(b)
            matrix[i, j] = matrix[j, i] = rho
        return matrix

    @cached_property
    def coordinates(self) -> Coordinates:
        """The arguments of polynomials that approximate outputs."""
        centre, scale = np.array([m.of_coordinate for m in self.marginals.values()]).reshape(-1, 2).T
        mixing = None
        if self.draws is not None:
            mixing = np.eye(len(self.marginals))
            mixing[self.joint.start :, self.joint.start :] = self.draws.mixing
        logarithmic = np.array([m.logarithmic for m in self.marginals.values()], dtype=bool)
        return Coordinates(logarithmic, centre, scale, mixing)

    @cached_property
    def correlation(self) -> FloatArray:
        """Correlation (d, d) of the coordinates, by Gauss–Hermite quadrature for correlated pairs; draws have none."""
        correlation = np.eye(len(self.marginals))
        if self.draws is not None:
            correlation[: self.joint.start, : self.joint.start] = self._alone.correlation
            return correlation
        nodes, weights = np.polynomial.hermite_e.hermegauss(64)  # type: ignore[no-untyped-call]
        weights = weights / weights.sum()
        marginals, d = list(self.marginals.values()), len(self.marginals)

        def coordinate(i: int, normals: FloatArray) -> FloatArray:
            points = np.ones((normals.size, d))
            points[:, i] = marginals[i].from_normal(normals.ravel())[0]
            return self.coordinates.of(points)[:, i].reshape(normals.shape)

        for a, b, rho in self.correlations:
            i, j = self.names.index(a), self.names.index(b)
            second = rho * nodes[:, None] + np.sqrt(1 - rho**2) * nodes[None, :]
            x, y = coordinate(i, nodes), coordinate(j, second)
            correlation[i, j] = correlation[j, i] = float(np.einsum("i,j,i,ij->", weights, weights, x, y))
        return correlation

    def points(self, uniforms: FloatArray) -> FloatArray:
        """Map points (n, d) of the open unit cube to points (n, d) of the parameters."""
        if self.draws is not None:
            own, of_draws = np.split(uniforms, [self.joint.start], axis=1)
            return np.hstack([self._alone.points(own), self.draws.points(of_draws)])
        if not self.correlations:
            points = np.empty_like(uniforms)
            for marginal, columns in self._columns.items():  # many parameters have few distributions
                points[:, columns] = marginal.quantile(uniforms[:, columns])
            return points
        from scipy.special import ndtri

        return self.from_normals(ndtri(uniforms))[0]

    def random(self, seed: int | tuple[int, ...], start: int, stop: int) -> FloatArray:
        """Return the random points number `start` to `stop` (stop − start, d) of a seed.

        Draws of equal weight come in turn, each once before any comes twice.
        """
        points = self.points(random_points(seed, start, stop, len(self.names)))
        if self.draws is not None and self.draws.equal:
            points[:, self.joint.start :] = self.draws.in_turn(seed, start, stop)
        return points

    @cached_property
    def _alone(self) -> Inputs:
        """The parameters that have distributions of their own."""
        return Inputs(self.own, self.correlations)

    def from_normals(self, normals: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map independent standard normal coordinates x (n, d) to the parameters ω (n, d).

        Returns
        -------
        tuple of numpy.ndarray
            ω, and the derivatives ∂ω_i/∂x_j (n, d, d).

        Raises
        ------
        ValueError
            If parameters are given by draws: no smooth map leads there.
        """
        if self.draws is not None:
            raise ValueError(f"{', '.join(self.draws.names)}: draws are not a smooth function of normal variables")
        factor = np.linalg.cholesky(self._copula)
        columns = zip(self.marginals.values(), (normals @ factor.T).T, strict=True)
        values, slopes = zip(*(marginal.from_normal(z) for marginal, z in columns), strict=True)
        return np.column_stack(values), np.column_stack(slopes)[:, :, None] * factor

    def whitened(self, uniforms: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map points (n, d) of the open unit cube to parameters, with derivatives by standard normal coordinates there.

        Of parameters that are given by draws these are roots of their covariance, of logarithms where coordinates are.

        Returns
        -------
        tuple of numpy.ndarray
            ω (n, d), and ∂ω_i/∂x_j (n, d, d).
        """
        from scipy.special import ndtri

        if self.draws is None:
            return self.from_normals(ndtri(uniforms))
        first = self.joint.start
        points, slopes = self.points(uniforms), np.zeros((*uniforms.shape, uniforms.shape[1]))
        if first:
            slopes[:, :first, :first] = self._alone.from_normals(ndtri(uniforms[:, :first]))[1]
        of_draws = self.coordinates
        size = np.where(of_draws.logarithmic, points, 1.0)[:, first:] * of_draws.scale[first:]
        slopes[:, first:, first:] = size[:, :, None] * self.draws.mixing
        return points, slopes

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return ln of the density (n,) at points (n, d), unrestricted; −∞ outside."""
        with np.errstate(divide="ignore"):
            logs = sum(np.log(m.density(x)) for m, x in zip(self.marginals.values(), points.T, strict=True))
        found = np.asarray(logs, dtype=float)
        if self.correlations:
            from scipy.special import ndtri

            columns = zip(self.marginals.values(), points.T, strict=True)
            z = ndtri(np.column_stack([m.cumulative(x) for m, x in columns]).clip(1e-300, 1 - 2**-53))
            matrix = np.linalg.inv(self._copula) - np.eye(len(self.marginals))
            found += -np.einsum("ni,ij,nj->n", z, matrix, z) / 2 - np.linalg.slogdet(self._copula)[1] / 2
        return found

    def within(self, admissible: Restriction) -> Inputs:
        """Return the same parameters, restricted."""
        return replace(self, admissible=admissible)

    def allowed(self, points: FloatArray) -> NDArray[np.bool_]:
        """Return at which points (n, d) the model is defined, (n,)."""
        if self.admissible is None:
            return np.ones(len(points), dtype=bool)
        return np.broadcast_to(self.admissible.admissible(dict(zip(self.names, points.T, strict=True))), len(points))

    def drawn(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Draw parameters (count, d) at which the model is defined."""
        kept = np.zeros((0, len(self.names)))
        while len(kept) < count:
            points = self.from_normals(rng.standard_normal((count, len(self.names))))[0]
            kept = np.concatenate([kept, points[self.allowed(points)]])
        return kept[:count]

    @cached_property
    def admitted(self) -> float:
        """Probability of parameters for which the model is defined."""
        return self.admitted_at(1.0)

    def admitted_at(self, width: float) -> float:
        """Return that probability if the standard normal coordinates are wider by a factor.

        It is 1 if all corners of the box of these coordinates are admissible: the moduli of materials are linear in
        each constant, hence smallest at a corner. Otherwise it is the share of admissible scrambled Sobol' points.
        """
        if self.admissible is None or not self.admissible.names:
            return 1.0
        if self.draws is not None:
            uniforms = sobol_points(0, 0, 0, len(self.draws.values), len(self.marginals))
            own = self._alone.points(uniforms[:, : self.joint.start])
            return float(self.draws.weights @ self.allowed(np.hstack([own, self.draws.values])))
        names = [name for name in self.names if name in self.admissible.names]
        pairs = tuple(c for c in self.correlations if c[0] in names and c[1] in names)
        few = Inputs({name: self.marginals[name] for name in names}, pairs, self.admissible)
        if len(names) <= CORNERS:
            z = width * np.array([-FARTHEST, FARTHEST])
            supports = [marginal.support for marginal in few.marginals.values()]
            if None not in supports and few._admits_corners(supports):  # a larger box, which needs no quantiles
                return 1.0
            if few._admits_corners([marginal.from_normal(z)[0] for marginal in few.marginals.values()]):
                return 1.0
        from scipy.special import ndtri

        points = few.from_normals(width * ndtri(sobol_points(0, 0, 0, POINTS, len(names))))[0]
        return float(few.allowed(points).mean())

    def _admits_corners(self, ends: Sequence[Any]) -> bool:
        """Whether the model is defined at all corners of a box with these two ends along each parameter."""
        return bool(self.allowed(np.stack(np.meshgrid(*ends), axis=-1).reshape(-1, len(ends))).all())
