"""A process of its own that prints, once a minute, what a run is doing: `python watch.py SECONDS FILE`.

A thread of the run could not: libraries hold Python's lock while they factorise. The end of the standard input is that
of the run, however it ended. It imports nothing of the program, to start at once.
"""

import json
import os
import select
import signal
import sys
import time
from typing import Any

SIZE = 4096  # bytes of a state
UNKNOWN = "time left not known yet"


def line(state: dict[str, Any], now: float) -> str:
    """Return what is printed of a state (`Progress.state`) at a time (s, of the monotonic clock)."""
    solves = f"{state['done']}/{state['planned']} solves, {pace(state, now)}".rstrip(", ") if state["planned"] else ""
    phases = ": ".join(f"{words} ({clock(now - begun)})" for words, begun in state["phases"])
    return "; ".join(one for one in (solves, phases) if one) or "at work"


def pace(state: dict[str, Any], now: float) -> str:
    """Return the rate of a state and the time left by it, where more solves are expected, and what has failed."""
    found = [UNKNOWN] if state["done"] < state["planned"] else []
    if state["rate"]:
        left = (state["planned"] - state["done"]) / state["rate"] - (now - state["at"])
        at_work = state["phases"] or state["done"] < state["planned"]
        known = left > 0 or not at_work  # else it takes longer than thought
        found = [f"{state['rate']:.3g} per second", f"{clock(max(left, 0.0))} left" if known else UNKNOWN]
    return ", ".join(found + [f"{state['failed']} failed"] * (state["failed"] > 0))


def clock(seconds: float) -> str:
    """Return a time in minutes and seconds, or hours too."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def watch(seconds: float, file: int) -> None:
    """Print a line each time that so many seconds have passed, until the standard input ends."""
    for number in (signal.SIGINT, signal.SIGTERM):  # which the run too is sent, and may survive
        signal.signal(number, signal.SIG_IGN)
    due = time.monotonic() + seconds
    while not select.select([0], [], [], max(due - time.monotonic(), 0.0))[0]:
        due += seconds
        try:
            state = json.loads(os.pread(file, SIZE, 0).rstrip(b"\0 "))
            os.write(2, f"{line(state, time.monotonic())}\n".encode())
        except ValueError:  # it was being written: the next one is whole
            continue
        except OSError:  # nobody reads any more
            return


if __name__ == "__main__":
    watch(float(sys.argv[1]), int(sys.argv[2]))
