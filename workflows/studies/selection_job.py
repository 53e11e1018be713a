"""The job of a comparison: the candidates, each for each group of data, and what is said of them together."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

from forward.combine import sums_of
from forward.fem.finer import Keep, extrapolated
from forward.model import FloatArray, ForwardModel
from inverse.criticism.assumptions import by_evaluation
from inverse.criticism.finer import Finer
from inverse.data.shared_motion import together
from inverse.methods.infer import Problem, Sampled
from inverse.methods.model_error import Truth
from inverse.methods.selection import Select
from uq.evaluation.evaluate import Recorder, SerialEvaluate, Steps
from uq.evaluation.kept import Kept
from uq.evaluation.request import Evaluate
from uq.findings import add
from workflows.results import comparison
from workflows.studies.assumptions import ASSUMED, SAMPLED
from workflows.studies.candidates import TRUTH
from workflows.studies.job import MOVED, MethodJob, kept_starts
from workflows.studies.solves import of_answers
from workflows.studies.study import FINER, of_file

if TYPE_CHECKING:
    import xarray as xr

    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from workflows.studies.selection_blocks import SelectionBlocks

Make = Callable[[], Any]


def job(study: SelectionBlocks, ensemble: Ensemble, checkpoint: Checkpoint) -> MethodJob:
    """Make the candidates, each for each group of data; collective."""
    method, why = study.method, study.unchecked
    makers: dict[tuple[str, str], Make] = {
        pair: cache(partial(study.build, *pair, ensemble.group)) for pair in study.pairs
    }
    recorders: dict[str, Recorder] = {}
    kept = Kept(checkpoint, MPI.COMM_SELF, "steps")  # of the method, which runs on the first rank
    checked = [pair for pair in study.pairs if not why.get(pair[0], "none")]
    taken = {pair: study.taken(*pair) for pair in study.pairs}
    wider = {f"{n}/{g}/{SAMPLED}": partial(study.build_wider, n, g) for (n, g), one in taken.items() if one.sampled}
    motions = {pair: found for pair in study.pairs if (found := study.shared(*pair)) is not None}

    def task(evaluate: Evaluate) -> xr.Dataset:
        def recorded(name: str, group: str) -> Evaluate:
            recorders[f"{name}/{group}"] = Recorder(evaluate.on(f"{name}/{group}"))
            return recorders[f"{name}/{group}"]

        def free(name: str, group: str) -> Evaluate:
            # What nested sampling solves is too much, and too cheap, to keep.
            return SerialEvaluate(study.build(name, group), ensemble.count)

        def problem(name: str, group: str) -> Problem[Select]:
            pair, label = (name, group), f"{name}/{group}"
            recorder, motion, one, learnt = recorders[label], motions.get(pair), taken[pair], study.learnt.get(name)
            assumed = truth = sampled = None
            if method.assumptions or study.uncertain:
                assumed = one.of(one.data, by_evaluation(evaluate.on(f"{label}/{ASSUMED}")) if one.asked else None)
            there = f"{label}/{SAMPLED}"
            if there in wider:
                recorders[there] = Recorder(evaluate.on(there))
                sampled = Sampled(one.sampled, wider[there], recorders[there])
            if learnt is not None:
                truth = Truth(evaluate.on(f"{label}/{TRUTH}"), learnt.solves, method.seed)
            finer = None if not why else Finer(None, why[name])
            if pair in checked:  # last, since it is asked first, and one of these models is in memory at a time
                finer = Finer.by(recorder.on(f"{label}/{FINER}"))
            moved = None if motion is None else motion.errors_by(evaluate.on(f"{label}/{MOVED}"))
            return Problem(
                study.data_groups[group].seen(),
                method,
                finer=finer,
                shared=together(moved, None if assumed is None else assumed.shared),
                model=makers[pair](),
                say=lambda line: ensemble.say(f"{name}: {line}"),
                steps=Steps(kept, recorder, label, ensemble.count),
                assumed=assumed,
                sampled=sampled,
                truth=truth,
            )

        return method.run(study.models, study.data_groups, recorded, problem, free)

    def labelled(found: xr.Dataset) -> xr.Dataset:
        found = found.assign_attrs(quantity=study.data.quantity)
        if "mesh_checked" in found:
            of_files = [of_file(study.of_candidates[str(name)]) for name in found.model.values]
            found = found.assign(mesh_of_file=("model", of_files))
        units = {name: study.units_of(name) for name in study.candidates}
        doubts = comparison.doubts_of_selection(found, study.priors, method.noise.factor, units)
        # Other programs may contradict themselves, or state derivatives that are not of their values.
        wrong = {
            name: [one.of(f"Candidate '{name}'") for one in of_answers(make(), study.candidates[name].inputs)]
            for (name, _), make in makers.items()
            if not study.of_candidates[name].shareable
        }
        of_wrong = [name for name, several in wrong.items() if several]
        right = found["trusted"] & ~found["model"].isin(of_wrong)  # of the others, modes were not found
        judged = comparison.trusted_on_meshes(found.assign(trusted=right))
        add(judged, *comparison.findings(found), *comparison.untrusted(found, judged, of_wrong), *doubts)
        add(judged, *(one for several in wrong.values() for one in several), *comparison.learnt(judged))
        return judged

    finer_ones = {
        f"{n}/{g}/{FINER}": partial(
            build_finer, makers[n, g], study.models[n].inputs.mean, kept_starts(checkpoint, ensemble.group, f"{n}/{g}")
        )
        for n, g in checked
    }
    moved_ones = {f"{n}/{g}/{MOVED}": partial(_moved, makers[n, g], one) for (n, g), one in motions.items()}
    true_ones = {
        f"{n}/{g}/{TRUTH}": partial(study.build_truth, n, ensemble.group) for n, g in study.pairs if n in study.learnt
    }
    held_ones = {f"{n}/{g}/{ASSUMED}": partial(one.model, ensemble.group) for (n, g), one in taken.items() if one.asked}
    wider_ones = {name: partial(make, ensemble.group) for name, make in wider.items()}
    passing = finer_ones | held_ones | wider_ones | true_ones
    return MethodJob(
        makers[study.pairs[0]](),
        {"/".join(pair): make for pair, make in makers.items()} | moved_ones | passing,
        task,
        recorders,
        labelled=labelled,
        costly=study.model is not None or method.chains in {"pcn", "emcee"},  # whose one step may take minutes
        passing=frozenset(passing),
    )


def build_finer(make: Make, start: FloatArray, keep: Keep) -> ForwardModel:
    """Make, on finer meshes, the specimen or the measured outputs of a body that `make` returns; collective."""
    own = make()
    body, _ = sums_of(own)
    return extrapolated(body, start, keep).of(own)


def _moved(make: Make, motion: Any) -> ForwardModel:
    """Return the model, on the mesh of a candidate, that tells what uncertain motions do; collective."""
    found: ForwardModel = make().observing(*motion.observed)
    return found
