"""Errors of measurement: their scales, heavy tails, what many data share, and what a model is known to miss.

A model predicts ψ(ω) of data y, and what it misses is known to some extent:

    y = ψ(ω) + δ(ω) + Uz + e,   δ(ω) = δ̂ + T (ω̃ − ω̂),   z ~ N(0, I),   e independent of scales √(s²σ² + τ²),

where s is 1 or unknown, U holds what data share (motions of a scan, patterns of an error of a mesh) and τ what else is
uncertain of δ: approximation errors as in J. Kaipio, E. Somersalo, J. Comput. Appl. Math. 198 (2007) 493–504, and S. R.
Arridge et al., Inverse Problems 22 (2006) 175–195, linearised at the mode in place of the mean of the prior (`Trend`).
With τ in σ, the errors have the covariance σ(I + ŨŨᵀ)σ, Ũ = U/σ = VSQᵀ, and residuals over σ become independent again
by W = (I + ŨŨᵀ)^(−1/2) = I − V (1 − (1 + S²)^(−1/2)) Vᵀ, symmetric and of low rank: whatever knows independent errors
only goes on with W r and W A.

With independent residuals r over the scale, −ln p = Σ ρ(r) + Σ ln scale. The score is ψ = ρ′; Gauss–Newton's matrix of
Student's errors is AᵀWA with the weights w(r) (ν+1)/(ν+3), w = ψ/r: of a datum that fits they have the mean of ψ′,
Fisher's information, and of one that does not belong they vanish (K. L. Lange, R. J. A. Little, J. M. G. Taylor, J. Am.
Stat. Assoc. 84 (1989) 881–896).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from forward.model import FloatArray
from forward.settings import Settings
from uq.inputs.distributions import Distribution

HALF_LOG = float(np.log(2 * np.pi) / 2)
FEWEST = 4  # errors of a model that tell the variance of the next one
ROUNDED = 1e-10  # singular values over the largest that are rounding


class NormalErrors(Settings):
    """Normal errors, of which the scale is the standard deviation.

    Parameters
    ----------
    process
        Whether displacements have errors too that vary smoothly along the body: what the model does not explain, of
        which size and length are inferred (`inverse.low_dimensional.residual_process`).
    """

    kind: Literal["normal"] = "normal"
    dof: ClassVar[float | None] = None  # degrees of freedom: infinitely many
    process: bool = False


class StudentErrors(Settings):
    """Student's t errors: a few that are far larger than the others do not decide.

    Parameters
    ----------
    degrees
        Degrees of freedom ν: the smaller, the heavier the tails. Standard deviations of the data are taken as scales;
        those of the errors are √(ν/(ν−2)) times as large.
    """

    kind: Literal["student-t"] = "student-t"
    process: ClassVar[bool] = False
    degrees: Annotated[float, Field(ge=1, le=1000)] = 4.0

    @property
    def dof(self) -> float | None:
        """Degrees of freedom."""
        return self.degrees


Errors = Annotated[NormalErrors | StudentErrors, Field(discriminator="kind")]
NORMAL = NormalErrors()


@dataclass(frozen=True, eq=False)
class Trend:
    """How what a model misses changes with d parameters, to first order at ω̂.

    Parameters ω̃ that it follows are read back from predictions ψ (m,) with weights w, as far as these tell them beside
    their deviations D: an error in proportion to predictions is limited where these are.

        ω̃ = ω̂ + P (ψ − ψ̂) + (I − PJ)(ω − ω̂),   P = (JᵀwJ + D⁻²)⁻¹ Jᵀw.

    Without weights these are the parameters themselves.

    Attributes
    ----------
    point
        ω̂ (d,).
    outputs
        ψ̂ (m,), predictions there.
    tangents
        J (m, d), their derivatives.
    slopes
        T (m, d), derivatives of what is missed.
    weights
        w (m,).
    spread
        D (d,).
    """

    point: FloatArray
    outputs: FloatArray
    tangents: FloatArray
    slopes: FloatArray
    weights: FloatArray
    spread: FloatArray

    @cached_property
    def _back(self) -> tuple[FloatArray, FloatArray]:
        """P (d, m) and I − PJ (d, d)."""
        along = self.tangents * self.spread
        known = self.spread[:, None] * np.linalg.inv(np.eye(len(self.spread)) + (along.T * self.weights) @ along)
        return known @ along.T * self.weights, known / self.spread

    def of(self, rows: NDArray[np.intp]) -> Trend:
        """Return that of some of the data, by number."""
        some = {name: getattr(self, name)[rows] for name in ("outputs", "tangents", "slopes", "weights")}
        return replace(self, **some)

    def at(self, points: FloatArray, outputs: FloatArray) -> FloatArray:
        """Return δ − δ̂ (n, m) at parameters (n, d), where the model predicts outputs (n, m)."""
        by_outputs, by_points = self._back
        back = (outputs - self.outputs) @ by_outputs.T + (points - self.point) @ by_points.T
        return np.asarray(back @ self.slopes.T)

    def tangent(self, tangents: FloatArray) -> FloatArray:
        """Return its derivatives (…, m, d) by the parameters, of predictions with derivatives (…, m, d)."""
        by_outputs, by_points = self._back
        return np.asarray(self.slopes @ (by_outputs @ tangents + by_points))

    def adjoint(self, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return derivatives of it in sum with weights (m,): by the predictions (m,) and by the parameters (d,)."""
        by_outputs, by_points = self._back
        back = weights @ self.slopes
        return back @ by_outputs, back @ by_points


