"""The fast loop of `tissuq live`: parameters in, outputs with errors and spread out, a line of JSON each.

One process does nothing else, with the priority of real time where the system lets it, and collects no garbage while
frames come. A second one makes local models of the newest frame, over and over; a third one serves the page. What they
have to say is taken between frames in whole messages (`workflows.live.mail`), so a frame never waits for them.

A client connects and is told in one line what there is: the `parameters` with their means, the names and units of
the `outputs`, and which of them come from the `local` model alone. Then each line that it sends, a table of the
parameters that have changed, is answered by one line: `outputs`, estimated `errors` to be added, `spread` (one standard
deviation due to the parameters that nobody has set), the `residual`, the number of `corrections`, whether the frame is
`late`, the age of the local model (`local_ms`), and the `microseconds` that the answer took. `id` comes back as sent.

A frame is corrected as long as that is done within `WITHIN`. Where a correction takes longer, the answer is the last
frame moved along the slopes of the local model (`corrections` is 0), and the correction follows once it has been sent.
When it is late, that is, when more than one line waits, only the last one is solved for; the others are answered in
that way, and say so. Where the model cannot follow (a jump), frames are those of the nearest local model until the next
one is there.
"""

from __future__ import annotations

import gc
import json
import multiprocessing
import os
import selectors
import socket
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from forward.model import FloatArray, SolveError
from forward.reduced.data import load
from forward.reduced.model import ReducedModel
from forward.reduced.newton import outside_of
from forward.reduced.stream import Local, Stream, local
from workflows.live.mail import Mail, pair

WITHIN = 0.5e-3  # s that the corrections of a frame may take
REST = 5e-5  # s in which the system delivers an answer before its correction is made
SHOWN = 1 / 60  # s between states that are sent to the page
BEHIND = 5  # how much nicer the other processes are than the loop
LONGEST = 2**16  # bytes of a line
NOT_PROMPT = "the usual one: frames are late where others want the processors (`ulimit -r 1` would let it be real time)"


def followed(path: str, mail: Mail) -> None:
    """Make a local model of each place that comes, until the line is closed; frames come first."""
    os.nice(BEHIND)
    data = load(Path(path))
    model = ReducedModel(data, data.parameters)
    try:
        while True:
            parameters, modes, uncertain = mail.receive()
            try:
                found = local(model, parameters, modes, uncertain)
                mail.send(replace(found, inverse=found.inverse.astype(np.float32)))  # in half the room
            except SolveError as error:
                mail.send(str(error))
    except (EOFError, OSError, KeyboardInterrupt):
        return


