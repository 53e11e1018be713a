"""The only package that knows DOLFINx: compiled forms, meshes, spaces, assembly, linear solvers.

Written for DOLFINx 0.5 (Debian 12) and 0.11 (the wheel `dolfinx-solver-real`); their differences are in `version`.
Importing any part of it initialises the libraries, in the order that they need.
"""

import os
import sys
from contextlib import suppress
from importlib import metadata
from types import ModuleType, SimpleNamespace

from forward.machine import HOW_TO_INSTALL, reserve_for_linear_algebra

TRIED, ANY = ("0.5.", "0.11."), "TISSUQ_ANY_DOLFINX"

# UFL and FFCx 0.5 ask `pkg_resources` for their version, and nothing else: importing it takes a third of what they do.
_stand_in = ModuleType("pkg_resources")
_stand_in.get_distribution = lambda name: SimpleNamespace(version=metadata.version(name))  # type: ignore[attr-defined]
_stands_in = sys.modules.setdefault("pkg_resources", _stand_in) is _stand_in

try:
    with suppress(ModuleNotFoundError):
        import dolfinx_solver as _  # the wheel wants to be first  # noqa: F401
    import petsc4py

    petsc4py.init(["tissuq", "-no_signal_handler"])  # PETSc would end the study where a child process dies (SIGPIPE)

    import basix
    import dolfinx
except ImportError as error:
    error.add_note(HOW_TO_INSTALL)
    raise
finally:
    if _stands_in:
        del sys.modules["pkg_resources"]

if not dolfinx.__version__.startswith(TRIED) and not os.environ.get(ANY):
    known = ", ".join(f"{one}x" for one in TRIED)
    raise ImportError(f"DOLFINx {dolfinx.__version__}, expected one of {known}; {ANY}=1 goes on", name="dolfinx")
import dolfinx.fem.petsc  # noqa: E402

reserve_for_linear_algebra()
basix.create_element(basix.ElementFamily.P, basix.CellType.interval, 1)  # with the linear algebra of DOLFINx, too
