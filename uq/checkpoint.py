"""Finished blocks on disk: one file each while a study runs, one file of all at its end.

A file is written under another name and renamed into place, so that whatever carries its final name is whole. A block
is found by what was asked, not by who asked: its name is a hash of the points and of everything else that decides the
answer.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from forward.model import WORK
from uq.evaluate import Evaluations, Failure, Request


class Checkpoint:
    """The finished blocks of a study in a directory.

    Parameters
    ----------
    directory
        The results directory; blocks are kept in its folder `evaluations`.
    identity
        Text that decides the answers besides the request (the study, the version of the program).
    """

    def __init__(self, directory: Path, identity: str) -> None:
        self._directory = directory
        self._folder = directory / "evaluations"
        self._identity = identity.encode()

    def key(self, block: Request) -> str:
        """Return the name of a block."""
        return digest(block, self._identity).hex()[:24]

    def has(self, key: str) -> bool:
        """Whether a block is finished; a file that cannot be read is removed."""
        path = self._path(key)
        if not path.exists():
            return False
        try:
            with h5py.File(path, "r"):
                return True
        except OSError:
            path.unlink()
            return False

    def save(self, key: str, block: Evaluations) -> None:
        """Write a finished block and rename it into place."""
        self._folder.mkdir(parents=True, exist_ok=True)
        _write(self._path(key), {"/": block})

    def load(self, key: str) -> Evaluations:
        """Read a finished block."""
        return load(self._path(key))

    def _path(self, key: str) -> Path:
        return self._folder / f"{key}.h5"

    def consolidate(self, evaluations: Mapping[str, Evaluations]) -> None:
        """Write all evaluations as `evaluations.h5`, each under its name; the blocks stay until `clear`."""
        _write(self._directory / "evaluations.h5", evaluations)

    def clear(self) -> None:
        """Remove the files of the blocks: the study is finished."""
        shutil.rmtree(self._folder, ignore_errors=True)


def digest(value: object, before: bytes = b"") -> bytes:
    """Return a hash of a value, after some text: of arrays by their numbers, of dataclasses by their fields."""
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
    else:
        digest.update(repr(value).encode())


def _write(path: Path, blocks: Mapping[str, Evaluations]) -> None:
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    with h5py.File(partial, "w") as file:
        for name, block in blocks.items():
            group = file.require_group(name)
            group["points"] = block.points
            group["outputs"] = block.outputs
            group["seconds"] = block.seconds
            group["work"] = block.work
            group["work"].attrs["columns"] = list(WORK)
            group["residuals"] = block.residuals
            group["converged"] = block.converged
            group["failures"] = json.dumps([asdict(failure) for failure in block.failures])
            if block.tangents is not None:
                group["tangents"] = block.tangents
            if block.fields.size:
                group["fields"] = block.fields
        file.flush()
    with partial.open("rb") as written:
        os.fsync(written.fileno())
    partial.replace(path)


def load(path: Path, name: str = "/") -> Evaluations:
    """Read evaluations, such as those of an `evaluations.h5`, which has several under their names if there were."""
    with h5py.File(path, "r") as whole:
        file = whole[name]
        failures = tuple(
            Failure(f["index"], tuple(f["parameters"]), f["reason"], tuple(f["history"]))
            for f in json.loads(file["failures"][()])
        )
        return Evaluations(
            np.asarray(file["points"]),
            np.asarray(file["outputs"]),
            np.asarray(file["tangents"]) if "tangents" in file else None,
            failures,
            np.asarray(file["seconds"]),
            np.asarray(file["work"]),
            np.asarray(file["residuals"]),
            np.asarray(file["converged"]),
            np.asarray(file["fields"]) if "fields" in file else np.zeros((0, 0)),
        )
