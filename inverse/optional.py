"""Packages that only some methods need."""

from importlib import import_module
from typing import Any


def imported(what: str, package: str) -> Any:
    """Import a package; where it is not installed, the ImportError says what needs it."""
    try:
        return import_module(package)
    except ImportError:
        raise ImportError(f"{what} {package}, which is not installed: pip install {package}") from None
