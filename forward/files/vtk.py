"""Files of VTK as pyvista reads them: polygons, grids, pieces, words among the arrays, every compression."""

from __future__ import annotations

import pickle
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray

if TYPE_CHECKING:
    import meshio

ABSENT = -9.87654321e30  # in place of "nan" in a text, where the reader of the old format ends at a word
NAN = re.compile(rb"(?<=\s)[-+]?nan(?:\([^)\s]*\))?(?=\s)", re.IGNORECASE)
ASCII = re.compile(rb"[^\n]*\n[^\n]*\n\s*ASCII")
WRONG = re.compile(rb"(ERR|WARN)\|")  # what VTK writes of itself, and then reads on with what it has
BRICKS = {8: (9, [0, 1, 3, 2]), 11: (12, [0, 1, 3, 2, 4, 5, 7, 6])}  # pixels and voxels: as what, their corners how
LISTED = {0, 4}  # what lists its cells: polygons, unstructured grids
REFUSED = 4  # exit code
DAMAGED = "it is cut off, or damaged"


def read(path: Path) -> meshio.Mesh:
    """Read a file (.vtk, .vtu, .vtp): points, cells, and the numbers at both.

    A process of its own reads it, since VTK ends its process where a damaged file asks for more memory than there is,
    or names points that it does not have.

    Raises
    ------
    ImportError
        Where pyvista is not installed.
    ValueError
        If VTK finds anything wrong, or the file has no points.
    """
    if find_spec("pyvista") is None:
        raise ImportError("No module named 'pyvista'", name="pyvista")
    command = [sys.executable, "-m", __name__, str(path.absolute())]
    found = subprocess.run(command, capture_output=True, check=False, cwd=Path(__file__).resolve().parents[2])
    if found.returncode == REFUSED:
        raise ValueError(found.stdout.decode())
    if found.returncode or WRONG.search(found.stderr):
        raise ValueError(DAMAGED)
    made: meshio.Mesh = pickle.loads(found.stdout)
    return made


def mesh(path: Path) -> meshio.Mesh:
    """Read a file in this process; raises ValueError as `read`."""
    import meshio
    import pyvista

    whole = path.read_bytes()
    if (b"DATASET " if path.suffix == ".vtk" else b"VTKFile") not in whole:
        raise ValueError("expected a data set of VTK")
    kinds = {".vtk": pyvista.VTKDataSetReader, ".vtu": pyvista.XMLUnstructuredGridReader}
    reader: Any = kinds.get(path.suffix, pyvista.XMLPolyDataReader)(path)
    if ASCII.match(whole):
        text = NAN.sub(repr(ABSENT).encode(), whole)
        reader.reader.ReadFromInputStringOn()
        reader.reader.SetBinaryInputString(text, len(text))
    data = reader.read()
    if not data.n_points:
        raise ValueError("it has no points")
    blocks, order = _cells(data)
    at_cells = _arrays(data.cell_data) if blocks else {}
    of_cells = {name: [values[rows] for rows in order] for name, values in at_cells.items()}
    return meshio.Mesh(np.array(data.points), blocks, point_data=_arrays(data.point_data), cell_data=of_cells)


def _cells(data: Any) -> tuple[list[tuple[str, NDArray[np.int64]]], list[NDArray[np.int64]]]:
    """Return cells kind by kind, and their numbers in the file; none of a regular grid."""
    from meshio._vtk_common import vtk_to_meshio_type
    from pyvista import convert_array

    if data.GetDataObjectType() not in LISTED or not data.n_cells:
        return [], []
    grid = data.cast_to_unstructured_grid()
    kinds, cells = grid.celltypes, grid.GetCells()
    starts, corner = (np.array(convert_array(one)) for one in (cells.GetOffsetsArray(), cells.GetConnectivityArray()))
    sizes = np.diff(starts)
    whole = len(sizes) == len(kinds) and (sizes > 0).all() and sizes.sum() == len(corner)
    if not whole or not 0 <= corner.min() <= corner.max() < data.n_points:
        raise ValueError(DAMAGED)
    blocks, order = [], []
    for kind, size in sorted(set(zip(kinds.tolist(), sizes.tolist(), strict=True))):
        mine = np.flatnonzero((kinds == kind) & (sizes == size))
        usual, turned = BRICKS.get(kind, (kind, slice(None)))
        corners = corner[starts[mine][:, None] + np.arange(size)][:, turned].astype(np.int64)
        blocks.append((vtk_to_meshio_type.get(usual, "polygon"), corners))
        order.append(mine)
    return blocks, order


def _arrays(data: Any) -> dict[str, FloatArray]:
    """Return the arrays of numbers by name."""
    found = {}
    for name, array in data.items():
        numbers = np.array(array)
        if np.issubdtype(numbers.dtype, np.floating):
            numbers[numbers == numbers.dtype.type(ABSENT)] = np.nan
        if np.issubdtype(numbers.dtype, np.number):
            found[name] = numbers
    return found


if __name__ == "__main__":
    try:
        sys.stdout.buffer.write(pickle.dumps(mesh(Path(sys.argv[1]))))
    except ValueError as error:
        sys.stdout.write(str(error))
        sys.exit(REFUSED)
