"""For scripts under mpirun: what must not depend on the number of ranks, by one launch instead of several."""

import sys
import traceback

from mpi4py import MPI

import forward.fem.dolfinx  # noqa: F401  (all ranks initialise PETSc, or none)
from uq.evaluation.work_queue import gather_here


def groups(*sizes):
    """The first ranks of the job, as many as each size says, one group after another; the other ranks sleep.

    Without sizes, from one rank up to all.
    """
    world = MPI.COMM_WORLD
    for size in sizes or range(1, world.size + 1):
        comm = world.Split(0 if world.rank < size else MPI.UNDEFINED, world.rank)
        if comm != MPI.COMM_NULL:
            assert comm.size == size
            yield comm
        gather_here(world)


def _abort(*error):
    """A check that failed on one rank ends the job: the others would wait for it."""
    traceback.print_exception(*error)
    sys.stderr.flush()
    MPI.COMM_WORLD.Abort(1)


sys.excepthook = _abort
