"""The effect of a finer mesh on data, unknowns and evidence, from one solve on it at the mode.

With δ, what that solve adds to the outputs ψ at the mode x̂, the model is y = ψ + δ + A(x − x̂) + e. Where the posterior
is a Gaussian of covariance H⁻¹, its mode moves by −H⁻¹Aᵀδ (data over the errors). With e₀ = y − ψ + A x̂ and errors of
scale s, the evidence of the linear model is in closed form,

    −2 ln Z(s) = (e₀ − δ)ᵀ (s²I + AAᵀ)⁻¹ (e₀ − δ) + ln det(s²I + AAᵀ),

and so is the change due to δ; an unknown size of the errors is integrated out (C. E. Rasmussen, C. K. I. Williams,
Gaussian Processes for Machine Learning (2006), section 2.1). At s = 1 the change is −r·δ − ½ δᵀ(I − AH⁻¹Aᵀ)δ.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from forward.model import FloatArray, ModelError, SolveError

if TYPE_CHECKING:
    from inverse.low_dimensional.laplace import Laplace
    from inverse.low_dimensional.posterior import Posterior
    from uq.inputs.distributions import Distribution

SIZES = np.linspace(-12.0, 12.0, 24_001)  # coordinates of the size of the errors: enough even for millions of data


@dataclass(frozen=True)
class Finer:
    """Outputs (m,) on a finer mesh at parameters (d,) of the model, or why they are unknown."""

    outputs: Callable[[FloatArray], FloatArray] | None
    why: str = ""

    def gap(self, point: FloatArray, outputs: FloatArray) -> tuple[FloatArray | None, str]:
        """Return what the finer mesh adds to outputs (m,), or why that is unknown."""
        if self.outputs is None:
            return None, self.why
        try:
            return self.outputs(point) - outputs, ""
        except (SolveError, ModelError, ValueError) as error:
            return None, f"the solve on a finer mesh failed: {error}"


NOT_LOOKED = Finer(None, "no finer mesh was given")


@dataclass(frozen=True)
class Moved:
    """The effect of a finer mesh on an evidence and its posterior.

    Attributes
    ----------
    why
        Why it is unknown; empty if it is known.
    error
        What it adds to the data (m,), over their errors.
    parameters
        What that adds to the most probable parameters (d,).
    log_evidence
        And to ln Z.
    """

    why: str
    error: FloatArray
    parameters: FloatArray
    log_evidence: float


def moved(posterior: Posterior, gaussian: Laplace, finer: Finer) -> Moved:
    """Find the effect of a finer mesh at the mode of few parameters with normal errors: one solve on each mesh."""
    d, m = len(posterior.inputs.names), posterior.data.size
    at = posterior.at(gaussian.mode[None], derivatives=True)
    assert at.tangents is not None
    best = posterior.physical(gaussian.mode[None])[0]
    gap, why = finer.gap(best[:d], at.everything[0])
    if gap is None:
        return Moved(why, np.full(m, np.nan), np.full(d, np.nan), np.nan)
    which = slice(None) if posterior.which is None else list(posterior.which)
    A = at.tangents[0][which] @ posterior.inputs.from_normals(at.x[:, :d])[1][0] / posterior.sigma[:, None]
    residual, error = ((values / posterior.sigma) for values in (posterior.data - at.outputs[0], gap[which]))
    factor = best[-1] if posterior.noise is not None else 1.0
    added = evidence_moved(A, residual + A @ gaussian.mode[:d], error, posterior.noise)
    return Moved("", error / factor, parameters_moved(posterior, gaussian, A / factor, error / factor), added)


def parameters_moved(posterior: Posterior, gaussian: Laplace, A: FloatArray, error: FloatArray) -> FloatArray:
    """Return how far the most probable parameters (d,) move if predictions are larger by `error` (m,).

    Parameters
    ----------
    A
        Derivatives (m, d) of the data by the normal coordinates; as `error`, over the errors of the data.
    """
    d = len(posterior.inputs.names)
    slopes = posterior.inputs.from_normals(gaussian.mode[None, :d])[1][0]
    return np.asarray(-slopes @ np.linalg.solve(gaussian.hessian[:d, :d], A.T @ error))


def evidence_moved(A: FloatArray, data: FloatArray, error: FloatArray, noise: Distribution | None) -> float:
    """Return what predictions that are larger by `error` (m,) add to ln Z of the linear model A x of data (m,).

    Parameters
    ----------
    A, data, error
        Over the stated standard deviations of the errors.
    noise
        Prior of the factor on these, if it is unknown.
    """
    s, log_prior = np.ones(1), np.zeros(1)
    if noise is not None:
        s, log_prior = noise.from_normal(SIZES)[0], -(SIZES**2) / 2
    values, vectors = np.linalg.eigh(A.T @ A)
    spread = np.log1p(np.maximum(values, 0) / s[:, None] ** 2).sum(axis=1) / 2 + len(data) * np.log(s)

    def log_evidence(e: FloatArray) -> float:
        seen = ((vectors.T @ (A.T @ e)) ** 2 / (s[:, None] ** 2 + values)).sum(axis=1)
        logs = log_prior - (e @ e - seen) / (2 * s**2) - spread
        return float(logs.max() + np.log(np.exp(logs - logs.max()).sum()))

    return log_evidence(data - error) - log_evidence(data)
