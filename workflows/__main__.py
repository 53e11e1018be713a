"""The command line: tissuq check | run | solve | report | reduce | live | serve | init | schema | completion."""

from __future__ import annotations

import argparse
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from workflows.studies.study import Sampled, StudyKind

# One thread per rank: ranks are the parallelism, and BLAS threads would compete with them for the cores.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

DONE, FAILED, BAD = 0, 1, 2
_RANK = ("OMPI_COMM_WORLD_RANK", "PMI_RANK", "PMIX_RANK", "SLURM_PROCID")
# Where no launcher has started this process, Open MPI would start a daemon for it and look for networks: 0.4 s.
if not any(_name in os.environ for _name in _RANK):
    os.environ.setdefault("OMPI_MCA_ess_singleton_isolated", "1")
    os.environ.setdefault("OMPI_MCA_pml", "ob1")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Returns
    -------
    int
        0 done; 1 failed, with one line that says why; 2 bad study or arguments; 3 finished, but some solves failed or
        a number cannot be trusted.
    """
    options = _parser().parse_args(arguments)
    try:
        return _done(options)
    except KeyboardInterrupt:  # while what says it otherwise is being imported
        sys.stderr.write("interrupted\n")
        return FAILED


def _done(options: argparse.Namespace) -> int:
    """Run a command; return its exit code."""
    from forward.machine import INTERRUPTED, START, StopError, reason_to_stop, require

    try:
        require(START, "the program alone")
    except StopError as error:
        _say(f"failed: {error}")
        return FAILED
    from forward.model import ModelError, SolveError
    from workflows.config.mistakes import StudyError

    try:
        found: int | str = options.command(options)
        sys.stdout.write(found if isinstance(found, str) else "")
        sys.stdout.flush()
        return DONE if isinstance(found, str) else found
    except (StudyError, ModelError) as error:
        _say(str(error))
        return BAD
    except (SolveError, StopError) as error:
        _say(f"failed: {error}")
    except (FileNotFoundError, PermissionError, FileExistsError, IsADirectoryError, NotADirectoryError) as error:
        _say(f"failed: {error if error.filename is None else f'{error.filename}: {error.strerror}'}")
    except BaseException as error:
        mpi = sys.modules.get("mpi4py.MPI")
        if mpi is not None and mpi.COMM_WORLD.size > 1:
            from uq.evaluation.work_queue import end_job

            end_job(mpi.COMM_WORLD, error)
        reason = reason_to_stop(error)
        if reason is None:
            traceback.print_exc()
        else:
            _say(reason if reason == INTERRUPTED else f"failed: {reason}")
    return FAILED


def _say(text: str) -> None:
    """Print errors once, on the first rank of the job, one line each."""
    from forward.settings import one_line

    if _first():
        sys.stderr.write("".join(f"{one_line(line)}\n" for line in text.split("\n")))


def _first() -> bool:
    """Whether this is the first rank of the job; tasks that do not know of each other are all first."""
    mpi = sys.modules.get("mpi4py.MPI")
    if mpi is not None and mpi.Is_initialized() and not mpi.Is_finalized():
        return bool(mpi.COMM_WORLD.rank == 0)
    return next((os.environ[name] for name in _RANK if name in os.environ), "0") == "0"


class _Version(argparse.Action):
    """Print the version, which is looked up only if it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from workflows.run.version import version

        sys.stdout.write(f"tissuq {version()}\n")
        parser.exit()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="tissuq",
        description="Uncertainty quantification and Bayesian model selection for hyperelastic soft tissue.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def added(name: str, command: Callable[[argparse.Namespace], int | str], said: str) -> argparse.ArgumentParser:
        """Add a command, which returns an exit code or what is printed, and say in a line what it does."""
        found = commands.add_parser(name, help=said)
        found.set_defaults(command=command)
        return found

    check = added("check", _check, "validate a study and print what it will cost")
    run = added("run", _run, "run a study, or continue it (under mpirun for several ranks)")
    solve = added("solve", _solve, "solve once, at the means of the parameters of a study, and print the outputs")
    report = added("report", _report, "rebuild the report of results; several are compared side by side")
    serve = added("serve", _serve, "serve the model of a study to other programs by UM-Bridge")
    reduce = added("reduce", _reduce, "make a reduced model of the body of a study, over its random parameters")
    init = added("init", _init, "print a commented starter study")
    live = added("live", _live, "serve a reduced model in real time: a socket for devices, a page to look at")
    live.add_argument("model", type=Path, metavar="MODEL", help="what `tissuq reduce` has made")
    live.add_argument("--port", type=int, default=4343, help="of the socket; 0: any free one (default: 4343)")
    live.add_argument("--page", type=int, default=8043, help="port of the page (default: 8043)")
    live.add_argument("--no-page", action="store_true", help="the socket alone")
    live.add_argument("--host", default="127.0.0.1", help="0.0.0.0 accepts devices on other machines too")
    live.add_argument("--no-token", action="store_true", help="serve everyone who reaches the ports")
    live.add_argument("--quiet", action="store_true", help="print nothing but errors")
    for command in (check, run, solve, reduce, serve):
        command.add_argument("study", type=Path, metavar="STUDY.toml")
        said = "change one value, such as method.samples=512"
        command.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=said)
    for command, name in ((run, "STUDY"), (reduce, "STUDY-reduced")):
        command.add_argument("--out", type=Path, metavar="DIR", help=f"results directory (default: results/{name})")
        command.add_argument(
            "--quiet", action="store_true", help="print only errors and, off the terminal, progress once a minute"
        )
        command.add_argument(
            "--no-report", action="store_true", help="leave report.html out; `tissuq report DIR` writes it"
        )
    reduce.add_argument("--output", type=Path, metavar="FILE", help="copy the model there (default: DIR/reduced.npz)")
    serve.add_argument("--port", type=int, default=4242, help="0: any free one (default: 4242)")
    serve.add_argument("--host", default="127.0.0.1", help="0.0.0.0 accepts requests from other machines too")
    serve.add_argument("--quiet", action="store_true", help="print nothing but errors")
    report.add_argument("directories", type=Path, nargs="+", metavar="DIR")
    report.add_argument("--out", type=Path, metavar="FILE", help="file of a comparison (default: comparison.html)")
    report.add_argument("--code", action="store_true", help="run code that the studies name besides what is installed")
    added("schema", _schema, "print the JSON Schema of study files, for editors")
    completion = added("completion", _completion, "print what lets a shell complete commands, options and files")
    completion.add_argument("shell", metavar="SHELL", choices=("bash", "zsh", "fish"), help="bash, zsh or fish")
    init.add_argument("kind", metavar="KIND", help="a method.kind, such as chaos; `tissuq init list` names them all")
    return parser


