"""Uncertainty quantification and Bayesian model selection for hyperelastic soft tissue."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

_PACKAGES = ("forward", "uq", "inverse", "workflows")


class _Finder:
    """Finds the packages of the program where they are installed: within this one, under no name of their own."""

    def __init__(self, folder: Path) -> None:
        self._folder = str(folder)

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return PathFinder.find_spec(name, [self._folder], target) if name in _PACKAGES else None


def _installed() -> None:
    folder = Path(__file__).parent / "_packages"
    if not folder.is_dir():  # a checkout, where they are found beside this package
        return
    for name in _PACKAGES:
        other = getattr(sys.modules.get(name), "__file__", None)
        if name in sys.modules and not (other and Path(other).is_relative_to(folder)):
            message = f"a module called '{name}' ({other}) is loaded already, and tissuq has a package of that name"
            raise ImportError(message)
    sys.meta_path.insert(0, _Finder(folder))


_installed()
