"""A time limit on Python code that may never end."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

AGAIN = 0.5  # seconds after which code that swallowed the exception is interrupted again


class TimeLimitError(BaseException):
    """Code took too long. It is not an Exception, so that `except Exception` in that code does not swallow it."""


@contextmanager
def time_limit(seconds: float | None) -> Iterator[None]:
    """Interrupt the code in this context after so many seconds; code outside Python, when it returns.

    There is no limit if `seconds` is None, or outside the main thread, since only that can be interrupted.

    Raises
    ------
    TimeLimitError
        If the time has passed.
    """
    if seconds is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting = True

    def interrupt(*_: Any) -> None:
        if waiting:
            raise TimeLimitError

    previous = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, seconds, AGAIN)
    try:
        yield
    finally:
        waiting = False
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous)
