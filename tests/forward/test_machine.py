"""Memory and room on disk: how much is left, which exceptions say that they ran out, files that are whole."""

import errno
import os

import numpy as np
import pytest

from forward import machine
from forward.machine import Headroom, out_of_memory, out_of_room, reason_to_stop, write_whole
from forward.model import SolveError
from tests.launch import run_script


def test_the_smallest_limit_counts():
    script = """
import resource
from forward.machine import MIB, headroom
before = headroom()
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 100 * MIB, resource.RLIM_INFINITY))
now = headroom()
assert now.size < before.size
assert 90 * MIB < now.size <= 100 * MIB, now
assert now.of_addresses and "ulimit -v" in str(now)
block = bytearray(60 * MIB)
assert 20 * MIB < headroom().size < 41 * MIB
"""
    done = run_script(None, script)
    assert done.returncode == 0, done.stderr


@pytest.mark.unit
@pytest.mark.parametrize(
    ("membership", "folder", "names"),
    [
        ("0::/job/step", "job/step", ("memory.max", "memory.current", "inactive_file")),
        (
            "4:cpu,memory:/job/step",
            "memory/job/step",
            ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
        ),
    ],
)
def test_limits_of_control_groups_and_of_those_above_them(tmp_path, membership, folder, names):
    most, used, cached = names
    own, root = tmp_path / "cgroup", tmp_path / "fs"
    own.write_text(f"{membership}\n")
    inner = root / folder
    inner.mkdir(parents=True)
    for group, limit, usage, files in ((inner, "max", 5, 0), (inner.parent, "1000", 700, 200)):
        (group / most).write_text(f"{limit}\n")
        (group / used).write_text(f"{usage}\n")
        (group / "memory.stat").write_text(f"{cached} {files}\n")
    assert list(machine._of_control_groups(root, own)) == [Headroom(500, "limit of the control group")]


@pytest.mark.unit
def test_exceptions_that_mean_no_memory():
    with pytest.raises(MemoryError) as numpy_said:
        np.empty(2**60, dtype=np.uint8)
    petsc = RuntimeError("error code 55")
    petsc.ierr = 55  # as petsc4py has it
    for error in (
        numpy_said.value,
        petsc,
        RuntimeError("std::bad_alloc"),
        RuntimeError("error code 76\n[0] Error reported by MUMPS in solve phase: INFOG(1)=-13"),
        OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)),
        ImportError("libpetsc.so: failed to map segment from shared object"),
    ):
        assert out_of_memory(error), error
        assert "memory ran out: about 1,024 MiB are needed" in reason_to_stop(error, 2**30)
    for error in (SolveError("the stiffness is singular"), ValueError("out of memory"), KeyError("bad_alloc")):
        assert not out_of_memory(error)
        assert reason_to_stop(error) is None


@pytest.mark.unit
def test_what_came_of_a_lack_of_memory_is_one_too():
    later = ValueError("later")
    later.__cause__ = MemoryError()
    assert out_of_memory(later)
    later = ValueError("while another was handled")
    later.__context__ = MemoryError()
    assert out_of_memory(later)
    later.__suppress_context__ = True  # from None
    assert not out_of_memory(later)


@pytest.mark.unit
def test_a_full_disk_is_named():
    with pytest.raises(OSError, match="No space left") as raised, open("/dev/full", "wb", buffering=0) as full:  # noqa: PTH123
        full.write(b"x")
    assert out_of_room(raised.value) == "cannot be written: No space left on device"
    named = OSError(errno.EDQUOT, "Disk quota exceeded", "/data/results.nc")
    assert out_of_room(named) == "/data/results.nc: cannot be written: Disk quota exceeded"
    assert out_of_room(OSError(errno.EACCES, "Permission denied")) is None


def test_files_are_whole_or_not_there(tmp_path):
    path = tmp_path / "file"
    write_whole(path, b"first")
    script = """
import resource, sys
from pathlib import Path
from forward.machine import StopError, write_whole
sys.dont_write_bytecode = True  # or else parts of modules are kept
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
try:
    write_whole(Path(sys.argv[1]), b"x" * 2000)
except StopError as error:
    print(error)
"""
    done = run_script(None, script, path)
    assert done.stdout.startswith(f"{path}: cannot be written: File too large; the same command continues"), done.stderr
    assert path.read_bytes() == b"first"
    assert [one.name for one in tmp_path.iterdir()] == ["file"]


def test_linear_algebra_does_not_wait_for_memory_that_never_comes():
    script = """
import resource
import numpy as np
from forward.machine import MIB, StopError, reserve_for_linear_algebra
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 60 * MIB, resource.RLIM_INFINITY))
try:
    reserve_for_linear_algebra()
except StopError as error:
    print(error)
"""
    done = run_script(None, script)
    assert done.stdout.startswith("memory ran out: linear algebra alone needs 160 MiB"), done.stderr
