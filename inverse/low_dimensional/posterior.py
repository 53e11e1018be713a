"""The posterior density of a few random parameters given measured outputs, in standard normal coordinates.

With ω = ω(x), x ~ N(0, I) a priori (`Inputs.from_normals`), data y = ψ(ω) + e and independent e_i ~ N(0, (s σ_i)²),

    −ln p(y | x) = ½ r·r + Σ ln(s σ_i) + (m/2) ln 2π,   r_i = (ψ_i(ω) − y_i)/(s σ_i),

where s = 1, or is unknown too, with its own prior and one more coordinate. The prior of x is normalised, so that
evidences of different models are comparable (for errors with heavy tails see `inverse.data.noise`):

    Z = ∫ p(y | x) N(x; 0, I) dx.

If the model is defined only on a part A of the prior (`Inputs.admissible`), the prior is N(x; 0, I)/P(A) in A and zero
elsewhere: outside A the model has no answer, and p(y | x) here includes the factor 1/P(A).

Where the error of the model's mesh is known, ψ is corrected by it, and what is uncertain of that is another error of
the data (`inverse.data.noise`): r is then W r.

Gradient and second derivatives of −ln p(y | x) + ½|x|² follow from ∂r/∂x = A; the second ones leave out what
multiplies ∂²ψ (Gauss–Newton), which is nothing for models that are linear in normal parameters: J. Nocedal, S. J.
Wright, Numerical Optimization (2006), section 10.2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray, ForwardModel, SolveError
from inverse.data.noise import Noise
from uq.evaluation.request import Evaluate, Request, Start
from uq.inputs.random_parameters import Inputs
from uq.surrogates.linearisation import linearise

NOISE = "noise"  # name of the coordinate of s


@dataclass(frozen=True)
class Density:
    """The posterior at n points.

    Attributes
    ----------
    x
        Points (n, c).
    parameters
        The model's parameters ω (n, d) there.
    outputs
        ψ (n, m), corrected where the error of the mesh is known; NaN where the model has no answer.
    log_likelihood
        ln p(y | x) (n,); −∞ where the model has no answer.
    everything
        All outputs (n, M) of the model, not corrected, of which ψ are those that were measured.
    tangents
        ∂ψ/∂ω (n, M, d) of all outputs, if derivatives were requested.
    gradient, curvature
        Of −ln p(y | x) + ½|x|²: (n, c), and its second derivatives (n, c, c) without those of ψ; NaN where the model
        has no answer, empty if they were not requested.
    """

    x: FloatArray
    parameters: FloatArray
    outputs: FloatArray
    log_likelihood: FloatArray
    everything: FloatArray
    tangents: FloatArray | None
    gradient: FloatArray
    curvature: FloatArray

    @property
    def log_posterior(self) -> FloatArray:
        """Ln p(y | x) − ½|x|² (n,), which is largest at the mode."""
        return np.asarray(self.log_likelihood - (self.x**2).sum(axis=1) / 2)

    @classmethod
    def joined(cls, parts: Sequence[Density], order: NDArray[np.intp] | None = None) -> Density:
        """Join points, in a new order if one is given; with derivatives if all parts have them."""
        n, names = sum(len(part.x) for part in parts), [one.name for one in fields(cls)]
        known: dict[str, Any] = {"tangents": None, "gradient": np.zeros((n, 0)), "curvature": np.zeros((n, 0, 0))}
        if not all(part.tangents is not None for part in parts):
            names = [name for name in names if name not in known]
        for name in names:
            values = np.concatenate([vars(part)[name] for part in parts])
            known[name] = values if order is None else values[order]
        return cls(**known)


@dataclass(frozen=True)
class Posterior:
    """Measured outputs, and the priors of parameters and errors.

    Parameters
    ----------
    inputs
        The d parameters of the model.
    evaluate
        The model.
    data
        y (m,), in the units of the outputs.
    noise
        The errors.
    which
        Outputs of the model that were measured: numbers (m,), or all of a slice.
    start
        Initial guesses of the solver.
    """

    inputs: Inputs
    evaluate: Evaluate
    data: FloatArray
    noise: Noise
    which: NDArray[np.int64] | slice = field(default_factory=lambda: slice(None))
    start: Start | None = None

    def __post_init__(self) -> None:
        if self.data.shape != self.noise.sigma.shape:
            message = f"{self.data.size} data with {self.noise.sigma.size} standard deviations, expected equal numbers"
            raise ValueError(message)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the c coordinates: the parameters, and the noise if it is unknown."""
        return self.inputs.names + ((NOISE,) if self.noise.factor is not None else ())

    def physical(self, x: FloatArray) -> FloatArray:
        """Return the parameters, and s if it is unknown, (n, c) at x (n, c)."""
        d = len(self.inputs.names)
        values = self.inputs.from_normals(x[:, :d])[0]
        if self.noise.factor is None:
            return values
        return np.column_stack([values, self.noise.factor.from_normal(x[:, d])[0]])

    def slopes(self, x: FloatArray) -> FloatArray:
        """Return the derivatives (n, c, c) of the parameters, and of s if it is unknown, by x (n, c)."""
        d, (n, c) = len(self.inputs.names), x.shape
        found = np.zeros((n, c, c))
        found[:, :d, :d] = self.inputs.from_normals(x[:, :d])[1]
        if self.noise.factor is not None:
            found[:, d, d] = self.noise.factor.from_normal(x[:, d])[1]
        return found

    def scale(self, x: FloatArray) -> FloatArray:
        """Return the standard deviations (n, m) of the independent errors at x (n, c)."""
        factor = self.noise.factor
        s = np.ones(len(x)) if factor is None else factor.from_normal(x[:, -1])[0]
        return s[:, None] * self.noise.scale

    def residuals(self, outputs: FloatArray, x: FloatArray) -> FloatArray:
        """Return independent residuals (n, m) of corrected outputs (n, m) at x (n, c)."""
        return self.noise.whitened((outputs - self.data) / self.scale(x))

    def output_slopes(self, at: Density) -> FloatArray:
        """Return derivatives (n, m, d) of the corrected outputs by the normal coordinates of the parameters."""
        assert at.tangents is not None
        tangents = at.tangents[:, self.which]
        if self.noise.model is not None and self.noise.model.trend is not None:
            tangents = tangents + self.noise.model.trend.tangent(tangents)
        return np.asarray(tangents @ self.inputs.from_normals(at.x[:, : len(self.inputs.names)])[1])

    def sensitivities(self, at: Density) -> FloatArray:
        """Return derivatives (n, m, d) of these residuals by the normal coordinates of the parameters."""
        A = self.output_slopes(at) / self.scale(at.x)[:, :, None]
        return np.swapaxes(self.noise.whitened(np.swapaxes(A, 1, 2)), 1, 2)

    def _misfit(self, residual: FloatArray, x: FloatArray) -> FloatArray:
        """−ln of the likelihood (n,) of independent residuals (n, m) at x (n, c)."""
        logs = np.log(self.scale(x)).sum(axis=1) + self.noise.log_determinant
        return np.asarray(self.noise.misfit(residual, logs) + np.log(self.inputs.admitted))

    def potential(self, x: FloatArray, model: ForwardModel) -> tuple[float, FloatArray]:
        """Return −ln p(y | x) + ½|x|² at x (c,), and its gradient (c,), by one solve of the model and one adjoint.

        Where the model has no answer that is infinite, and the gradient zero. Collective over the ranks of the model.
        """
        d, m, here, noise = len(self.inputs.names), self.data.size, x[None], self.noise
        point, slopes = self.inputs.from_normals(here[:, :d])
        guess = None if self.start is None else self.start.on(model)(point[0])
        try:
            solution = model.solve(point[0], guess)
        except SolveError:
            return np.inf, np.zeros(len(x))
        outputs = np.asarray(solution.outputs)[None, self.which]
        if noise.model is not None:
            outputs = outputs + noise.model.at(point, outputs)
        residual = self.residuals(outputs, here)
        score = noise.score(residual)
        pull = (noise.whitened(score) / self.scale(here))[0]  # W is symmetric
        weights, own = np.zeros(len(model.outputs)), np.zeros(d)
        if noise.model is not None and noise.model.trend is not None:
            more, own = noise.model.trend.adjoint(pull)
            pull = pull + more
        np.add.at(weights, np.arange(len(weights))[self.which], pull)
        gradient = x.copy()
        gradient[:d] += (solution.adjoint(weights) + own) @ slopes[0]
        if noise.factor is not None:
            s, s_slope = noise.factor.from_normal(here[:, d])
            gradient[d] += float(((m - (residual * score).sum(axis=1)) * s_slope / s)[0])
        return float(self._misfit(residual, here)[0] + x @ x / 2), gradient

    def at(self, x: FloatArray, *, derivatives: bool = False) -> Density:
        """Solve at the points x (n, c)."""
        d, m = len(self.inputs.names), self.data.size
        n, c = x.shape
        points = self.inputs.from_normals(x[:, :d])[0]
        found = self.evaluate(Request(points, tangents=derivatives, start=self.start))
        outputs = found.outputs[:, self.which]
        if self.noise.model is not None:
            outputs = outputs + self.noise.model.at(points, outputs)
        residual = self.residuals(outputs, x)
        log_likelihood = np.where(found.ok, -self._misfit(residual, x), -np.inf)
        empty = np.zeros((n, 0))
        plain = Density(x, points, outputs, log_likelihood, found.outputs, None, empty, empty[:, :, None])
        if not derivatives:
            return plain
        A = np.zeros((n, m, c))
        A[:, :, :d] = self.sensitivities(replace(plain, tangents=found.tangents))
        score = self.noise.score(residual)
        gradient = x + np.einsum("zm,zmc->zc", score, A)
        curvature = np.eye(c) + np.einsum("zmc,zm,zme->zce", A, self.noise.information(residual), A)
        if self.noise.factor is not None:
            s, s_slope = self.noise.factor.from_normal(x[:, d])
            ln_s_slope = s_slope / s
            # r falls with ln s: d(Σρ + m ln s)/d ln s = m − r·ψ; the second derivatives are exact in ln s.
            gradient[:, d] += (m - (residual * score).sum(axis=1)) * ln_s_slope
            turn = self.noise.turn(residual)
            cross = -np.einsum("zm,zmc->zc", turn, A) * ln_s_slope[:, None]
            curvature[:, d, :] += cross
            curvature[:, :, d] += cross
            curvature[:, d, d] += (residual * turn).sum(axis=1) * ln_s_slope**2
        return replace(plain, tangents=found.tangents, gradient=gradient, curvature=curvature)


