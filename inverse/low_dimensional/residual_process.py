"""What a model does not explain of displacements, as a process along the body whose size and length are inferred.

y = ψ(ω) + δ(X) + e: each component of δ, in each load case by itself, is a Gaussian process of size s and Matérn
correlation (1 + √3 r/ℓ) e^(−√3 r/ℓ) at a distance r (M. C. Kennedy, A. O'Hagan, J. R. Stat. Soc. B 63 (2001) 425–464).
With the model linear around the mode, and all other errors whitened, data have the covariance S + s²P_ℓ, S = I + AAᵀ,
whose evidence is known for all sizes from one decomposition of S^(−½) P_ℓ S^(−½). The process that is counted has the
covariance that is the mean over sizes and lengths, K = UUᵀ at the data: how little is known of these is in it.

At other places it is Vᵀz + ε with the z ~ N(0, I) of δ = Uz at the data, UV = K there and here, and ε what is left.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import logsumexp

from forward.model import FloatArray, SolveError
from inverse.data.measurements import Measurements
from inverse.data.noise import Noise
from inverse.low_dimensional.laplace import Laplace, deviations, laplace, unexplained
from inverse.low_dimensional.posterior import Density, Posterior

SIZES = np.geomspace(0.03, 100.0, 36)  # over the median error of the data, equally likely beforehand
LENGTHS = np.geomspace(0.05, 1.0, 8)  # over the extent of the points, equally likely too
LEFT_OUT = 1e-3  # variance that is left out, over that of the median error
MOST = 4000  # data, of which matrices are decomposed
SETTLED, ROUNDS = 0.1, 5  # deviations by which the mode moves in the end, and searches


@dataclass(frozen=True, eq=False)
class Process:
    """A residual process of m data.

    Attributes
    ----------
    rows
        Uᵀ (k, m) with UUᵀ its covariance, in the units of the data.
    size, length
        Means over the logarithms (m).
    log_evidence
        What ln Z over all sizes and lengths has more than that of the process that is counted.
    elsewhere, left
        V (k, n) at n places where nothing was measured, and the covariance (n, n) of what is left there.
    """

    rows: FloatArray
    size: float
    length: float
    log_evidence: float
    elsewhere: FloatArray
    left: FloatArray

    def given(self, noise: Noise, residuals: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return what the process is elsewhere, given independent residuals (N, m) of data with this noise.

        Means (N, n), their covariance (n, n), and that (n, g) with what is uncertain beside, in its deviations.
        """
        known = noise.pulled(noise.process) @ noise.pull.T
        pull = self.elsewhere.T @ noise.pulled(noise.process)
        covariance = self.elsewhere.T @ self.elsewhere - pull @ pull.T + self.left
        return -residuals @ pull.T, covariance, -self.elsewhere.T @ known


def with_process(
    posterior: Posterior, gaussian: Laplace, data: Measurements, elsewhere: Measurements | None = None
) -> tuple[Posterior, Laplace, Process]:
    """Return a posterior whose data have such a process among their errors, and its Gaussian.

    Found at the mode, and again at the mode with it, until that stays. What is elsewhere has the parts of the data.
    Raises `SolveError` if the model has no answer at a mode, or there are too many data.
    """
    if len(data) > MOST:
        message = f"data.errors.process: {len(data):,} data, expected at most {MOST:,}; take fewer points"
        raise SolveError(message)
    bare = posterior
    for _ in range(ROUNDS):
        at = bare.at(gaussian.mode[None], derivatives=True)
        found = process(bare, at, data, elsewhere)
        posterior = replace(bare, noise=replace(bare.noise, process=found.rows))
        before, gaussian = gaussian, laplace(posterior, starts=1, first=gaussian.mode)
        moved = posterior.physical(np.array([before.mode, gaussian.mode]))[:, : len(bare.inputs.names)]
        if np.abs(np.diff(moved, axis=0)[0] / deviations(posterior, gaussian)).max() <= SETTLED:
            break
    return posterior, gaussian, found


def process(posterior: Posterior, at: Density, data: Measurements, elsewhere: Measurements | None = None) -> Process:
    """Infer the process of what a posterior without one leaves, given it at its mode, with derivatives."""
    noise, scale, d = posterior.noise, posterior.scale(at.x)[0], len(posterior.inputs.names)
    A, unit = posterior.sensitivities(at)[0], float(np.median(scale))
    start = unexplained(A, posterior.residuals(at.outputs, at.x) - A @ at.x[0, :d])[0]
    lengths = LENGTHS * (np.ptp(data.places[data.placed], axis=0).max() or 1.0)  # at one place, all are the same
    kernels = [correlation(data, data, length) for length in lengths]

    def log_evidence(kernel: FloatArray, squares: FloatArray) -> FloatArray:
        """Return ln of the evidence (n,) of a process with the covariance s² times a kernel, for squares s² (n,)."""
        rows = unexplained(A, noise.whitened(noise.whitened(kernel / scale / scale[:, None]).T))
        values, vectors = np.linalg.eigh(unexplained(A, rows.T))
        over = 1 + squares[:, None] * np.maximum(values, 0)
        return np.asarray(-((start @ vectors) ** 2 / over + np.log(over)).sum(axis=1) / 2)

    squares = (unit * SIZES) ** 2
    logs = np.array([log_evidence(kernel, squares) for kernel in kernels])
    weights = np.exp(logs - logsumexp(logs))

    def averaged(one: Measurements, other: Measurements) -> FloatArray:
        parts = zip(weights @ squares, lengths, strict=True)
        return sum((square * correlation(one, other, length) for square, length in parts), np.zeros(()))

    mean = averaged(data, data)
    more = float(logsumexp(logs) - np.log(logs.size) - log_evidence(mean, np.ones(1))[0])
    values, vectors = np.linalg.eigh(mean)
    kept = values > LEFT_OUT * unit**2
    factor = scale[0] / noise.scale[0]  # where the size of the errors is unknown, that of the process is not
    size, length = np.exp(weights.sum(axis=0) @ np.log(unit * SIZES)), np.exp(weights.sum(axis=1) @ np.log(lengths))
    rows = np.sqrt(values[kept])[:, None] * vectors.T[kept]
    there, left = np.zeros((len(rows), 0)), np.zeros((0, 0))
    if elsewhere is not None:
        there = rows @ averaged(data, elsewhere) / values[kept, None]
        left = averaged(elsewhere, elsewhere) - there.T @ there
    return Process(rows / factor, float(size), float(length), more, there, left)


def correlation(one: Measurements, other: Measurements, length: float) -> FloatArray:
    """Return the correlation (m, n) of displacements over a length (m); zero of what is no displacement."""
    X, Y = (np.where(data.placed[:, None], data.places, 0.0) for data in (one, other))
    along, beside = (np.where(data.placed[:, None], data.along, 0.0) for data in (one, other))
    apart = np.sqrt(3) * cdist(X, Y) / length
    return np.asarray((along @ beside.T) * (one.cases[:, None] == other.cases) * (1 + apart) * np.exp(-apart))
