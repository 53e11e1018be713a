"""Finished blocks on disk: one file of plain data each while a study runs, one HDF5 file for all at its end.

A file is written under a temporary name and renamed into place, so that whatever has its final name is complete. A
block is found by its request, whoever made it: its name is a hash of the points and of everything else that determines
the answer. It has a checksum of its content and its name, so that neither damage nor swapped files pass for an answer.
"""

from __future__ import annotations

import hashlib
import json
import pickle
import shutil
import sys
from collections.abc import Iterable, Mapping
from dataclasses import asdict, fields, is_dataclass
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
HEAD = 512  # bytes before the content, as HDF5 allows; they begin with a checksum of the rest
SUFFIX = ".block"
OWN = {"forward", "inverse", "uq"}  # packages whose dataclasses and named tuples are plain data
OF_ARRAYS = {"_reconstruct", "_frombuffer", "scalar", "ndarray", "dtype"}


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


class _Reader(pickle.Unpickler):
    """Reads plain data: numbers, arrays, and dataclasses and named tuples of them; a file can do nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        """Return one of the few things that plain data are made of."""
        package = module.partition(".")[0]
        if package in OWN or (package == "numpy" and name in OF_ARRAYS):  # nothing else is even imported
            found = super().find_class(module, name)
            if package == "numpy" or (isinstance(found, type) and (is_dataclass(found) or issubclass(found, tuple))):
                return found
        raise pickle.UnpicklingError(f"{module}.{name} is no plain data")


def reread(block: T) -> T:
    """Return plain data as they would be read from disk, to the layout of their arrays, which sums may depend on."""
    found: T = _Reader(BytesIO(pickle.dumps(block))).load()
    return found


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
            note = self._read(key, whole=False)
        except OSError as error:
            sys.stderr.write(f"{error}; computed again\n")
            path.unlink(missing_ok=True)
            return False
        objection = self._code.objection(note) if self._code is not None else None
        if objection is not None:
            raise ModelError(f"{self._directory}: {objection}")
        return True

    def save(self, key: str, block: object) -> None:
        """Write a finished block, plain data other than None, and rename its file into place."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            raise StopError(
                f"{self._folder}: cannot be created: {error.strerror}; the same command continues once that is fixed"
            ) from None
        note = "" if self._code is None else self._code.note()
        _write(self.path(key), pickle.dumps(note) + pickle.dumps(block), key)

    def find(self, key: str) -> Any:
        """Return a finished block; None if there is none. Errors as for `has`."""
        return self.read(key) if self.has(key) else None

    def read(self, key: str) -> Any:
        """Return a block whose checksum was verified; a `DamagedError` if it is no plain data."""
        return self._read(key, whole=True)

    def _read(self, key: str, *, whole: bool) -> Any:
        """Return what was saved with a block, or that and the block."""
        path = self.path(key)
        try:
            with path.open("rb") as file:
                file.seek(HEAD)
                note = _Reader(file).load()
                return _Reader(file).load() if whole else note
        except (pickle.UnpicklingError, EOFError) as error:
            raise DamagedError(path) from error

    @property
    def answers(self) -> bool:
        """Whether any stored block holds more than failed solves."""
        return any(self._answers(path.stem) for path in self._folder.glob(f"*{SUFFIX}"))

    def _answers(self, key: str) -> bool:
        """Whether a block does; one that cannot be read counts as such."""
        try:
            block = self.read(key)
        except OSError:
            return True
        return not isinstance(block, Evaluations) or len(block.failures) < len(block.points)

    def drop(self, keys: Iterable[str]) -> None:
        """Remove blocks that are no longer needed because their results are stored."""
        for key in keys:
            self.path(key).unlink(missing_ok=True)

    def path(self, key: str) -> Path:
        """Return the path of a block."""
        return self._folder / f"{key}{SUFFIX}"

    def consolidate(self, evaluations: Mapping[str, Evaluations]) -> None:
        """Write all evaluations as `evaluations.h5`, each under its name; the blocks stay until `clear`."""
        with in_memory(HEAD) as file:
            for name, found in evaluations.items():
                _put(file.require_group(name), found)
            _write(self._directory / "evaluations.h5", image(file))

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


def _put(group: h5py.Group, block: Evaluations) -> None:
    """Write evaluations into a group of a file."""
    for name, array in block.rows.items():
        group[name] = array
    group["work"].attrs["columns"] = list(WORK)
    group["stability"].attrs["values"] = [known.name.lower().replace("_", " ") for known in Stability]
    group["failures"] = json.dumps([asdict(failure) for failure in block.failures])
    if block.fields.size:
        group["fields"] = block.fields


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
    try:
        with h5py.File(path, "r") as whole:
            file = whole[name]
            failures = tuple(
                Failure(f["index"], tuple(f["parameters"]), f["reason"], tuple(f["history"]), f["inadmissible"])
                for f in json.loads(file["failures"][()])
            )
            rows = {name: np.asarray(file[name]) for name in ROWS if name in file or name not in ON_REQUEST}
            return Evaluations.of(rows, failures, np.asarray(file["fields"]) if "fields" in file else np.zeros((0, 0)))
    except (OSError, KeyError, ValueError) as error:
        raise DamagedError(path) from error
