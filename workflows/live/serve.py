"""The processes of `tissuq live`: the fast loop in this one, and beside it the page."""

from __future__ import annotations

import multiprocessing
import os
import sys
from pathlib import Path

from workflows.config.mistakes import StudyError
from workflows.http import listen
from workflows.live.loop import Loop
from workflows.live.mail import pair
from workflows.live.page import show
from workflows.live.token import kept, place

NOT_PROMPT = "the usual one: frames are late where others want the processors (`ulimit -r 1` would let it be real time)"


def real_time() -> bool:
    """Ask the system to run this process before all usual ones; whether it does. Processes that it starts are usual."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    except (OSError, AttributeError):  # not permitted, or not on this system
        return False
    return True


def serve(path: Path, host: str, port: int, page: int | None, *, quiet: bool = False, secret: bool = True) -> None:
    """Serve a reduced model until the user ends it, with a page at another port unless that is None.

    Where it is `secret`, only those who have the token are served. A StudyError says that there is no token, or that a
    port is taken.
    """
    token = kept() if secret else None
    context = multiprocessing.get_context("spawn")
    listening = listen(host, port, "--port")
    view = process = None
    if page is not None:
        try:
            shown = listen("127.0.0.1", page, "--page")
        except StudyError:
            listening.close()
            raise
        page = shown.getsockname()[1]
        view, theirs = pair()
        process = context.Process(target=show, args=(str(path), shown, theirs, token), daemon=True)
        process.start()
        theirs.close()
        shown.close()
    loop = Loop(path, listening, view, token)
    prompt = real_time()
    if not quiet:
        sys.stdout.write(f"frames: {host}:{listening.getsockname()[1]}, a line of JSON each\n")
        if page is not None:
            sys.stdout.write(f"page: http://127.0.0.1:{page}/{'' if token is None else f'#{token}'}\n")
        sys.stdout.write(f"token: {'none, whoever reaches the port is served' if token is None else place()}\n")
        sys.stdout.write(f"priority: {'that of real time' if prompt else NOT_PROMPT}\n")
        sys.stdout.flush()
    try:
        loop.run()
    except KeyboardInterrupt:
        return
    finally:
        loop.close()
        if process is not None:
            process.terminate()