class Loop:
    """Frames for all clients, one after the other.

    Parameters
    ----------
    path
        The reduced model.
    host, port
        Where it listens; port 0 is any free one.
    view
        Sends what the page shows, and what its sliders say comes back; None without a page.
    """

    def __init__(self, path: Path, host: str, port: int, view: Mail | None = None) -> None:
        data = load(path)
        self._model = ReducedModel(data, data.parameters)
        self._data, self._view = data, view
        self._uncertain = data.spread.copy()
        self.stream = Stream(self._model, local(self._model, data.nominal, None, self._uncertain))
        for _ in range(20):  # compiled, and known how long it takes, before the first client comes
            self.stream.frame(data.nominal)
        self._now, self._made = data.nominal.copy(), time.monotonic()
        context = multiprocessing.get_context("spawn")
        self._helper, theirs = pair()
        self._process = context.Process(target=followed, args=(str(path), theirs), daemon=True)
        self._process.start()
        theirs.close()
        self._busy, self._shown, self._asked = False, 0.0, data.nominal.copy()
        self._listening = socket.create_server((host, port))
        self.port = int(self._listening.getsockname()[1])
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listening, selectors.EVENT_READ, self._accept)
        self._selector.register(self._helper, selectors.EVENT_READ, self._local)
        if view is not None:
            self._selector.register(view, selectors.EVENT_READ, self._slid)
        self._buffers: dict[socket.socket, bytearray] = {}
        self.ended = False

    def run(self) -> None:
        """Answer until `ended` is set."""
        gc.collect()
        gc.freeze()
        gc.disable()
        try:
            while not self.ended:
                ready = self._selector.select(SHOWN)
                for key, _ in sorted(ready, key=lambda one: one[0].fileobj not in self._buffers):  # clients first
                    handle: Callable[[Any], None] = key.data
                    handle(key.fileobj)
                if self.stream.behind:
                    time.sleep(REST)
                    self.stream.frame(self._now, self.stream.takes + self.stream.besides)  # one correction
                self._share()
                if not ready:
                    gc.collect(0)
        finally:
            gc.enable()
            gc.unfreeze()

    def close(self) -> None:
        """Let go of everything."""
        self.ended = True
        for one in (*self._buffers, self._listening):
            one.close()
        self._helper.close()
        self._process.terminate()
        self._process.join(5)

    def greeting(self) -> dict[str, Any]:
        """Return what a client is told first."""
        outputs = self._data.outputs
        return {
            "parameters": dict(zip(self._data.parameters, self._data.nominal.tolist(), strict=True)),
            "outputs": [output.name for output in outputs],
            "units": [output.unit for output in outputs],
            "local": [output.name for output in outputs if output.kind == "peak"],
        }

    # --- clients -----------------------------------------------------------------------------------------------------

    def _accept(self, listening: socket.socket) -> None:
        client, _ = listening.accept()
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._buffers[client] = bytearray()
        self._selector.register(client, selectors.EVENT_READ, self._read)
        self._send(client, self.greeting())

    def _read(self, client: socket.socket) -> None:
        try:
            arrived = client.recv(LONGEST)
        except OSError:
            arrived = b""
        buffer = self._buffers[client]
        buffer += arrived
        *lines, rest = bytes(buffer).split(b"\n")
        self._buffers[client] = bytearray(rest)
        if not arrived or len(rest) > LONGEST:
            self._leave(client)
            return
        for line in lines[:-1]:
            self._send(client, self.answer(line, late=True))
        if lines:
            self._send(client, self.answer(lines[-1]))

    def _leave(self, client: socket.socket) -> None:
        self._selector.unregister(client)
        del self._buffers[client]
        client.close()

    def _send(self, client: socket.socket, table: dict[str, Any]) -> None:
        try:
            client.sendall(json.dumps(table).encode() + b"\n")
        except OSError:  # it has gone; the next read says so
            return

    def answer(self, line: bytes, *, late: bool = False) -> dict[str, Any]:
        """Return the answer to a line."""
        begin = time.perf_counter()
        try:
            table = json.loads(line)
            assert isinstance(table, dict)
            own = {"id": table.pop("id")} if "id" in table else {}
            self._set({str(path): float(value) for path, value in table.items()})
        except (ValueError, TypeError, AssertionError) as error:
            said = (
                str(error) if isinstance(error, _UnknownError) else "expected a table of numbers by parameter, in JSON"
            )
            return {"error": said}
        frame = self.stream.linear(self._now) if late else self.stream.frame(self._now, WITHIN)
        here = self.stream.here
        beyond = outside_of(self._data, self._now)
        return {
            **own,
            "outputs": frame.outputs.tolist(),
            "errors": here.errors.tolist(),
            "spread": here.spread.tolist(),
            "residual": None if np.isnan(frame.residual) else frame.residual,
            "corrections": frame.corrections,
            "late": late,
            **({"outside": beyond} if beyond else {}),
            "local_ms": round(1e3 * (time.monotonic() - self._made), 1),
            "microseconds": round(1e6 * (time.perf_counter() - begin)),
        }

    def _set(self, values: dict[str, float]) -> None:
        names = self._data.parameters
        for path in values:
            if path not in names:
                message = f"'{path}' is not a parameter, expected one of: {', '.join(names)}"
                raise _UnknownError(message)
        if not all(np.isfinite(value) for value in values.values()):
            raise ValueError
        self._now = self._now.copy()
        for path, value in values.items():
            self._now[names.index(path)] = value
            self._uncertain[names.index(path)] = 0.0  # what is set is known

    # --- the other processes -----------------------------------------------------------------------------------------

    def _local(self, helper: Mail) -> None:
        try:
            found = helper.receive()
        except (EOFError, OSError):
            self.ended = True
            return
        self._busy = False
        if isinstance(found, Local):
            self.stream.moved(replace(found, inverse=found.inverse.astype(float)))
            self._made = time.monotonic()

    def _slid(self, view: Mail) -> None:
        try:
            values: dict[str, float] = view.receive()
        except (EOFError, OSError):
            self._selector.unregister(view)
            self._view = None
            return
        self.answer(json.dumps(values).encode())

    def _share(self) -> None:
        """Have the newest place linearised, and show it."""
        if not self._busy and (self.stream.lost or not np.array_equal(self._asked, self._now)):
            start = None if self.stream.lost else self.stream.modes
            try:
                self._busy = self._helper.send((self._now, start, self._uncertain))
            except OSError:  # it has ended
                self.ended = True
            if self._busy:
                self._asked = self._now
        now = time.monotonic()
        if self._view is not None and now - self._shown >= SHOWN:
            self._shown = now
            outputs: FloatArray = self.stream.linear(self._now).outputs
            here = self.stream.here
            try:
                self._view.send((self._now, self.stream.modes, outputs, here.errors, here.spread))
            except OSError:  # the page has ended; frames go on
                self._selector.unregister(self._view)
                self._view = None


def real_time() -> bool:
    """Ask the system to run this process before all usual ones; whether it does. Processes that it starts are usual."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    except (OSError, AttributeError):  # not permitted, or not on this system
        return False
    return True


class _UnknownError(ValueError):
    """A parameter that the model does not have."""


def serve(path: Path, host: str, port: int, page: int | None, *, quiet: bool = False) -> None:
    """Serve a reduced model until the user ends it.

    Parameters
    ----------
    path
        The file.
    host, port
        Where clients connect.
    page
        Port of the page; None for no page.
    quiet
        Say nothing.
    """
    from workflows.live.page import show

    context = multiprocessing.get_context("spawn")
    view = process = None
    if page is not None:
        view, theirs = pair()
        process = context.Process(target=show, args=(str(path), page, theirs), daemon=True)
        process.start()
        theirs.close()
    loop = Loop(path, host, port, view)
    prompt = real_time()
    if not quiet:
        sys.stdout.write(f"frames: {host}:{loop.port}, a line of JSON each\n")
        if page is not None:
            sys.stdout.write(f"page: http://127.0.0.1:{page}/\n")
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
