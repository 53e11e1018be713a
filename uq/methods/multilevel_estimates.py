"""Estimates of multilevel Monte Carlo from the samples on all meshes: moments, rates, errors of the finest mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from forward.model import FloatArray
from uq.estimators.moments import Estimates, combine, ratio
from uq.estimators.tails import of_influences, unseen
from uq.inputs.random_parameters import Inputs
from uq.methods.multilevel_meshes import Mesh

ASSUMED_RATE = 1.0  # of convergence per mesh, if there is only one difference
RATES = (0.5, 2.0)  # assumed bounds of rates: faster ones do not last where stresses are singular


@dataclass(frozen=True)
class Found:
    """Estimates from the samples so far.

    Attributes
    ----------
    by_mesh
        The telescoped moments up to each mesh.
    differences
        E[Y_l] (L, m), l = 1 … L.
    signs, std_signs
        Whether the last meshes raise (1) or lower (−1) mean and standard deviation (m,): as finer ones will.
    bias_error, std_bias_error
        Estimated errors (m,) of mean and standard deviation on the finest mesh.
    consistency
        Of l = 1 … L (L, m).
    """

    by_mesh: tuple[Estimates, ...]
    differences: FloatArray
    signs: FloatArray
    std_signs: FloatArray
    bias_error: FloatArray
    std_bias_error: FloatArray
    consistency: FloatArray

    @classmethod
    def of(cls, inputs: Inputs, meshes: Sequence[Mesh]) -> Found:
        """Estimate from the samples on all meshes."""
        terms = [mesh.term for mesh in meshes]
        *coarser, finest = (combine(mesh.centre.middle, terms[: k + 1]) for k, mesh in enumerate(meshes))
        moved = influences(meshes)
        tails = [of_influences(finest, inputs, one) for one in moved]
        first = np.maximum(tails[0], unseen(inputs, meshes[0].values) * finest.std)
        error = np.linalg.norm([finest.std_error, first, *tails[1:]], axis=0)
        by_mesh = (*coarser, replace(finest, std_error=error))
        differences = np.array([mesh.offset + t.first for mesh, t in zip(meshes, terms, strict=True)])[1:]
        std_differences = np.diff([e.std for e in by_mesh], axis=0)
        consistency = np.array([_consistency(*pair) for pair in pairwise(meshes)])
        # The differences at the mean parameters converge at the same rate, without sampling error.
        nominal = np.array([mesh.nominal for mesh in meshes])[1:]
        alpha = np.clip(np.minimum(rate(differences), rate(nominal)), *RATES)
        return cls(
            by_mesh,
            differences,
            np.sign(differences[-1]),
            np.sign(std_differences[-1]),
            bias(differences, alpha),
            bias(std_differences, alpha),
            consistency,
        )

    @property
    def estimates(self) -> Estimates:
        """Moments on the finest mesh."""
        return self.by_mesh[-1]

    @property
    def total_error(self) -> FloatArray:
        """Error (m,) of the mean, of sampling and mesh."""
        return np.hypot(self.bias_error, self.estimates.mean_error)

    def relative(self, error: FloatArray) -> FloatArray:
        """An error (…, m) over the mean, or over the standard deviation if that is larger."""
        scale = np.maximum(np.abs(self.estimates.mean), self.estimates.std)
        return ratio(error, np.broadcast_to(scale, error.shape))


def influences(meshes: Sequence[Mesh]) -> list[FloatArray]:
    """By how much each sample (n, m) of every mesh moves the variance on the finest one."""
    mean = np.sum([mesh.term.first for mesh in meshes], axis=0)
    return [mesh.influences(mean) for mesh in meshes]


def _consistency(coarser: Mesh, mesh: Mesh) -> FloatArray:
    """Compare the mean of ψ_{l−1} as the coarser and as the finer of two meshes: |a − b + c| / 3(σ_a + σ_b + σ_c).

    a and b are the estimates of E[ψ_{l−1}] and E[ψ_l], each from the samples of its own level, and c that of E[Y_l],
    with standard errors σ: beyond 1 the sum does not telescope (M. B. Giles, Acta Numerica 24 (2015), section 3.3).
    """
    a, b, c = coarser.single, mesh.single, mesh.term
    c_mean, c_error = mesh.offset + c.first, np.sqrt(c.variance / c.n)
    gap = np.abs(a.mean - b.mean + c_mean)
    # Rounding is no inconsistency, where the control leaves nothing else.
    gap = np.where(gap < 1e-12 * np.abs(b.mean), 0.0, gap)
    return ratio(gap, 3 * (a.mean_error + b.mean_error + c_error))


def rate(values: FloatArray) -> FloatArray:
    """Slope (m,) of −log₂|value| over the rows (L, m), by least squares; what is assumed where there is one row."""
    if len(values) < 2:
        return np.full(values.shape[1], ASSUMED_RATE)
    steps = np.arange(len(values)) - (len(values) - 1) / 2
    logs = np.log2(np.maximum(np.abs(values), np.finfo(float).tiny))
    return np.asarray(-(steps @ logs) / (steps @ steps))


def bias(differences: FloatArray, alpha: FloatArray) -> FloatArray:
    """Estimate the error (m,) on the finest mesh from the differences (L, m) between meshes: |E[Y_L]| / (2^α − 1).

    |E[Y_L]| counts as at least what the two differences before it predict with the rate α (m,), which guards against
    one that is small by chance (M. B. Giles, Acta Numerica 24 (2015), section 3.2).
    """
    last = np.abs(differences[-3:])
    expected = last * 2.0 ** (-alpha * np.arange(len(last))[::-1, None])
    return np.asarray(expected.max(axis=0) / (2.0**alpha - 1))
