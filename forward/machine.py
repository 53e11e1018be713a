"""What the machine has left, memory and disk space, and the exceptions that say that it ran out.

Nothing large is imported at the top, not even NumPy, so that this can be asked before anything else is imported.
"""

from __future__ import annotations

import errno
import os
import resource
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from forward.errors import Error

MIB = 2**20
INTERRUPTED = "interrupted; the same command continues"
FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}  # no room on disk, or no larger file is allowed
IN_THE_WAY = {errno.EISDIR, errno.ENOTDIR, errno.EEXIST, errno.ENOTEMPTY, errno.ELOOP, errno.EROFS, errno.EACCES}
START = 240 * MIB  # Python with NumPy, pydantic and the buffer below
BLAS_BUFFER = 160 * MIB  # OpenBLAS takes 128 MiB for its buffer, and tries for ever where it cannot have them
SHARED_BY_RANKS = 4 * MIB  # file by which MPI lets ranks share memory
PETSC_OUT_OF_MEMORY = 55  # PETSC_ERR_MEM
# How other libraries say it: C++, the dynamic loader, a compiler, the operating system, MUMPS through PETSc.
OUT_OF_MEMORY = (
    "infog(1)=-5",
    "infog(1)=-7",
    "infog(1)=-13",
    "bad_alloc",
    "cannot allocate memory",
    "failed to map segment",
    "out of memory",
    "virtual memory exhausted",
)
FENICSX = {"dolfinx", "dolfinx_solver", "basix", "ffcx", "ufl", "petsc4py", "mpi4py", "h5py"}
HOW_TO_INSTALL = (
    "tissuq needs FEniCSx. On Debian 12: apt-get install python3-dolfinx python3-h5py-mpi libopenblas0-serial, and "
    "install tissuq in an environment of `/usr/bin/python3 -m venv --system-site-packages`; elsewhere, with Python "
    "3.12 or newer: pip install 'tissuq[fenicsx]', and `import dolfinx_solver` before dolfinx in your own code"
)
NO_ROOM = ("no space left on device", "disk quota exceeded", "file too large")
_INTERRUPTIONS: list[int] = []  # signals that came


class StopError(Error):
    """The run cannot go on here and now: no memory, no room on disk, a model that ends its process.

    Nothing is wrong with the study. Finished work is kept, work in progress is lost, and the same command continues
    once the cause, which the message gives in one line, is gone.
    """


@dataclass(frozen=True)
class Headroom:
    """Memory that this process can still allocate.

    Attributes
    ----------
    size
        How much (bytes).
    limit
        What sets this limit, in words.
    of_addresses
        Whether allocated memory counts, rather than used memory.
    of_each_process
        Whether every process has its own limit, rather than a share.
    """

    size: float
    limit: str
    of_addresses: bool = False
    of_each_process: bool = False

    def __str__(self) -> str:
        return f"{self.size / MIB:,.0f} MiB are available ({self.limit})"