@dataclass(frozen=True, eq=False)
class ModelError:
    """What a model misses of m data, in their units.

    Attributes
    ----------
    error
        δ̂ (m,).
    root
        Uᵀ (k, m).
    apart
        τ (m,).
    trend
        How it changes with the parameters; None if it is taken to be the same everywhere.
    scale
        Factor on σ at which it counts, where that is unknown.
    """

    error: FloatArray
    root: FloatArray
    apart: FloatArray
    trend: Trend | None = None
    scale: float = 1.0

    @property
    def std(self) -> FloatArray:
        """Standard deviations (m,) of what is uncertain of it."""
        return np.asarray(np.sqrt((self.root**2).sum(axis=0) + self.apart**2))

    @classmethod
    def of_pairs(cls, errors: FloatArray, sigma: FloatArray, scale: float = 1.0) -> ModelError:
        """Return what N errors (N, m) of a model tell of the next one, of data with errors σ (m,).

        With their mean and covariance S, in p dimensions that is Student's distribution with N − p degrees of freedom
        and the covariance S (1 + 1/N) (N − 1)/(N − p − 2) (A. Gelman et al., Bayesian Data Analysis (2013), section
        3.6); here it is the normal one, and p counts the directions in which S is seen beside σ², Σ λ/(1 + λ) of the
        eigenvalues λ of S over σ². What errors that are left out one by one have beyond the span of the others is
        independent from datum to datum. Raises `ValueError` with fewer than four errors.
        """
        N = len(errors)
        if N < FEWEST:
            raise ValueError(f"{N} errors of a model, expected at least {FEWEST}")
        mean = errors.mean(axis=0)
        root = (errors - mean) / np.sqrt(N - 1)
        seen = np.linalg.svd(root / sigma, compute_uv=False) ** 2
        p = min(max((seen / (1 + seen)).sum(), 1.0), N - 3.0)
        root = root * np.sqrt((1 + 1 / N) * (N - 1) / (N - p - 2))
        beyond = np.zeros_like(errors)
        for k, others in enumerate(np.delete(errors / sigma, j, axis=0) for j in range(N)):
            centre = others.mean(axis=0)
            basis, sizes = np.linalg.svd((others - centre).T, full_matrices=False)[:2]
            basis, left = basis[:, sizes > ROUNDED * sizes.max(initial=0.0)], errors[k] / sigma - centre
            beyond[k] = left - basis @ (basis.T @ left)
        apart = sigma * np.sqrt((beyond**2).mean(axis=0))
        return cls(mean, root, apart, scale=scale)

    def of(self, rows: NDArray[np.intp]) -> ModelError:
        """Return that of some of the data, by number."""
        trend = None if self.trend is None else self.trend.of(rows)
        return replace(self, error=self.error[rows], root=self.root[:, rows], apart=self.apart[rows], trend=trend)

    def at(self, points: FloatArray, outputs: FloatArray) -> FloatArray:
        """Return δ (n, m) at parameters (n, d), where the model predicts outputs (n, m)."""
        if self.trend is None:
            return np.broadcast_to(self.error, (len(points), len(self.error)))
        return self.error + self.trend.at(points, outputs)


