"""The run of a study: the one place where model, method and MPI meet."""

from __future__ import annotations

import fcntl
import json
import os
import signal
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from threading import Thread, Timer
from typing import TYPE_CHECKING, Any

from forward.external.own_modules import SESSION, Loaded
from forward.machine import (
    INTERRUPTED,
    StopError,
    forget_interruptions,
    headroom,
    interrupt,
    out_of_memory,
    reason_to_stop,
    write_text,
    write_whole,
)
from forward.model import SolveError
from forward.phases import phase
from uq.evaluation.checkpoint import Checkpoint
from uq.findings import add
from workflows.config.blocks import KEPT, MESHES
from workflows.config.mistakes import StudyError
from workflows.config.study import differences, document, dump
from workflows.results.directory import completed, digest, read_dataset, read_summary, write_dataset, write_fields
from workflows.results.summary import summarised
from workflows.run import own_code
from workflows.run.closing import closing_words
from workflows.run.plan import of_program, shortage
from workflows.run.progress import Progress, in_notebook
from workflows.run.version import version
from workflows.studies.job import Job
from workflows.studies.solves import findings_of_solves

if TYPE_CHECKING:
    import xarray as xr

    from workflows.studies.study import StudyKind

SECONDS_TO_END = 5.0  # in which ranks of a run that was killed end
ENDING = (signal.SIGINT, signal.SIGTERM)
SECONDS_FOR_OTHERS = 1.5  # within which `mpirun`, if it was signalled too, ends all ranks silently
SECONDS_TO_ABORT = 2.0
DONE, PARTIAL = 0, 3  # exit codes; `workflows.__main__` has the others


def run(
    study: StudyKind, name: str, directory: Path, *, quiet: bool = False, silent: bool = False, report: bool = True
) -> int:
    """Run a study, or continue it, and leave its results in a directory; collective over all ranks of the job.

    If it fails before anything is solved, or because the model has no answer worth keeping, the directory is left as it
    was.

    Parameters
    ----------
    name
        Of the study, in its results.
    quiet
        Print only errors and, off the terminal, a line of progress a minute.
    silent
        Not even that line.

    Returns
    -------
    int
        Exit code: 0 done, 3 finished but some solves failed or a number cannot be trusted (on rank 0; 0 on the
        others).

    Raises
    ------
    StudyError
        If the directory holds another study, cannot be written, or belongs to a run that goes on.
    ModelError
        If the model cannot be made.
    SolveError
        If the study cannot be finished because the model has no answer.
    StopError
        If there is no memory, or no space on disk; finished work is kept.
    """
    try:
        with ExitStack() as held:
            return _run(study, name, directory, held, quiet=quiet or silent, silent=silent, report=report)
    except StopError:
        raise
    except Exception as error:
        if not out_of_memory(error):
            raise
        reason = reason_to_stop(error, study.memory + of_program(headroom()))
        raise StopError(reason) from error


def _run(
    study: StudyKind, name: str, directory: Path, held: ExitStack, *, quiet: bool, silent: bool, report: bool
) -> int:
    from mpi4py import MPI

    from uq.evaluation.work_queue import alone

    world = MPI.COMM_WORLD
    begin = time.monotonic()
    loaded = Loaded() if own_code.modules(study) else None
    finished = _agreed(world, lambda: _prepare(study, directory, world.size, held))
    if finished is not None:
        with alone(world):
            if world.rank == 0 and report and not (directory / "report.html").exists():
                _report(directory)
            if world.rank == 0 and not quiet:
                sys.stdout.write(f"{directory}: finished before, nothing to do\n")
        return int(finished)

    from uq.evaluation.ensemble import Ensemble

    shown = Progress(quiet=quiet, silent=silent or world.rank > 0, failures=not study.explains)
    progress, ensemble = held.enter_context(shown), Ensemble.split(world, study.parallel.ranks_per_model)
    _warn_of_memory(study, world, quiet=quiet)
    ensemble.say = _say if world.rank == 0 and not quiet else lambda _: None
    checkpoint = Checkpoint(directory, own_code.identity(study), loaded)
    try:
        study = phase("preparing")(study.prepared)(ensemble, directory, ensemble.say)
        progress.expect(study.solves)
        checkpoint = Checkpoint(directory, own_code.identity(study), loaded)
        job = ensemble.together(phase("making the model")(lambda: study.job(ensemble, name, directory, checkpoint)))
        if world.rank == 0:
            own_code.keep(directory, study, loaded)
        dataset = phase(study.method.kind)(job.run)(ensemble, checkpoint, progress, study.parallel.blocks)
    except BaseException as error:
        if world.rank == 0:
            _withdraw(directory, error, checkpoint)
        raise
    with alone(world), phase("writing results"):
        if dataset is None:
            return DONE
        progress.close()
        evaluations = job.evaluations
        dataset = completed(job.labelled(dataset))
        add(dataset, *study.findings)
        dataset.attrs |= {"study": name, "method": study.method.kind, "tissuq": version(), "config": dump(study.kept)}
        add(dataset, *(findings_of_solves(evaluations.values()) if study.explains else ()))
        dataset = job.finished(dataset, evaluations)
        own_code.keep(directory, study, loaded)
        took = time.monotonic() - begin
        summary = summarised(study, name, dataset, job, world.size, ensemble.rank_groups, took)
        _leave(study, directory, dataset, summary, checkpoint, job)
        # What was found need not wait for pictures.
        sys.stdout.write("" if quiet else closing_words(dataset, summary, study))
        sys.stdout.flush()
        if report:
            _report(directory)
        if not quiet and (directory / "report.html").exists():
            sys.stdout.write(f"report: {directory / 'report.html'}\n")
        return exit_code(summary)


