"""How requests reach a server: what is read, for how long, and from whom; refusals are in the form of UM-Bridge."""

from __future__ import annotations

import contextlib
import io
import ipaddress
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from email.message import Message
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

from workflows.config.mistakes import StudyError

SECONDS_TO_SEND = 30.0  # within which a client must send its whole request and take the answer
LARGEST = 16 * 2**20  # bytes of a request
DEEPEST = 32  # levels of lists and tables in a request
MOST_WAITING = 1024  # requests that wait to be answered
Ask = Callable[[str, dict[str, Any]], dict[str, Any]]  # what, with which fields


class RefusalError(Exception):
    """A request that cannot be answered: what is wrong, and the kind of error in the protocol's words."""

    def __init__(self, message: str, kind: str = "InvalidInput", status: int = 400) -> None:
        super().__init__(message)
        self.kind, self.status = kind, status


class _Deadline(io.RawIOBase):
    """What arrives from a socket before a deadline."""

    def __init__(self, connection: socket.socket, seconds: float) -> None:
        self._connection, self._until = connection, time.monotonic() + seconds

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        left = self._until - time.monotonic()
        if left <= 0:
            raise TimeoutError
        self._connection.settimeout(left)
        return self._connection.recv_into(buffer)


class Handler(BaseHTTPRequestHandler):
    """Reads a request, passes it on, and sends the answer."""

    server: Server

    def setup(self) -> None:
        """Set the client's time limit for sending its request."""
        super().setup()
        self._unread = True
        self.rfile = io.BufferedReader(_Deadline(self.connection, SECONDS_TO_SEND))

    def do_GET(self) -> None:
        """Answer a question without fields."""
        self._unread = False
        self._reply(dict)

    def do_HEAD(self) -> None:
        """Say that the server is there."""
        self.send_response(200)
        self.end_headers()

    def do_POST(self) -> None:
        """Answer a question."""
        self._reply(self._question)

    def _question(self) -> dict[str, Any]:
        if self.headers.get("Transfer-Encoding"):
            raise RefusalError("the request has no length, expected a header Content-Length", status=411)
        length = self.headers.get("Content-Length") or "0"
        if not (length.isascii() and length.isdecimal()):
            raise RefusalError("Content-Length: expected a number of bytes")
        if len(length) > 18 or int(length) > LARGEST:
            raise RefusalError(f"the request is too long, expected at most {LARGEST} bytes", status=413)
        try:
            body = self.rfile.read(int(length))
            self._unread = False
        except TimeoutError:
            raise RefusalError(f"the request did not come within {SECONDS_TO_SEND:.0f} s", status=408) from None
        return parsed(body or b"{}")

    def _reply(self, read: Callable[[], dict[str, Any]]) -> None:
        status = 200
        try:
            self._check_origin()
            answer = self.server.ask(self.path.strip("/"), read())
        except RefusalError as refusal:
            answer, status = {"error": {"type": refusal.kind, "message": str(refusal)}}, refusal.status
        self.connection.settimeout(SECONDS_TO_SEND)
        self.send_response(status)
        self._send(answer)
        if self._unread:  # read on for a moment: closing a connection with unread bytes would discard the answer
            self.wfile.flush()
            with contextlib.suppress(OSError):
                self.connection.shutdown(socket.SHUT_WR)
                rest = _Deadline(self.connection, 2.0)
                while rest.readinto(bytearray(2**16)):
                    pass

    def _send(self, answer: dict[str, Any]) -> None:
        body = json.dumps(answer).encode()
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def _check_origin(self) -> None:
        """Refuse requests from browser pages, also under a name that was made to point to this host."""
        objection = foreign(self.headers, self.server.called if self.server.local else None)
        if objection:
            raise RefusalError(objection, "Forbidden", 403)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Say what is wrong with the header of a request."""
        del explain
        self.send_response_only(code)
        self._send({"error": {"type": "InvalidInput", "message": message or HTTPStatus(code).phrase}})

    def log_message(self, format: str, *args: Any) -> None:
        """Do not log single requests."""


class Listening(ThreadingHTTPServer):
    """A server at a socket that listens."""

    def __init__(self, listening: socket.socket, handler: type[BaseHTTPRequestHandler]) -> None:
        super().__init__(listening.getsockname(), handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listening

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say in a line what went wrong, unless the client has just disconnected."""
        error = sys.exception()
        if not isinstance(error, ConnectionError | TimeoutError):
            sys.stderr.write(f"a request was not answered: {type(error).__name__}: {error}\n")


class Server(Listening):
    """A server whose requests are answered by a function of what they ask and their fields, each in its own thread."""

    def __init__(self, host: str, listening: socket.socket, ask: Ask) -> None:
        self.ask = ask
        self.called = host.lower()
        self._free = threading.BoundedSemaphore(MOST_WAITING)
        super().__init__(listening, Handler)
        listening.listen(MOST_WAITING)  # the system's own limit is often lower: clients retry dropped connections
        self.local = ipaddress.ip_address(str(self.server_address[0])).is_loopback

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a separate thread, if there are not too many of these."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer in this thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()


def listen(host: str, port: int, option: str) -> socket.socket:
    """Return a socket at a port, where 0 is any free one; a StudyError if it is taken."""
    try:
        return socket.create_server((host, port))
    except OverflowError as error:
        reason = str(error)
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno and error.errno > 0 else str(error)
    raise StudyError(f"{option} {port}: cannot be used on {host}: {reason}")


def foreign(headers: Message, called: str | None) -> str:
    """Say why a request is that of a page elsewhere, which a browser shows; empty if it is not.

    A server that answers this machine alone is `called` by a name; others (None) have any.
    """
    host, origin = headers.get("Host"), headers.get("Origin")
    if called is not None and host is not None and not _is_local(host, called):
        return f"Host: {host[:80]!r}, expected localhost: this server answers only this machine"
    if origin is not None and (not host or origin.partition("://")[2].lower() != host.lower()):
        return f"Origin: {origin[:80]!r}, expected none: this server does not answer browser pages"
    return ""


def parsed(body: bytes) -> dict[str, Any]:
    """Return the fields of a request; a RefusalError if it is no JSON object, too deep, or has invalid numbers."""

    def refuse(word: str) -> float:
        raise RefusalError(f"{word} is not a number of JSON")

    if nesting(body) > DEEPEST:
        raise RefusalError(f"the request is nested too deeply, expected at most {DEEPEST} levels")
    try:
        question = json.loads(body, parse_constant=refuse)
    except (ValueError, RecursionError):
        question = None
    if not isinstance(question, dict):
        raise RefusalError("the request is not a JSON object")
    return question


def nesting(body: bytes) -> int:
    """Return a bound on the nesting of lists and tables in a JSON text; brackets in strings count too."""
    deepest = level = 0
    for byte in body.translate(None, delete=bytes(set(range(256)) - set(b"[]{}"))):
        level += 1 if byte in b"[{" else -1
        deepest = max(deepest, level)
    return deepest


def _is_local(host: str, called: str) -> bool:
    """Whether the name in a header, with or without a port, is a local name of this machine."""
    with contextlib.suppress(ValueError):
        name = urlsplit(f"//{host}").hostname or ""
        return name in {"localhost", called} or ipaddress.ip_address(name).is_loopback
    return False
