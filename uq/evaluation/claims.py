"""Several jobs that work on one study, each with a world of ranks of its own: they share its results directory.

Every job runs the method; since it decides the same in each, all ask for the same blocks. A job computes those that it
has claimed by a file, and reads those of others. A claim only saves work: a block that two jobs compute is the same.
So claims need neither clocks that agree nor signs of life: whoever sees one for long without a change takes it over.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar
from zlib import crc32

T = TypeVar("T")
GOLDEN = (5**0.5 - 1) / 2
PATIENCE = 300.0  # seconds without a change after which a claim is taken over,
LONG = 5.0  # or as many times as the longest piece of work took here, if that is longer
BEAT = 10.0  # seconds between changes of a claim, if there is something to tell
SHORTEST, GROWTH, LONGEST = 0.02, 1.3, 2.0  # pauses (s) while others work
RESULTS = "results"  # what is claimed by the job that writes them


class FinishedElsewhere(Exception):  # noqa: N818 - what has happened
    """Another job has finished the study."""


class Claims:
    """What this job has claimed among those that share a study.

    Parameters
    ----------
    folder
        Where claims are.
    name
        Of this job among the others; what a job of the same name had claimed before it ended is free.
    finished
        Whether the study is.
    patience
        Seconds without a change after which a claim of another job is taken over.
    """

    def __init__(self, folder: Path, name: str, finished: Callable[[], bool], patience: float = PATIENCE) -> None:
        self._folder, self._name, self._patience = folder, name, patience
        self._finished = finished
        self._held: dict[str, float] = {}  # when each was taken
        self._beaten = -PATIENCE
        self._seen: dict[str, tuple[int, float]] = {}  # the last change of those of others, and when it was seen first
        self._pause = 0.0

    @classmethod
    def of(cls, world: Any, directory: Path, name: str) -> Claims:
        """Claims of a job of this name in a results directory; collective over its ranks."""
        found = cls(directory / "evaluations", name, (directory / "summary.json").exists)
        if world.rank == 0:
            found.begin()
        world.barrier()
        return found

    @property
    def over(self) -> bool:
        """Whether the study is finished."""
        return self._finished()

    def begin(self) -> None:
        """Make the folder, and free what an earlier job of this name has left."""
        self._folder.mkdir(parents=True, exist_ok=True)
        for path in self._folder.glob("*.claim"):
            with suppress(OSError):
                if path.read_text(encoding="utf-8") == self._name:
                    path.unlink()

    def take(self, key: str) -> bool:
        """Claim a piece of work; False if another job has, or the study is finished."""
        path = self._path(key)
        if self._finished():
            return False
        if self._stale(path, key):
            with suppress(OSError):
                path.unlink()
        try:
            with path.open("x", encoding="utf-8") as file:
                file.write(self._name)
        except FileExistsError:
            return False
        except FileNotFoundError:  # the folder is gone: the study is finished, or somebody has removed it
            if not self._finished():
                self._folder.mkdir(parents=True, exist_ok=True)
            return False
        self._held[key] = self._beaten = time.monotonic()
        return True

    def beat(self) -> None:
        """Show others that this job goes on, at most once in `BEAT` seconds."""
        now = time.monotonic()
        if now - self._beaten > BEAT:
            self._beaten = now
            for key in self._held:
                with suppress(OSError):
                    os.utime(self._path(key))

    def drop(self, key: str) -> None:
        """Give a piece of work back that is done, or will not be."""
        begun = self._held.pop(key, None)
        if begun is not None:
            self._patience = max(self._patience, LONG * (time.monotonic() - begun))
            path = self._path(key)
            with suppress(OSError):
                if path.read_text(encoding="utf-8") == self._name:  # or else it was taken over
                    path.unlink()

    def turned(self, pieces: Sequence[T]) -> tuple[T, ...]:
        """Return pieces of work from another one on for each job, so that they rarely meet."""
        number = int(self._name) if self._name.isdecimal() else crc32(self._name.encode())
        first = int(number * GOLDEN % 1 * len(pieces))
        return (*pieces[first:], *pieces[:first])

    def wait(self, *, news: bool) -> None:
        """Sleep, the longer the less there is that is new; the first time, not at all.

        Raises
        ------
        FinishedElsewhere
            If the study is finished.
        """
        if news:
            self._pause = 0.0
            return
        if self._finished():
            raise FinishedElsewhere
        time.sleep(self._pause)
        self._pause = min(max(SHORTEST, GROWTH * self._pause), LONGEST)

    def writes(self) -> None:
        """Return once this job is the one to write results.

        Raises
        ------
        FinishedElsewhere
            If another one has written them.
        """
        while not self.take(RESULTS):
            self.wait(news=False)

    def _path(self, key: str) -> Path:
        return self._folder / f"{key}.claim"

    def _stale(self, path: Path, key: str) -> bool:
        """Whether a claim has not changed for long."""
        try:
            changed = path.stat().st_mtime_ns
        except OSError:
            return False
        before, since = self._seen.get(key, (0, 0.0))
        if changed != before:
            self._seen[key] = changed, time.monotonic()
            return False
        return time.monotonic() - since > self._patience