def _warn_of_memory(study: StudyKind, world: Any, *, quiet: bool) -> None:
    """Warn on the first rank if the memory of its machine may not suffice; collective."""
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
    """Return rank 0's result, or raise its exception, on all ranks."""
    found: int | Exception | None = None
    if world.rank == 0:
        try:
            found = prepare()
        except (StudyError, StopError) as error:
            found = error
    found = world.bcast(found)
    if isinstance(found, Exception):
        raise found
    return found


def _leave(
    study: StudyKind, directory: Path, dataset: xr.Dataset, summary: dict[str, Any], checkpoint: Checkpoint, job: Job
) -> None:
    """Write all results, in an order that is safe against a kill."""
    write_dataset(directory / "results.nc", dataset, study.arviz_groups(dataset))
    write_fields(directory / "fields", dataset, study.units_of)
    for name, text in job.texts(dataset).items():
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        write_text(directory / name, text)
    checkpoint.consolidate(job.evaluations)
    # The summary marks the study as finished: only then may the blocks be removed.
    summary["provenance"]["results_sha256"] = digest(directory)
    write_text(directory / "summary.json", json.dumps(summary, indent=2, ensure_ascii=False) + "\n")
    checkpoint.clear()


@phase("drawing the report")
def _report(directory: Path) -> None:
    from workflows.report.page import write_report

    write_report(directory, code=True)  # it has run already


def _prepare(study: StudyKind, directory: Path, ranks: int, held: ExitStack) -> int | None:
    """Check ranks and directory, and write study.toml; return the exit code of a study that is finished already.

    Until `held` is closed, the directory belongs to this run.
    """
    share = study.parallel.ranks_per_model
    if ranks % share:
        raise StudyError(f"parallel.ranks_per_model: {ranks} ranks were started, expected a multiple of {share}")
    rank_groups, blocks = ranks // share, min(max(study.planned - 1, 1), study.parallel.blocks)
    if rank_groups > blocks:
        tasks, idle = f"{blocks} task{'s' * (blocks > 1)}", rank_groups - blocks
        _say(
            f"note: {rank_groups} groups of ranks were started for {tasks}: {idle} of them will be idle; "
            "parallel.ranks_per_model makes groups larger"
        )
    kept = directory / "study.toml"
    try:
        if kept.exists():
            changes = differences(tomllib.loads(kept.read_text(encoding="utf-8")), document(study))
            if changes:
                raise StudyError(f"{directory}: holds another study ({'; '.join(changes[:5])}); choose another --out")
        elif directory.exists() and any(directory.iterdir()):
            message = f"{directory}: is not empty and holds no study, expected a new directory or one of this study"
            raise StudyError(message)
        directory.mkdir(parents=True, exist_ok=True)
        if not os.access(directory, os.W_OK | os.X_OK):
            raise StudyError(f"{directory}: cannot be written: permission denied")
        _hold(directory, held)
        _keep_study(directory, study)
    except tomllib.TOMLDecodeError:
        raise StudyError(f"{kept}: is not a study, expected a directory of this study") from None
    except OSError as error:
        reason = reason_to_stop(error)
        if reason is not None:
            raise StopError(reason) from None
        raise StudyError(f"{directory}: cannot be written: {error.strerror}") from None
    try:
        own_code.refuse_other(directory, study)
        return _finished(directory)
    except OSError as error:  # a folder where a file should be
        raise StudyError(f"{error.filename or directory}: cannot be read: {error.strerror or error}") from None


def _hold(directory: Path, held: ExitStack) -> None:
    """Lock a directory until `held` is closed or the process ends; a StudyError if another run has it.

    File systems without locks are left alone.
    """
    handle = os.open(directory, os.O_RDONLY)
    held.callback(os.close, handle)
    begin = time.monotonic()
    while True:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > begin + SECONDS_TO_END:
                message = f"{directory}: another run is at work there; wait for its end, or choose another --out"
                raise StudyError(message) from None
            time.sleep(0.05)
        except OSError:
            return
        else:
            return


def _keep_study(directory: Path, study: StudyKind) -> None:
    """Write study.toml, also if only the block of the report differs; the report is then made again.

    What a killed run was writing is removed.
    """
    for leftover in [*directory.glob(".*.*"), *directory.glob("evaluations/.*")]:
        leftover.unlink()
    kept = directory / "study.toml"
    if not kept.exists():
        for name, content in study.beside.items():
            write_whole(directory / name, content)
        write_text(kept, dump(study))
    elif tomllib.loads(kept.read_text(encoding="utf-8")).get("report") != document(study).get("report"):
        write_text(kept, dump(study))
        (directory / "report.html").unlink(missing_ok=True)