@dataclass(frozen=True, eq=False)
class Noise:
    """Errors of m data.

    Attributes
    ----------
    sigma
        Stated standard deviations σ (m,) of independent errors; of heavy tails the scales.
    dof
        Degrees of freedom ν of Student's errors, over their scales; None for normal ones.
    factor
        Prior of s; None for s = 1.
    shared
        (k, m): what data share, a row for a standard deviation of each; None if there is nothing.
    model
        What the model misses; None where that is not known, or nothing.
    uncertain, process
        (k, m): what predictions share because of what is taken for granted, and what no model explains, as `shared`.
    """

    sigma: FloatArray
    dof: float | None = None
    factor: Distribution | None = None
    shared: FloatArray | None = None
    model: ModelError | None = None
    uncertain: FloatArray | None = None
    process: FloatArray | None = None

    def __post_init__(self) -> None:
        if not (self.sigma > 0).all():
            raise ValueError(f"standard deviation of the errors {self.sigma.min():g}, expected positive ones")

    def of(self, rows: NDArray[np.intp]) -> Noise:
        """Return that of some of the data, by number."""
        found = {name: of[:, rows] for name, of in self._shared.items()}
        model = None if self.model is None else self.model.of(rows)
        return replace(self, sigma=self.sigma[rows], model=model, **found)

    def seen(self, measured: FloatArray) -> Noise:
        """Return the same where those data that were not measured, zeros among ones (m,), share nothing."""
        model, found = self.model, {name: of * measured for name, of in self._shared.items()}
        if model is not None:
            model = replace(model, root=model.root * measured, apart=model.apart * measured)
        return replace(self, model=model, **found)

    @property
    def _shared(self) -> dict[str, Any]:
        """Rows (k, m) of what data share, but for what the model misses, by their names here."""
        known = {"shared": self.shared, "uncertain": self.uncertain, "process": self.process}
        return {name: of for name, of in known.items() if of is not None}

    @cached_property
    def scale(self) -> FloatArray:
        """Standard deviations (m,) that residuals are divided by, for s = 1.

        Errors with heavy tails are no multivariate ones: of what data share, their scales only become larger.
        """
        more = np.zeros(len(self.sigma))
        if self.model is not None:
            more = more + (self.model.apart / self.model.scale) ** 2
        if self.dof is not None:
            more = more + (self._rows**2).sum(axis=0)
        return np.sqrt(self.sigma**2 + more) if self.model is not None or more.any() else self.sigma

    @cached_property
    def _rows(self) -> FloatArray:
        """Uᵀ (k, m), of all that is shared."""
        roots = [np.zeros((0, len(self.sigma))), *self._shared.values()]
        return np.concatenate(roots if self.model is None else [*roots, self.model.root / self.model.scale])

    @cached_property
    def _basis(self) -> tuple[FloatArray, FloatArray]:
        """S (k,) and Vᵀ (k, m)."""
        if not len(self._rows) or self.dof is not None:
            return np.zeros(0), np.zeros((0, len(self.sigma)))
        _, sizes, basis = np.linalg.svd(self._rows / self.scale, full_matrices=False)
        return sizes, basis

    @cached_property
    def _less(self) -> FloatArray:
        """1 − (1 + S²)^(−1/2) (k,)."""
        return np.asarray(1 - 1 / np.sqrt(1 + self._basis[0] ** 2))

    @property
    def log_determinant(self) -> float:
        """½ ln det(I + ŨŨᵀ), which −ln of the likelihood has more."""
        return float(np.log1p(self._basis[0] ** 2).sum() / 2)

    def whitened(self, rows: FloatArray) -> FloatArray:
        """Return W r (…, m) of rows over the scale (…, m); W is symmetric."""
        if not len(self._less):
            return rows
        return np.asarray(rows - ((rows @ self._basis[1].T) * self._less) @ self._basis[1])

    def coloured(self, rows: FloatArray) -> FloatArray:
        """Return W⁻¹r (…, m)."""
        return np.asarray(rows + ((rows @ self._basis[1].T) * (self._less / (1 - self._less))) @ self._basis[1])

    @cached_property
    def pull(self) -> FloatArray:
        """H (g, m): given independent residuals r (m,), what is uncertain is N(−Hr, I − HHᵀ), in its deviations.

        Of heavy tails, which hide it in the scales, H is zero: nothing is learnt.
        """
        return self.pulled(self.uncertain)

    def pulled(self, rows: FloatArray | None) -> FloatArray:
        """Return such an H (k, m) of other rows (k, m) that data share; of None it has none."""
        over = np.zeros((0, len(self.sigma))) if rows is None else rows / self.scale
        return self.whitened(over) if self.dof is None else np.zeros_like(over)

    # --- independent residuals, over the scale ------------------------------------------------------------------------

    def minus_log(self, r: FloatArray) -> FloatArray:
        """Return ρ, −ln of the density, of residuals of any shape."""
        nu = self.dof
        if nu is None:
            return np.asarray(r**2 / 2 + HALF_LOG)
        from scipy.special import gammaln

        constant = gammaln(nu / 2) - gammaln((nu + 1) / 2) + np.log(nu * np.pi) / 2
        return np.asarray((nu + 1) / 2 * np.log1p(r**2 / nu) + constant)

    def misfit(self, r: FloatArray, log_scale: FloatArray) -> FloatArray:
        """Return −ln of the likelihood (n,) of residuals (n, m) with sums (n,) of the logarithms of their scales."""
        if self.dof is None:
            return np.asarray((r**2).sum(axis=1) / 2 + log_scale + r.shape[1] * HALF_LOG)
        return np.asarray(self.minus_log(r).sum(axis=1) + log_scale)

    def score(self, r: FloatArray) -> FloatArray:
        """Return ψ = ρ′."""
        return r if self.dof is None else np.asarray((self.dof + 1) * r / (self.dof + r**2))

    def score_slope(self, r: FloatArray) -> FloatArray:
        """Return ψ′ = ρ″, which is negative of data that do not belong."""
        nu = self.dof
        return np.ones_like(r) if nu is None else np.asarray((nu + 1) * (nu - r**2) / (nu + r**2) ** 2)

    def information(self, r: FloatArray) -> FloatArray:
        """Return what stands for ψ′ in Gauss–Newton's matrix; never negative."""
        nu = self.dof
        return np.ones_like(r) if nu is None else np.asarray((nu + 1) ** 2 / ((nu + 3) * (nu + r**2)))

    def turn(self, r: FloatArray) -> FloatArray:
        """Return (rψ)′, for derivatives by the logarithm of the scale."""
        nu = self.dof
        return 2 * r if nu is None else np.asarray(2 * nu * (nu + 1) * r / (nu + r**2) ** 2)

    def normal_scores(self, r: FloatArray) -> FloatArray:
        """Return standard normal values of the same probabilities."""
        if self.dof is None:
            return r
        from scipy.special import ndtri, stdtr

        return np.asarray(-np.sign(r) * ndtri(np.maximum(stdtr(self.dof, -np.abs(r)), 1e-300)))
