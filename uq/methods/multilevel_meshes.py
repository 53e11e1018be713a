"""Meshes of multilevel Monte Carlo: samples on each and on the next coarser one, and their terms of the sums.

With ψ_l the quantity on mesh l, E[ψ_L] = Σ_l E[Y_l], Y_l = ψ_l − ψ_{l−1}, Y_0 = ψ_0: both meshes of a difference get
the same parameters, so that Var Y_l is small, and differences on fine meshes need few samples (M. B. Giles, Acta
Numerica 24 (2015) 259–328). Each mesh is linearised at the mean parameters. With the deviation w_l = ψ_l − ψ̄_l, its
tangent prediction T_l and V_l = E[T_l²], the terms of the mean and of the second moment of w_L are

    ⟨w_l − w_{l−1} − (T_l − T_{l−1})⟩
    ⟨w_l² − w_{l−1}² − (T_l² − V_l − T_{l−1}² + V_{l−1})⟩

where the controls, in brackets, have expectation zero. `moments.combine` adds them up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from forward.model import FloatArray, SolveError
from uq.estimators.moments import Estimates, Moments, Term, combine, controlled, estimate, monomials, ratio, term
from uq.estimators.tails import with_tails
from uq.evaluation.request import OWN, Evaluate, Evaluations, Request
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import random_points
from uq.methods.method import MESH, TEXTBOOK, seconds_per_solve
from uq.surrogates.linearisation import Linearisation, linearise

SIZE = 10_000  # unknowns assumed on the coarsest mesh for a model without a state
ASSUMED_RATE = 1.0  # of convergence per mesh, if there is only one difference
RATES = (0.5, 2.0)  # assumed bounds of rates: faster ones do not last where stresses are singular


def name_of(level: int) -> str:
    """Name of the model on a mesh."""
    return f"{MESH}{level}" if level else OWN


@dataclass(frozen=True)
class Pilot:
    """What every mesh begins with: so many samples of a seed; and whether tangents control the differences."""

    samples: int
    seed: int
    controlled: bool


class Mesh:
    """A mesh with its linearisation and the samples on it and on the next coarser one.

    Attributes
    ----------
    centre
        Linearisation at the mean parameters.
    points, fine, coarse, ok
        Parameters (n, d), outputs (n, m) on this mesh and on the coarser one (zero where there is none), and which
        samples have both.
    """

    def __init__(self, pilot: Pilot, inputs: Inputs, evaluate: Evaluate, coarser: Mesh | None) -> None:
        self._pilot, self._inputs, self._coarser = pilot, inputs, coarser
        self.level: int = 0 if coarser is None else coarser.level + 1
        self._evaluate = evaluate.on(name_of(self.level))
        self.centre: Linearisation = linearise(inputs, self._evaluate)
        self.unknowns = self._evaluate.displacements or SIZE * 8**self.level
        self._solves, self._seconds = 0, 0.0
        d, m = len(inputs.names), len(self.centre.outputs)
        self.points = np.empty((0, d))
        self.fine, self.coarse = np.empty((0, m)), np.empty((0, m))
        self.ok = np.empty(0, dtype=bool)
        self._reasons: set[str] = set()
        self.extend(pilot.samples)

    def extend(self, count: int) -> None:
        """Go on to `count` samples."""
        before = len(self.points)
        if count <= before:
            return
        cube = random_points((self._pilot.seed, self.level), before, count, len(self._inputs.names))
        points = self._inputs.points(cube)
        here = self._solve(points)
        fine, ok, coarse = here.outputs, here.ok, np.zeros_like(here.outputs)
        if self._coarser is not None:
            there = self._coarser._solve(points)
            coarse, ok = there.outputs, ok & there.ok
            self._reasons |= {failure.reason for failure in there.failures}
        self._reasons |= {failure.reason for failure in here.failures}
        self.points = np.concatenate([self.points, points])
        self.fine, self.coarse = np.concatenate([self.fine, fine]), np.concatenate([self.coarse, coarse])
        self.ok = np.concatenate([self.ok, ok])
        if self.ok.sum() < 2:
            reasons = "; ".join(sorted(self._reasons)[:3])
            message = f"level {self.level}: {self.ok.sum()} of {count} samples have an answer, expected 2: {reasons}"
            raise SolveError(message)

    def _solve(self, points: FloatArray) -> Evaluations:
        found = self._evaluate(Request(points, start=self.centre.prediction))
        self._solves += len(points)
        self._seconds += float(found.seconds.sum())
        return found

    @property
    def seconds_per_solve(self) -> float:
        """Predicted time (s) of one solve: measured times would make results depend on the machine."""
        return seconds_per_solve(self.unknowns)

    @property
    def cost(self) -> float:
        """Predicted time (s) of one sample, on both meshes."""
        return self.seconds_per_solve + (0 if self._coarser is None else self._coarser.seconds_per_solve)

    @property
    def measured_cost(self) -> float:
        """Time (s) that one sample took on both meshes, which counts against a budget."""
        here = self._seconds / self._solves
        return here if self._coarser is None else here + self._coarser._seconds / self._coarser._solves

    @property
    def cost_of_finer(self) -> float:
        """Predicted time (s) of linearisation and pilot on the next finer mesh."""
        finer = seconds_per_solve(8 * self.unknowns)
        return TEXTBOOK * finer + self._pilot.samples * (finer + self.seconds_per_solve)

    def affords_finer(self, left: float) -> bool:
        """Whether the next finer mesh takes at most half of the remaining budget (s), judging by the solves so far."""
        return self.cost_of_finer * self.measured_cost / self.cost <= left / 2

    @property
    def nominal(self) -> FloatArray:
        """Difference (m,) of the outputs at the mean parameters."""
        return self.centre.outputs - (0 if self._coarser is None else self._coarser.centre.outputs)

    @property
    def offset(self) -> FloatArray:
        """Difference (m,) of the values from which deviations are taken."""
        return self.centre.middle - (0 if self._coarser is None else self._coarser.centre.middle)

    def deviations(self, outputs: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return w and T (n, m) of outputs on this mesh, and E[T²] (m,)."""
        slopes = self.centre.output_slopes
        variance = np.einsum("mi,ij,mj->m", slopes, self._inputs.correlation, slopes)
        return outputs - self.centre.middle, self.centre.coordinates.of(points) @ slopes.T, variance

    def influences(self, mean: FloatArray) -> FloatArray:
        """By how much each sample (n, m) moves the variance on the finest mesh, with the mean (m,) of w there."""
        first, second, *controls = self._moments()
        c, d = controls
        first, second = controlled(first, second, (c, d) if self._pilot.controlled else None)
        moved = second - 2 * mean * first
        return np.asarray(moved - moved.mean(axis=0))

    @property
    def values(self) -> FloatArray:
        """Outputs (n, m) on this mesh of the samples with an answer on both."""
        return np.asarray(self.fine[self.ok])

    def _moments(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return w_l − w_{l−1}, the second moment's term, and their controls (n, m) with expectation zero."""
        points = self.points[self.ok]
        w, T, V = self.deviations(self.fine[self.ok], points)
        if self._coarser is None:
            return w, w**2, T, T**2 - V
        w0, T0, V0 = self._coarser.deviations(self.coarse[self.ok], points)
        return w - w0, w**2 - w0**2, T - T0, T**2 - T0**2 - (V - V0)

    @property
    def term(self) -> Term:
        """This mesh's term of the telescoping sums."""
        first, second, c, d = self._moments()
        return term(first, second, (c, d) if self._pilot.controlled else None)

    @property
    def plain_variance(self) -> FloatArray:
        """Variance (m,) of the difference without control."""
        return np.asarray(self._moments()[0].var(axis=0, ddof=1))

    @property
    def kurtosis(self) -> FloatArray:
        """Fourth central moment over the squared variance (m,) of the controlled difference."""
        r, _, control, _ = self._moments()
        if self._pilot.controlled:
            r = r - control
        r = r - r.mean(axis=0)
        return ratio((r**4).mean(axis=0), (r**2).mean(axis=0) ** 2, empty=3.0)

    @property
    def single(self) -> Moments:
        """Moments on this mesh alone."""
        w, T, V = self.deviations(self.fine[self.ok], self.points[self.ok])
        n, offset = len(w), self.centre.middle
        if not self._pilot.controlled:
            return estimate(monomials(w, None).sum(axis=1), n, offset)
        return estimate(monomials(w, T).sum(axis=1), n, offset, V)


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
        by_mesh = (*coarser, with_tails(finest, inputs, influences(meshes), meshes[0].values))
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
