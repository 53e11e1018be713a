"""Progress on rank 0: a bar in a terminal, elsewhere a plain line a minute."""

from __future__ import annotations

import sys
import time

SECONDS_BETWEEN_LINES = 60.0


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
    """

    def __init__(self, planned: int, *, quiet: bool = False, silent: bool = False, failures: bool = True) -> None:
        self.done = 0
        self.failed = 0
        self._planned = planned
        self._failures = failures
        self._begin = time.monotonic()
        self._shown, self._before = self._begin, 0  # when the last line was printed, and the count then
        self._bar = None
        terminal = sys.stderr.isatty()
        self._quiet = quiet or silent
        self._lines = not silent and not terminal
        if terminal and not self._quiet:
            from tqdm import tqdm

            self._bar = tqdm(total=planned, unit="solve", smoothing=0.05, dynamic_ncols=True)

    def __call__(self, done: int, failed: int) -> None:
        """Count solves that were finished, and how many of them failed."""
        self.done += done
        self.failed += failed if self._failures else 0
        if self._bar is not None:
            self._bar.update(done)
            if self.failed:
                self._bar.set_postfix(failed=self.failed)
        elif self._lines and time.monotonic() - self._shown >= SECONDS_BETWEEN_LINES:
            self._print_line(self._shown, self._before)
            self._shown, self._before = time.monotonic(), self.done

    def close(self) -> None:
        """Show the last state."""
        if self._bar is not None:
            self._bar.total = self.done
            self._bar.close()
        elif not self._quiet:
            self._planned = self.done
            self._print_line(self._begin, 0)

    def _print_line(self, since: float, before: int) -> None:
        """Print the progress, with the rate since a given time: what was read from disk at first took no time."""
        seconds = time.monotonic() - since
        rate = (self.done - before) / seconds if seconds > 0 else 0.0
        left = max(self._planned - self.done, 0) / rate if rate > 0 else float("inf")
        line = f"{self.done}/{max(self._planned, self.done)} solves, {rate:.3g} per second, {_clock(left)} left"
        sys.stderr.write(line + (f", {self.failed} failed" if self.failed else "") + "\n")
        sys.stderr.flush()


def _clock(seconds: float) -> str:
    if seconds == float("inf"):
        return "unknown time"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
