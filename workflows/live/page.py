"""The page of `tissuq live`: one file, the surface of the body at the newest frame, and sliders that move it.

What it shows and moves is for those who have the token: behind the `#` of its address, which browsers send to nobody.
The page sends it in a header, which no page elsewhere can; these are refused besides.
"""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import numpy as np

from forward.model import FloatArray
from forward.reduced.data import ReducedData, load
from workflows.http import Listening, foreign
from workflows.live.mail import Mail
from workflows.live.token import same
from workflows.results.surfaces import flat, outer

HERE = Path(__file__).parent
LARGEST = 2**16  # bytes of a request
CONNECTIONS = 24  # that are open at the same time, of more the longest without an answer is closed; a browser has six
IDLE = 10.0  # s after which one is closed of which nothing comes


class Scene:
    """The surface of a reduced model at its newest frame."""

    def __init__(self, data: ReducedData) -> None:
        triangles, _ = outer(data.cells, flat(data.cell_kind))
        self._nodes, local = np.unique(triangles, return_inverse=True)
        self._data = data
        rows = (3 * self._nodes[:, None] + np.arange(3)).ravel()
        modes = data.levels[0].modes
        before = data.before
        self._lifts = data.fields[: len(data.lifts), rows]
        self._modes = np.ascontiguousarray(data.fields[before : before + modes, rows])
        ranges = (numbers.tolist() for numbers in (data.lower, data.upper, data.nominal))
        self.told = {
            "places": data.places[self._nodes].ravel().tolist(),
            "triangles": local.ravel().tolist(),
            "outputs": [[output.name, output.unit] for output in data.outputs],
            "parameters": list(zip(data.parameters, *ranges, strict=True)),
        }
        self.parameters = frozenset(data.parameters)
        self.latest: tuple[FloatArray, ...] = ()  # parameters, modes, outputs, errors, spread

    def image(self) -> bytes:
        """Return the newest frame: numbers of the outputs (three each), then displacements of the surface, float32."""
        if not self.latest:
            return b""
        parameters, modes, *rest = self.latest
        moved = np.array([value if n < 0 else parameters[n] for n, value in self._data.lifts])
        u = modes @ self._modes + (moved @ self._lifts if len(moved) else 0.0)
        return bytes(np.concatenate([*rest, u]).astype("<f4").tobytes())


class _Server(Listening):
    """Serves a scene at a socket to those who have the token; `move` is called with what sliders say."""

    def __init__(
        self, scene: Scene, listening: socket.socket, move: Callable[[dict[str, float]], object], token: str | None
    ) -> None:
        super().__init__(listening, _Handler)
        self.scene, self.move, self.token = scene, move, token
        self._answered: dict[socket.socket, float] = {}  # open connections, and when they had their last answer
        self._lock = threading.Lock()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection, and close another one if there are too many."""
        with self._lock:
            if len(self._answered) >= CONNECTIONS:
                silent = min(self._answered, key=lambda one: self._answered[one])
                del self._answered[silent]
                with contextlib.suppress(OSError):
                    silent.shutdown(socket.SHUT_RDWR)  # its thread closes it
            self._answered[request] = time.monotonic()
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._lock:
            self._answered.pop(request, None)
        super().shutdown_request(request)

    def answered(self, request: socket.socket) -> None:
        """Note that a connection has had an answer."""
        with self._lock:
            if request in self._answered:
                self._answered[request] = time.monotonic()


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = IDLE
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # or a picture takes 40 ms

    def _may(self) -> bool:
        """Whether it is our page that asks, with the token; a page elsewhere can make its name point here."""
        token = self.server.token
        given = self.headers.get("Authorization", "").removeprefix("Bearer ")
        if not foreign(self.headers, "127.0.0.1") and (token is None or self.path == "/" or same(given, token)):
            return True
        self.send_error(403)  # and ends the connection: what has not been read would be taken for the next request
        return False

    def _answer(self, content: bytes, kind: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Frame-Options", "DENY")
        self.end_headers()
        self.wfile.write(content)
        self.server.answered(self.connection)

    def do_GET(self) -> None:
        if not self._may():
            return
        match self.path:
            case "/":
                self._answer((HERE / "page.html").read_bytes(), "text/html; charset=utf-8")
            case "/scene":
                self._answer(json.dumps(self.server.scene.told).encode(), "application/json")
            case "/frame":
                self._answer(self.server.scene.image(), "application/octet-stream")
            case _:
                self.send_error(404)

    def _values(self) -> dict[str, float]:
        length = int(self.headers.get("Content-Length", "0"))
        # A page elsewhere may send text, but no JSON, without being allowed to.
        if self.headers.get("Content-Type") == "application/json" and 0 < length <= LARGEST:
            values = {str(k): float(v) for k, v in json.loads(self.rfile.read(length)).items()}
            if values.keys() <= self.server.scene.parameters and np.isfinite(list(values.values())).all():
                return values
        raise ValueError

    def do_POST(self) -> None:
        if not self._may():
            return
        try:
            values = self._values()
        except (ValueError, TypeError, AttributeError, OverflowError, RecursionError):
            self.send_error(400)
            return
        self.server.move(values)
        self._answer(b"{}", "application/json")

    def log_message(self, format: str, *arguments: Any) -> None:
        return


def show(path: str, listening: socket.socket, mail: Mail, token: str | None = None) -> None:
    """Serve the page of a model whose newest frames come by mail, until that is closed."""
    scene = Scene(load(Path(path)))
    found = _Server(scene, listening, mail.send, token)
    threading.Thread(target=found.serve_forever, daemon=True).start()
    try:
        while True:
            scene.latest = mail.receive()
    except (EOFError, OSError, KeyboardInterrupt):
        found.shutdown()
