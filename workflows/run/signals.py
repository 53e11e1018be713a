"""How a run ends on a signal: with one line, and no rank left waiting."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from threading import Thread, Timer
from typing import Any

from forward.machine import INTERRUPTED

ENDING = (signal.SIGINT, signal.SIGTERM)
SECONDS_FOR_OTHERS = 1.5  # within which `mpirun`, if it was signalled too, ends all ranks silently
SECONDS_TO_ABORT = 2.0


def heed() -> None:
    """Let SIGINT and SIGTERM end the job; to be called once, by the main thread of each rank.

    A single process raises KeyboardInterrupt. Of several ranks the first prints the line; each ends the job from a
    separate thread, since MPI waits without ever returning to Python. No rank dies at once: `mpirun`, which signals
    all of them, would then kill the others at once too, before the line is printed, in place of a second later. It
    sends the signal too once a rank ends the job for a reason of its own: then that is said, and they die.
    """
    from mpi4py import MPI

    from uq.evaluation.work_queue import is_ending

    world = MPI.COMM_WORLD
    if world.size == 1:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
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
        sys.stderr.write(f"{INTERRUPTED}\n")
        sys.stderr.flush()
    time.sleep(SECONDS_FOR_OTHERS)
    fallback = Timer(SECONDS_TO_ABORT, os._exit, [1])
    fallback.daemon = True
    fallback.start()
    world.Abort(1)
