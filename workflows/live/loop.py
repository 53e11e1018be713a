"""The fast loop of `tissuq live`: parameters in, outputs with errors and spread out, a line of JSON each.

One process does nothing else, with the priority of real time where the system lets it, and collects no garbage while
frames come. A second one makes local models of the newest frame, over and over; a third one serves the page. What they
have to say is taken between frames in whole messages (`workflows.live.mail`), so a frame never waits for them.

What clients say and are told, who is served, and what frames are when they are late or far: docs/how-to/reduced.md.
What begins with anything but a table is no client, but perhaps a page in a browser, whatever follows.
"""

from __future__ import annotations

import contextlib
import errno
import gc
import json
import multiprocessing
import os
import selectors
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import FiniteFloat, TypeAdapter

from forward.model import SolveError
from forward.reduced.data import load
from forward.reduced.model import ReducedModel
from forward.reduced.newton import outside_of
from forward.reduced.stream import Local, Stream, local
from workflows.live.mail import Mail, pair
from workflows.live.token import place, same

WITHIN = 0.5e-3  # s that the corrections of a frame may take
REST = 5e-5  # s in which the system delivers an answer before its correction is made
SHOWN = 1 / 60  # s between states that are sent to the page
BEHIND = 5  # how much nicer the other processes are than the loop
LONGEST = 2**16  # bytes of a line
FIRST = 5.0  # s until the first line is there
AT_ONCE = 2**13  # bytes that are read of one client before others have their turn
CLIENTS, STRANGERS = 16, 16  # that are connected at the same time: those who have spoken, and those who have not
FAR = "the body has moved too far at once: outputs are on the tangent at another place, until this one is solved"
_table = TypeAdapter(dict[str, Any]).validate_json
_number = TypeAdapter(FiniteFloat).validate_python  # text, truth values and what is not finite are none
UNBALANCED = "forces were out of balance by more than 1 % before the last correction: the body moves too fast to follow"


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
                mail.send((replace(found, inverse=found.inverse.astype(np.float32)), ""))  # in half the room
            except SolveError as error:
                mail.send((None, str(error)))
    except (EOFError, OSError, KeyboardInterrupt):
        return


@dataclass
class _Client:
    """What is known of one that is connected."""

    heard: float  # when it last said something, by the monotonic clock
    known: bool = False  # whether it has said its first line
    asked: bool = False  # whether it has asked for a frame
    rest: bytes = b""  # what came of a line that is not complete
    unsent: bytes = b""  # answers for which there was no room
    skipping: bool = False  # whether what comes is the rest of a line that was too long