def _finished(directory: Path) -> int | None:
    """Return the exit code of a finished study; None if it is unfinished, or its results are lost."""
    summary = read_summary(directory)
    if summary is None:
        return None
    with suppress(FileNotFoundError, KeyError):
        if digest(directory) == summary["provenance"]["results_sha256"]:
            return exit_code(summary)
    sys.stderr.write(f"{directory / 'results.nc'}: missing or damaged, the study is computed again\n")
    (directory / "summary.json").unlink(missing_ok=True)  # it says that the study is finished
    return None


def _say(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


def _withdraw(directory: Path, error: BaseException, checkpoint: Checkpoint) -> None:
    """Remove what `_prepare` has made, if nothing else is there, so that the corrected study can use the directory.

    Where no solve has an answer, nothing of them is kept, nor a mesh that was refined.
    """
    if isinstance(error, SolveError) and not checkpoint.answers:
        checkpoint.clear()
        for name in MESHES:
            (directory / name).unlink(missing_ok=True)
    made = ("study.toml", own_code.FILE, KEPT)
    if {path.name for path in directory.iterdir()} <= set(made):
        for name in made:
            (directory / name).unlink(missing_ok=True)
        directory.rmdir()


# --- signals ---------------------------------------------------------------------------------------------------------


def heed() -> None:
    """Let SIGINT and SIGTERM end the job; to be called once, by the main thread of each rank.

    A single process raises KeyboardInterrupt, unless a signal is ignored, as SIGINT in a shell's background. Of
    several ranks the first prints the line; each ends the job from a separate thread, since MPI waits without ever
    returning to Python. No rank dies at once: `mpirun`, which signals all of them, would then kill the others at once
    too, before the line is printed, in place of a second later. It sends the signal too once a rank ends the job for
    a reason of its own: then that is said, and they die.
    """
    from mpi4py import MPI

    from uq.evaluation.work_queue import is_ending

    world = MPI.COMM_WORLD
    if world.size == 1:
        forget_interruptions()
        for number in ENDING:
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, interrupt)
        return
    read, write = os.pipe()
    os.set_blocking(write, False)
    signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    for number in ENDING:
        signal.signal(number, lambda *_: None)
    Thread(target=_wait, args=(read, world, is_ending), daemon=True).start()


def _wait(pipe: int, world: Any, is_ending: Callable[[], bool]) -> None:
    while os.read(pipe, 1)[0] not in ENDING:
        pass
    if is_ending():
        os.kill(os.getpid(), signal.SIGKILL)
    if world.rank == 0:
        _say(INTERRUPTED)
    time.sleep(SECONDS_FOR_OTHERS)
    fallback = Timer(SECONDS_TO_ABORT, os._exit, [1])
    fallback.daemon = True
    fallback.start()
    world.Abort(1)


# --- from Python ----------------------------------------------------------------------------------------------------


def results_of(
    study: StudyKind, directory: str | Path | None = None, *, quiet: bool | None = None, report: bool = False
) -> xr.Dataset:
    """Run a study and return its results; under mpirun collective, and the results are those of the first rank.

    Parameters
    ----------
    study
        What `load` returns, or `tissuq.Study(...)`.
    directory
        Where results go; an interrupted study there is continued, a finished one is read. By default nothing is written
        to disk.
    quiet
        Print no progress; by default, only a bar in a notebook.
    report
        Write report.html too, if there is a directory.

    Returns
    -------
    xarray.Dataset
        results.nc, see docs/results.md; `findings` says what is doubtful about it. Empty on ranks other than the first.

    Raises
    ------
    StudyError, ModelError, SolveError, StopError
        Those that the command reports in one line.
    """
    from mpi4py import MPI

    printing = {"quiet": quiet is not False, "silent": not in_notebook() if quiet is None else quiet}
    if directory is not None:
        if SESSION in own_code.modules(study):  # its text is not known, and so not whether it has changed
            raise StudyError("model: is a function of this session, expected one of a module, or no directory")
        run(study, Path(directory).name, Path(directory), **printing, report=report)
        return _on_first_rank(Path(directory))
    world = MPI.COMM_WORLD
    with tempfile.TemporaryDirectory(prefix="tissuq-") as own:
        scratch = Path(world.bcast(own)) / "study"
        run(study, "study", scratch, **printing, report=False)
        found = _on_first_rank(scratch)
        world.barrier()  # the folder of the first rank goes with it
    return found


def _on_first_rank(directory: Path) -> xr.Dataset:
    import xarray as xr
    from mpi4py import MPI

    if MPI.COMM_WORLD.rank > 0:
        return xr.Dataset()
    found = read_dataset(directory)
    found.encoding["ran"] = True  # here: what shows it may run its code again
    return found
