"""Messages between two processes, whole or not at all: no end waits for the other amid one, as it would with pipes.

Packets of a Unix socket arrive whole; where there is no room for one, it is left out: only the newest matters.
"""

from __future__ import annotations

import errno
import os
import pickle
import socket
from typing import Any

LARGEST = 1 << 20  # bytes of a message, if the system has as much room


class Mail:
    """One end of a line between two processes of this program, of a pair of sockets; what comes in is trusted."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, LARGEST)

    def fileno(self) -> int:
        """Return the number of the socket, for selectors."""
        return self._end.fileno()

    def send(self, message: Any) -> bool:
        """Send a message if there is room for it; whether there was.

        An OSError says that the other end is closed, or that there would never be as much room.
        """
        packet = pickle.dumps(message, protocol=5)
        if len(packet) > LARGEST:  # the other end would read a part of it
            raise OSError(errno.EMSGSIZE, os.strerror(errno.EMSGSIZE))
        try:
            self._end.send(packet, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return False
        return True

    def receive(self) -> Any:
        """Wait for a message; an EOFError if the other end is closed."""
        packet = self._end.recv(LARGEST)
        if not packet:
            raise EOFError
        return pickle.loads(packet)

    def close(self) -> None:
        """Let go of it."""
        self._end.close()


def pair() -> tuple[Mail, Mail]:
    """Return both ends of a line."""
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    return Mail(one), Mail(other)
