"""Multilevel Monte Carlo over nested meshes: the total error, of mesh and sampling, at the least cost.

The meshes, the terms of the telescoping sums and what is estimated from them are in `uq.methods.multilevel_meshes`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field, model_validator

from forward.model import FloatArray, ModelError
from uq.estimators.blue import NEGLIGIBLE, Problem, alone
from uq.estimators.doubts import of_differences, of_tails
from uq.estimators.estimate import part
from uq.estimators.moments import ratio
from uq.evaluation.evaluate import Recorder
from uq.evaluation.request import Evaluate
from uq.findings import add
from uq.inputs.random_parameters import Inputs
from uq.methods.method import Amount
from uq.methods.monte_carlo import MOST_GROWTH, UNLIMITED
from uq.methods.multilevel_meshes import RATES, Found, Meshes, name_of, rate
from uq.surrogates.linearisation import local_dataset

if TYPE_CHECKING:
    import xarray as xr

    from forward.scalars import Mistake
    from forward.spec import ModelSpec, Times

FIRST_MESHES = 3  # two differences, the fewest that show a rate
HEAVY_TAILED = 100.0  # kurtosis beyond which a variance from a few samples says little
UNCOUPLED = 0.5  # of the variance on a mesh: a difference that varies more gains nothing from the coarser mesh
# What is said of kurtosis, consistency, and the share of a difference in the variance on a mesh, beyond these limits.
LIMITS = (HEAVY_TAILED, 1.0, UNCOUPLED)
BEYOND = (
    "a few samples make most of the variance (kurtosis {most:.3g}) of {where}: errors are less certain than they look",
    "the coarser mesh has another mean here than on its own level (consistency {most:.3g}, expected below 1) for "
    "{where}: do not trust these results",
    "the two meshes do not follow each other for {where}: the coarsest mesh is too coarse, or the model is not the "
    "same on both",
)


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

    undecided: ClassVar[str] = "linearisations and pilots"
    kind: Literal["multilevel-monte-carlo"] = "multilevel-monte-carlo"
    levels: Annotated[int, Field(ge=2, le=10)] = 3
    pilot: Annotated[int, Field(ge=4)] = 8
    control: Literal["none", "tangent"] = "tangent"
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _check_pilot(self) -> MultilevelMonteCarlo:
        if self.samples is not None and self.samples < self.pilot:
            raise ValueError(f"samples = {self.samples}, expected at least pilot = {self.pilot}")
        return self

    def planned(self, dimension: int) -> int:
        """Number of solves of the linearisations and pilots on all meshes, which decide how many more are needed."""
        return self.levels + self.pilot * (2 * self.levels - 1)

    def models(self, spec: ModelSpec) -> dict[str, ModelSpec]:
        return {name_of(level): spec.refined(level) for level in range(1, self.levels)}

    def unfit(self, spec: ModelSpec) -> Iterator[Mistake]:
        """Find that there are no meshes, or that they have different parameters."""
        if not spec.meshed:
            yield ("method", "kind"), f"a model of kind '{spec.kind}' has no meshes, expected another method", self.kind
        elif spec.coefficients:
            message = "random fields have other coefficients on every mesh, expected a method with one mesh"
            yield ("model", "fields"), message, self.kind

    def seconds(self, dimension: int, costs: Mapping[str, Times]) -> float:
        each = [costs[name_of(level)].sample for level in range(self.levels)]
        return self.pilot * (2 * sum(each) - each[-1])

    def run(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        """Sample and estimate.

        Returns
        -------
        xarray.Dataset
            Estimates by output (`mean`, `mean_error`, `std`, `std_error`, and the errors `bias_error` of the mesh and
            `total_error`), what was found on each mesh (`mesh_…` by level), rates of convergence and samples; see
            docs/results.md.
        """
        if self.control != "none" and not evaluate.differentiable:
            message = f"the model has no derivatives, expected one that has, or control = 'none' for '{self.control}'"
            raise ModelError(message)
        recorder = Recorder(evaluate)
        controlled = self.control != "none"
        meshes = Meshes(inputs, recorder, self.seed, self.levels, self.pilot, controlled=controlled)
        while (count := len(meshes.members)) < min(self.levels, FIRST_MESHES):
            if count > 1 and not meshes.affords_finer(self._left(recorder)):
                break
            meshes.refine()
        while True:
            found = Found.of(meshes)
            reached = float((found.total_error / found.estimates.size).max())
            left = self._left(recorder)
            allocation = _allocate(self, meshes, found, left)
            if self.met(reached):
                break
            if self._wants_finer(meshes, found, allocation, left):
                meshes.refine()
            elif allocation.settled:
                break
            else:
                for level, n in enumerate(allocation.now):
                    meshes.extend(level, int(n))
        return self._dataset(recorder, meshes, found, self._why(meshes, found, reached, allocation))

    def _left(self, recorder: Recorder) -> float:
        """What is left of the budget (s)."""
        return np.inf if self.budget_seconds is None else self.budget_seconds - recorder.seconds

    def _wants_finer(self, meshes: Meshes, found: Found, allocation: _Allocation, left: float) -> bool:
        """Whether a finer mesh is the next step."""
        if len(meshes.members) == self.levels or not meshes.affords_finer(left):
            return False
        error = float((found.bias_error / found.estimates.size).max())
        if self.tolerance is not None:
            # First sample as if there were no finer mesh: only this shows how far the mesh error can be trusted.
            return allocation.settled and 2 * error**2 > self.tolerance**2
        return error > allocation.sampling_error

    def _why(self, meshes: Meshes, found: Found, reached: float, allocation: _Allocation) -> str:
        blocks = meshes.blocks()
        counts = " + ".join(str(len(one.taken.points)) for one in blocks)
        mesh = float((found.bias_error / found.estimates.size).max())
        sampling = float(found.estimates.relative_error.max())
        error = f"relative total error {reached:.3g} (mesh {mesh:.2g}, sampling {sampling:.2g})"
        amount = f"{counts} samples on {len(blocks)} meshes"
        if self.tolerance is not None and mesh > self.tolerance and len(blocks) == self.levels:
            amount += f" (levels = {self.levels} allows no finer one)"
        return self.why_stopped(reached, error, 1 - int(allocation.cut), 1, amount)

    def _dataset(self, evaluate: Evaluate, meshes: Meshes, found: Found, stopped: str) -> xr.Dataset:
        by_output, by_level, both = ("output",), ("level",), ("level", "output")
        levels, members, blocks = found.levels, meshes.members, meshes.blocks()
        dataset = local_dataset(meshes.inputs, members[-1].evaluate, members[-1].centre, fields=False)
        single, telescoped = [one.single for one in levels], found.by_mesh
        *_, before, finest = telescoped
        counts, values = [len(one.ok) for one in blocks], [one.taken.values for one in blocks]
        plain, kurtosis = np.array([one.variance for one in levels]), np.array([one.kurtosis for one in levels])
        remaining = np.array([one.term.variance for one in levels])
        seconds = np.array([one.cost for one in members])
        shares = ratio(plain[1:], np.array([s.std**2 for s in single[1:]]))
        consistency, shares = (
            np.vstack([np.full_like(kurtosis[:1], np.nan), of]) for of in (found.consistency, shares)
        )
        coarse = [np.zeros_like(values[0][:, 0]), *(one[:, k] for k, one in enumerate(values[1:]))]
        dataset = dataset.assign_coords(level=np.arange(len(levels))).assign(
            {
                **found.estimates.variables(),
                "bias_error": (by_output, found.bias_error),
                part("mean", "total"): (by_output, found.total_error),
                "std_bias_error": (by_output, found.std_bias_error),
                part("std", "total"): (by_output, np.hypot(found.estimates.std_error, found.std_bias_error)),
                # Finer meshes will raise or lower them as the last one did.
                part("mean", "mesh"): (by_output, np.sign(found.differences[-1]) * found.bias_error),
                part("std", "mesh"): (by_output, np.sign(finest.std - before.std) * found.std_bias_error),
                "weak_rate": (by_output, rate(found.differences)),
                "strong_rate": (by_output, rate(plain[1:])),
                "cost_rate": ((), float(-rate(seconds[:, None])[0])),
                "mesh_unknowns": (by_level, np.array(meshes.unknowns)),
                "mesh_samples": (by_level, np.array(counts)),
                "mesh_failed": (by_level, np.array([int((~one.ok).sum()) for one in blocks])),
                "mesh_cost": (by_level, seconds),
                "mesh_nominal": (both, np.array([one.centre.outputs for one in members])),
                "mesh_mean": (both, np.array([e.mean for e in telescoped])),
                "mesh_std": (both, np.array([e.std for e in telescoped])),
                "mesh_variance": (both, np.array([s.std**2 for s in single])),
                "mesh_variance_ratio": (both, np.array([s.variance_ratio for s in single])),
                "difference_mean": (both, np.array([one.offset + one.term.first for one in levels])),
                "difference_mean_error": (both, np.sqrt(remaining / np.array([[one.term.n] for one in levels]))),
                "difference_variance": (both, plain),
                "difference_variance_ratio": (both, ratio(plain, remaining, empty=1.0)),
                "difference_kurtosis": (both, kurtosis),
                "consistency": (both, consistency),
                "points": (("sample", "parameter"), np.concatenate([one.taken.points for one in blocks])),
                "sample_level": (("sample",), np.repeat(np.arange(len(levels)), counts)),
                "fine": (("sample", "output"), np.concatenate([one[:, k] for k, one in enumerate(values)])),
                "coarse": (("sample", "output"), np.concatenate(coarse)),
                "ok": (("sample",), np.concatenate([one.ok for one in blocks])),
            }
        )
        dataset.attrs["stopped"] = stopped
        claimed = found.estimates.relative_std_error
        add(dataset, *of_tails(evaluate.outputs, levels[0].values, claimed, found.moved[0]))
        add(dataset, *of_differences(evaluate.outputs, found.moved, found.estimates.std, claimed))
        notes = list(_notes(evaluate.outputs, kurtosis, consistency, shares))
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


def _notes(outputs: Sequence[str], *checked: FloatArray) -> Iterator[str]:
    """Say which of these (L, m) are beyond their `LIMITS`, mesh by mesh."""
    for level, found in enumerate(zip(*checked, strict=True)):
        for values, limit, words in zip(found, LIMITS, BEYOND, strict=True):
            where = ", ".join(output for output, value in zip(outputs, values, strict=True) if value > limit)
            if where:
                yield f"level {level}: {words.format(most=values.max(), where=where)}"


class _Allocation(NamedTuple):
    """Numbers of samples on every mesh to reach next, and the relative sampling error that is expected in the end.

    `settled` is the current allocation; `cut` is one for which the budget is too small to reach all that is needed.
    """

    now: FloatArray
    settled: bool
    cut: bool
    sampling_error: float


def _allocate(method: MultilevelMonteCarlo, meshes: Meshes, found: Found, left: float) -> _Allocation:
    """Choose numbers of samples: the least of what tolerance, samples and budget allow."""
    counts = np.array([float(len(one.ok)) for one in meshes.blocks()])
    limit = float(method.samples or UNLIMITED)
    # Relative to the square of what the tolerance is relative to.
    variances = np.array([one.term.variance for one in found.levels]) / found.estimates.size**2
    variances = np.maximum(variances, 1e-30)
    if len(counts) >= FIRST_MESHES:
        # A few samples may agree by chance: no finer mesh is assumed to vary much less than expected.
        decay = 2.0 ** -np.maximum(rate(variances[1:]), RATES[0])
        for level in range(2, len(counts)):
            variances[level] = np.maximum(variances[level], 0.5 * decay * variances[level - 1])
    problem = Problem(alone(variances.T), meshes.costs, np.zeros_like(counts), np.ones_like(counts))
    # Numbers of samples for a unit of cost; every mesh needs some.
    shape = np.maximum(problem.best(1.0), NEGLIGIBLE / meshes.costs)

    def numbers(cost: float) -> FloatArray:
        return np.asarray(np.maximum(counts, np.minimum(np.ceil(cost * shape * (1 - 1e-9)), limit)))

    wanted = limit / shape[0]
    if method.tolerance is not None:
        unit = float(problem.variances(shape).max())
        wanted = min(wanted, unit / _target(method, meshes, found, unit))
    # What the budget allows: the largest cost, by bisection.
    paid = meshes.measured
    low, high = 0.0, wanted
    cut = (numbers(wanted) - counts) @ paid > left
    if cut:
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if (numbers(middle) - counts) @ paid <= left else (low, middle)
    final = numbers(low if cut else high)
    now = np.minimum(final, np.ceil(MOST_GROWTH * counts))
    sampling = float(np.sqrt(problem.variances(final).max()))
    return _Allocation(now, bool((now <= counts).all()), bool(cut), sampling)


def _target(method: MultilevelMonteCarlo, meshes: Meshes, found: Found, unit: float) -> float:
    """Square of the relative error allowed for sampling, whose square is `unit` for a unit of cost."""
    assert method.tolerance is not None
    allowed = method.tolerance**2
    # A little more than its estimate, so that the total is met when sampling meets its share.
    remaining = allowed - (1.001 * float((found.bias_error / found.estimates.size).max())) ** 2
    if remaining >= allowed / 2:
        return remaining
    # Less than half is left: sample for it if that is cheaper than another mesh.
    last = len(meshes.members) == method.levels
    if remaining > 0 and (last or unit / remaining < unit / allowed + meshes.cost_of_finer):
        return remaining
    return allowed / 2