def _load(options: argparse.Namespace) -> StudyKind:
    """Read the study."""
    from forward.machine import reserve_for_linear_algebra
    from workflows.config.mistakes import StudyError
    from workflows.config.study import load

    reserve_for_linear_algebra()
    study = load(options.study, options.set)
    if study.recorded:
        message = (
            f"{options.study}: records a study without its data, expected the study that was run; the same command as "
            "then, with the same --out, goes on with it"
        )
        raise StudyError(message)
    if study.report is not None:  # a section that is missing is said before the study runs
        from workflows.report.section import of_study

        of_study(study.report)
    return study


def _check(options: argparse.Namespace) -> str:
    from workflows.run.plan import plan

    return "\n".join([f"{options.study}: a valid study", *plan(_load(options))]) + "\n"


def _run(options: argparse.Namespace) -> int:
    return _run_study(options, _load(options), options.study.stem)


def _solve(options: argparse.Namespace) -> str:
    from workflows.solve import solved

    return solved(_sampled(options, "solve"))


def _sampled(options: argparse.Namespace, to_do: str) -> Sampled:
    from workflows.config.mistakes import StudyError

    study = _load(options)
    if study.sampled is None:
        raise StudyError(f"{options.study}: is of kind '{study.method.kind}', expected a study of one model to {to_do}")
    return study.sampled


def _reduce(options: argparse.Namespace) -> int:
    from workflows.config.study import kind_of
    from workflows.studies.reduction import OTHER_METHOD

    if kind_of(options.study) != "reduce":  # a study that samples the body says over which parameters
        options.set = [OTHER_METHOD, *options.set]
    name = f"{options.study.stem}-reduced"
    code = _run_study(options, _load(options), name)
    if code != FAILED and options.output is not None and _first():
        from forward.machine import write_whole
        from workflows.studies.reduction_job import FILE

        options.output.parent.mkdir(parents=True, exist_ok=True)
        write_whole(options.output, ((options.out or Path("results") / name) / FILE).read_bytes())
    return code


def _run_study(options: argparse.Namespace, study: StudyKind, name: str) -> int:
    from forward.machine import SHARED_BY_RANKS, require_files
    from workflows.run.run import heed, run

    if "mpi4py.MPI" not in sys.modules:  # or else it has its file
        require_files(SHARED_BY_RANKS, "MPI")
    heed()
    out = options.out or Path("results") / name
    return run(study, name, out, quiet=options.quiet, report=not options.no_report)


def _report(options: argparse.Namespace) -> int:
    from workflows.config.mistakes import StudyError
    from workflows.report.page import compare, write_report

    if options.out is not None and len(options.directories) == 1:
        raise StudyError(f"--out {options.out}: is the file of a comparison, expected several directories")
    for directory in options.directories:
        sys.stdout.write(f"{write_report(directory, code=options.code)}\n")
    if len(options.directories) > 1:
        out = options.out or Path("comparison.html")
        sys.stdout.write(f"{compare(options.directories, out, code=options.code)}\n")
    return DONE


def _serve(options: argparse.Namespace) -> int:
    from workflows.serve import serve

    serve(_sampled(options, "serve"), options.port, options.host, quiet=options.quiet)
    return DONE


def _live(options: argparse.Namespace) -> int:
    from workflows.live.serve import serve

    page = None if options.no_page else options.page
    serve(options.model, options.host, options.port, page, quiet=options.quiet, secret=not options.no_token)
    return DONE


def _init(options: argparse.Namespace) -> str:
    from workflows.starter import starter

    return starter(options.kind)


def _completion(options: argparse.Namespace) -> str:
    from workflows.completion import completion

    return completion(options.shell, _parser())


def _schema(options: argparse.Namespace) -> str:
    import json

    from workflows.config.study import schema

    return json.dumps(schema(), indent=2, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    sys.exit(main())
