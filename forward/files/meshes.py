"""Meshes of other programs: the reader that understands a file, what it prints kept back, what is wrong in a line."""

from __future__ import annotations

import io
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING

from forward.files import abaqus, abaqus_mesh, vtk, xdmf
from forward.machine import out_of_memory

if TYPE_CHECKING:
    import meshio

OWN = {".inp": abaqus_mesh.read, ".xdmf": xdmf.read, ".vtp": vtk.read}
BESIDE = {".inp": abaqus.included, ".xdmf": xdmf.stored}
OF_VTK = (".vtk", ".vtu")  # of which meshio reads the usual ones, faster and without VTK


def beside(path: Path) -> list[Path]:
    """Return the files that hold what a file refers to: the numbers of XDMF, what Abaqus would include.

    Raises
    ------
    OSError
        If the file cannot be read.
    """
    found = BESIDE.get(path.suffix)
    return [] if found is None else found(path)


def read(path: Path) -> meshio.Mesh:
    """Read a mesh: Abaqus's and XDMF by ourselves, the rest by meshio, and by VTK where that fails.

    Raises
    ------
    ValueError
        With what is wrong.
    ImportError
        If a package is missing without which files of this kind cannot be read.
    """
    import meshio

    said = io.StringIO()
    try:
        with redirect_stdout(said), redirect_stderr(said):  # meshio prints, also before it exits
            return OWN.get(path.suffix, meshio.read)(path)
    except ImportError:
        raise
    except SystemExit:
        reason = " ".join(said.getvalue().partition("Error: Couldn't read")[0].split())
    except Exception as error:  # files may be anything, and their readers fail in many ways
        if out_of_memory(error):
            raise
        reason = " ".join(str(error).split()) or type(error).__name__
    if path.suffix in OF_VTK:
        try:
            return vtk.read(path)
        except ImportError:
            reason += " (pip install 'tissuq[vtk]' reads more)"
        except ValueError as error:
            reason = reason or str(error)
    raise ValueError(reason or f"it is no {path.suffix} file that meshio reads") from None
