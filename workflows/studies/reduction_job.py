"""The job of a reduction: snapshots, round by round, the reduced model that they make, and its errors."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from mpi4py import MPI

from forward.findings import Finding
from forward.model import FloatArray, Solution, SolveError
from forward.reduced.data import ReducedData, save
from forward.reduced.model import ReducedModel
from forward.reduced.reduction import Reduction, Sizes
from forward.reduced.snapshots import Snapshots, adjoint_states, directions
from forward.reduced.spec import without_answer
from uq.evaluation.evaluate import Recorder, Steps
from uq.evaluation.kept import Kept
from uq.evaluation.request import Evaluate, FieldSum, Request
from uq.findings import add
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import random_points, sobol_points
from uq.surrogates.linearisation import linearise
from workflows.results.directory import label
from workflows.studies.job import Job, MethodJob

if TYPE_CHECKING:
    from forward.fem.model import HyperelasticModel
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble

FILE = "reduced.npz"
OF_STATES = 4  # times as many modes of states in the larger model besides, where there are no adjoints
ROUGH = 3.0  # times what points may miss while snapshots are chosen
ENOUGH = 120  # modes of states that the larger model has besides then
CANDIDATES = 32  # for each snapshot that is drawn where errors are large
LOST = 4  # of so many snapshots that are drawn, one may be where the reduced model has no answer
UNBALANCED = 1e-4  # forces that may be left at candidates
TIMED = 16  # samples at which a solve is timed
UNSEEN = 10_000  # number of the first random point at which errors are measured
EXACT = 1e-6  # error relative to the spread, below which estimates do not matter
TRUSTED = (0.5, 2.0)  # effectivities, outside of which estimates cannot be taken for the errors
LEFT = 0.5  # of the errors after correction, above which neither: errors and estimates of any sign may agree on average


@dataclass(frozen=True)
class KeptStates(FieldSum):
    """Keep the state of each point and, if the spread of its parameters is given, adjoint states and its changes."""

    compact = True
    spread: FloatArray | None

    def on(self, model: Any) -> Callable[[Solution, FloatArray], FloatArray]:
        """Return the function (solution, parameters) → rows (1 + m + k, U_local)."""
        spread = self.spread
        if spread is None:
            return lambda solution, _: np.asarray(solution.state)[None]

        def rows(solution: Solution, point: FloatArray) -> FloatArray:
            tangents = solution.state_tangent(directions(spread, point))
            return np.vstack([solution.state, adjoint_states(model, solution), tangents])

        return rows

    def total(self, points: FloatArray, rows: FloatArray) -> FloatArray:
        """Return nothing worth keeping: there is no sum."""
        return np.zeros((1, 1))

    def sketch(self, rows: FloatArray) -> FloatArray:
        """Return all rows (n, 1 + m, U)."""
        return rows


def job(method: Any, spec: Any, inputs: Inputs, ensemble: Ensemble, directory: Path, checkpoint: Checkpoint) -> Job:
    """Make the body on every group; collective over the group."""
    model: HyperelasticModel = spec.build(ensemble.group, inputs.names)
    recorders: dict[str, Recorder] = {}
    told: dict[str, Any] = {}

    def task(evaluate: Evaluate) -> xr.Dataset:
        recorders["/"] = Recorder(evaluate)
        steps = Steps(Kept(checkpoint, MPI.COMM_SELF, "steps"), recorders["/"], count=ensemble.count)
        own = model if ensemble.group.size == 1 else spec.build(MPI.COMM_SELF, inputs.names)
        made = _Making(method, inputs, recorders["/"], own, ensemble.say, steps)
        data, found = made.run()
        save(data, directory / FILE)
        kept = {key: value for key, value in data.about.items() if key not in {"spread", "lowest", "highest"}}
        told.update(kept | {"seconds": made.seconds, "file": FILE})
        return found

    units = {output.name: output.unit for output in spec.returned}
    return MethodJob(model, {}, task, recorders, labelled=lambda found: label(found, units), told={"reduced": told})


@dataclass
class _Making:
    """Snapshots, round by round, and what errors the model that they make has."""

    method: Any
    inputs: Inputs
    evaluate: Recorder
    model: HyperelasticModel
    say: Callable[[str], None]
    steps: Steps
    lost: list[str] = field(default_factory=list)  # why snapshots have no answer
    seconds: dict[str, float] = field(default_factory=dict)  # of the processor; not in the file, the same anywhere

    def __post_init__(self) -> None:
        method, self.start = self.method, linearise(self.inputs, self.evaluate).prediction
        more = method.more
        if not method.derivatives and method.modes is not None:  # no adjoints: modes of states in their place
            more = max(more, OF_STATES * method.modes)
        blocks: dict[str, Any] = {} if method.blocks is None else {"cut": method.blocks.cut, "full": method.blocks.full}
        self.sizes = Sizes(method.modes, method.truncation, method.cubature, more, **blocks)

    def run(self) -> tuple[ReducedData, xr.Dataset]:
        """Return the reduced model, and its errors on unseen samples."""
        method, inputs, d = self.method, self.inputs, len(self.inputs.names)
        in_rounds = method.snapshots // 2 if method.rounds else 0
        first = method.snapshots - in_rounds
        snapshots = self._solved(inputs.points(sobol_points(method.seed, 0, 0, first, d)))
        if snapshots is None:
            raise SolveError(f"no snapshot has an answer: {self.lost[0]}")
        reduction = Reduction(self.model, inputs.mean, inputs.std)
        rough = replace(self.sizes, cubature=ROUGH * self.sizes.cubature, more=min(self.sizes.more, ENOUGH))
        seconds = 0.0
        for number in range(method.rounds):
            few = in_rounds // method.rounds + (number < in_rounds % method.rounds)
            if few == 0:
                continue
            begin = time.process_time()
            candidates = inputs.points(sobol_points(method.seed, 1 + number, 0, CANDIDATES * few, d))
            worst = self.steps(f"round {number}", partial(self._worst, reduction, snapshots, rough, candidates, few))
            seconds += time.process_time() - begin
            more = self._solved(worst) if len(worst) else None
            snapshots = snapshots if more is None else snapshots.with_others(more)
        begin = time.process_time()
        data = self.steps("model", partial(reduction.reduced, snapshots, self.sizes))
        seconds += time.process_time() - begin
        solving = float(sum(one.seconds.sum() for one in self.evaluate.log))
        self.seconds = {"snapshots": solving, "reduction": seconds}
        data.about["without an answer"] = len(self.lost)
        found = self._measured(data, reduction)
        add(found, *without_answer(data.about))
        return data, found

    def _solved(self, points: FloatArray) -> Snapshots | None:
        """Solve at points (n, d); those without an answer are left out, and None is returned if no point has one."""
        kept = KeptStates(self.inputs.std if self.method.derivatives else None)
        found = self.evaluate(Request(points, fields=kept, start=self.start))
        rows, ok = found.sketches, found.ok
        self.lost += [failure.reason for failure in found.failures]
        if rows is None or not ok.any():
            return None
        m, size = found.outputs.shape[1] if self.method.derivatives else 0, rows.shape[2]
        adjoints, tangents = rows[:, 1 : 1 + m].reshape(-1, size), rows[:, 1 + m :].reshape(-1, size)
        return Snapshots(points[ok], rows[:, 0], adjoints, tangents, found.outputs[ok])

    def _worst(
        self, reduction: Reduction, snapshots: Snapshots, sizes: Sizes, candidates: FloatArray, few: int
    ) -> FloatArray:
        """Return the candidates (few, d) where the model and the larger one differ most, in any output."""
        data = reduction.reduced(snapshots, sizes)
        both = (
            ReducedModel(data, data.parameters, alone=alone, tested=False, unbalanced=UNBALANCED)
            for alone in (False, True)
        )
        lost = np.full(len(self.model.outputs), np.nan)
        solved = (model.solve_many(candidates) for model in both)
        outputs = [[lost if isinstance(one, SolveError) else one.outputs for one in each] for each in solved]
        gaps = np.abs((np.array(outputs[1]) - np.array(outputs[0])) / np.array(data.about["spread"])).max(axis=1)
        known = np.isfinite(gaps)
        unknown = np.flatnonzero(~known)[: few // LOST]
        worst = np.argsort(np.where(known, -gaps, np.inf), kind="stable")[: min(few - len(unknown), known.sum())]
        said = f"{len(data.snapshots)} snapshots, {data.about['modes']} modes, {data.about['points']} points"
        if known.any():
            largest = 100 * gaps[known].max()
            self.say(f"reduced: {said}; estimated errors up to {largest:.2g} % of the spread of an output")
        return np.asarray(candidates[np.sort(np.concatenate([unknown, worst]))])

    def _measured(self, data: ReducedData, reduction: Reduction) -> xr.Dataset:
        """Return errors and their estimates at unseen samples; what they are together goes into the file too."""
        method, inputs, names = self.method, self.inputs, list(self.model.outputs)
        found = xr.Dataset(coords={"output": names, "parameter": list(inputs.names)})
        found["mode_energy"] = ("mode", (data.coordinates[:, data.before :] ** 2).mean(axis=0))
        if not method.unseen:
            return found
        last = UNSEEN + method.unseen
        points = inputs.points(random_points((method.seed, 1), UNSEEN, last, len(inputs.names)))
        full = self.evaluate(Request(points, tangents=True, fields=KeptStates(None), start=self.start))
        ok = full.ok
        states = iter(np.zeros((0, 1)) if full.sketches is None else full.sketches[:, 0])
        model = ReducedModel(data, data.parameters)
        n, m = method.unseen, len(names)
        errors, estimates, of_state = np.full((n, m), np.nan), np.full((n, m), np.nan), np.full(n, np.nan)
        gradients = np.full((3, n, m, len(inputs.names)), np.nan)  # of the body, and what is off before and after
        places = np.zeros((3, n, m))  # of largest values: of the body, and what the model says before and after
        answered = np.zeros(n, dtype=bool)
        for i, point in enumerate(points):
            state = next(states) if ok[i] else None
            try:
                solution = model.reduced(point)
            except SolveError:
                continue
            answered[i] = True
            if state is not None:
                errors[i], estimates[i] = full.outputs[i] - solution.outputs, solution.estimate.outputs
                of_state[i] = np.linalg.norm(state - solution.state) / np.linalg.norm(state)
                assert full.tangents is not None
                own = solution.adjoint(np.eye(m))
                exact = full.tangents[i]
                gradients[:, i] = np.array([exact, exact - own, exact - solution.corrected_jacobian]) * inputs.std
                of_point = np.array([state, solution.state, np.nan_to_num(solution.corrected_state)])
                places[:, i] = reduction.places(of_point, np.tile(point, (3, 1)))
        good = np.isfinite(errors).all(axis=1)
        told: dict[str, Any] = {
            "unseen": int(good.sum()),
            "unseen without an answer": int((~ok).sum()),
            "of these answered all the same": int((answered & ~ok).sum()),
            "unseen that only the body answers": int((ok & ~answered).sum()),
        }
        if good.any():
            spread = np.array(data.about["spread"])
            told["error of the state"] = float(np.sqrt((of_state[good] ** 2).mean()))
            told |= self._of_errors(found, errors[good] / spread, estimates[good] / spread)
            known = good & np.isfinite(estimates).all(axis=1)
            told |= _of_gradients(names, gradients[:, known], places[:, known]) if known.any() else {}
        data.about.update(told)
        found["reduced_error"] = (("sample", "output"), errors)
        found["reduced_estimate"] = (("sample", "output"), estimates)
        found["reduced_state_error"] = ("sample", of_state)
        found["points"] = (("sample", "parameter"), points)
        self.seconds["full solve"] = float(np.median(full.seconds))
        self.seconds["reduced solve"] = _seconds_of(model, points[good][:TIMED])
        return found

    @staticmethod
    def _of_errors(found: xr.Dataset, errors: FloatArray, estimates: FloatArray) -> dict[str, Any]:
        """Return the sizes of errors (n, m) and what their estimates are worth; say where these cannot be trusted.

        Estimates (n, m) are NaN where there are none. All are relative to the spread of the outputs.
        """
        names = found["output"].to_numpy().tolist()
        known = np.isfinite(estimates).all(axis=1)
        missing = int((~known).sum())
        sizes = np.sqrt((errors**2).mean(axis=0))
        told = {"unseen without an estimate": missing, "errors": dict(zip(names, sizes.tolist(), strict=True))}
        if missing:
            add(found, Finding("reduced-estimates-missing", "note", {"missing": missing, "samples": len(errors)}))
        if not known.any():
            return told
        errors, estimates = errors[known], estimates[known]
        sizes, left = (np.sqrt((one**2).mean(axis=0)) for one in (errors, errors - estimates))
        effectivity = (estimates * errors).sum(axis=0) / np.maximum((errors**2).sum(axis=0), 1e-300)
        found["reduced_effectivity"] = ("output", effectivity)
        low, high = TRUSTED
        off = [
            f"{name} {share:.2g} and {100 * rest / size:.0f} %"
            for name, share, rest, size in zip(names, effectivity, left, sizes, strict=True)
            if not (low <= share <= high and rest <= LEFT * size) and size > EXACT
        ]
        if off:
            add(found, Finding("reduced-estimates-off", "warning", {"off": "; ".join(off)}))
        return told | {
            "errors after correction": dict(zip(names, left.tolist(), strict=True)),
            "effectivity": dict(zip(names, effectivity.tolist(), strict=True)),
        }


def _seconds_of(model: ReducedModel, points: FloatArray) -> float:
    """Return the median processor time of a solve with its outputs at points (n, d); NaN without points."""
    taken = []
    for point in points:
        begin = time.process_time()
        assert np.isfinite(model.reduced(point).outputs).all()
        taken.append(time.process_time() - begin)
    return float(np.median(taken)) if taken else float("nan")


def _of_gradients(names: list[str], gradients: FloatArray, places: FloatArray) -> dict[str, Any]:
    """Return errors of gradients by output, root mean square over samples relative to the gradients.

    Where two places of a body have nearly the same largest value, that has a kink: a model may take the other place,
    with another gradient. So they are told for all samples, and for those at which the place is the same.

    Gradients (3, n, m, d) are those of the body, and what is off before and after correction; numbers (3, n, m) of the
    places of largest values are in the same order.
    """
    sizes = (gradients**2).sum(axis=3)
    told: dict[str, Any] = {}
    for k, which in ((1, ""), (2, " after correction")):
        same = places[k] == places[0]
        every, there = (
            np.sqrt((sizes[k] * counted).sum(axis=0) / np.maximum((sizes[0] * counted).sum(axis=0), 1e-300))
            for counted in (np.ones_like(same), same)
        )
        told[f"errors of gradients{which}"] = dict(zip(names, every.tolist(), strict=True))
        told[f"errors of gradients{which}, at the same place"] = dict(zip(names, there.tolist(), strict=True))
        told[f"share of samples at the same place{which}"] = dict(zip(names, same.mean(axis=0).tolist(), strict=True))
    return told
