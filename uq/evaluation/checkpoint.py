"""Finished blocks on disk: one file each while a study runs, one file for all at its end.

A file is written under a temporary name and renamed into place, so that whatever has its final name is complete. A
block is found by its request, whoever made it: its name is a hash of the points and of everything else that determines
the answer. It has a checksum of its content and its name, so that neither damage nor swapped files pass for an answer.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from io import BufferedReader, BytesIO
from pathlib import Path
from typing import Any, Protocol, TypeVar

import h5py
import numpy as np

from forward.errors import Error
from forward.machine import StopError, write_whole
from forward.model import WORK, ModelError, Stability
from uq.evaluation.hdf5 import image, in_memory
from uq.evaluation.request import ON_REQUEST, ROWS, Evaluations, Failure

T = TypeVar("T")
HEAD = 512  # bytes before those of HDF5; they begin with a checksum of the rest


class DamagedError(Error, OSError):
    """A file of evaluations that is not as it was written."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path}: damaged, or not what it is named after")


class Code(Protocol):
    """The user's code that was loaded during a run, beyond that covered by the identity of the study."""

    def note(self) -> str:
        """Describe it, for storage with a block."""

    def objection(self, note: str) -> str | None:
        """Say why a block with a note is no longer valid; None if it is."""


class Block(Protocol):
    """Finished work other than evaluations."""

    def image(self, note: str) -> bytes:
        """Return the bytes of an HDF5 file with an attribute `note`; the first `HEAD` are left free."""


@dataclass(frozen=True)
class Plain:
    """A block of bytes."""

    data: bytes

    def image(self, note: str) -> bytes:
        """Return the bytes of its file."""
        with in_memory(HEAD) as file:
            file.attrs["note"] = note
            file["found"] = np.frombuffer(self.data, dtype=np.uint8)
            return image(file)

    @staticmethod
    def read(path: Path) -> bytes:
        """Return the bytes; a `DamagedError` if there are none."""
        try:
            with h5py.File(path, "r") as file:
                return bytes(np.asarray(file["found"]).data)
        except (OSError, KeyError, ValueError) as error:
            raise DamagedError(path) from error


