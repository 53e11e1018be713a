"""Forms are compiled once, however many processes start together with an empty cache, and whoever is killed."""

import os
import signal
import subprocess
import sys
import time

import pytest

from tests.launch import ROOT, environment, on_ranks

pytestmark = [pytest.mark.fem, pytest.mark.mpi]

SCRIPT = """
import pathlib, sys, tempfile
from mpi4py import MPI
import ufl
from forward.fem.dolfinx import assembly, meshes, spaces
from forward.bodies.geometry import Box

make, made = tempfile.mkdtemp, []
def counted(*arguments, **options):
    made.append(make(*arguments, **options))
    return made[-1]
tempfile.mkdtemp = counted
comm = MPI.COMM_WORLD
msh, _ = meshes.mesh_body(comm, Box(size=(1.0, 2.0, 3.0), cells=(2, 2, 2), degree=1))
v = ufl.TestFunction(spaces.scalar_space(msh, 1))
one = spaces.constant(msh, 1.0)
volume = assembly.VectorAssembler(one * v * ufl.dx(domain=msh), None, comm)
found = comm.gather((round(comm.allreduce(volume().sum()), 12), len(made)))
for line in found or ():  # two ranks that print may mix their lines
    print(*line)
"""


def start(cache, ranks=None):
    return subprocess.Popen(
        on_ranks(ranks, sys.executable, "-c", SCRIPT),
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=environment() | {"XDG_CACHE_HOME": str(cache)},
        start_new_session=True,
    )


def found(process):
    """Lines of volume and number of compilations, one for each rank."""
    output, _ = process.communicate(timeout=100)
    assert process.returncode == 0
    return [line.split() for line in output.splitlines()]


@pytest.mark.slow
def test_forms_are_compiled_once_by_many_processes(tmp_path):
    lines = [line for process in [start(tmp_path, ranks) for ranks in (None, 2)] for line in found(process)]
    assert [volume for volume, _ in lines] == ["6.0"] * 3
    folders = [path for path in (tmp_path / "tissuq").glob("forms-*/*") if path.is_dir()]
    assert sum(int(made) for _, made in lines) == len(folders)
    assert all(len(list(folder.glob("*.so"))) == 1 for folder in folders)


@pytest.mark.slow
def test_whoever_is_killed_while_compiling_is_not_waited_for(tmp_path):
    killed = start(tmp_path)
    while not list((tmp_path / "tissuq").glob("forms-*/*/*.c")):
        assert killed.poll() is None
        time.sleep(0.005)
    os.killpg(killed.pid, signal.SIGKILL)
    killed.wait()
    ((volume, made),) = found(start(tmp_path))
    assert volume == "6.0"
    assert int(made) > 0


def test_a_cache_that_cannot_be_made_is_said_in_one_line(tmp_path):
    (tmp_path / "tissuq").write_text("no folder")
    done = subprocess.run(
        on_ranks(
            None,
            sys.executable,
            "-m",
            "workflows",
            "run",
            "configs/tiny.toml",
            "--no-report",
            "--out",
            tmp_path / "out",
        ),
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
        cwd=ROOT,
        env=environment() | {"XDG_CACHE_HOME": str(tmp_path)},
    )
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith(f"failed: compiled forms cannot be kept in {tmp_path}/tissuq/forms-")
    assert last.endswith("set XDG_CACHE_HOME to a folder of yours")


def test_what_is_imported_with_dolfinx():
    """Not what UFL and FFCx only ask for their versions, nor SciPy before it is used."""
    code = (
        "import sys, forward.fem.dolfinx as _, forward.fem.dolfinx.spaces, ufl, ffcx\n"
        "print(ufl.__version__ == ffcx.__version__ == '', {'pkg_resources', 'scipy.sparse'} & set(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, cwd=ROOT, env=environment(), stdout=subprocess.PIPE, text=True
    )
    assert done.stdout.split(maxsplit=1) == ["False", "set()\n"]
