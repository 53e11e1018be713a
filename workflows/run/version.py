"""Versions of this program, of its dependencies, and of its source."""

from __future__ import annotations

import os
from contextlib import suppress
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as installed
from pathlib import Path


def version() -> str:
    """Return the version of this program."""
    with suppress(PackageNotFoundError):
        return installed("tissuq")
    return "unknown"


def versions() -> dict[str, str]:
    """Return the versions of installed packages that results may depend on, by name."""
    dolfinx = ("fenics-dolfinx", "dolfinx-solver-real")  # Debian's name and that of the wheel
    names = ("tissuq", *dolfinx, "petsc4py", "mpi4py", "numpy", "scipy", "chaospy", "xarray")
    found = {}
    for name in names:
        with suppress(PackageNotFoundError):
            found[name] = installed(name)
    return found


def commit() -> str | None:
    """Return the commit of the source tree, where there is one; else that which an image was made of."""
    import subprocess

    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return os.environ.get("TISSUQ_COMMIT") or None
    command = ["git", "--no-optional-locks", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
