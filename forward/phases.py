"""What this process is doing just now, in words, for whoever shows it; the innermost of what was begun comes last."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Phases = tuple[tuple[str, float], ...]  # what was begun and has not ended, and when (s, of the monotonic clock)
listeners: list[Callable[[Phases], None]] = []
_begun: list[tuple[str, float]] = []


@contextmanager
def phase(words: str) -> Iterator[None]:
    """Say what is done inside; also a decorator."""
    _begun.append((words, time.monotonic()))
    _tell()
    try:
        yield
    finally:
        _begun.pop()
        _tell()


def _tell() -> None:
    for listener in listeners:
        listener(tuple(_begun))
