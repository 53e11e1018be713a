"""The mode of a posterior and Laplace's Gaussian there: few parameters, in standard normal coordinates.

The mode is found by Gauss–Newton steps of limited length (K. Levenberg, Quart. Appl. Math. 2 (1944) 164–168; D. W.
Marquardt, J. SIAM 11 (1963) 431–441), from several starts. Near a mode where residuals are large and outputs are curved
these steps only crawl: each leaves a share of the distance that does not fall. The best end is therefore reached by
Newton's steps, with the second derivatives that are needed there anyway. A search has converged if its next step would
move no unknown, nor any combination of them, by more than a thousandth of its standard deviation. There
−ln p(y | x) + ½|x|² ≈ Φ̂ + ½ δᵀH δ, so that

    x ~ N(x̂, H⁻¹),   ln Z ≈ −Φ̂ − ½ ln det H,

which is exact for models that are linear in normal parameters (D. J. C. MacKay, Neural Comput. 4 (1992) 415–447).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from forward.model import FloatArray, SolveError
from forward.phases import phase
from inverse.low_dimensional.posterior import Density, Posterior
from uq.inputs.sampling import sobol_points

STEPS = 50
NEWTON = 8  # steps with second derivatives from the best end
CLOSE = 1e-13  # squared Newton decrement that ends the search: twice the error of the log density
NEAR = 1e-6  # of a search that has converged: its root is the largest move of any unknown, in standard deviations
CRAWLING, CRAWLED = 0.25, 1e-4  # share of the decrement that a step leaves, and decrement, from which on Newton's go on
FARTHEST = 3.0  # length of a step, in standard deviations of the prior
STIFFER, SOFTER = 8.0, 3.0
HALVED = 20  # times that a step of Newton is halved
ROUNDED = 1e-12  # gain over the log posterior that is rounding
MOST_STARTS, ENDED = 32, 0.1
APART, NEGLIGIBLE = 3.0, 9.0  # deviations between modes, and ln of the weight of one beside the other
DIFFERENCE = 0.05  # step of the second derivatives, in standard deviations of the posterior
WIDER = 1.3  # τ: standard deviations of the Gaussian in the mixture with the prior, over those of Laplace
SHARE = 0.7  # α: share of the points from the Gaussians; the others are from the prior
WORTHWHILE = 1 / 3  # share of its points that a first proposal is worth if the posterior is Gaussian
TRIED = 1024  # draws of Laplace's Gaussian to find that
Map = Callable[[FloatArray], FloatArray]  # points (n, c) → a number (n,) for each


class Step(NamedTuple):
    """One iteration of the search: start, log posterior, squared Newton decrement, damping."""

    start: int
    log_posterior: float
    decrement: float
    damping: float


@dataclass(frozen=True)
class Laplace:
    """A Gaussian for a posterior.

    Attributes
    ----------
    mode
        x̂ (c,).
    log_posterior
        ln p(y | x̂) − ½|x̂|².
    hessian
        H (c, c), positive definite.
    converged
        Whether the search ended at a stationary point.
    left
        How far, in standard deviations, the next step would move the combination of unknowns that it moves most.
    steps
        The iterations of all starts.
    modes
        End points (k, c) of the searches, and `ends` (k,), the log posterior there.
    curvatures
        Gauss–Newton's second derivatives (k, c, c) there, NaN where a search has not ended at a mode; None where
        nothing is said of other modes.
    """

    mode: FloatArray
    log_posterior: float
    hessian: FloatArray
    converged: bool
    steps: tuple[Step, ...]
    modes: FloatArray
    ends: FloatArray
    left: float
    curvatures: FloatArray | None = None

    @property
    def log_evidence(self) -> float:
        """Ln Z of the Gaussian."""
        return float(self.log_posterior - np.linalg.slogdet(self.hessian)[1] / 2)

    @property
    def root(self) -> FloatArray:
        """L (c, c) with L Lᵀ = H⁻¹: x̂ + L z with standard normal z is a sample."""
        return np.linalg.inv(np.linalg.cholesky(self.hessian)).T

    @property
    def covariance(self) -> FloatArray:
        """H⁻¹ (c, c)."""
        root = self.root
        return np.asarray(root @ root.T)

    @property
    def others(self) -> tuple[FloatArray, FloatArray]:
        """Other modes (k, c) where searches have ended, and second derivatives (k, c, c) there, by what they weigh.

        They are apart from each other and from the mode, and not negligible beside it, by Laplace's formula.
        """
        if self.curvatures is None:
            return self.modes[:0], self.hessian[None][:0]
        modes, hessians = np.vstack([self.mode, self.modes]), np.concatenate([self.hessian[None], self.curvatures])
        which = _distinct(modes, hessians, np.append(np.inf, self.ends), self.log_evidence)
        return modes[which[1:]], hessians[which[1:]]

    def knowing(self, searched: Laplace, places: Sequence[int]) -> Laplace:
        """Return the same with where searches have ended in some of the coordinates, before the posterior changed."""
        if searched.curvatures is None:
            return self
        c, n = len(self.mode), len(searched.modes)
        modes, curvatures = np.zeros((n, c)), np.tile(np.eye(c), (n, 1, 1))
        modes[:, places], curvatures[np.ix_(range(n), places, places)] = searched.modes, searched.curvatures
        ends = searched.ends + self.log_posterior - searched.log_posterior
        return replace(self, modes=modes, ends=ends, curvatures=curvatures)


@phase("searching for the mode")
def laplace(
    posterior: Posterior, *, starts: int = 4, seed: int = 0, exact: bool = True, first: FloatArray | None = None
) -> Laplace:
    """Find the mode, and the second derivatives there.

    Where searches end in w different modes there may be more: of n starts, w (n − 1)/(n − w − 2) are expected in all
    (C. G. E. Boender, A. H. G. Rinnooy Kan, Math. Program. 37 (1987) 59–80). Until that is w + ½, starts are doubled.

    Parameters
    ----------
    posterior
        Its model must have derivatives.
    starts, seed
        Number of starts: the `first`, by default the centre of the prior, and points of a scrambled Sobol' sequence.
    exact
        Take second derivatives by central differences of the gradient (two solves for each coordinate), or those of
        Gauss–Newton.

    Raises
    ------
    SolveError
        If the model has no answer at any of the starts.
    """
    from scipy.special import ndtri

    c = len(posterior.names)

    def begin(start: int, stop: int) -> FloatArray:
        # Every coordinate of a start is within a standard deviation or two: in the far tails models have no answer.
        return np.asarray(ndtri(0.05 + 0.9 * sobol_points(seed, 0, start - 1, stop - 1, c)))

    ends: list[Density] = []
    steps: list[Step] = []
    number, begun = 0, list(np.vstack([np.zeros(c) if first is None else first, begin(1, starts)]))
    while begun:
        for x in begun:
            found = _climb(posterior, x, number, steps)
            number += 1
            if found is not None:
                ends.append(found)
        if not ends:
            raise SolveError(f"the model has no answer at any of the {starts} starts of the search for the mode")
        curvatures = np.array([_at_mode(end) for end in ends])
        values = np.array([float(end.log_posterior[0]) for end in ends])
        seen = len(_distinct(np.vstack([end.x for end in ends]), curvatures, values))
        enough = seen < 2 or number >= MOST_STARTS or seen * (number - 1) <= (seen + 0.5) * (number - seen - 2)
        begun = [] if enough else list(begin(number, 2 * number))
    best = int(values.argmax())
    here = ends[best]
    hessian = _positive(here.curvature[0])
    if exact:
        here, hessian = _newton(posterior, here, best, steps)
    gradient = here.gradient[0]
    left = float(np.sqrt(gradient @ np.linalg.solve(hessian, gradient)))
    values[best] = here.log_posterior[0]
    return Laplace(
        here.x[0],
        float(here.log_posterior[0]),
        hessian if exact else here.curvature[0],
        left <= np.sqrt(NEAR) or left**2 <= ROUNDED * abs(values[best]),
        tuple(steps),
        np.array([(here if k == best else end).x[0] for k, end in enumerate(ends)]),
        values,
        left,
        curvatures,
    )


def _at_mode(end: Density) -> FloatArray:
    """Second derivatives (c, c) where a search has ended; NaN if it would go on by more than a tenth of a deviation."""
    gradient, curvature = end.gradient[0], _positive(end.curvature[0])
    ended = float(gradient @ np.linalg.solve(curvature, gradient)) < ENDED**2
    return curvature if ended else np.full_like(curvature, np.nan)


def _distinct(modes: FloatArray, hessians: FloatArray, ends: FloatArray, log_evidence: float = -np.inf) -> list[int]:
    """Return which of modes (k, c) are apart, by their weights, and not negligible beside the heaviest one.

    Or beside what has some evidence; an infinite log posterior is of a mode that comes first.
    """
    with np.errstate(invalid="ignore"):
        weights = ends - np.linalg.slogdet(hessians)[1] / 2
    heaviest, found = max(weights[np.isfinite(weights)].max(initial=-np.inf), log_evidence), list[int]()
    for k in np.argsort(-weights, kind="stable"):
        gaps = ((modes[k] - modes[j], hessians[k] + hessians[j]) for j in found)
        if weights[k] > heaviest - NEGLIGIBLE and all(gap @ both @ gap > 2 * APART**2 for gap, both in gaps):
            found.append(int(k))
    return found


def _newton(posterior: Posterior, here: Density, number: int, steps: list[Step]) -> tuple[Density, FloatArray]:
    """Go on with Newton's steps, shortened until they climb; return where they end, and second derivatives there."""
    for _ in range(NEWTON):
        hessian = _differences(posterior, here.x[0], here.curvature[0])
        gradient, value = here.gradient[0], float(here.log_posterior[0])
        step = -np.linalg.solve(hessian, gradient)
        decrement = float(-gradient @ step)
        if decrement < max(CLOSE, ROUNDED * abs(value)):
            break
        step *= min(1.0, FARTHEST / float(np.linalg.norm(step)))
        for _ in range(HALVED):
            there = posterior.at(here.x + step, derivatives=True)
            if float(there.log_posterior[0]) > value:
                break
            step /= 2
        else:
            break
        here = there
        steps.append(Step(number, float(here.log_posterior[0]), decrement, 0.0))
    return here, hessian


