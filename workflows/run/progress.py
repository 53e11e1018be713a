"""Progress on rank 0: a bar in a terminal, elsewhere a plain line a minute."""

from __future__ import annotations

import sys
import time
from collections import deque

SECONDS_BETWEEN_LINES = 60.0
SECONDS_BETWEEN_MARKS = 1.0  # that the rate is computed between
UNKNOWN = "time left not known yet"
BAR = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} solves [{elapsed}{postfix}]"


class Progress:
    """Counts finished and failed solves and shows rate and time left.

    Parameters
    ----------
    planned
        Number of solves expected; it grows when a method asks for more.
    quiet
        Show only a line a minute, and on a terminal not even that.
    silent
        Show nothing at all.
    failures
        Whether solves without an answer are failures, which are shown; in inversions they may be parameters with zero
        likelihood.

    Notes
    -----
    The rate is that of the last minute of a phase: of solves that are asked for together. It begins when the first of
    them are finished, which compile forms and factorise once for all; until the next are, neither rate nor time left is
    known. What was read from disk, in no time, is before.
    """

    def __init__(self, planned: int, *, quiet: bool = False, silent: bool = False, failures: bool = True) -> None:
        self.done = 0
        self.failed = 0
        self._planned = planned
        self._failures = failures
        self._begin = time.monotonic()
        self._shown = self._begin  # when the last line was printed
        self._marks: deque[tuple[float, int]] = deque()  # times, and the counts then, of this phase
        self._bar = None
        terminal = sys.stderr.isatty()
        self._quiet = quiet or silent
        self._lines = not silent and not terminal
        if terminal and not self._quiet:
            from tqdm import tqdm

            self._bar = tqdm(total=planned, dynamic_ncols=True, bar_format=BAR)

    def __call__(self, done: int, failed: int) -> None:
        """Count solves that were finished, and how many of them failed; none at all: a phase begins."""
        if not done:
            self._marks.clear()
            return
        self.done += done
        self.failed += failed if self._failures else 0
        now = time.monotonic()
        if not self._marks or now - self._marks[-1][0] >= SECONDS_BETWEEN_MARKS:
            self._marks.append((now, self.done))
        while len(self._marks) > 1 and now - self._marks[1][0] >= SECONDS_BETWEEN_LINES:
            self._marks.popleft()
        if self._bar is not None:
            self._bar.set_postfix_str(self._pace(now) + self._failures_so_far(), refresh=False)
            self._bar.update(done)
        elif self._lines and now - self._shown >= SECONDS_BETWEEN_LINES:
            self._print(self._pace(now))
            self._shown = now

    def close(self) -> None:
        """Show the last state."""
        if self._bar is not None:
            self._bar.total = self.done
            self._bar.close()
        elif not self._quiet:
            self._planned = self.done
            seconds = time.monotonic() - self._begin
            self._print(f"{self.done / seconds if seconds > 0 else 0.0:.3g} per second, 0:00 left")

    def _pace(self, now: float) -> str:
        """Solves per second since the first of the marks, and the time left by that."""
        then, before = self._marks[0]
        if now <= then:
            return UNKNOWN
        rate = (self.done - before) / (now - then)
        return f"{rate:.3g} per second, {_clock(max(self._planned - self.done, 0) / rate)} left"

    def _print(self, pace: str) -> None:
        line = f"{self.done}/{max(self._planned, self.done)} solves, {pace}{self._failures_so_far()}"
        sys.stderr.write(f"{line}\n")
        sys.stderr.flush()

    def _failures_so_far(self) -> str:
        return f", {self.failed} failed" if self.failed else ""


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