class Loop:
    """Frames of a reduced model for all clients, one after the other.

    The `view` sends what the page shows, and what its sliders say comes back. Clients must say the token first, if
    there is one; else anyone on this machine, or that reaches it, is served.
    """

    def __init__(
        self, path: Path, listening: socket.socket, view: Mail | None = None, token: str | None = None
    ) -> None:
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
        self._refused = ""  # why there is no local model where one was asked for last
        self._listening, self._token = listening, token
        listening.setblocking(False)  # one that has gone before it was accepted keeps nobody waiting
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listening, selectors.EVENT_READ, self._accept)
        self._selector.register(self._helper, selectors.EVENT_READ, self._local)
        if view is not None:
            self._selector.register(view, selectors.EVENT_READ, self._slid)
        self._clients: dict[socket.socket, _Client] = {}
        self.ended = False

    def run(self) -> None:
        """Answer until `ended` is set."""
        gc.collect()
        gc.freeze()
        gc.disable()
        try:
            while not self.ended:
                ready = self._selector.select(SHOWN)
                for key, _ in sorted(ready, key=lambda one: one[0].fileobj not in self._clients):  # they first
                    handle: Callable[[Any], None] = key.data
                    handle(key.fileobj)
                if self.stream.behind:
                    time.sleep(REST)
                    self.stream.frame(self._now, self.stream.takes + self.stream.besides)  # one correction
                self._share()
                self._dismiss()
                if not ready:
                    gc.collect(0)
        finally:
            gc.enable()
            gc.unfreeze()

    def close(self) -> None:
        """Let go of everything."""
        self.ended = True
        for one in (*self._clients, self._listening):
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
        try:
            client, _ = listening.accept()
        except OSError as error:
            if error.errno in {errno.EMFILE, errno.ENFILE}:  # there is room for it once another one has left
                self._leave(min(self._clients, key=self._stays, default=None))
                time.sleep(REST)
            return  # or else it has gone again
        client.setblocking(False)
        with contextlib.suppress(OSError):
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._clients[client] = _Client(time.monotonic())
        self._selector.register(client, selectors.EVENT_READ, self._read)
        if self._token is None:
            self._send(client, [self.greeting()])
        if client in self._clients:  # it has not gone meanwhile
            self._make_room(client, STRANGERS)

    def _read(self, client: socket.socket) -> None:
        one = self._clients.get(client)
        if one is None:  # it has had to leave since
            return
        if one.unsent:
            self._send(client, [])
            return
        try:
            arrived = client.recv(AT_ONCE)
        except BlockingIOError:
            return
        except OSError:
            arrived = b""
        if not arrived:
            self._leave(client)
            return
        if one.skipping:
            _, newline, arrived = arrived.partition(b"\n")
            if not newline:
                return
            one.skipping = False
        *lines, one.rest = (one.rest + arrived).split(b"\n")
        answers: list[dict[str, Any]] = []
        if not one.known:
            if not lines and len(one.rest) <= LONGEST and one.rest.lstrip()[:1] in {b"", b"{"}:
                return
            objection, first = self._introduced(lines[0] if lines else b"")
            if objection:
                self._send(client, [{"error": objection}])
                self._leave(client)
                return
            one.known, one.heard = True, time.monotonic()
            self._make_room(client, CLIENTS)
            answers = [] if self._token is None else [self.greeting()]
            lines[:1] = first
        if lines:
            one.asked, one.heard = True, time.monotonic()
        answers += [self.answer(line, late=k < len(lines)) for k, line in enumerate(lines, 1)]
        if len(one.rest) > LONGEST:
            answers.append({"error": f"a line of more than {LONGEST} bytes, expected a table of numbers"})
            one.skipping, one.rest = True, b""
        self._send(client, answers)

    def _introduced(self, line: bytes) -> tuple[str, list[bytes]]:
        """Return what is wrong with a first line, or else what is to be answered of it besides the token."""
        try:
            table = _table(line)
        except (ValueError, TypeError, RecursionError):
            return "expected a table in JSON as the first line; nothing else is answered here", []
        given = table.pop("token", None)
        if self._token is not None and not same(given, self._token):
            return f'expected {{"token": "..."}} first, with what is in {place()} where `tissuq live` runs', []
        return "", [json.dumps(table).encode()] if table or given is None else []

    def _make_room(self, new: socket.socket, most: int) -> None:
        """Have another one leave of the kind of a new one, of which there are at most so many."""
        known = self._clients[new].known
        kind = [client for client, one in self._clients.items() if one.known == known and client is not new]
        if len(kind) >= most:
            self._leave(min(kind, key=self._stays))

    def _stays(self, client: socket.socket) -> tuple[bool, bool, float]:
        """Of two clients the one with the smaller leaves: strangers, those who never asked, the longest silent."""
        one = self._clients[client]
        return one.known, one.asked, one.heard

    def _dismiss(self) -> None:
        """Have those leave that were to say a token and have said nothing."""
        if self._token is None:
            return
        now = time.monotonic()
        for client, one in list(self._clients.items()):
            if not one.known and now - one.heard > FIRST:
                self._send(client, [{"error": f'expected {{"token": "..."}} within {FIRST:.0f} s'}])
                self._leave(client)

    def _leave(self, client: socket.socket | None) -> None:
        if client is not None and self._clients.pop(client, None) is not None:
            self._selector.unregister(client)
            client.close()

    def _send(self, client: socket.socket, tables: list[dict[str, Any]]) -> None:
        """Send answers; of what there is no room for now, the rest once there is, and nothing is read before."""
        one = self._clients[client]
        before = one.unsent
        content = before + b"".join(json.dumps(table).encode() + b"\n" for table in tables)
        try:
            sent = client.send(content) if content else 0
        except BlockingIOError:
            sent = 0
        except OSError:  # it has gone
            self._leave(client)
            return
        one.unsent = content[sent:]
        if before or one.unsent:
            self._selector.modify(client, selectors.EVENT_WRITE if one.unsent else selectors.EVENT_READ, self._read)

    def answer(self, line: bytes, *, late: bool = False) -> dict[str, Any]:
        """Return the answer to a line."""
        begin = time.perf_counter()
        own: dict[str, Any] = {}
        names = self._data.parameters
        try:
            table = _table(line)
            number = table.pop("id", None)
            if isinstance(number, str) or (number is not None and np.isfinite(number)):
                own = {"id": number}
            values = {str(path): _number(value, strict=True) for path, value in table.items()}
        except (ValueError, TypeError, OverflowError, RecursionError):
            return {**own, "error": "expected a table of numbers by parameter, in JSON"}
        for path in values:
            if path not in names:
                expected = f"expected one of: {', '.join(names)}"
                return {**own, "error": f"'{path}' is not a parameter, {expected}"}
        self._now = self._now.copy()
        for path, value in values.items():
            self._now[names.index(path)] = value
            self._uncertain[names.index(path)] = 0.0  # what is set is known
        frame = self.stream.linear(self._now) if late else self.stream.frame(self._now, WITHIN)
        beyond, doubt = outside_of(self._data, self._now), self._doubt
        unknown = np.full(len(frame.outputs), np.nan)
        return {
            **own,
            "outputs": _known(frame.outputs),
            "errors": _known(unknown if doubt else frame.errors),
            "spread": _known(unknown if doubt else self.stream.here.spread),
            "residual": _known([frame.residual])[0],
            "corrections": frame.corrections,
            "late": late,
            **({"outside": beyond} if beyond else {}),
            **({"doubt": doubt} if doubt else {}),
            "local_ms": round(1e3 * (time.monotonic() - self._made), 1),
            "microseconds": round(1e6 * (time.perf_counter() - begin)),
        }

    @property
    def _doubt(self) -> str:
        """Why the newest frame is not an answer of the model; empty if it is one."""
        if self._refused or self.stream.lost:
            return self._refused or FAR
        return UNBALANCED if self.stream.unbalanced else ""

    # --- the other processes -----------------------------------------------------------------------------------------

    def _local(self, helper: Mail) -> None:
        found: Local | None
        try:
            found, self._refused = helper.receive()
        except (EOFError, OSError):
            self.ended = True
            return
        self._busy = False
        if found is not None:
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
        again = self.stream.lost and not self._refused  # what has no equilibrium has none the next time
        if not self._busy and (again or not np.array_equal(self._asked, self._now)):
            start = None if self.stream.lost or self._refused else self.stream.modes
            try:
                self._busy = self._helper.send((self._now, start, self._uncertain))
            except OSError:  # it has ended
                self.ended = True
            if self._busy:
                self._asked = self._now
        now = time.monotonic()
        if self._view is not None and now - self._shown >= SHOWN:
            self._shown = now
            frame = self.stream.linear(self._now)
            known = frame.errors, self.stream.here.spread
            errors, spread = (np.full(len(x), np.nan) if self._doubt else x for x in known)
            try:
                self._view.send((self._now, self.stream.modes, frame.outputs, errors, spread))
            except OSError:  # the page has ended; frames go on
                self._selector.unregister(self._view)
                self._view = None


def _known(values: Any) -> list[float | None]:
    """Return numbers for JSON, which has none that are not finite."""
    return [float(value) if np.isfinite(value) else None for value in values]
