"""The run of a study: the one place where model, method and MPI meet."""

from __future__ import annotations

import json
import os
import platform
import sys
import time
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from forward.external.own_modules import Loaded
from forward.machine import StopError, headroom, out_of_memory, reason_to_stop
from forward.model import Stability
from forward.spec import ModelSpec
from uq.estimators import branch
from uq.evaluation.evaluate import OWN, Evaluate, Evaluations, Recorder
from uq.findings import add, findings
from uq.inputs.sampling import random_points
from workflows.config.study import WITHOUT_EFFECT, Study, StudyError, differences, document, dump
from workflows.report import words
from workflows.results.directory import (
    above_rounding,
    blank_where_still,
    digest,
    label,
    read_dataset,
    read_summary,
    with_norms,
    with_random_fields,
    with_regions,
    write_dataset,
    write_fields,
    write_text,
)
from workflows.results.norms import node_volumes
from workflows.results.summary import inverted, summarise
from workflows.run import own_code
from workflows.run.plan import memory, of_program, shortage
from workflows.run.progress import Progress
from workflows.run.version import commit, version, versions
from workflows.studies.findings_solves import findings_of_solves, measured
from workflows.studies.job import Job, MethodJob

if TYPE_CHECKING:
    import xarray as xr

    from forward.fem.model import HyperelasticModel
    from forward.model import FloatArray, ForwardModel
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from uq.evaluation.tasks import Outcome
    from uq.inputs.random_parameters import Inputs
    from workflows.config.study import AnyStudy

DONE, FAILED, BAD, PARTIAL = 0, 1, 2, 3  # exit codes
REALISATIONS = 3  # of random fields, to look at
_STOPPED = {"select": "all evidences found", "invert": "all data sets inverted", "synthesize": "all data made"}
LISTED = 50  # failures that summary.json lists; evaluations.h5 has all


def run(study: AnyStudy, name: str, directory: Path, *, quiet: bool = False, report: bool = True) -> int:
    """Run a study, or continue it, and leave its results in a directory; collective over all ranks of the job.

    Parameters
    ----------
    study
        What to compute.
    name
        Name of the study in results.
    directory
        Where results go; made if it does not exist.
    quiet
        Print nothing but errors.
    report
        Whether report.html is written.

    Returns
    -------
    int
        Exit code: 0 done, 3 finished but some solves failed or a number cannot be trusted (on rank 0; 0 on the
        others).

    Raises
    ------
    StudyError
        If the directory holds another study or cannot be written, or if there is less work than groups of ranks.
    ModelError
        If the model cannot be made.
    SolveError
        If the study cannot be finished because the model has no answer.
    StopError
        If there is no memory, or no room on disk; what is finished is kept.

    Notes
    -----
    Where it fails before anything is solved, the directory is left as it was.
    """
    try:
        return _run(study, name, directory, quiet=quiet, report=report)
    except Exception as error:
        if isinstance(error, StopError) or not out_of_memory(error):
            raise
        reason = reason_to_stop(error, memory(study) + of_program(headroom()))
        raise StopError(reason) from error


def _run(study: AnyStudy, name: str, directory: Path, *, quiet: bool, report: bool) -> int:
    from mpi4py import MPI

    world = MPI.COMM_WORLD
    begin = time.monotonic()
    loaded = Loaded() if own_code.modules(study) else None
    finished = _agreed(world, lambda: _prepare(study, directory, world.size))
    if finished is not None:
        if world.rank == 0:
            if report and not (directory / "report.html").exists():
                _report(directory)
            if not quiet:
                sys.stdout.write(f"{directory}: finished before, nothing to do\n")
        return int(finished)

    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble

    ensemble = Ensemble.split(world, study.parallel.ranks_per_model)
    _warn_of_memory(study, world, quiet=quiet)
    planned = study.solves if hasattr(study, "solves") else study.planned
    progress = Progress(planned, quiet=quiet or world.rank > 0, failures=not _explains(study))
    checkpoint = Checkpoint(directory, json.dumps([_identity(study), version()]), loaded)
    try:
        job = ensemble.together(lambda: _job(study, ensemble, name, directory, checkpoint))
        if world.rank == 0:
            own_code.keep(directory, study, loaded)
        dataset = job.run(ensemble, checkpoint, progress, study.parallel.blocks)
    except BaseException:
        if world.rank == 0:
            _withdraw(directory)
        raise
    if dataset is None:
        return DONE
    progress.close()
    dataset = above_rounding(blank_where_still(with_norms(job.labelled(dataset))))
    add(dataset, *study.findings)
    dataset.attrs |= {"study": name, "method": study.method.kind, "tissuq": version(), "config": dump(study)}
    evaluations = job.evaluations
    own_code.keep(directory, study, loaded)
    add(dataset, *(findings_of_solves(evaluations.values()) if _explains(study) else ()))
    if isinstance(study, Study):
        dataset = _with_stability(study, dataset, evaluations["/"])
    wall = time.monotonic() - begin
    summary = _summary(study, name, dataset, evaluations, job.outcomes, world.size, ensemble.groups, wall)
    if isinstance(study, Study) and len(study.meshes) > 1:
        summary["meshes"] = _meshes(study, job)
    _leave(directory, dataset, evaluations, summary, checkpoint, job)
    if report:
        _report(directory)
    if not quiet:
        sys.stdout.write(_closing_words(directory, dataset, summary))
    return exit_code(summary)