class Checkpoint:
    """The finished blocks of a study in a directory.

    Parameters
    ----------
    directory
        The results directory; blocks are kept in its folder `evaluations`.
    identity
        Text that, with the request, determines the answers (the study, the version of the program).
    code
        Knows which of the user's code was loaded during the run.
    """

    def __init__(self, directory: Path, identity: str, code: Code | None = None) -> None:
        self._directory = directory
        self._folder = directory / "evaluations"
        self._identity = identity.encode()
        self._code = code

    def part(self, name: str) -> Checkpoint:
        """Return that of a part of the study, whose answers are its own."""
        return Checkpoint(self._directory, json.dumps([self._identity.decode(), name]), self._code)

    def key(self, block: object) -> str:
        """Return the name of a block, from a request or another value that specifies it."""
        return digest(block, self._identity).hex()[:24]

    def has(self, key: str) -> bool:
        """Whether a block is finished; one that is damaged or answers another request is removed.

        Raises `ModelError` if a file of the user on which it depends has changed.
        """
        path = self.path(key)
        if not path.exists():
            return False
        try:
            _check(path, key)
            with h5py.File(path, "r") as file:
                note = str(file.attrs["note"])
        except OSError as error:
            sys.stderr.write(f"{error}; computed again\n")
            path.unlink(missing_ok=True)
            return False
        objection = self._code.objection(note) if self._code is not None else None
        if objection is not None:
            raise ModelError(f"{self._directory}: {objection}")
        return True

    def save(self, key: str, block: Evaluations | Block) -> None:
        """Write a finished block and rename it into place."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            raise StopError(
                f"{self._folder}: cannot be created: {error.strerror}; the same command continues once that is fixed"
            ) from None
        note = "" if self._code is None else self._code.note()
        body = _image({"/": block}, note) if isinstance(block, Evaluations) else block.image(note)
        _write(self.path(key), body, key)

    def find(self, key: str, read: Callable[[Path], T]) -> T | None:
        """Return a finished block, as `read` reads it; None if there is none. Errors as for `has`."""
        return read(self.path(key)) if self.has(key) else None

    @property
    def answers(self) -> bool:
        """Whether any stored block holds more than failed solves."""
        return any(_has_answers(path) for path in self._folder.glob("*.h5"))

    def drop(self, keys: Iterable[str]) -> None:
        """Remove blocks that are no longer needed because their results are stored."""
        for key in keys:
            self.path(key).unlink(missing_ok=True)

    def path(self, key: str) -> Path:
        """Return the path of a block."""
        return self._folder / f"{key}.h5"

    def consolidate(self, evaluations: Mapping[str, Evaluations]) -> None:
        """Write all evaluations as `evaluations.h5`, each under its name; the blocks stay until `clear`."""
        _write(self._directory / "evaluations.h5", _image(evaluations))

    def clear(self) -> None:
        """Remove the files of the blocks: the study is finished."""
        shutil.rmtree(self._folder, ignore_errors=True)


def digest(value: object, before: bytes = b"") -> bytes:
    """Return a hash of a value, after some text; arrays count by their numbers, dataclasses and tuples part by part."""
    hashed = hashlib.sha256(before)
    _feed(hashed, value)
    return hashed.digest()


def _feed(digest: Any, value: object) -> None:
    if isinstance(value, np.ndarray):
        digest.update(repr((value.shape, value.dtype.str)).encode())
        digest.update(np.ascontiguousarray(value).data)
    elif is_dataclass(value):
        digest.update(type(value).__name__.encode())
        for field in fields(value):
            digest.update(field.name.encode())
            _feed(digest, getattr(value, field.name))
    elif isinstance(value, tuple):
        digest.update(f"({len(value)})".encode())
        for one in value:
            _feed(digest, one)
    else:
        digest.update(repr(value).encode())


def _image(blocks: Mapping[str, Evaluations], note: str = "") -> bytes:
    """Return the bytes of a file of evaluations, each in the group of its name, without the head."""
    with in_memory(HEAD) as file:
        for name, block in blocks.items():
            group = file.require_group(name)
            write(group, block)
            group.attrs["note"] = note
        return image(file)


def write(group: h5py.Group, block: Evaluations) -> None:
    """Write evaluations into a group of a file."""
    for name, array in block.rows.items():
        group[name] = array
    group["work"].attrs["columns"] = list(WORK)
    group["stability"].attrs["values"] = [known.name.lower().replace("_", " ") for known in Stability]
    group["failures"] = json.dumps([asdict(failure) for failure in block.failures])
    if block.fields.size:
        group["fields"] = block.fields


def _has_answers(path: Path) -> bool:
    """Whether a block holds more than failed solves; a block that cannot be read counts as such."""
    try:
        with h5py.File(path, "r") as file:
            return len(json.loads(file["failures"][()])) < len(file["points"])
    except (OSError, KeyError, ValueError):
        return True


def _write(path: Path, body: bytes, key: str = "") -> None:
    """Write a file, with its checksum before it, and rename it into place."""
    write_whole(path, _checksum(BytesIO(body), key).encode().ljust(HEAD, b"\0") + body)


def _checksum(file: BytesIO | BufferedReader, key: str) -> str:
    """Return a hash of the rest of a file and of its key."""
    return hashlib.file_digest(file, lambda: hashlib.sha256(key.encode())).hexdigest()


def _check(path: Path, key: str) -> None:
    """Raise `DamagedError` unless a file is as it was written; HDF5 may crash on one wrong bit."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD)
            if _checksum(file, key).encode() == head[:64]:
                return
            if not key and head.startswith(b"\x89HDF"):  # from a version that wrote no checksum
                return
    except FileNotFoundError:
        raise
    except OSError as error:
        raise DamagedError(path) from error
    raise DamagedError(path)


def load(path: Path, name: str = "/") -> Evaluations:
    """Read evaluations in a group of a file, such as an `evaluations.h5`, which holds several by name if there were.

    Raises `DamagedError` if the file cannot be read, or its content is not what was written, and `FileNotFoundError` if
    there is none.
    """
    _check(path, "")
    return read(path, name)


def read(path: Path, name: str = "/") -> Evaluations:
    """Read evaluations from a file whose checksum was verified."""
    try:
        with h5py.File(path, "r") as whole:
            file = whole[name]
            failures = tuple(
                Failure(f["index"], tuple(f["parameters"]), f["reason"], tuple(f["history"]), f["inadmissible"])
                for f in json.loads(file["failures"][()])
            )
            rows = {name: np.asarray(file[name]) for name in ROWS if name in file or name not in ON_REQUEST}
            counts = rows["work"]  # an earlier version had fewer of them
            rows["work"] = np.pad(counts, ((0, 0), (0, max(0, len(WORK) - counts.shape[1]))))
            return Evaluations.of(rows, failures, np.asarray(file["fields"]) if "fields" in file else np.zeros((0, 0)))
    except (OSError, KeyError, ValueError) as error:
        raise DamagedError(path) from error
