"""Code in C, compiled once for each kind of processor and kept in the folder of compiled forms."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

from forward.machine import compiled_forms

# How all C is compiled, forms too; TISSUQ_CFLAGS in the environment replaces it. Sums are not reordered: what is
# written keeps its digits on every processor (docs/decisions/0049-nothing-is-reordered.md has what that costs).
_DEFAULT = "-O2 -ftree-vectorize -g0 -march=native -fno-math-errno -fno-trapping-math -fno-signed-zeros"
FLAGS = tuple(shlex.split(os.environ.get("TISSUQ_CFLAGS", _DEFAULT)))


@cache
def processor() -> str:
    """What the processor can do; empty where the system does not say it."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line for line in lines if line.startswith("flags"))
    return ""


def library(source: str, *, flags: Sequence[str] = FLAGS, against: Sequence[str] = ("-lm",)) -> ctypes.CDLL | None:
    """Return code in C as a library, compiled or as it was kept; None without a compiler, or if it fails.

    Processes that compile at the same time replace each other's result by the same.
    """
    key = hashlib.sha256("\n".join([source, processor(), *flags, *against]).encode()).hexdigest()[:24]
    folder = compiled_forms() / "kernels"
    kept = folder / f"{key}.so"
    if not kept.exists():
        compiler = os.environ.get("CC") or shutil.which("cc") or shutil.which("gcc")
        if compiler is None:
            return None
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=folder) as place:
                (Path(place) / "source.c").write_text(source, encoding="utf-8")
                made = ["-fPIC", "-shared", "-o", f"{place}/made.so", f"{place}/source.c"]
                command = [*shlex.split(compiler), *flags, *made, *against]
                subprocess.run(command, check=True, capture_output=True)
                (Path(place) / "made.so").rename(kept)
        except (OSError, subprocess.CalledProcessError):
            return None
    try:
        return ctypes.CDLL(str(kept))
    except OSError:
        return None
