"""The job of a study that compares models."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import TYPE_CHECKING

from inverse.criticism.finer import Finer
from uq.evaluation.evaluate import Recorder, SerialEvaluate
from uq.evaluation.request import Evaluate
from uq.findings import add
from workflows.studies.findings_selection import (
    contradictions,
    doubts_of_selection,
    findings,
    trusted_on_meshes,
    untrusted,
    with_right_derivatives,
)
from workflows.studies.finer import FINER, solved_by
from workflows.studies.job import MOVED, MethodJob
from workflows.studies.selection_results import arviz_groups

if TYPE_CHECKING:
    import xarray as xr

    from forward.model import ForwardModel
    from inverse.data.shared_motion import SharedMotion
    from uq.evaluation.ensemble import Ensemble
    from workflows.studies.selection import Comparison


def _moved(study: Comparison, make: Callable[[], ForwardModel], motion: SharedMotion) -> ForwardModel:
    return study.moved(make(), motion)


def job(study: Comparison, ensemble: Ensemble) -> MethodJob:
    """The candidates, each for each group of data; making them is collective over the group."""
    makers = {pair: cache(partial(study.build, *pair, ensemble.group)) for pair in study.pairs}
    recorders: dict[str, Recorder] = {}
    why = study.unchecked
    checked = [pair for pair in study.pairs if not why.get(pair[0], "none")]

    motions = {pair: found for pair in study.pairs if (found := study.shared(*pair)) is not None}

    def task(evaluate: Evaluate) -> xr.Dataset:
        shared = {pair: motion.errors_by(evaluate.on(f"{'/'.join(pair)}/{MOVED}")) for pair, motion in motions.items()}

        def recorded(name: str, group: str) -> Evaluate:
            recorders[f"{name}/{group}"] = Recorder(evaluate.on(f"{name}/{group}"))
            return recorders[f"{name}/{group}"]

        def free(name: str, group: str) -> Evaluate:
            # What nested sampling solves is too much, and too cheap, to keep.
            return SerialEvaluate(study.build(name, group), ensemble.count)

        def finer(name: str, group: str) -> Finer:
            if (name, group) not in checked:
                return Finer(None, why[name])
            return solved_by(recorders[f"{name}/{group}"].on(f"{name}/{group}/{FINER}"))

        look = finer if why else None

        def itself(name: str, group: str) -> ForwardModel:
            return makers[name, group]()

        method = study.method
        return method.run(study.models, study.data_groups, recorded, free, look, ensemble.say, shared or None, itself)

    def labelled(found: xr.Dataset) -> xr.Dataset:
        found = found.assign_attrs(quantity=study.data.quantity)
        if "mesh_checked" in found:
            found = found.assign(mesh_of_file=("model", [str(name) in study.of_files for name in found.model.values]))
        candidates = {name: candidate.inputs for name, candidate in study.candidates.items()}
        units = {name: study.units_of(name) for name in candidates}
        doubts = doubts_of_selection(found, candidates, study.method.noise.factor, units)
        wrong = {name: contradictions(study, name, make) for (name, _), make in makers.items()}
        of_wrong = [name for name, several in wrong.items() if several]
        judged = trusted_on_meshes(with_right_derivatives(found, of_wrong))
        add(judged, *findings(found), *untrusted(found, judged, of_wrong), *doubts)
        add(judged, *(one for several in wrong.values() for one in several))
        return judged

    others: dict[str, Callable[[], ForwardModel]] = {f"{name}/{group}": make for (name, group), make in makers.items()}
    finer_ones = {f"{n}/{g}/{FINER}": partial(study.build_finer, n, makers[n, g], ensemble.group) for n, g in checked}
    moved_ones = {f"{n}/{g}/{MOVED}": partial(_moved, study, makers[n, g], one) for (n, g), one in motions.items()}
    first = makers[study.pairs[0]]()
    return MethodJob(
        first,
        others | finer_ones | moved_ones,
        task,
        recorders,
        labelled=labelled,
        arviz_groups=partial(arviz_groups, study),
        costly=study.costly,
        passing=frozenset(finer_ones),
    )
