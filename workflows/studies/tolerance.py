"""A mesh that is fine enough for a tolerance of all errors: found before a study samples, and kept with its results.

On each mesh, the model is linearised at the mean of its parameters and the error of the mesh is estimated at a few:
what is then not known of the error of means and standard deviations, which is left when they are corrected, is held
against the tolerance. The mesh that is given is kept where that leaves enough for sampling. Otherwise cells are divided
so that it will, by the rate at which errors fall; of all such numbers of cells (and of estimates, which are few) the
cheapest is taken, by predicted times: those of samples, whose number grows as a mesh takes more of the tolerance, and
of estimates. Tetrahedra are refined where errors arise (`forward.fem.adapt`).

All of this depends on the study only. Blocks of solves are those of the study on that mesh, which finds them again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.adapt import OF_ROUNDING, Adapt
from forward.machine import MIB, StopError, write_text
from forward.model import FloatArray, SolveError
from uq.accuracy.effects import with_mesh_errors
from uq.accuracy.mesh_errors import MeshErrors, estimate
from uq.estimators.estimate import ESTIMATED, estimate_of
from uq.estimators.moments import Z
from uq.evaluation.checkpoint import Checkpoint
from uq.evaluation.evaluate import Recorder
from uq.evaluation.request import Evaluate
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.surrogates.linearisation import Linearisation, linearise, local_dataset
from workflows.studies.adapted_mesh import FILES as ADAPTED
from workflows.studies.adapted_mesh import on_adapted_mesh
from workflows.studies.predictions import times_of
from workflows.studies.tolerance_asked import (
    AIM,
    COUNTS,
    HOPELESS,
    RATE,
    STEP,
    Assessed,
    cells,
    factor,
    goal,
    least_share,
    most_unknowns,
    out_of_reach,
    rate_of,
    refinement,
)

if TYPE_CHECKING:
    import xarray as xr

    from forward.spec import ModelSpec
    from uq.evaluation.ensemble import Ensemble
    from workflows.studies.sampling_blocks import S, SamplingBlocks

FILE = "tolerance.json"
KEPT = 0.8  # of the tolerance: what a mesh may take that was not predicted (`AIM`: one that is)
BETWEEN = 0.1  # error of a mesh between the given one and one that may be out of reach, over that of the former
OF_ADAPTED = 0.4  # the same of one that is refined where errors arise, which stops soon below what it is asked for
MOST_MESHES = 4
FAR = 2.0  # times as many cells: farther, an assumed rate says too little
DOUBLED = 1.9  # times as many cells, where nothing is known: then a mesh may do
LARGEST = 16.0  # times as many cells along an edge
POINTS = 4096  # at which tangents are drawn
SAMPLES = {True: (30.0, 0.5), False: (1000.0, 1.5)}  # of expansions and others: number, and power of what is left


def on_fine_mesh(
    study: S, ensemble: Ensemble, directory: Path, say: Callable[[str], None], identity: Callable[[S], str]
) -> S:
    """Return the study on a mesh that is fine enough, or on the finest that there may be; collective.

    Parameters
    ----------
    identity
        All that evaluations of a study depend on, which blocks on disk are found by.

    Raises
    ------
    StopError
        If meshes seen so far say that memory ends far from the tolerance.
    """
    world, path = ensemble.world, directory.resolve() / FILE
    told = world.bcast(_read(path) if world.rank == 0 else None)
    first, meshes, count = study, list[Assessed](), COUNTS[0]
    if told is None:
        _forget(study, world, directory)
    while told is None:
        meshes.append(_assessed(study, ensemble, Checkpoint(directory, identity(study)), count))
        say(_line(meshes[-1]))
        finer, count, why = _next(study, first, meshes)
        if finer is None:
            told = {
                "meshes": [one.document for one in meshes],
                "why": why,
                "body": _body(study, first),
                "estimates": count,
            }
            if world.rank == 0:
                write_text(path, json.dumps(told, indent=2, ensure_ascii=False) + "\n")
            return study
        if finer is not study.model and (said := out_of_reach(study, first, meshes)):
            raise StopError(said)
        if finer.unrefined:
            _forget(first, world, directory)
        study = _refined(study, finer, ensemble, directory, say)
    changed = told["body"]
    if "adapt" in changed:
        return _refined(study, _adapting(study, changed["adapt"]), ensemble, directory, say)
    if not changed:
        return study
    body = study.solid.body
    body = body.model_validate(body.model_dump(exclude={"contents"}) | changed)
    return study.of(study.model.model_copy(update={"body": body}))


def _forget(first: SamplingBlocks, world: Any, directory: Path) -> None:
    """Remove the mesh of an attempt that was given up or interrupted, unless the study itself asked for it."""
    if world.rank == 0 and not first.model.adaptive:
        for name in ADAPTED:
            (directory / name).unlink(missing_ok=True)


def history(directory: Path) -> dict[str, Any] | None:
    """Return how the mesh of a study was found, which stands beside its results; None where it was not looked for."""
    return _read(directory.resolve() / FILE)


def meshes_before(directory: Path) -> list[dict[str, Any]]:
    """Return the meshes that were looked at before the last one, the estimates on which are those of the study."""
    told = history(directory)
    return [] if told is None else list(told["meshes"][:-1])


def _read(path: Path) -> dict[str, Any] | None:
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    return found


def _body(study: SamplingBlocks, first: SamplingBlocks) -> dict[str, Any]:
    """What of the body was changed."""
    if study.model is first.model:
        return {}
    if study.model.adaptive:
        return {"adapt": study.solid.adapt.tolerance}
    body = study.solid.body
    return {"levels": body.levels} if hasattr(body, "levels") else {"cells": body.cells}


def _refined(study: S, model: ModelSpec, ensemble: Ensemble, directory: Path, say: Callable[[str], None]) -> S:
    """Return the study of a model, whose mesh may have to be refined first; collective."""
    if not model.unrefined:
        return study.of(model)
    return on_adapted_mesh(study.of(model), ensemble, directory, say)


# --- what a mesh takes -----------------------------------------------------------------------------------------------


class Found:
    """The model at the mean of its parameters, and the error of its mesh at a few.

    Attributes
    ----------
    centre, errors
        Those.
    doubts
        What is not known of the error of means and standard deviations (2, m), by what tangents say of the outputs;
        zero where there is no estimate.
    close
        The part of it that more estimates would leave (2, m).
    dataset
        Means and standard deviations by tangents, with these errors.
    """

    def __init__(
        self, study: SamplingBlocks, inputs: Inputs, evaluate: Evaluate, centre: Linearisation, count: int = COUNTS[0]
    ) -> None:
        fields = getattr(study.method, "fields", True) and centre.state.size > 0
        self.centre = centre
        self.errors: MeshErrors = estimate(
            inputs, evaluate, centre, count, getattr(study.method, "seed", 0), fields=fields
        )
        points = inputs.points(sobol_points(0, 0, 0, POINTS, len(inputs.names)))
        drawn = centre.middle + inputs.coordinates.of(points) @ centre.output_slopes.T
        zero = np.zeros(len(centre.outputs))
        moments = {"mean": drawn.mean(axis=0), "mean_error": zero, "std": drawn.std(axis=0), "std_error": zero}
        dataset = local_dataset(inputs, evaluate, centre, fields=False)
        dataset = dataset.assign({name: (("output",), values) for name, values in moments.items()})
        self.dataset = with_mesh_errors(dataset, inputs, centre, self.errors, study.told)
        self.doubts = doubts(self.dataset)
        errors = np.abs([estimate_of(self.dataset, name).mesh for name in ESTIMATED])
        self.close = np.nan_to_num(self.dataset["mesh_error_unknown"].to_numpy() * errors)


def doubts(dataset: xr.Dataset) -> FloatArray:
    """Return what is not known of the error of the mesh in means and standard deviations (2, m); zero without one."""
    return np.nan_to_num([estimate_of(dataset, name).doubt for name in ESTIMATED])


def _assessed(study: SamplingBlocks, ensemble: Ensemble, checkpoint: Checkpoint, count: int) -> Assessed:
    """Estimate what the mesh of a study takes of the tolerance; collective."""
    model = ensemble.together(lambda: study.spec.build(ensemble.group, study.inputs.names))

    def task(evaluate: Evaluate) -> Assessed | Exception:
        recorder, inputs = Recorder(evaluate), study.inputs
        try:
            centre = linearise(inputs, recorder)
        except (SolveError, ValueError) as error:  # for all ranks, which wait for what comes of it
            return error
        found = None
        with suppress(SolveError):
            found = Found(study, inputs, recorder, centre, count)
        shares, close, relative, means = np.full((2, 1), np.inf), None, np.inf, list[tuple[str, float, float, float]]()
        if found is not None and found.errors.evaluations.ok.sum() > 1:
            asked, data = goal(study), found.dataset
            sizes = asked.sizes(data["mean"].to_numpy(), data["std"].to_numpy())
            shares, close = (Z * part / (asked.tolerance * sizes) for part in (found.doubts, found.close))
            mean = estimate_of(data, "mean")
            rows = zip(recorder.outputs, *(x.tolist() for x in (mean.value, mean.mesh, mean.doubt)), strict=True)
            means = [row for row in rows if np.isfinite(row[2])]
            relative = float((np.nan_to_num(np.abs(estimate_of(data, "nominal").mesh)) / sizes[0]).max())
        row, column = np.unravel_index(int(np.argmax(shares)), shares.shape)
        return Assessed(
            study.spec.unknowns,
            cells(study),
            count,
            float(shares.max()),
            len(inputs.names),
            recorder.outputs[column],
            ("mean", "standard deviation")[row],
            [] if close is None else close.tolist(),
            [] if close is None else np.sqrt(np.maximum(shares**2 - close**2, 0.0)).tolist(),
            relative,
            means,
            recorder.solves,
            recorder.seconds,
        )

    found = ensemble.run(model, task, checkpoint=checkpoint, blocks=study.parallel.blocks)
    result: Assessed | Exception = ensemble.world.bcast(found)
    if isinstance(result, Exception):
        raise result
    return result


def _line(one: Assessed) -> str:
    if one.share == np.inf:
        return f"mesh of {one.unknowns:,} unknowns: too coarse for an estimate of its error"
    return f"mesh of {one.unknowns:,} unknowns: takes {one.share:.2g} of the tolerance ({one.of} of {one.output})"


# --- which mesh is next ----------------------------------------------------------------------------------------------


def _next(
    study: SamplingBlocks, first: SamplingBlocks, meshes: Sequence[Assessed]
) -> tuple[ModelSpec | None, int, str]:
    """Return the model on the next mesh and the number of estimates on it, and why that is so.

    None in place of a model where the last mesh is taken.
    """
    now = meshes[-1]
    takes = f"the mesh of {now.unknowns:,} unknowns takes {100 * now.share:.0f} % of the tolerance once corrected"
    how, words = refinement(first)
    if how != "cells":
        if now.share <= KEPT:
            return None, now.estimates, takes
        more = [c for c in COUNTS if c > now.estimates and now.share_with(1.0, c) <= AIM]
        if more:
            return study.model, more[0], ""
        if not how:
            return None, now.estimates, f"{takes}; it {words}"
        before = study.solid.adapt
        if before is not None and (len(meshes) > MOST_MESHES or study.spec.unknowns * STEP > before.unknowns):
            return None, now.estimates, f"{takes}; finer ones would take more than {_memory(study)}"
        error = now.relative if before is None else before.tolerance
        to = 0.1 if now.share == np.inf else float(np.clip(error * OF_ADAPTED / now.share, OF_ROUNDING, 0.5))
        if len(meshes) == 1 and now.close and least_share(first, now, RATE) > HOPELESS:
            to = max(to, min(BETWEEN * error, 0.5))  # it may be out of reach: a mesh between them tells the rate
        return _adapting(first, to), COUNTS[0], ""
    if len(meshes) > MOST_MESHES and now.share > KEPT:
        return None, now.estimates, f"{takes}, and {len(meshes)} meshes are enough"
    ways = list(_ways(study, now, rate_of(meshes)))
    here = [way for way in ways if way.times == 1 and way.estimates == now.estimates and way.share <= KEPT]
    enough = [*here, *(way for way in ways if way.share <= AIM)]
    best = min(enough, key=lambda way: way.seconds) if enough else min(ways, key=lambda way: way.share)
    if best.times == 1 and best.estimates == now.estimates:
        rest = "" if enough else f"; finer ones would take more than {_memory(study)}"
        return None, now.estimates, takes + rest
    if len(meshes) == 1 and best.times > FAR:  # a mesh between them costs little, and tells the rate
        between = next(way for way in ways if way.times >= best.times**0.5)
        return between.model, COUNTS[0], ""
    return best.model, best.estimates, ""


def _memory(study: SamplingBlocks) -> str:
    return f"accuracy.memory = {study.accuracy.memory:,.0f} MiB"


@dataclass(frozen=True)
class _Way:
    """A mesh that might be taken, its share of the tolerance, and the predicted time (s) of the study on it."""

    times: float
    model: ModelSpec
    estimates: int
    share: float
    seconds: float


def _ways(study: SamplingBlocks, now: Assessed, rate: float) -> Iterator[_Way]:
    """Go through the meshes with more and more cells for which there is memory, from the given one on."""
    few, power = SAMPLES[study.method.kind in ("automatic", "chaos") and study.inputs.independent]
    seen, times = set[int](), 1.0
    while times <= LARGEST:
        try:
            model = study.model if times == 1 else study.model.finer(times)
        except ValueError:  # too large
            return
        other = study.of(model)
        times *= STEP
        if other.spec.unknowns in seen:
            continue
        seen.add(other.spec.unknowns)
        cost, estimating = times_of(other.spec), other.spec.mesh_error_cost()
        assert estimating is not None
        if cost.bytes + estimating.bytes > MIB * study.accuracy.memory and model is not study.model:
            return
        finer = factor(cells(study), cells(other))
        for count in COUNTS:
            if model is study.model and count < now.estimates:
                continue
            share = now.share_with(finer**rate, count)
            if not now.close and finer > DOUBLED:
                share = AIM
            samples = few / max(1 - share**2, 0.05) ** (power / 2)
            estimates = estimating.once + count * (cost.sample + estimating.seconds)
            seconds = cost.first + samples * cost.sample + estimates
            yield _Way(1.0 if model is study.model else finer, model, count, share, seconds)


def _adapting(study: SamplingBlocks, tolerance: float) -> ModelSpec:
    """Return the model with a mesh that is refined until its relative error is so much, or memory ends."""
    found: ModelSpec = study.model.model_copy(
        update={"adapt": Adapt(tolerance=tolerance, unknowns=most_unknowns(study))}
    )
    return found
