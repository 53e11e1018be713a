"""Uncertainty quantification and Bayesian model selection for hyperelastic soft tissue.

    import tissuq

    study = tissuq.load("configs/beam.toml")
    data = study.run()                                          # an xarray dataset, for all plots
    print(float(data["mean"].sel(output="uy_max")), tissuq.findings(data))

    model = tissuq.Model(study.model)
    solution = model.solve({"material.C1": 9e3})                # numbers by name
    print(solution["uy_max"], solution.displacement_at([0.28, 0.01, 0.04]), solution.gradient("uy_max"))

Names are imported when first used: `import tissuq` itself imports neither FEniCSx nor MPI.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

_PACKAGES = ("forward", "uq", "inverse", "workflows")


class _Finder:
    """Finds the packages of the program where they are installed: within this one, not at the top level."""

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

_PUBLIC = {  # MODULE:NAME of each public name, or a module
    "load": "tissuq.studies:load",
    "run": "workflows.run.run:results_of",
    "read": "tissuq.studies:read",
    "findings": "uq.findings:findings",
    "Study": "tissuq.studies:Study",
    "Error": "forward.errors:Error",
    "StudyError": "workflows.config.study:StudyError",
    "Model": "tissuq.model:Model",
    "Hyperelastic": "tissuq.studies:Hyperelastic",
    "Specimen": "tissuq.studies:Specimen",
    "SolveError": "forward.model:SolveError",
    "DerivativeError": "forward.model:DerivativeError",
    "plots": "workflows.report.plots",
    "bodies": "workflows.report.bodies",
}
__all__ = [*_PUBLIC]  # noqa: PLE0604 - names

if TYPE_CHECKING:
    from forward.errors import Error as Error
    from forward.model import DerivativeError as DerivativeError
    from forward.model import SolveError as SolveError
    from tissuq.model import Model as Model
    from tissuq.studies import Hyperelastic as Hyperelastic
    from tissuq.studies import Specimen as Specimen
    from tissuq.studies import Study as Study
    from tissuq.studies import load as load
    from tissuq.studies import read as read
    from uq.findings import findings as findings
    from workflows.config.mistakes import StudyError as StudyError
    from workflows.report import bodies as bodies
    from workflows.report import plots as plots
    from workflows.run.run import results_of as run  # noqa: F401


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("workflows.run.version").version()
    place = _PUBLIC.get(name)
    if place is None:
        from forward.settings import nearest

        raise AttributeError(f"module 'tissuq' has no attribute '{name}'; {nearest(name, tuple(_PUBLIC))}")
    module, _, inside = place.partition(":")
    found = import_module(module)
    return getattr(found, inside) if inside else found


def __dir__() -> list[str]:
    return sorted([*_PUBLIC, "__version__"])