class Wider(NamedTuple):
    """A posterior with further unknowns that are standard normal beforehand: strengths, standard deviations.

    Attributes
    ----------
    posterior
        The posterior.
    first
        Coordinates (c,) where the search for its mode begins.
    own, new
        Places of the parameters (d,) that it had, and of the others (k,).
    """

    posterior: Posterior
    first: FloatArray
    own: list[int]
    new: list[int]


def widened(
    posterior: Posterior,
    mode: FloatArray,
    names: Sequence[str],
    values: FloatArray,
    evaluate: Callable[[Sequence[str]], Evaluate],
    means: FloatArray | None = None,
) -> Wider:
    """Return a posterior with unknowns of further names, near its mode (c,) and most probable values (k,) of these.

    These have the standard deviation 1 beforehand, and means that are zero by default.

    Names of parameters → the model of these. What the model misses depends on the others by its predictions alone.
    Raises `SolveError` if the model has no answer there.
    """
    before, d = posterior.inputs, len(posterior.inputs.names)
    means = np.zeros(len(names)) if means is None else means
    inputs = before.beside(names, means)
    own, new = ([inputs.names.index(name) for name in some] for some in (before.names, names))

    def wider(rows: FloatArray) -> FloatArray:
        found = np.zeros((len(rows), len(inputs.names)))
        found[:, own] = rows
        return found

    x = wider(mode[None, :d])
    x[0, new] = values - means
    noise, model = posterior.noise, evaluate(inputs.names)
    if noise.model is not None and (trend := noise.model.trend) is not None:
        more = {"slopes": wider(trend.slopes), "tangents": wider(trend.tangents), "spread": inputs.std}
        trend = replace(trend, point=wider(trend.point[None])[0], **more)
        noise = replace(noise, model=replace(noise.model, trend=trend))
    start = linearise(inputs, model, inputs.from_normals(x)[0][0]).prediction
    found = replace(posterior, inputs=inputs, evaluate=model, noise=noise, start=start)
    return Wider(found, np.append(x[0], mode[d:]), own, new)