def compiled_forms() -> Path:
    """Folder of forms that were compiled before, in a subfolder for each version of what they depend on."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tissuq"


def headroom() -> Headroom:
    """Return the smallest of the limits."""
    return min(limits(), key=lambda one: one.size)


def require(size: float, what: str) -> None:
    """Check that memory is available before it is needed: without it, libraries crash or wait for ever.

    Raises
    ------
    StopError
        If less than `size` (bytes) is left for `what`.
    """
    have = headroom()
    if have.size < size:
        raise StopError(f"memory ran out: {what} needs {size / MIB:,.0f} MiB, {have}")


def reserve_for_linear_algebra() -> None:
    """Let the linear algebra library allocate now the buffer that it keeps.

    Raises
    ------
    StopError
        If there is no room for it.
    """
    require(BLAS_BUFFER, "linear algebra alone")
    import numpy as np

    np.linalg.solve(np.eye(2), np.eye(2))


def require_files(size: float, what: str) -> None:
    """Make sure that files of some size (bytes) are allowed.

    Raises
    ------
    StopError
        If they are not.
    """
    soft, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    if soft != resource.RLIM_INFINITY and soft < size:
        raise StopError(f"{what} needs files of {size / MIB:.0f} MiB, {soft / MIB:.3g} MiB are allowed (ulimit -f)")


def limits() -> Iterator[Headroom]:
    """Yield what the machine, the limits of this process and its control group leave."""
    yield Headroom(float("inf"), "no limit is known")
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        free = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable"))
        yield Headroom(free, "free memory of the machine")
        pages = [int(word) for word in Path("/proc/self/statm").read_text(encoding="ascii").split()]
    except (OSError, StopIteration, ValueError):
        pages = [0] * 7
    page = resource.getpagesize()
    for name, used, said in (
        (resource.RLIMIT_AS, pages[0], "limit of the address space, ulimit -v"),
        (resource.RLIMIT_DATA, pages[5], "limit of the data segment, ulimit -d"),
    ):
        soft, _ = resource.getrlimit(name)
        if soft != resource.RLIM_INFINITY:
            left = max(0, soft - used * page)
            yield Headroom(left, said, of_addresses=name == resource.RLIMIT_AS, of_each_process=True)
    yield from _of_control_groups(Path("/sys/fs/cgroup"), Path("/proc/self/cgroup"))


def _of_control_groups(root: Path, own: Path) -> Iterator[Headroom]:
    """Limits of the control groups of this process (containers, batch systems), in both versions of the interface."""
    try:
        memberships = [line.split(":", 2) for line in own.read_text(encoding="utf-8").splitlines()]
    except OSError:
        return
    for _, controllers, path in (parts for parts in memberships if len(parts) == 3):
        if controllers not in {"", "memory"} and "memory" not in controllers.split(","):
            continue
        top = root / "memory" if controllers else root
        names = (
            ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
            if controllers
            else ("memory.max", "memory.current", "inactive_file")
        )
        folder = top / path.lstrip("/")
        for group in (folder, *folder.parents):
            if not group.is_relative_to(top):
                break
            found = _of_group(group, *names)
            if found is not None:
                yield found


def _of_group(group: Path, most: str, used: str, cached: str) -> Headroom | None:
    try:
        limit = int((group / most).read_text(encoding="ascii"))  # "max" where there is none
        usage = int((group / used).read_text(encoding="ascii"))
        stat = dict(line.split() for line in (group / "memory.stat").read_text(encoding="ascii").splitlines())
    except (OSError, ValueError):
        return None
    # Pages of files that nobody uses are given up for others.
    return Headroom(max(0, limit - usage + int(stat.get(cached, 0))), "limit of the control group")


def out_of_memory(error: BaseException) -> bool:
    """Whether an exception, or one of its causes, says that memory ran out."""
    return any(
        isinstance(one, MemoryError)
        or getattr(one, "ierr", None) == PETSC_OUT_OF_MEMORY
        or (isinstance(one, OSError) and one.errno == errno.ENOMEM)
        or _says(one, OUT_OF_MEMORY)
        for one in _chain(error)
    )


def out_of_room(error: BaseException) -> str | None:
    """Return, in a line, which file found no space on disk, if an exception or one of its causes says so."""
    for one in _chain(error):
        if isinstance(one, OSError) and one.errno in FULL:
            place = f"{os.fsdecode(one.filename)}: " if isinstance(one.filename, str | bytes) else ""
            return f"{place}cannot be written: {one.strerror}"
        if _says(one, NO_ROOM):
            return next(line for line in str(one).splitlines() if any(word in line.lower() for word in NO_ROOM))
    return None


def _says(error: BaseException, words: tuple[str, ...]) -> bool:
    text = str(error).lower() if isinstance(error, RuntimeError | ImportError | OSError) else ""
    return any(word in text for word in words)


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)


def interrupt(number: int, _: Any) -> None:
    """Handle a signal: raise KeyboardInterrupt, and know of it, since libraries turn that into their own exceptions."""
    _INTERRUPTIONS.append(number)
    raise KeyboardInterrupt


def forget_interruptions() -> None:
    """Start anew: signals that came before are no reason to stop what begins now."""
    _INTERRUPTIONS.clear()


def reason_to_stop(error: BaseException, needed: float | None = None) -> str | None:
    """Say in a line why an exception ends the run, if the cause is not a bug of the program; otherwise None.

    It tells the memory (bytes) that this process was expected to need in all.
    """
    if _INTERRUPTIONS:
        return INTERRUPTED
    match error:
        case StopError():
            return str(error)
        case KeyboardInterrupt():
            return INTERRUPTED
        case SystemExit(code=code):
            return f"the code of the model ended the process (SystemExit: {code})"
        case _:
            room = out_of_room(error)
            if room is not None:
                return f"{room}; the same command continues once there is room"
            if not out_of_memory(error):
                return missing(error)
            wants = "" if needed is None else f"about {needed / MIB:,.0f} MiB are needed in all, "
            return f"memory ran out: {wants}{headroom()} now; the same command continues where there is more"


def missing(error: BaseException) -> str | None:
    """Say in a line what to install, if an exception or one of its causes says that FEniCSx is not there."""
    for one in _chain(error):
        name = (one.name or "").partition(".")[0] if isinstance(one, ImportError) else ""
        if name in FENICSX:
            return f"{name} cannot be imported ({' '.join(str(one).split())}): {HOW_TO_INSTALL}"
    return None


def modified(folder: str) -> int:
    """Return when names in a folder, or in the current one for "", have changed (ns); zero if there is none."""
    try:
        return Path(folder).stat().st_mtime_ns
    except OSError:
        return 0


def write_whole(path: Path, data: bytes) -> None:
    """Write a file under another name and rename it into place, so that it exists completely or not at all.

    Raises
    ------
    StopError
        If there is no space for it, or something else in its place; no partial file is left.
    """
    partial = path.with_name(f".{path.name}.{os.uname().nodename}.{os.getpid()}")
    try:
        with partial.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        with suppress(OSError):
            partial.unlink()
        if error.errno not in FULL | IN_THE_WAY:
            raise
        remedy = "there is room" if error.errno in FULL else "that is mended"
        message = f"{path}: cannot be written: {error.strerror}; the same command continues once {remedy}"
        raise StopError(message) from None


def write_text(path: Path, text: str) -> None:
    """Write a text, as `write_whole` does."""
    write_whole(path, text.encode())
