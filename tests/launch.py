"""Start programs as a user's shell would, under mpirun too."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import xarray as xr

from forward.native import library
from tests import COMPILED

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


def run_script(ranks, script, *arguments, timeout=HANGS):
    """Run a Python script."""
    return run(ranks, sys.executable, "-c", script, *arguments, timeout=timeout)


def report_of_own(folder, study):
    """Check and run a study with own parts, in the folder of their module, as a user does; return its report."""
    (folder / "study.toml").write_text(study)
    for command in (("check", "study.toml"), ("run", "study.toml", "--out", "out")):
        done = subprocess.run(
            [TISSUQ, *command],
            cwd=folder,
            env=environment() | {"PYTHONPATH": str(folder)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
    return (folder / "out" / "report.html").read_text()


def assert_same_bits(a, b):
    """The results of two runs are the same bytes."""
    left, right = (xr.load_dataset(d / "results.nc") for d in (a, b))
    for name in left.variables:
        assert left[name].values.tobytes() == right[name].values.tobytes(), name
    assert (a / "results.nc").read_bytes() == (b / "results.nc").read_bytes()