def _climb(posterior: Posterior, x: FloatArray, number: int, steps: list[Step]) -> Density | None:
    """Climb from x (c,) by Gauss–Newton steps until they end or crawl; None where the model has no answer at x."""
    here = posterior.at(x[None, :], derivatives=True)
    if not np.isfinite(here.log_likelihood[0]):
        return None
    damping, before = 0.0, np.inf
    for _ in range(STEPS):
        gradient, curvature = here.gradient[0], _positive(here.curvature[0])
        decrement = float(gradient @ np.linalg.solve(curvature, gradient))
        value = float(here.log_posterior[0])
        steps.append(Step(number, value, decrement, damping))
        if decrement < CLOSE or CRAWLING * before < decrement < CRAWLED:
            return here
        before = decrement
        for _ in range(STEPS):
            step = -np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), gradient)
            step *= min(1.0, FARTHEST / float(np.linalg.norm(step)))
            there = posterior.at(here.x + step, derivatives=True)
            gain = float(there.log_posterior[0]) - value
            expected = float(-gradient @ step - step @ curvature @ step / 2)
            if gain > 1e-4 * expected:
                break
            if abs(expected) < ROUNDED * abs(value):
                return here
            damping = max(STIFFER * damping, 1e-2)
        else:
            return here
        if gain > 0.5 * expected:
            damping = damping / SOFTER if damping > 1e-3 else 0.0
        here = there
    return here