def _with_stability(study: Study, dataset: xr.Dataset, evaluations: Evaluations) -> xr.Dataset:
    """Add how the stability of each sample was looked at, and say where there is no answer."""
    continued = "loo_error" in dataset or getattr(study.method, "control", None) == "chaos"
    add(dataset, *branch.findings(study.inputs, evaluations, continued=continued))
    if not branch.counts([evaluations]):
        return dataset
    if "points" in dataset and dataset.points.dims == ("sample", "parameter"):
        known = branch.by_sample(dataset.points.to_numpy(), evaluations)
        meanings = ", ".join(f"{one.value}: {one.name.lower().replace('_', ' ')}" for one in Stability)
        dataset = dataset.assign(stability=("sample", known, {"meanings": meanings}))
    return dataset


def _warn_of_memory(study: AnyStudy, world: Any, *, quiet: bool) -> None:
    """Say on the first rank that the memory of its machine may not do; collective."""
    from mpi4py import MPI

    here = world.Split_type(MPI.COMM_TYPE_SHARED)
    short = shortage(study, max(1, here.size // study.parallel.ranks_per_model))
    here.Free()
    if short is not None and world.rank == 0 and not quiet:
        sys.stderr.write(f"{short.severity}: {short.text}\n")


def exit_code(summary: Mapping[str, Any]) -> int:
    """Return the exit code of a finished study: 3 where solves failed, or where a number cannot be trusted."""
    doubtful = any(one["severity"] == "error" for one in summary.get("findings", ()))
    return PARTIAL if summary["failed"] or doubtful else DONE


def _agreed(world: Any, prepare: Callable[[], int | None]) -> int | None:
    """Return on all ranks what rank 0 finds, or raise there what it raises."""
    refusal: Exception | None = None
    found = None
    if world.rank == 0:
        try:
            found = prepare()
        except (StudyError, StopError) as error:
            refusal = error
    refusal, found = world.bcast((refusal, found))
    if refusal is not None:
        raise refusal
    return found  # type: ignore[no-any-return]


def _leave(
    directory: Path,
    dataset: xr.Dataset,
    evaluations: dict[str, Evaluations],
    summary: dict[str, Any],
    checkpoint: Checkpoint,
    job: Job,
) -> None:
    """Write all results, in an order that a kill cannot spoil."""
    write_dataset(directory / "results.nc", dataset, job.groups(dataset))
    write_fields(directory / "fields", dataset)
    for name, text in job.texts(dataset).items():
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        write_text(directory / name, text)
    checkpoint.consolidate(evaluations)
    # The summary says that the study is finished: only then may the blocks go.
    summary["provenance"]["results_sha256"] = digest(directory)
    write_text(directory / "summary.json", json.dumps(summary, indent=2, ensure_ascii=False) + "\n")
    checkpoint.clear()


def _report(directory: Path) -> None:
    from workflows.report.page import write_report

    write_report(directory)


def _job(study: AnyStudy, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
    if isinstance(study, Study):
        return _sampling(study, ensemble)
    from workflows.studies.inversion import InversionStudy
    from workflows.studies.synthesis import Synthesis

    if isinstance(study, InversionStudy):
        from workflows.studies import inversion_job

        return inversion_job.job(study, ensemble, directory, checkpoint)
    if isinstance(study, Synthesis):
        from workflows.studies import synthesis

        return synthesis.job(study, ensemble, name)
    from workflows.studies import selection_job

    return selection_job.job(study, ensemble)


def _sampling(study: Study, ensemble: Ensemble) -> Job:
    """One model, and others that the method may want, at the points of a method; collective over the group."""
    inputs, units = study.inputs, {output.name: output.unit for output in study.model.outputs}
    recorders: dict[str, Recorder] = {}

    def task(evaluate: Evaluate) -> xr.Dataset:
        recorders["/"] = Recorder(evaluate)
        method = study.method.with_sources(lambda place: read_dataset(Path(place)))
        return method.run(inputs, recorders["/"])

    others: dict[str, Callable[[], ForwardModel]] = {
        name: partial(other.build, ensemble.group, inputs.names) for name, other in study.models.items()
    }
    function = study.spec.build(ensemble.group, inputs.names)
    if not study.spec.meshed:
        return MethodJob(function, others, task, recorders, lambda found: label(found, units, None, None, 0))

    model = cast("HyperelasticModel", function)
    # Rank 0 may leave the task by an exception: nothing that needs the other ranks may follow it.
    cells, kind = model.space.cells()
    regions = model.space.regions()
    factors = _factors(study, inputs, model) if ensemble.index == 0 else {}
    locking = measured(study, model) if ensemble.index == 0 else []

    def labelled(found: xr.Dataset) -> xr.Dataset:
        found = label(found, units, model.space.coordinates, cells, kind)
        add(found, *locking)
        found = with_regions(found, model.spec.body.regions, regions)
        return with_random_fields(found, factors, model.space.variance_kept)

    volumes = partial(node_volumes, model.space.coordinates, cells)
    return MethodJob(model, others, task, recorders, labelled, node_volumes=volumes)


def _identity(study: AnyStudy) -> dict[str, Any]:
    """Return what decides on evaluations."""
    blocks = {key: value for key, value in document(study).items() if key not in WITHOUT_EFFECT}
    source = own_code.digest(study)
    if source is not None:
        blocks["source"] = source
    if isinstance(model := getattr(study, "model", None), ModelSpec):
        blocks["model"] = model.identity()
    return blocks


def _prepare(study: AnyStudy, directory: Path, ranks: int) -> int | None:
    """Check ranks and directory, and write study.toml; return the exit code of a study that is finished already."""
    share = study.parallel.ranks_per_model
    if ranks % share:
        message = f"parallel.ranks_per_model: {ranks} ranks were started, expected a multiple of {share}"
        raise StudyError(message)
    groups, blocks = ranks // share, min(max(study.planned - 1, 1), study.parallel.blocks)
    if groups > blocks and not isinstance(
        study, Study
    ):  # tasks that each take minutes: someone who waits is no mistake
        _note(f"{groups} groups of ranks were started for {blocks} tasks: {groups - blocks} have nothing to do")
    elif groups > blocks:
        message = (
            f"{ranks} ranks were started as {groups} groups, but the study has work for {blocks} only: "
            f"start mpirun -n {blocks * share}, or set parallel.blocks or parallel.ranks_per_model"
        )
        raise StudyError(message)
    kept = directory / "study.toml"
    try:
        if kept.exists():
            changes = differences(tomllib.loads(kept.read_text(encoding="utf-8")), document(study))
            if changes:
                message = f"{directory}: holds another study ({'; '.join(changes[:5])}); choose another --out"
                raise StudyError(message)
        elif directory.exists() and any(directory.iterdir()):
            message = f"{directory}: is not empty and holds no study, expected a new directory or one of this study"
            raise StudyError(message)
        directory.mkdir(parents=True, exist_ok=True)
        if not os.access(directory, os.W_OK | os.X_OK):
            message = f"{directory}: cannot be written: permission denied"
            raise StudyError(message)
        for leftover in [*directory.glob(".*.*"), *directory.glob("evaluations/.*")]:
            leftover.unlink()
        _keep_study(directory, study)
    except tomllib.TOMLDecodeError:
        message = f"{kept}: is not a study, expected a directory of this study"
        raise StudyError(message) from None
    except OSError as error:
        reason = reason_to_stop(error)
        if reason is not None:
            raise StopError(reason) from None
        message = f"{directory}: cannot be written: {error.strerror}"
        raise StudyError(message) from None
    own_code.refuse_other(directory, study)
    return _finished(directory)


def _keep_study(directory: Path, study: AnyStudy) -> None:
    """Write study.toml, also where it differs in what is asked of the report, which is then made again."""
    kept = directory / "study.toml"
    if not kept.exists():
        write_text(kept, dump(study))
    elif tomllib.loads(kept.read_text(encoding="utf-8")).get("report") != document(study).get("report"):
        write_text(kept, dump(study))
        (directory / "report.html").unlink(missing_ok=True)


def _finished(directory: Path) -> int | None:
    """Return the exit code of a study that is finished; None for any other, and where its results are lost."""
    summary = read_summary(directory)
    if summary is None:
        return None
    expected = summary["provenance"].get("results_sha256")  # earlier versions did not keep it
    try:
        if expected is None:
            read_dataset(directory)
        intact = expected is None or digest(directory) == expected
    except FileNotFoundError:
        intact = False
    if not intact:
        sys.stderr.write(f"{directory / 'results.nc'}: missing or damaged, the study is computed again\n")
        return None
    return exit_code(summary)


def _note(text: str) -> None:
    sys.stderr.write(f"note: {text}\n")
    sys.stderr.flush()


def _withdraw(directory: Path) -> None:
    """Remove what `_prepare` has made, if nothing else is there: the study, corrected, may go to the same place."""
    made = ("study.toml", own_code.FILE)
    if {path.name for path in directory.iterdir()} <= set(made):
        for name in made:
            (directory / name).unlink(missing_ok=True)
        directory.rmdir()


def _factors(study: Study, inputs: Inputs, model: HyperelasticModel) -> dict[str, FloatArray]:
    """Return the factors (n, nodes) of the random fields in a few realisations, on rank 0; collective over its group.

    They are the first samples of Monte Carlo with the seed of the study.
    """
    if not study.model.coefficients:
        return {}
    seed = getattr(study.method, "seed", 0)
    return model.space.factors(inputs.points(random_points(seed, 0, REALISATIONS, len(inputs.names))))


def _summary(
    study: AnyStudy,
    name: str,
    dataset: xr.Dataset,
    evaluations: dict[str, Evaluations],
    outcomes: Sequence[Outcome],
    ranks: int,
    groups: int,
    wall: float,
) -> dict[str, Any]:
    from forward.model import WORK

    every = evaluations.values()
    done = _of_tasks(outcomes, every) if outcomes else _of_solves(study, evaluations)
    seconds = sum(one.seconds for one in outcomes) or float(sum(found.seconds.sum() for found in every))
    source = own_code.digest(study)
    stability = branch.counts(every)
    return {
        "study": name,
        "method": study.method.kind,
        "status": "partial" if done["failed"] else "complete",
        "stopped": dataset.attrs.get("stopped", _STOPPED.get(study.method.kind, "one linearisation")),
        **({"note": dataset.attrs["note"]} if "note" in dataset.attrs else {}),
        "findings": [one._asdict() for one in findings(dataset)],
        **done,
        **({"stability": stability} if stability else {}),
        "wall_seconds": wall,
        "cpu_seconds": seconds * study.parallel.ranks_per_model,
        "work": dict(zip(WORK, sum(found.work.sum(axis=0) for found in every).tolist(), strict=True)),
        **summarise(dataset),
        "provenance": {
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "seed": getattr(study.method, "seed", None),
            "ranks": ranks,
            "groups": groups,
            "processor": platform.machine(),
            "commit": commit(),
            **({} if source is None else {"source": source}),
            "versions": {"python": platform.python_version(), **versions()},
        },
    }


def _of_solves(study: AnyStudy, evaluations: Mapping[str, Evaluations]) -> dict[str, Any]:
    """Number of solves, and which failed."""
    explains = _explains(study)
    failed = [
        (label, failure)
        for label, found in evaluations.items()
        for failure in found.failures
        if not (explains and failure.inadmissible)
    ]
    return {
        "evaluations": sum(len(found.points) for found in evaluations.values()),
        "failed": len(failed),
        **({"zero_likelihood": _unlikely(evaluations.values())} if explains else {}),
        "failures": [
            {
                **({} if label == "/" else {"model": label}),
                "parameters": dict(zip(_parameters(study, label), failure.parameters, strict=True)),
                "reason": failure.reason,
            }
            for label, failure in failed[:LISTED]
        ],
    }


def _of_tasks(outcomes: Sequence[Outcome], evaluations: Iterable[Evaluations]) -> dict[str, Any]:
    """Number of data sets that were inverted side by side, and which failed."""
    failed = [(number, one.reason) for number, one in enumerate(outcomes) if one.dataset is None]
    return {
        "evaluations": len(outcomes),
        "failed": len(failed),
        "zero_likelihood": _unlikely(evaluations),
        "failures": [{"parameters": {"data_set": float(k)}, "reason": reason} for k, reason in failed[:LISTED]],
    }


def _unlikely(evaluations: Iterable[Evaluations]) -> int:
    """Number of solves at parameters for which there is no model."""
    return sum(failure.inadmissible for found in evaluations for failure in found.failures)


def _explains(study: AnyStudy) -> bool:
    """Whether data are explained: then parameters without a model have no likelihood, which is an answer too."""
    return not isinstance(study, Study) and study.method.kind != "synthesize"


def _meshes(study: Study, job: Job) -> list[dict[str, Any]]:
    """What was solved on each mesh, and what it took."""
    assert isinstance(job, MethodJob)
    recorder = job.recorders["/"]
    found = []
    for name, mesh in zip([OWN, *study.models], study.meshes, strict=True):
        parts = [part for part, model in zip(recorder.log, recorder.models, strict=True) if model == name]
        if not parts:  # it was not needed
            continue
        seconds = float(sum(part.seconds.sum() for part in parts)) * study.parallel.ranks_per_model
        solves = sum(len(part.points) for part in parts)
        found.append({"unknowns": mesh.unknowns, "solves": solves, "cpu_seconds": seconds})
    return found


def _parameters(study: AnyStudy, label: str) -> tuple[str, ...]:
    """Names of the parameters of a model by the name that its evaluations are kept under."""
    if isinstance(study, Study):
        return study.inputs.names
    from workflows.studies.inversion import InversionStudy
    from workflows.studies.synthesis import Synthesis

    if isinstance(study, InversionStudy | Synthesis):
        return study.inputs.names
    return tuple(study.candidates[label.partition("/")[0]].parameters)


def _closing_words(directory: Path, dataset: xr.Dataset, summary: dict[str, Any]) -> str:
    lines = [
        f"{model}: ln Z {found['log_evidence']:.2f} ± {found['log_evidence_error']:.2g}, "
        f"probability {found['probability']:.3g}"
        for model, found in summary.get("models", {}).items()
    ]
    lines += inverted(summary)
    for output, values in summary.get("outputs", {}).items():
        unit = dataset.unit.sel(output=output).item()
        lines.append(
            f"{output}: mean {values['mean']:.6g} ± {values['mean_error']:.2g} {unit}, "
            f"standard deviation {values['std']:.4g} ± {values['std_error']:.2g} {unit}"
        )
        if "bias_error" in values:
            lines[-1] += (
                f"; error of the mesh about {values['bias_error']:.2g} and {values['std_bias_error']:.2g} {unit}"
            )
    first = next(iter(dataset.output.values)) if "output" in dataset.coords else ""
    for name, rows in summary.get("methods", {}).items():
        last = rows[-1]
        lines.append(
            f"{name}: {last['cost']} solves, {last['cpu_seconds']:.3g} s, "
            f"root mean square error of the mean of {first} {last['error'] or float('nan'):.2g}"
        )
    if not lines:
        for output, slopes in summary.get("local_per_range", {}).items():
            shown = ", ".join(f"{p} {v:.4g}" for p, v in slopes.items() if v is not None)
            lines.append(f"{output}: derivative × range of the parameter: {shown}")
    failed = f"{summary['failed']}{' data sets' if len(summary.get('data_sets', ())) > 1 else ''} failed"
    lines.append(f"{words.counted(words.solves(summary))} in {summary['wall_seconds']:.1f} s, {failed}")
    if "stability" in summary:
        lines.append(words.stability(summary["stability"]))
    if "note" in summary:
        lines.append(summary["note"])
    lines += [f"{one['severity']}: {one['text']}" for one in summary["findings"]]
    if (directory / "report.html").exists():
        lines.append(f"report: {directory / 'report.html'}")
    return "\n".join(lines) + "\n"
