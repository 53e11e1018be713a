"""Forms, expressions and elements, compiled once for each machine."""

from __future__ import annotations

import fcntl
import hashlib
import shutil
import sysconfig
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, TypeVar

import ffcx.naming
from dolfinx import fem

from forward.fem.dolfinx import version
from forward.machine import StopError, compiled_forms
from forward.native import FLAGS, processor
from forward.phases import phase

T = TypeVar("T")


# Folder of compiled code for this kind of processor, this Python and these flags.
_MADE_FOR = " ".join([processor(), str(sysconfig.get_config_var("SOABI")), version.VERSION, *FLAGS])
_CACHE = compiled_forms() / f"forms-{hashlib.sha256(_MADE_FOR.encode()).hexdigest()[:12]}"


def options_for(folder: Path) -> dict[str, Any]:
    """Return DOLFINx's arguments with which it compiles in a folder."""
    options = {"cffi_extra_compile_args": [*FLAGS], "cffi_libraries": ["m"], "cache_dir": str(folder), "timeout": 600}
    return {version.JIT: options}


@contextmanager
def _lock(name: str) -> Iterator[None]:
    """Let one process in at a time. The system releases the lock of a process that dies."""
    try:
        _CACHE.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StopError(
            f"compiled forms cannot be kept in {_CACHE}: {error.strerror}; set XDG_CACHE_HOME to a folder of yours"
        ) from None
    with (_CACHE / f"{name}.lock").open("w") as lock:
        with suppress(OSError):  # some cluster file systems have no locks: then more than one process compiles
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def signature(what: Any) -> str:
    """Name of a form, an element, or an expression with its points; it takes a while to find."""
    return str(ffcx.naming.compute_signature([what], ""))


def folder_of(name: str, beside: str = "") -> Path:
    """Where what is compiled under a name is kept, or what is made from that."""
    return _CACHE / f"{name}{beside}"


def compiled(name: str, make: Callable[[Path], T], comm: Any, beside: str = "") -> T:
    """Return what `make` compiles, or loads, in the folder of a name (its `signature`); collective over `comm`.

    However many processes ask for it at the same time, one compiles: in a folder that is renamed when it is complete,
    so that none ever finds half of it, or waits for a process that was killed. What exists is loaded without a lock.
    """
    folder = folder_of(name, beside)
    if comm.bcast(folder.is_dir() if comm.rank == 0 else None):
        return make(folder)
    with _lock(folder.name) if comm.rank == 0 else nullcontext():
        place = folder
        if comm.rank == 0 and not folder.is_dir():  # it may have appeared
            place = Path(tempfile.mkdtemp(dir=_CACHE))
        place = comm.bcast(place)
        try:
            with phase("compiling forms"):
                made = make(place)
            comm.barrier()  # everyone has loaded it
            if comm.rank == 0 and place != folder:
                with suppress(OSError):  # without locks another process may have been faster
                    place.rename(folder)
        finally:
            if comm.rank == 0 and place != folder:
                shutil.rmtree(place, ignore_errors=True)
    return made


def compile_form(form: Any, comm: Any, name: str = "") -> Any:
    """Compile a UFL form, once per machine, under its `signature`, which may be known; collective over `comm`."""
    return compiled(name or signature(form), lambda folder: fem.form(form, **options_for(folder)), comm)
