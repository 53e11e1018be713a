"""Progress on rank 0: a bar in a terminal or a notebook, elsewhere a plain line a minute (`workflows.run.watch`)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections import deque
from contextlib import ExitStack, suppress
from typing import Any, Self

from forward.phases import Phases, listeners
from workflows.run import watch

SECONDS_BETWEEN_LINES = 60.0
SECONDS_BETWEEN_BARS = 1.0  # in a notebook, which keeps each
SECONDS_BETWEEN_MARKS = 1.0  # that the rate is computed between
BAR = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} solves [{elapsed}{postfix}]"


def in_notebook() -> bool:
    """Whether this process is what runs a notebook."""
    python = sys.modules.get("IPython")
    return python is not None and "IPKernelApp" in getattr(python.get_ipython(), "config", {})


class Progress:
    """Counts finished and failed solves, and shows rate, time left and what is done, from its beginning to its end.

    If `quiet`, only a line a minute is shown, on a terminal not even that, and in a notebook the bar; if `silent`,
    nothing at all. Failures are shown where solves without an answer are some, rather than zero likelihood.

    The rate is that of the last minute of a phase: of solves that are asked for together. It begins when the first of
    them are finished, which compile forms and factorise once for all; until the next are, neither rate nor time left is
    known. What was read from disk, in no time, is before.
    """

    def __init__(self, *, quiet: bool = False, silent: bool = False, failures: bool = True) -> None:
        self._done = self._failed = self._planned = 0
        self._failures = failures
        self._begin = self._now = time.monotonic()
        self._marks: deque[tuple[float, int]] = deque()  # times, and the counts then, of this phase
        self._phases: Phases = ()
        self._bar: Any = None
        self._file = -1  # that the watch reads, if there is one
        self._held = ExitStack()
        notebook = in_notebook()
        self._quiet, self._terminal = quiet or silent, sys.stderr.isatty() or notebook
        self._interval = SECONDS_BETWEEN_BARS if notebook else 0.1
        self._bars = not silent and (notebook or (self._terminal and not quiet))
        self._lines = not silent and not self._terminal

    def __enter__(self) -> Self:
        """Begin to print lines."""
        if self._lines:
            file = self._held.enter_context(tempfile.TemporaryFile()).fileno()
            command = [sys.executable, "-I", "-S", watch.__file__, str(SECONDS_BETWEEN_LINES), str(file)]
            with suppress(OSError):  # no room for another process
                self._held.enter_context(subprocess.Popen(command, stdin=subprocess.PIPE, pass_fds=[file]))
                self._file = file
                listeners.append(self._doing)
                self._held.callback(listeners.remove, self._doing)
        return self

    def __exit__(self, *_: object) -> None:
        """End that."""
        self._held.close()

    def expect(self, planned: int) -> None:
        """Count towards so many solves; they grow when a method asks for more."""
        self._planned = planned
        if self._bars:
            with warnings.catch_warnings(action="ignore"):  # of a notebook without widgets, which has a bar of letters
                from tqdm.auto import tqdm

            self._bar = tqdm(total=planned, dynamic_ncols=True, bar_format=BAR, mininterval=self._interval)
        self._write()

    def __call__(self, done: int, failed: int) -> None:
        """Count solves that were finished, and how many of them failed; none at all: a phase begins."""
        if not done:
            self._marks.clear()
            return
        self._done += done
        self._failed += failed if self._failures else 0
        self._now = now = time.monotonic()
        marked = not self._marks or now - self._marks[-1][0] >= SECONDS_BETWEEN_MARKS
        if marked:
            self._marks.append((now, self._done))
        while len(self._marks) > 1 and now - self._marks[1][0] >= SECONDS_BETWEEN_LINES:
            self._marks.popleft()
        if self._bar is not None:
            self._bar.set_postfix_str(watch.pace(self.state, now), refresh=False)
            self._bar.total = max(self._bar.total, self._done)
            self._bar.update(done)
        elif marked:  # not of each solve, which may take less than this
            self._write()

    def close(self) -> None:
        """Show the last count."""
        if self._bar is not None:
            self._bar.total = self._done
            self._bar.close()
        elif not self._quiet:
            took = time.monotonic() - self._begin
            self._planned, rate = self._done, self._done / took if took > 0 else 0.0
            sys.stderr.write(f"{watch.line({**self.state, 'rate': rate, 'phases': ()}, self._now)}\n")
            sys.stderr.flush()

    @property
    def state(self) -> dict[str, Any]:
        """What `workflows.run.watch.line` makes a line of: counts, rate (1/s) and its time, phases."""
        then, before = self._marks[0] if self._marks else (self._now, self._done)
        rate = (self._done - before) / (self._now - then) if self._now > then else 0.0
        counts = {"done": self._done, "planned": max(self._planned, self._done), "failed": self._failed}
        return {**counts, "rate": rate, "at": self._now, "phases": self._phases}

    def _doing(self, phases: Phases) -> None:
        self._phases = phases
        self._write()

    def _write(self) -> None:
        if self._file >= 0:
            with suppress(OSError):  # a full disk
                os.pwrite(self._file, json.dumps(self.state).encode().ljust(watch.SIZE), 0)
