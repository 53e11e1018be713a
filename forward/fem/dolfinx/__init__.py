"""The only package that knows DOLFINx: compiled forms, meshes, spaces, assembly, linear solvers.

Written for DOLFINx 0.5 (Debian 12) and 0.11 (the wheel `dolfinx-solver-real`); their differences are in `version`.
Importing any part of it initialises the libraries, in the order that they need.
"""

from contextlib import suppress

from forward.machine import HOW_TO_INSTALL, reserve_for_linear_algebra

try:
    with suppress(ModuleNotFoundError):
        import dolfinx_solver as _  # the wheel wants to be first  # noqa: F401
    import petsc4py

    petsc4py.init(["tissuq", "-no_signal_handler"])  # PETSc would end the study where a child process dies (SIGPIPE)

    import basix
    import dolfinx.fem.petsc  # noqa: F401
except ImportError as error:
    error.add_note(HOW_TO_INSTALL)
    raise

reserve_for_linear_algebra()
basix.create_element(basix.ElementFamily.P, basix.CellType.interval, 1)  # with the linear algebra of DOLFINx, too
