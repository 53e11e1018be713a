"""Densities from which points of a posterior are drawn, and how many of these would count.

Points of a proposal q have the weights p/q in a posterior p. If p is Laplace's Gaussian in c unknowns, points of a
Gaussian that is τ times as wide are worth (√(2τ² − 1)/τ²)ᶜ of their number: with τ = 1.3 nothing is left of them from
ten unknowns on. Those of Student's t with ν degrees of freedom are worth about √((2c + ν)ν)/(c + ν): with ν = c, 87 %
of them in any number of unknowns, and as the prior has the tails of a Gaussian in these coordinates, no weight is
without bound. So few unknowns have a wide mixture with the prior, which sees what is far from the mode, and many have
Student's t.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from forward.model import FloatArray
from inverse.low_dimensional.laplace import Laplace
from uq.inputs.sampling import sobol_points

WIDER = 1.3  # τ: standard deviations of the Gaussian in the mixture with the prior, over those of Laplace
SHARE = 0.7  # α: share of the points from the Gaussians; the others are from the prior
WORTHWHILE = 1 / 3  # share of its points that a first proposal is worth if the posterior is Gaussian
TRIED = 1024  # draws of Laplace's Gaussian to find that

Map = Callable[[FloatArray], FloatArray]  # points (n, c) → a number (n,) for each


@dataclass(frozen=True, eq=False)
class Mixture:
    """Gaussians of equal weight and the prior: a proposal.

    Attributes
    ----------
    centres
        (k, c).
    roots
        L (k, c, c), with L Lᵀ the covariances.
    """

    centres: FloatArray
    roots: FloatArray

    @classmethod
    def of(cls, gaussian: Laplace) -> Mixture:
        """Return the mixture of the prior and widened Gaussians: Laplace's, and others about other modes."""
        modes, hessians = gaussian.others
        roots = [gaussian.root, *(np.linalg.inv(np.linalg.cholesky(one)).T for one in hessians)]
        return cls(np.vstack([gaussian.mode, modes]), WIDER * np.array(roots))

    def draw(self, cubes: FloatArray) -> FloatArray:
        """Map points (n, c + 1) of the unit cube to points (n, c): the first number chooses the component."""
        from scipy.special import ndtri

        z = ndtri(cubes[:, 1:])
        which = np.minimum((cubes[:, 0] / SHARE * len(self.centres)).astype(int), len(self.centres) - 1)
        x = self.centres[which] + np.einsum("zij,zj->zi", self.roots[which], z)
        return np.where((cubes[:, 0] < SHARE)[:, None], x, z)

    def log_over_prior(self, x: FloatArray) -> FloatArray:
        """Ln of the density at x (n, c) over that of the prior, (n,)."""
        log_prior = -(x**2).sum(axis=1) / 2
        parts = []
        for centre, root in zip(self.centres, self.roots, strict=True):
            deviation = (x - centre) @ np.linalg.inv(root).T
            parts.append(-(deviation**2).sum(axis=1) / 2 - np.linalg.slogdet(root)[1])
        top = np.max(parts, axis=0)
        gaussians = top + np.log(np.exp(np.array(parts) - top).mean(axis=0))
        return np.asarray(np.logaddexp(np.log(SHARE) + gaussians - log_prior, np.log(1 - SHARE)))


@dataclass(frozen=True, eq=False)
class Elliptical:
    """Student's t, or a Gaussian: a proposal.

    Attributes
    ----------
    centre
        (c,).
    root
        L (c, c), with L Lᵀ the scale: the covariance of a Gaussian.
    degrees
        Degrees of freedom; infinite for a Gaussian.
    """

    centre: FloatArray
    root: FloatArray
    degrees: float = np.inf

    def draw(self, cubes: FloatArray) -> FloatArray:
        """Map points (n, c + 1) of the unit cube to points (n, c): the first number says how far out Student's are."""
        from scipy.special import gammaincinv, ndtri

        z = ndtri(cubes[:, 1:])
        if np.isfinite(self.degrees):
            z = z * np.sqrt(self.degrees / 2 / gammaincinv(self.degrees / 2, cubes[:, :1]))
        return np.asarray(self.centre + z @ self.root.T)

    def log_over_prior(self, x: FloatArray) -> FloatArray:
        """Ln of the density at x (n, c) over that of the prior, (n,)."""
        from scipy.special import gammaln

        c, nu = len(self.centre), self.degrees
        square = (np.linalg.solve(self.root, (x - self.centre).T) ** 2).sum(axis=0)
        log_prior = -(x**2).sum(axis=1) / 2
        if np.isfinite(nu):
            constant = gammaln((nu + c) / 2) - gammaln(nu / 2) - c / 2 * np.log(nu / 2)
            log_density = constant - (nu + c) / 2 * np.log1p(square / nu)
        else:
            log_density = -square / 2
        return np.asarray(log_density - np.linalg.slogdet(self.root)[1] - log_prior)


Proposal = Mixture | Elliptical  # a density of which points are drawn


def joint(over_prior: Sequence[Map], shares: Sequence[float], x: FloatArray) -> FloatArray:
    """Ln of a mixture of densities at x (n, c) over the prior, from ln of each over the prior and their shares."""
    parts = np.array([np.log(share) + one(x) for one, share in zip(over_prior, shares, strict=True)])
    top = parts.max(axis=0)
    return np.asarray(top + np.log(np.exp(parts - top).sum(axis=0)))


def about(gaussian: Laplace) -> tuple[Mixture, Elliptical, Elliptical]:
    """Return proposals about the mode: a wide mixture with the prior, Student's t, and Laplace's Gaussian itself."""
    mode, root = gaussian.mode, gaussian.root
    return Mixture.of(gaussian), Elliptical(mode, root, float(len(mode))), Elliptical(mode, root)


def first(wide: Mixture, student: Elliptical, normal: Elliptical) -> Proposal:
    """Return the widest of proposals about a mode whose points would count if the posterior were Laplace's Gaussian.

    Of several modes it is the one that knows them.
    """
    if len(wide.centres) > 1:
        return wide
    x = normal.draw(sobol_points(0, 0, 0, TRIED, len(normal.centre) + 1))
    over = np.exp(normal.log_over_prior(x) - wide.log_over_prior(x))
    return wide if 1 / over.mean() >= WORTHWHILE else student
