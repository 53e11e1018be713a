"""Multilevel Monte Carlo over nested meshes: the total error, of mesh and sampling, at the least cost.

With ψ_l the quantity on mesh l, E[ψ_L] = Σ_l E[Y_l], Y_l = ψ_l − ψ_{l−1}, Y_0 = ψ_0: both meshes of a difference get
the same parameters, so that Var Y_l is small, and differences on fine meshes need few samples (M. B. Giles, Acta
Numerica 24 (2015) 259–328). Each mesh is linearised at the mean parameters. With the deviation w_l = ψ_l − ψ̄_l, its
tangent prediction T_l and V_l = E[T_l²], the terms of the mean and of the second moment of w_L are

    ⟨w_l − w_{l−1} − (T_l − T_{l−1})⟩
    ⟨w_l² − w_{l−1}² − (T_l² − V_l − T_{l−1}² + V_{l−1})⟩

where the controls, in brackets, have expectation zero. `moments.combine` adds them up.

Allotting samples, estimating differences and adding errors depend on each other at every step, hence one file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from forward.model import FloatArray, ModelError, SolveError
from uq.estimators.doubts import of_differences, of_tails
from uq.estimators.moments import (
    ESTIMATES,
    Estimates,
    Moments,
    Term,
    combine,
    controlled,
    estimate,
    monomials,
    ratio,
    term,
)
from uq.estimators.tails import of_influences, unseen
from uq.evaluation.evaluate import OWN, Evaluate, Evaluations, Recorder, Request
from uq.findings import add
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import random_points
from uq.methods.method import MESH
from uq.methods.monte_carlo import MOST_GROWTH, UNLIMITED
from uq.methods.stopping import TEXTBOOK, Amount, seconds_per_solve
from uq.surrogates.linearisation import Linearisation, linearise, local_dataset

if TYPE_CHECKING:
    import xarray as xr

    from forward.scalars import Mistake
    from forward.spec import ModelSpec, Times

FIRST_MESHES = 3  # two differences, the fewest that show a rate
ASSUMED_RATE = 1.0  # of convergence per mesh, if there is only one difference
RATES = (0.5, 2.0)  # assumed bounds of rates: faster ones do not last where stresses are singular
SIZE = 10_000  # unknowns assumed on the coarsest mesh for a model without a state
HEAVY_TAILED = 100.0  # kurtosis beyond which a variance from a few samples says little
UNCOUPLED = 0.5  # of the variance on a mesh: a difference that varies more gains nothing from the coarser mesh


class MultilevelMonteCarlo(Amount):
    """Multilevel Monte Carlo over meshes: mean and standard deviation to a total error, of mesh and sampling.

    The body of the study is the coarsest mesh; the cells of mesh l are divided by 2^l along each edge. Meshes are added
    as the estimated error of the finest requires, each with a pilot, from which the number of samples on every mesh is
    chosen so that the cost is least: n_l ∝ √(V_l/C_l), V_l the variance and C_l the predicted cost of one sample.
    Displacement fields are not estimated, since they live on different meshes.

    Parameters
    ----------
    samples
        Number of samples on the coarsest mesh, with optimal numbers on the others; with a tolerance or a budget, the
        largest number.
    tolerance
        Stop when the total error of every mean, √(mesh² + sampling²), is below this fraction of the mean (of the
        standard deviation, where the mean is smaller than that).
    budget_seconds
        As in `Amount`; a third or finer mesh is not added if it would take more than half of the remaining budget.
    levels
        Largest number of meshes.
    pilot
        Number of samples on each mesh before anything is known about it; they keep at most this many groups of ranks
        busy.
    control
        Control variate on every mesh: "none", or the "tangent" at the mean parameters, with the coefficient 1: there
        are too few samples on fine meshes to fit another.
    seed
        Seed of the random points; every mesh has its own stream.
    """

    kind: Literal["multilevel-monte-carlo"] = "multilevel-monte-carlo"
    levels: Annotated[int, Field(ge=2, le=10)] = 3
    pilot: Annotated[int, Field(ge=4)] = 8
    control: Literal["none", "tangent"] = "tangent"
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _check_pilot(self) -> MultilevelMonteCarlo:
        if self.samples is not None and self.samples < self.pilot:
            message = f"samples = {self.samples}, expected at least pilot = {self.pilot}"
            raise ValueError(message)
        return self

    def planned(self, dimension: int) -> int:
        """Number of solves of the linearisations and pilots on all meshes, which decide how many more are needed."""
        return self.levels + self.pilot * (2 * self.levels - 1)

    @property
    def undecided(self) -> str:
        """What the planned solves are for."""
        return "linearisations and pilots"

    def models(self, spec: ModelSpec) -> dict[str, ModelSpec]:
        """Return the body on the finer meshes."""
        return {_name(level): spec.refined(level) for level in range(1, self.levels)}

    def unfit(self, spec: ModelSpec) -> Iterator[Mistake]:
        """Find that there are no meshes, or that they have different parameters."""
        if not spec.meshed:
            yield ("method", "kind"), f"a model of kind '{spec.kind}' has no meshes, expected another method", self.kind
        elif spec.coefficients:
            message = "random fields have other coefficients on every mesh, expected a method with one mesh"
            yield ("model", "fields"), message, self.kind

    def seconds(self, dimension: int, costs: Mapping[str, Times]) -> float:
        """Predict the processor time (s) of the pilots."""
        each = [costs[_name(level)].sample for level in range(self.levels)]
        return self.pilot * (2 * sum(each) - each[-1])

    def run(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        """Sample and estimate.

        Returns
        -------
        xarray.Dataset
            Estimates by output (`mean`, `mean_error`, `std`, `std_error`, and the errors `bias_error` of the mesh and
            `total_error`), what was found on each mesh (`mesh_…` by level), rates of convergence and samples; see
            docs/results.md.

        Raises
        ------
        SolveError
            If the model has no answer at the mean parameters on one of the meshes, or on both meshes of fewer than two
            samples of a difference.
        ValueError
            If the model has no derivatives, which the control needs.
        """
        if self.control != "none" and not evaluate.differentiable:
            message = f"the model has no derivatives, expected one that has for method.control = '{self.control}'"
            raise ModelError(message)
        recorder = Recorder(evaluate)
        meshes = [_Mesh(self, inputs, recorder, None)]
        while len(meshes) < min(self.levels, FIRST_MESHES):
            if len(meshes) > 1 and not meshes[-1].affords_finer(self._left(recorder)):
                break
            meshes.append(_Mesh(self, inputs, recorder, meshes[-1]))
        while True:
            found = _Found.of(inputs, meshes)
            reached = float(found.relative(found.total_error).max())
            left = self._left(recorder)
            allocation = _allocate(self, meshes, found, left)
            if self.met(reached):
                break
            if self._wants_finer(meshes, found, allocation, left):
                meshes.append(_Mesh(self, inputs, recorder, meshes[-1]))
            elif allocation.settled:
                break
            else:
                for mesh, n in zip(meshes, allocation.now, strict=True):
                    mesh.extend(int(n))
        return self._dataset(inputs, recorder, meshes, found, self._why(meshes, found, reached, allocation))

    def _left(self, recorder: Recorder) -> float:
        """What is left of the budget (s)."""
        return np.inf if self.budget_seconds is None else self.budget_seconds - recorder.seconds

    def _wants_finer(self, meshes: list[_Mesh], found: _Found, allocation: _Allocation, left: float) -> bool:
        """Whether a finer mesh is the next step."""
        if len(meshes) == self.levels or not meshes[-1].affords_finer(left):
            return False
        error = float(found.relative(found.bias_error).max())
        if self.tolerance is not None:
            # First sample as if there were no finer mesh: only this shows how far the mesh error can be trusted.
            return allocation.settled and 2 * error**2 > self.tolerance**2
        return error > allocation.sampling_error

    def _why(self, meshes: list[_Mesh], found: _Found, reached: float, allocation: _Allocation) -> str:
        counts = " + ".join(str(len(mesh.points)) for mesh in meshes)
        mesh, sampling = (float(found.relative(e).max()) for e in (found.bias_error, found.estimates.mean_error))
        error = f"relative total error {reached:.3g} (mesh {mesh:.2g}, sampling {sampling:.2g})"
        amount = f"{counts} samples on {len(meshes)} meshes"
        if self.tolerance is not None and mesh > self.tolerance and len(meshes) == self.levels:
            amount += f" (levels = {self.levels} allows no finer one)"
        return self.why_stopped(reached, error, 1 - int(allocation.cut), 1, amount)

    def _dataset(
        self, inputs: Inputs, evaluate: Evaluate, meshes: list[_Mesh], found: _Found, stopped: str
    ) -> xr.Dataset:
        by_output, by_level, both = ("output",), ("level",), ("level", "output")
        finest = len(meshes) - 1
        dataset = local_dataset(inputs, evaluate.on(_name(finest)), meshes[-1].centre, fields=False)
        single, telescoped = [mesh.single for mesh in meshes], found.by_mesh
        differences = [mesh.term for mesh in meshes]
        plain, kurtosis = np.array([mesh.plain_variance for mesh in meshes]), np.array([m.kurtosis for m in meshes])
        remaining = np.array([t.variance for t in differences])
        seconds = np.array([mesh.seconds_per_solve for mesh in meshes])
        consistency, shares = found.consistency, ratio(plain[1:], np.array([s.std**2 for s in single[1:]]))
        dataset = dataset.assign_coords(level=np.arange(len(meshes))).assign(
            {
                **{name: (by_output, getattr(found.estimates, name)) for name in ESTIMATES},
                "bias_error": (by_output, found.bias_error),
                "total_error": (by_output, found.total_error),
                "std_bias_error": (by_output, found.std_bias_error),
                "std_total_error": (by_output, np.hypot(found.estimates.std_error, found.std_bias_error)),
                "mesh_error": (by_output, found.signs * found.bias_error),
                "std_mesh_error": (by_output, found.std_signs * found.std_bias_error),
                "weak_rate": (by_output, rate(found.differences)),
                "strong_rate": (by_output, rate(plain[1:])),
                "cost_rate": ((), float(-rate(seconds[:, None])[0])),
                "mesh_unknowns": (by_level, np.array([mesh.unknowns for mesh in meshes])),
                "mesh_samples": (by_level, np.array([len(mesh.points) for mesh in meshes])),
                "mesh_failed": (by_level, np.array([int((~mesh.ok).sum()) for mesh in meshes])),
                "mesh_cost": (by_level, seconds),
                "mesh_nominal": (both, np.array([mesh.centre.outputs for mesh in meshes])),
                "mesh_mean": (both, np.array([e.mean for e in telescoped])),
                "mesh_std": (both, np.array([e.std for e in telescoped])),
                "mesh_variance": (both, np.array([s.std**2 for s in single])),
                "mesh_variance_ratio": (both, np.array([s.variance_ratio for s in single])),
                "difference_mean": (both, np.array([m.offset + m.term.first for m in meshes])),
                "difference_mean_error": (both, np.sqrt(remaining / np.array([[t.n] for t in differences]))),
                "difference_variance": (both, plain),
                "difference_variance_ratio": (both, ratio(plain, remaining, empty=1.0)),
                "difference_kurtosis": (both, kurtosis),
                "consistency": (both, np.vstack([np.full_like(kurtosis[:1], np.nan), consistency])),
                "points": (("sample", "parameter"), np.concatenate([mesh.points for mesh in meshes])),
                "sample_level": (("sample",), np.repeat(np.arange(len(meshes)), [len(m.points) for m in meshes])),
                "fine": (("sample", "output"), np.concatenate([mesh.fine for mesh in meshes])),
                "coarse": (("sample", "output"), np.concatenate([mesh.coarse for mesh in meshes])),
                "ok": (("sample",), np.concatenate([mesh.ok for mesh in meshes])),
            }
        )
        dataset.attrs["stopped"] = stopped
        moved, claimed = _influences(meshes), found.estimates.relative_std_error
        add(dataset, *of_tails(evaluate.outputs, meshes[0].values, claimed, moved[0]))
        add(dataset, *of_differences(evaluate.outputs, moved, found.estimates.std, claimed))
        notes = list(_notes(evaluate.outputs, consistency, kurtosis, shares, len(meshes)))
        failed, count = int((~dataset["ok"]).sum()), dataset.sizes["sample"]
        if failed:
            follow = "" if self.control == "none" else ", or taken to follow the tangent,"
            notes.append(
                f"{failed} of {count} samples have no answer on both of their meshes; estimates are over the others"
                f"{follow} which their errors do not cover"
            )
        if notes:
            dataset.attrs["note"] = "; ".join(notes)
        return dataset


def _name(level: int) -> str:
    """Name of the model on a mesh."""
    return f"{MESH}{level}" if level else OWN


def _notes(
    outputs: Sequence[str], consistency: FloatArray, kurtosis: FloatArray, shares: FloatArray, count: int
) -> list[str]:
    """Say which checks failed, mesh by mesh."""

    def where(bad: FloatArray) -> str:
        return ", ".join(o for o, b in zip(outputs, bad, strict=True) if b)

    notes = []
    for level in range(count):
        if (kurtosis[level] > HEAVY_TAILED).any():
            largest = kurtosis[level].max()
            notes.append(
                f"level {level}: a few samples make most of the variance (kurtosis {largest:.3g}) of "
                f"{where(kurtosis[level] > HEAVY_TAILED)}: errors are less certain than they look"
            )
        if level and (consistency[level - 1] > 1).any():
            notes.append(
                f"level {level}: the coarser mesh has another mean here than on its own level (consistency "
                f"{consistency[level - 1].max():.3g}, expected below 1) for {where(consistency[level - 1] > 1)}: "
                "do not trust these results"
            )
        if level and (shares[level - 1] > UNCOUPLED).any():
            notes.append(
                f"level {level}: the two meshes do not follow each other for {where(shares[level - 1] > UNCOUPLED)}: "
                "the coarsest mesh is too coarse, or the model is not the same on both"
            )
    return notes


class _Mesh:
    """A mesh with its linearisation and the samples on it and on the next coarser one.

    Attributes
    ----------
    centre
        Linearisation at the mean parameters.
    points, fine, coarse, ok
        Parameters (n, d), outputs (n, m) on this mesh and on the coarser one (zero where there is none), and which
        samples have both.
    """

    def __init__(self, method: MultilevelMonteCarlo, inputs: Inputs, evaluate: Evaluate, coarser: _Mesh | None) -> None:
        self._method, self._inputs, self._coarser = method, inputs, coarser
        self.level: int = 0 if coarser is None else coarser.level + 1
        self._evaluate = evaluate.on(_name(self.level))
        self.centre: Linearisation = linearise(inputs, self._evaluate)
        self.unknowns = self._evaluate.displacements or SIZE * 8**self.level
        self._solves, self._seconds = 0, 0.0
        d, m = len(inputs.names), len(self.centre.outputs)
        self.points = np.empty((0, d))
        self.fine, self.coarse = np.empty((0, m)), np.empty((0, m))
        self.ok = np.empty(0, dtype=bool)
        self._reasons: set[str] = set()
        self.extend(method.pilot)

    def extend(self, count: int) -> None:
        """Go on to `count` samples."""
        before = len(self.points)
        if count <= before:
            return
        cube = random_points((self._method.seed, self.level), before, count, len(self._inputs.names))
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
        return TEXTBOOK * finer + self._method.pilot * (finer + self.seconds_per_solve)

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
        first, second = controlled(first, second, None if self._method.control == "none" else (c, d))
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
        return term(first, second, None if self._method.control == "none" else (c, d))

    @property
    def plain_variance(self) -> FloatArray:
        """Variance (m,) of the difference without control."""
        return np.asarray(self._moments()[0].var(axis=0, ddof=1))

    @property
    def kurtosis(self) -> FloatArray:
        """Fourth central moment over the squared variance (m,) of the controlled difference."""
        r, _, control, _ = self._moments()
        if self._method.control != "none":
            r = r - control
        r = r - r.mean(axis=0)
        return ratio((r**4).mean(axis=0), (r**2).mean(axis=0) ** 2, empty=3.0)

    @property
    def single(self) -> Moments:
        """Moments on this mesh alone."""
        w, T, V = self.deviations(self.fine[self.ok], self.points[self.ok])
        n, offset = len(w), self.centre.middle
        if self._method.control == "none":
            return estimate(monomials(w, None).sum(axis=1), n, offset)
        return estimate(monomials(w, T).sum(axis=1), n, offset, V)


@dataclass(frozen=True)
class _Found:
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
    def of(cls, inputs: Inputs, meshes: Sequence[_Mesh]) -> _Found:
        terms = [mesh.term for mesh in meshes]
        *coarser, finest = (combine(mesh.centre.middle, terms[: k + 1]) for k, mesh in enumerate(meshes))
        moved = _influences(meshes)
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
        return self.by_mesh[-1]

    @property
    def total_error(self) -> FloatArray:
        return np.hypot(self.bias_error, self.estimates.mean_error)

    def relative(self, error: FloatArray) -> FloatArray:
        """An error (…, m) over the mean, or over the standard deviation if that is larger."""
        scale = np.maximum(np.abs(self.estimates.mean), self.estimates.std)
        return ratio(error, np.broadcast_to(scale, error.shape))


def _influences(meshes: Sequence[_Mesh]) -> list[FloatArray]:
    """By how much each sample (n, m) of every mesh moves the variance on the finest one."""
    mean = np.sum([mesh.term.first for mesh in meshes], axis=0)
    return [mesh.influences(mean) for mesh in meshes]


def _consistency(coarser: _Mesh, mesh: _Mesh) -> FloatArray:
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


@dataclass(frozen=True)
class _Allocation:
    """Numbers of samples on every mesh.

    Attributes
    ----------
    now
        To reach next.
    settled
        Whether this is the current allocation.
    cut
        Whether the budget is too small for all that is needed.
    sampling_error
        Expected final relative sampling error.
    """

    now: FloatArray
    settled: bool
    cut: bool
    sampling_error: float


def optimal(variances: FloatArray, costs: FloatArray, target: float) -> FloatArray:
    """Numbers of samples √(V_l/C_l) Σ√(V C)/target by which Σ V_l/n_l is `target` at the least cost Σ n_l C_l."""
    return np.asarray(np.sqrt(variances / costs) * np.sqrt(variances * costs).sum() / target)


def _allocate(method: MultilevelMonteCarlo, meshes: Sequence[_Mesh], found: _Found, left: float) -> _Allocation:
    """Choose numbers of samples: the least of what tolerance, samples and budget allow."""
    counts = np.array([len(mesh.points) for mesh in meshes], dtype=float)
    costs = np.array([mesh.cost for mesh in meshes])
    limit = float(method.samples or UNLIMITED)
    # One variance for all outputs, relative to the square of what the tolerance is relative to.
    by_output = found.relative(found.relative(np.array([mesh.term.variance for mesh in meshes])))
    variances = np.maximum(by_output.max(axis=1), 1e-30)
    if len(meshes) >= FIRST_MESHES:
        # A few samples may agree by chance: no finer mesh is assumed to vary much less than expected.
        decay = 2.0 ** -max(float(rate(variances[1:, None])[0]), RATES[0])
        for level in range(2, len(meshes)):
            variances[level] = max(variances[level], 0.5 * decay * variances[level - 1])
    shape = optimal(variances, costs, 1.0)

    def numbers(multiple: float) -> FloatArray:
        return np.asarray(np.maximum(counts, np.minimum(np.ceil(multiple * shape * (1 - 1e-9)), limit)))

    wanted = limit / shape[0]
    if method.tolerance is not None:
        wanted = min(wanted, 1 / _target(method, meshes, found, variances, costs))
    # What the budget allows: cost grows with the multiple, so bisection finds the largest.
    paid = np.array([mesh.measured_cost for mesh in meshes])
    low, high = 0.0, wanted
    cut = (numbers(wanted) - counts) @ paid > left
    if cut:
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if (numbers(middle) - counts) @ paid <= left else (low, middle)
    final = numbers(low if cut else high)
    now = np.minimum(final, np.ceil(MOST_GROWTH * counts))
    sampling = float(np.sqrt((variances / final).sum()))
    return _Allocation(now, bool((now <= counts).all()), bool(cut), sampling)


def _target(
    method: MultilevelMonteCarlo, meshes: Sequence[_Mesh], found: _Found, variances: FloatArray, costs: FloatArray
) -> float:
    """Square of the relative error allowed for sampling."""
    assert method.tolerance is not None
    allowed = method.tolerance**2
    # A little more than its estimate, so that the total is met when sampling meets its share.
    remaining = allowed - (1.001 * float(found.relative(found.bias_error).max())) ** 2
    if remaining >= allowed / 2:
        return remaining
    # Less than half is left: sample for it if that is cheaper than another mesh.
    work = np.sqrt(variances * costs).sum() ** 2
    last = len(meshes) == method.levels
    if remaining > 0 and (last or work / remaining < work / allowed + meshes[-1].cost_of_finer):
        return remaining
    return allowed / 2
