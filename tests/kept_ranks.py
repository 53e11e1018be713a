"""Under mpirun: run one script after another that a process of tests asks for, until that has ended.

    python -m tests.kept_ranks FOLDER PROCESS

A script and its arguments are in a file of the folder that is named by a number; each rank leaves the exit code and
what was printed beside it. A script that fails on one rank ends the job: the other ranks would wait for it.
"""

import gc
import io
import json
import os
import sys
import time
import traceback
from contextlib import redirect_stderr, redirect_stdout
from itertools import count
from pathlib import Path

from mpi4py import MPI

import forward.fem.dolfinx  # noqa: F401  (all ranks initialise PETSc, or none)

ROOT = Path(__file__).parent.parent
FAILED = -1
WAIT = 0.01  # s


def forget(known):
    """Modules from beside studies, in folders of tests: others may have the same names."""
    kept = (str(ROOT), sys.prefix, sys.base_prefix)
    for name in sys.modules.keys() - known:
        file = getattr(sys.modules[name], "__file__", None)
        if file and not file.startswith(kept):
            del sys.modules[name]


def ran(script):
    """Return the exit code of a script, and what it printed."""
    code, out, err, path, known = 0, io.StringIO(), io.StringIO(), [*sys.path], {*sys.modules}
    with redirect_stdout(out), redirect_stderr(err):
        try:
            exec(compile(script, "script", "exec"), {"__name__": "__main__"})
        except SystemExit as end:
            code = end.code or 0
        except BaseException:
            traceback.print_exc()
            code = FAILED
    sys.path[:] = path
    forget(known)
    return code, out.getvalue(), err.getvalue()


def main(place, process):
    """Wait for scripts; ends with an error once the process is gone."""
    gc.freeze()  # what is imported stays
    for number in count():
        asked, answer = place / f"{number}.json", place / f"{number}.rank{MPI.COMM_WORLD.rank}"
        while not asked.exists():
            os.kill(process, 0)
            time.sleep(WAIT)
        script, *sys.argv = json.loads(asked.read_text())
        found = ran(script)
        part = answer.with_suffix(f".part{MPI.COMM_WORLD.rank}")
        part.write_text(json.dumps(found))
        part.rename(answer)
        if found[0] == FAILED:
            MPI.COMM_WORLD.Abort(1)
        gc.collect()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
