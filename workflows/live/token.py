"""The word by which `tissuq live` knows its own clients: kept for this user, in a file that nobody else can read."""

from __future__ import annotations

import contextlib
import hmac
import os
import secrets
import tempfile
from pathlib import Path

from forward.machine import compiled_forms
from workflows.config.mistakes import StudyError

BYTES = 24  # of chance


def place() -> Path:
    """Return where the token is."""
    return compiled_forms() / "live-token"


def kept() -> str:
    """Return this user's token, made where there is none; a StudyError if others may read it, or it cannot be kept."""
    path = place()
    try:
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile("w", dir=path.parent, encoding="ascii") as file:  # only we can read it
                file.write(f"{secrets.token_urlsafe(BYTES)}\n")
                file.flush()
                with contextlib.suppress(FileExistsError):  # another program was as quick: its token is that of both
                    os.link(file.name, path)
        if path.stat().st_mode & 0o077:
            message = f"{path}: others can read this token, expected `chmod 600`; or delete it, and another one is made"
            raise StudyError(message)
        word = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is damaged"
        message = f"{path}: the token of `tissuq live` cannot be kept there: {reason}; --no-token does without"
        raise StudyError(message) from None
    if len(word) < BYTES:
        raise StudyError(f"{path}: is no token of `tissuq live`; delete it, and another one is made")
    return word


def same(given: object, token: str) -> bool:
    """Whether what somebody says is the token; how long that takes says nothing of it."""
    return hmac.compare_digest(str(given).encode(errors="replace"), token.encode())
