"""What starts programs, and tests."""

import sys
from importlib.util import cache_from_source
from pathlib import Path

import pytest

from tests import launch


@pytest.mark.unit
def test_modules_are_compiled_once_whatever_the_environment_says():
    """To compile them is two thirds of the time that each worker takes to collect the tests."""
    assert not sys.dont_write_bytecode
    assert Path(cache_from_source(launch.__file__)).is_file()


@pytest.mark.mpi
def test_ranks_that_are_kept_begin_anew_after_a_script_that_fails_on_one():
    fails = "from mpi4py import MPI\nassert MPI.COMM_WORLD.rank\nMPI.COMM_WORLD.Barrier()"
    done = launch.on_kept_ranks(2, fails)
    assert done.returncode
    assert "AssertionError" in done.stderr
    done = launch.on_kept_ranks(2, "import sys; print(sys.argv[1:]); sys.exit(3)", 1, "x")
    assert (done.returncode, done.stdout) == (3, "['1', 'x']\n" * 2)
