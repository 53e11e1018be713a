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

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from forward.model import FloatArray, SolveError
from uq.estimators.moments import Estimates, Moments, Term, combine, controlled, estimate, monomials, ratio, term
from uq.estimators.tails import influences, kurtosis, with_tails
from uq.evaluation.evaluate import Recorder
from uq.evaluation.request import OWN
from uq.inputs.random_parameters import Inputs
from uq.methods.fidelity_team import Block, Member, Team
from uq.methods.method import MESH, TEXTBOOK, seconds_per_solve
from uq.surrogates.linearisation import linearise

SIZE = 10_000  # unknowns assumed on the coarsest mesh for a model without a state
ASSUMED_RATE = 1.0  # of convergence per mesh, if there is only one difference
RATES = (0.5, 2.0)  # assumed bounds of rates: faster ones do not last where stresses are singular


def name_of(level: int) -> str:
    """Name of the model on a mesh."""
    return f"{MESH}{level}" if level else OWN


class Meshes(Team):
    """The meshes, the coarsest first: group l are mesh l and the next coarser one.

    Attributes
    ----------
    unknowns
        Number of unknowns of each.
    """

    def __init__(
        self, inputs: Inputs, evaluate: Recorder, seed: int, most: int, pilot: int, *, controlled: bool
    ) -> None:
        super().__init__(inputs, evaluate, seed, most)
        self._pilot, self._controlled = pilot, controlled
        self.unknowns: list[int] = []
        self.refine()

    def refine(self) -> None:
        """Add a mesh, with its linearisation and a pilot; costs are predicted times (s), which depend on no machine."""
        level = len(self.members)
        evaluate = self.evaluate.on(name_of(level))
        self.unknowns.append(evaluate.displacements or SIZE * 8**level)
        cost = seconds_per_solve(self.unknowns[-1])
        self.members.append(Member("", evaluate, cost, linearise(self.inputs, evaluate)))
        self.groups.append((level, level - 1) if level else (0,))
        self.extend(level, self._pilot)

    def extend(self, level: int, count: int) -> None:
        """Go on to `count` samples of a mesh."""
        before = len(self.taken[level].points) if level in self.taken else 0
        if count > before:
            self.take(level, count - before)
        one = self.blocks()[level]
        if one.ok.sum() < 2:
            reasons = "; ".join(sorted(one.taken.reasons)[:3])
            raise SolveError(f"level {level}: {one.ok.sum()} of {count} samples have an answer, expected 2: {reasons}")

    @property
    def measured(self) -> FloatArray:
        """Time (s) that one sample of each mesh took (L,), which counts against a budget."""
        return np.array([sum(self.members[k].seconds / self.members[k].solves for k in g) for g in self.groups])

    @property
    def cost_of_finer(self) -> float:
        """Predicted time (s) of linearisation and pilot on the next finer mesh."""
        finer = seconds_per_solve(8 * self.unknowns[-1])
        return TEXTBOOK * finer + self._pilot * (finer + self.members[-1].cost)

    def affords_finer(self, left: float) -> bool:
        """Whether the next finer mesh takes at most half of the remaining budget (s), judging by the solves so far."""
        return bool(self.cost_of_finer * self.measured[-1] / self.costs[-1] <= left / 2)

    def level(self, of: Block) -> Level:
        """Return what the samples of a mesh tell."""
        points, values = of.taken.points[of.ok], of.taken.values[of.ok]
        centres = [self.members[k].centre for k in of.group]
        parts, sums = [], []
        for k, centre in zip(of.group, centres, strict=True):
            w, T = values[:, k] - centre.middle, centre.predicted(points)
            V = centre.predicted_variance(self.inputs.correlation)
            parts.append(np.array([w, w**2, T, T**2 - V]))
            sums.append((monomials(w, T if self._controlled else None).sum(axis=1), V if self._controlled else None))
        first, second, *controls = parts[0] - sum(parts[1:])
        nominal, offset = (one[0] - sum(one[1:]) for one in zip(*((c.outputs, c.middle) for c in centres), strict=True))
        single = estimate(sums[0][0], len(points), centres[0].middle, sums[0][1])
        used = (controls[0], controls[1]) if self._controlled else None
        return Level(values[:, of.group[0]], single, nominal, offset, first, second, used)


