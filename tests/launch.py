"""Start programs as a user's shell would, under mpirun too."""

import atexit
import io
import itertools
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from pathlib import Path

import pytest
import xarray as xr

from forward.native import library
from tests import COMPILED
from workflows.__main__ import main

ROOT = Path(__file__).parent.parent
TISSUQ = Path(sys.executable).parent / "tissuq"
NOT_KEPT = "PYTHONDONTWRITEBYTECODE"
# What two ranks of a body share well they share as three: one test of all its forms is enough of that between changes.
UP_TO_RANKS = pytest.mark.parametrize("ranks", [2, pytest.param(3, marks=pytest.mark.slow)])
HANGS = 900  # s, after which a program hangs: busy machines that compile all forms are slow
# Ranks that wait for others ask MPI again and again, and yield in between: with more ranks than cores, that takes more
# of the cores than what they wait for. Asleep for a moment instead of yielding, they take next to nothing.
_SLEEP = """
#include <time.h>
int sched_yield(void)
{
    struct timespec moment = {0, 20000};
    nanosleep(&moment, 0);
    return 0;
}
"""
_SLEEPING = library(_SLEEP, flags=("-O2",), against=())


def environment():
    """The environment of a fresh shell: a process that has initialised MPI cannot start mpirun with its own.

    Compiled modules are kept, elsewhere if not beside their sources: to compile them in each of hundreds of programs
    takes longer than what these do.
    """
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_", "PMIX_", "PMI_"))}
    if clean.pop(NOT_KEPT, ""):
        clean.setdefault("PYTHONPYCACHEPREFIX", COMPILED)
    root = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    shared = {"OMPI_MCA_rmaps_base_oversubscribe": "1", "OMPI_MCA_mpi_yield_when_idle": "1"}
    shared |= {"OMPI_MCA_hwloc_base_binding_policy": "none"}  # other tests run beside, on the same cores if bound
    # On one machine there are no networks to look for, and a process without mpirun needs no daemon beside it.
    shared |= {"OMPI_MCA_pml": "ob1", "OMPI_MCA_ess_singleton_isolated": "1"}
    if _SLEEPING is not None:
        shared["LD_PRELOAD"] = " ".join(filter(None, (_SLEEPING._name, clean.get("LD_PRELOAD"))))
    return clean | root | shared | {"OMP_NUM_THREADS": "1"}


def on_ranks(ranks, *command):
    """The command, under mpirun where a number of ranks is given."""
    beside = Path(sys.executable).parent / "mpirun"  # the wheel of DOLFINx brings an MPI of its own
    mpirun = beside if beside.exists() else "mpirun"
    return list(map(str, command if ranks is None else (mpirun, "-n", ranks, *command)))


def run(ranks, *command, path=None, timeout=HANGS):
    """Run to the end, with packages in a folder of their own; exit code and output are in what is returned."""
    return subprocess.run(
        on_ranks(ranks, *command),
        capture_output=True,
        text=True,
        timeout=timeout,
        env=environment() | ({} if path is None else {"PYTHONPATH": str(path)}),
        check=False,
        cwd=ROOT,
    )


def in_process(*arguments):
    """Run the command in this process, which has imported all: a program of its own takes longer to import it."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            code = main(list(map(str, arguments)))
        except SystemExit as end:
            code = end.code
    return subprocess.CompletedProcess(arguments, code, out.getvalue(), err.getvalue())


def killed(ranks, blocks, *command):
    """Kill a run, whose directory comes last, once so many more blocks are finished; whether it was at work."""
    nothing = dict.fromkeys(("stdout", "stderr"), subprocess.DEVNULL)
    process = subprocess.Popen(on_ranks(ranks, *command), env=environment(), cwd=ROOT, **nothing)
    kept, begin = Path(command[-1]) / "evaluations", time.monotonic()
    until = len(list(kept.glob("*.block"))) + blocks
    while process.poll() is None and time.monotonic() - begin < HANGS and len(list(kept.glob("*.block"))) < until:
        time.sleep(0.02)
    at_work = process.poll() is None
    if at_work:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        for one in (process.pid, *map(int, children)):  # mpirun first, or it would end the others in good order
            with suppress(ProcessLookupError):
                os.kill(one, signal.SIGKILL)
    process.wait()
    return at_work


def run_script(ranks, script, *arguments, timeout=HANGS):
    """Run a Python script."""
    return run(ranks, sys.executable, "-c", script, *arguments, timeout=timeout)


@contextmanager
def without_pictures():
    """Reports whose pictures cost nothing, where only their words are looked at."""
    from workflows.report import blocks

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(blocks, "svg", lambda ax: b"<svg/>")
        patched.setattr(blocks, "png_of", lambda figure, dpi: b"PNG")
        yield


_COMMAND = "import sys; from workflows.__main__ import main; sys.exit(main(sys.argv[1:]))"


class _TwoRanks:
    """Two ranks that run one script after another: to start them takes longer than what most tests do on them."""

    def __init__(self):
        self.job = None

    def start(self):
        self.folder = tempfile.TemporaryDirectory()
        self.numbers = itertools.count()
        words = on_ranks(2, sys.executable, "-m", "tests.kept_ranks", self.folder.name, os.getpid())
        nothing = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
        self.job = subprocess.Popen(words, env=environment(), cwd=ROOT, **nothing)
        atexit.register(self.job.terminate)

    def run(self, script, *arguments):
        if self.job is None or self.job.poll() is not None:
            self.start()
        place, number, begun = Path(self.folder.name), next(self.numbers), time.monotonic()
        (place / "asked").write_text(json.dumps([script, "-c", *map(str, arguments)]))
        (place / "asked").rename(place / f"{number}.json")
        answers = [place / f"{number}.rank{rank}" for rank in range(2)]
        while not all(map(Path.exists, answers)) and self.job.poll() is None and time.monotonic() - begun < HANGS:
            time.sleep(0.005)
        found = [json.loads(one.read_text()) if one.exists() else (-1, "", "without an end") for one in answers]
        codes, out, err = zip(*found, strict=True)
        if -1 in codes:
            self.job.kill()
            self.job.wait()
        return subprocess.CompletedProcess(arguments, next(filter(None, codes), 0), "".join(out), "".join(err))


_two_ranks = _TwoRanks()


def on_kept_ranks(ranks, script, *arguments):
    """Run a script that ends well, and leaves modules as they are; on two ranks, on those that are kept for others."""
    return _two_ranks.run(script, *arguments) if ranks == 2 else run_script(ranks, script, *arguments)


def tissuq_on_two_ranks(*arguments):
    """Run the command on the two ranks that are kept."""
    return _two_ranks.run(_COMMAND, *arguments)


def report_of_own(folder, study):
    """Check and run a study with own parts, of a module in its folder; return its report."""
    (folder / "study.toml").write_text(study)
    for words in (("check", folder / "study.toml"), ("run", folder / "study.toml", "--out", folder / "out")):
        done = in_process(*words)
        assert done.returncode == 0, done.stderr
    return (folder / "out" / "report.html").read_text()


def assert_same_bits(a, b):
    """The results of two runs are the same bytes; if not, a variable is named that differs."""
    if (a / "results.nc").read_bytes() == (b / "results.nc").read_bytes():
        return
    left, right = (xr.load_dataset(d / "results.nc") for d in (a, b))
    for name in left.variables:
        assert left[name].values.tobytes() == right[name].values.tobytes(), name
    pytest.fail("the variables are the same, the files are not")
