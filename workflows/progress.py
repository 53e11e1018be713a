"""Progress on rank 0: a bar in a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time

SECONDS_BETWEEN_LINES = 10.0


class Progress:
    """Counts finished and failed solves and shows rate and time left.

    Parameters
    ----------
    planned
        Number of solves expected; it grows when a method asks for more.
    quiet
        Show nothing.
    """

    def __init__(self, planned: int, *, quiet: bool = False) -> None:
        self.done = 0
        self.failed = 0
        self._planned = planned
        self._begin = time.monotonic()
        self._shown = self._begin
        self._bar = None
        self._quiet = quiet
        if not quiet and sys.stderr.isatty():
            from tqdm import tqdm

            self._bar = tqdm(total=planned, unit="solve", smoothing=0.05, dynamic_ncols=True)

    def __call__(self, done: int, failed: int) -> None:
        """Count solves that were finished, and how many of them failed."""
        self.done += done
        self.failed += failed
        if self._quiet:
            return
        if self._bar is not None:
            self._bar.update(done)
            if self.failed:
                self._bar.set_postfix(failed=self.failed)
        elif time.monotonic() - self._shown > SECONDS_BETWEEN_LINES:
            self._shown = time.monotonic()
            self._print_line()

    def close(self) -> None:
        """Show the last state."""
        if self._bar is not None:
            self._bar.total = self.done
            self._bar.close()
        elif not self._quiet:
            self._planned = self.done
            self._print_line()

    def _print_line(self) -> None:
        seconds = time.monotonic() - self._begin
        rate = self.done / seconds if seconds > 0 else 0.0
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