def _positive(matrix: FloatArray) -> FloatArray:
    """Return the nearest matrix whose eigenvalues are those of a posterior at most 30 times as wide as the prior."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.asarray(vectors * np.maximum(values, 1e-3) @ vectors.T)


def _differences(posterior: Posterior, mode: FloatArray, curvature: FloatArray) -> FloatArray:
    """Second derivatives by differences of the gradient, in directions in which the posterior is about equally wide."""
    directions = np.linalg.inv(np.linalg.cholesky(_positive(curvature))).T  # columns
    moves = DIFFERENCE * directions.T
    found = posterior.at(np.concatenate([mode + moves, mode - moves]), derivatives=True)
    if not np.isfinite(found.log_likelihood).all():
        return _positive(curvature)
    c = len(mode)
    change = (found.gradient[:c] - found.gradient[c:]) / (2 * DIFFERENCE)  # rows: H times a direction
    whitened = change @ directions
    inverse = np.linalg.inv(directions)
    values, vectors = np.linalg.eigh((whitened + whitened.T) / 2)
    # In these coordinates Gauss–Newton gives 1.
    return np.asarray(inverse.T @ (vectors * np.maximum(values, 1e-2) @ vectors.T) @ inverse)


def deviations(posterior: Posterior, gaussian: Laplace) -> FloatArray:
    """Return standard deviations (d,) of the parameters by Laplace's Gaussian."""
    d = len(posterior.inputs.names)
    slopes = posterior.inputs.from_normals(gaussian.mode[None, :d])[1][0]
    return np.asarray(np.sqrt(np.diag(slopes @ gaussian.covariance[:d, :d] @ slopes.T)))


def unexplained(A: FloatArray, rows: FloatArray) -> FloatArray:
    """Return rows (k, m) times S^(−½), S = I + AAᵀ with the derivatives A (m, d) of normal residuals."""
    U, sizes, _ = np.linalg.svd(A, full_matrices=False)
    return np.asarray(rows - ((rows @ U) * (1 - 1 / np.sqrt(1 + sizes**2))) @ U.T)


@dataclass(frozen=True, eq=False)
class Mixture:
    """Gaussians of equal weight and the prior: a proposal that sees what is far from the mode, for few unknowns.

    If the posterior is Laplace's Gaussian in c unknowns, points of one τ times as wide are worth (√(2τ² − 1)/τ²)ᶜ of
    their number: with τ = 1.3 nothing is left of them from ten unknowns on.

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

    If the posterior is Laplace's Gaussian, points of Student's t with ν degrees of freedom are worth about
    √((2c + ν)ν)/(c + ν): with ν = c, 87 % of them in any number of unknowns c, and as the prior has the tails of a
    Gaussian in these coordinates, no weight is without bound.

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