def missed(wider: Wider, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return what first order misses of the d parameters: of their means, in deviations, and of ln deviation.

    Three points of each further unknown tell (Gauss and Hermite), along the Cholesky factor of their covariance, with
    the parameters on their regression on them. Given the further unknowns there, the posterior of the parameters is
    nearly a Gaussian, one Newton step away; their moments are those of the mixture, each weighted by what its Gaussian
    holds of the density.

    `covariance` (c, c) is that of the posterior to first order. NaN where the model has no answer.
    """
    posterior, new = wider.posterior, wider.new
    rest = np.setdiff1d(np.arange(len(wider.first)), new)
    own = np.searchsorted(rest, wider.own)
    here = posterior.at(wider.first[None], derivatives=True)
    joint = np.linalg.inv(here.curvature[0])
    lines = np.sqrt(3) * np.linalg.solve(np.linalg.cholesky(joint[np.ix_(new, new)]), joint[new])

    def given(at: Density) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Means and variances of the rest, given the further unknowns, and what the Gaussian holds of the density."""
        gradient, inverse = at.gradient[:, rest], np.linalg.inv(at.curvature[:, rest[:, None], rest])
        step = -np.einsum("zce,ze->zc", inverse, gradient)
        held = at.log_posterior - ((gradient * step).sum(axis=1) - np.linalg.slogdet(inverse)[1]) / 2
        return at.x[:, rest] + step, np.diagonal(inverse, axis1=1, axis2=2), held

    mean, variance, middle = given(here)
    far, wide, held = given(posterior.at(np.vstack([wider.first + lines, wider.first - lines]), derivatives=True))
    weights = np.exp(held - middle + 1.5).reshape(2, -1, 1) / 6  # e^(3/2): beside the density of the normal there
    weights /= 2 / 3 + weights.sum(axis=0)
    apart, wider_by = ((x - y).reshape(2, len(new), -1) for x, y in ((far, mean), (wide, variance)))
    moves = (weights * apart).sum(axis=0)
    widths = variance[0] + ((weights * (wider_by + apart**2)).sum(axis=0) - moves**2).sum(axis=0)
    moved = moves.sum(axis=0) - (joint @ here.gradient[0])[rest]
    before = np.diag(covariance)[: len(own)]
    return (moved / np.sqrt(np.diag(joint)[rest]))[own], np.log(widths[own] / before) / 2
