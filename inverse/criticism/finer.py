"""What finer meshes say of data, unknowns and evidence.

With δ, what they add to the outputs ψ at the mode x̂, the model is y = ψ + δ + A(x − x̂) + e. Where the posterior
is a Gaussian of covariance H⁻¹, its mode moves by −H⁻¹Aᵀδ (data over the errors). With e₀ = y − ψ + A x̂ and errors of
scale s, the evidence of the linear model is in closed form,

    −2 ln Z(s) = (e₀ − δ)ᵀ (s²I + AAᵀ)⁻¹ (e₀ − δ) + ln det(s²I + AAᵀ),

and so is the change due to δ; an unknown size of the errors is integrated out (C. E. Rasmussen, C. K. I. Williams,
Gaussian Processes for Machine Learning (2006), section 2.1). At s = 1 the change is −r·δ − ½ δᵀ(I − AH⁻¹Aᵀ)δ.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from forward.model import FloatArray, ModelError, SolveError
from inverse.low_dimensional.laplace import Laplace
from inverse.low_dimensional.posterior import Posterior
from uq.evaluation.request import Evaluate, Request
from uq.inputs.distributions import Distribution

SIZES = np.linspace(-12.0, 12.0, 24_001)  # coordinates of the size of the errors: data by the million make it no finer
Solved = tuple[FloatArray, FloatArray | None]  # outputs (2M,) of `forward.fem.finer`, and their derivatives (2M, d)


@dataclass(frozen=True)
class Look:
    """What finer meshes say at one point of M outputs.

    Attributes
    ----------
    outputs
        What they tend to (M,).
    between
        The difference (M,) between two of them.
    tangents
        Derivatives (M, d) of what they tend to; None where they were not asked for.
    """

    outputs: FloatArray
    between: FloatArray
    tangents: FloatArray | None


@dataclass(frozen=True)
class Finer:
    """A model on finer meshes, or why there is none.

    Attributes
    ----------
    solve
        At parameters (d,), with derivatives or without.
    why
        Why that is not possible.
    """

    solve: Callable[[FloatArray, bool], Solved] | None
    why: str = ""

    @classmethod
    def by(cls, evaluate: Evaluate) -> Finer:
        """Solve by an evaluation of the model on finer meshes."""

        def solve(point: FloatArray, tangents: bool) -> Solved:
            found = evaluate(Request(point[None], tangents=tangents))
            for failure in found.failures:
                raise SolveError(failure.reason)
            return np.asarray(found.outputs[0]), None if found.tangents is None else found.tangents[0]

        return cls(solve)

    def look(self, point: FloatArray, *, tangents: bool = False) -> tuple[Look | None, str]:
        """Solve at parameters (d,): what finer meshes say, or why that is not known."""
        if self.solve is None:
            return None, self.why
        try:
            outputs, slopes = self.solve(point, tangents)
        except (SolveError, ModelError, ValueError) as error:
            return None, f"the solve on a finer mesh failed: {error}"
        there, between = np.split(outputs, 2)
        return Look(there, between, None if slopes is None else np.split(slopes, 2)[0]), ""


NOT_LOOKED = Finer(None, "no finer mesh was given")


@dataclass(frozen=True, eq=False)
class MeshFound:
    """What finer meshes said of m data and k unknowns.

    Attributes
    ----------
    why
        Why nothing is known; empty where something is.
    error
        Error of the mesh at the mode (m,), over the noise.
    shift
        How far correcting it moves, or would move, the unknowns (k,), over their posterior deviations.
    left
        Standard deviation (k,) that what is uncertain of the correction makes, over those.
    corrected
        Whether the posterior is corrected.
    settled
        Whether the error at its mode is the one that it is corrected by.
    log_evidence
        What correcting it adds, or would add, to ln Z of the linear model, but for what is uncertain; NaN of fields.
    solves
        Number of solves on finer meshes.
    """

    why: str
    error: FloatArray
    shift: FloatArray
    left: FloatArray
    corrected: bool = False
    settled: bool = True
    log_evidence: float = np.nan
    solves: int = 0

    @classmethod
    def unknown(cls, why: str, data: int, unknowns: int, solves: int = 0) -> MeshFound:
        """Nothing is known."""
        nans = np.full(unknowns, np.nan)
        return cls(why, np.full(data, np.nan), nans, nans, solves=solves)


def parameters_moved(posterior: Posterior, gaussian: Laplace, A: FloatArray, error: FloatArray) -> FloatArray:
    """Return how far the most probable parameters (d,), or (d, k), move if predictions are larger by (m,), or (m, k).

    The derivatives A (m, d) by the normal coordinates are over the errors of the data, as the error is.
    """
    d = len(posterior.inputs.names)
    slopes = posterior.inputs.from_normals(gaussian.mode[None, :d])[1][0]
    return np.asarray(-slopes @ np.linalg.solve(gaussian.hessian[:d, :d], A.T @ error))


def evidence_moved(A: FloatArray, data: FloatArray, error: FloatArray, noise: Distribution | None) -> float:
    """Return what predictions that are larger by `error` (m,) add to ln Z of the linear model A x of data (m,).

    All are over the stated standard deviations, of which a factor with the prior `noise` may be unknown.
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