@dataclass(frozen=True)
class Level:
    """What the samples of a mesh and of the next coarser one tell.

    Attributes
    ----------
    values
        Outputs (n, m) on this mesh of the samples with an answer on both.
    single
        Moments on this mesh alone.
    nominal, offset
        Differences (m,) of the outputs at the mean parameters, and of the values from which deviations are taken.
    first, second, controls
        Samples (n, m) of the difference of both moments, and their controls with expectation zero, if there are any.
    """

    values: FloatArray
    single: Moments
    nominal: FloatArray
    offset: FloatArray
    first: FloatArray
    second: FloatArray
    controls: tuple[FloatArray, FloatArray] | None

    @cached_property
    def term(self) -> Term:
        """This mesh's term of the telescoping sums."""
        return term(self.first, self.second, self.controls)

    def moved(self, mean: FloatArray) -> FloatArray:
        """By how much each sample (n, m) moves the variance on the finest mesh, with the mean (m,) of w there."""
        return influences(*controlled(self.first, self.second, self.controls), mean)

    @property
    def variance(self) -> FloatArray:
        """Variance (m,) of the difference without control."""
        return np.asarray(self.first.var(axis=0, ddof=1))

    @property
    def kurtosis(self) -> FloatArray:
        """Fourth central moment over the squared variance (m,) of the controlled difference."""
        return kurtosis(self.first if self.controls is None else self.first - self.controls[0])


@dataclass(frozen=True)
class Found:
    """Estimates from the samples so far.

    Attributes
    ----------
    levels
        What each mesh tells.
    by_mesh
        The telescoped moments up to each mesh.
    moved
        By how much each sample (n, m) of every mesh moves the variance on the finest one.
    differences
        E[Y_l] (L, m), l = 1 … L.
    bias_error, std_bias_error
        Estimated errors (m,) of mean and standard deviation on the finest mesh.
    consistency
        Of l = 1 … L (L, m).
    """

    levels: tuple[Level, ...]
    by_mesh: tuple[Estimates, ...]
    moved: tuple[FloatArray, ...]
    differences: FloatArray
    bias_error: FloatArray
    std_bias_error: FloatArray
    consistency: FloatArray

    @classmethod
    def of(cls, meshes: Meshes) -> Found:
        """Estimate from the samples on all meshes."""
        levels = tuple(map(meshes.level, meshes.blocks()))
        terms, middles = [one.term for one in levels], [one.centre.middle for one in meshes.members]
        *coarser, finest = (combine(middle, terms[: k + 1]) for k, middle in enumerate(middles))
        mean = np.sum([one.first for one in terms], axis=0)
        moved = tuple(one.moved(mean) for one in levels)
        by_mesh = (*coarser, with_tails(finest, meshes.inputs, moved, levels[0].values))
        differences = np.array([one.offset + one.term.first for one in levels])[1:]
        std_differences = np.diff([e.std for e in by_mesh], axis=0)
        consistency = np.array([_consistency(*pair) for pair in pairwise(levels)])
        # The differences at the mean parameters converge at the same rate, without sampling error.
        nominal = np.array([one.nominal for one in levels])[1:]
        alpha = np.clip(np.minimum(rate(differences), rate(nominal)), *RATES)
        errors = bias(differences, alpha), bias(std_differences, alpha)
        return cls(levels, by_mesh, moved, differences, *errors, consistency)

    @property
    def estimates(self) -> Estimates:
        """Moments on the finest mesh."""
        return self.by_mesh[-1]

    @property
    def total_error(self) -> FloatArray:
        """Error (m,) of the mean, of sampling and mesh."""
        return np.hypot(self.bias_error, self.estimates.mean_error)


def _consistency(coarser: Level, finer: Level) -> FloatArray:
    """Compare the mean of ψ_{l−1} as the coarser and as the finer of two meshes: |a − b + c| / 3(σ_a + σ_b + σ_c).

    a and b are the estimates of E[ψ_{l−1}] and E[ψ_l], each from the samples of its own level, and c that of E[Y_l],
    with standard errors σ: beyond 1 the sum does not telescope (M. B. Giles, Acta Numerica 24 (2015), section 3.3).
    """
    a, b, c = coarser.single, finer.single, finer.term
    c_mean, c_error = finer.offset + c.first, np.sqrt(c.variance / c.n)
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
