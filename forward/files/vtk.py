"""Files of VTK as VTK reads them: polygons, grids, pieces, words among the arrays, every compression."""

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

Arrays = dict[str, FloatArray]  # by name
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
        Where VTK is not installed.
    ValueError
        If VTK finds anything wrong, or the file has no points.
    """
    if find_spec("vtkmodules") is None:
        raise ImportError("No module named 'vtk'", name="vtk")
    command = [sys.executable, "-m", __name__, str(path.absolute())]
    found = subprocess.run(command, capture_output=True, check=False, cwd=Path(__file__).resolve().parents[2])
    if found.returncode == REFUSED:
        raise ValueError(found.stdout.decode())
    if found.returncode or WRONG.search(found.stderr):
        raise ValueError(DAMAGED)
    return _mesh(*pickle.loads(found.stdout))


def _mesh(points: FloatArray, at_points: Arrays, at_cells: Arrays, cells: tuple[NDArray[np.int64], ...]) -> meshio.Mesh:
    """Return the mesh of what a process has read; cells stand kind by kind, with numbers at them."""
    import meshio
    from meshio._vtk_common import vtk_to_meshio_type

    blocks, order = [], []
    if cells:
        kinds, starts, corner = cells
        sizes = np.diff(starts)
        for kind, size in sorted(set(zip(kinds.tolist(), sizes.tolist(), strict=True))):
            mine = np.flatnonzero((kinds == kind) & (sizes == size))
            usual, turned = BRICKS.get(kind, (kind, slice(None)))
            corners = corner[starts[mine][:, None] + np.arange(size)][:, turned].astype(np.int64)
            blocks.append((vtk_to_meshio_type.get(usual, "polygon"), corners))
            order.append(mine)
    of_cells = {name: [values[rows] for rows in order] for name, values in at_cells.items() if blocks}
    return meshio.Mesh(points, blocks, point_data=at_points, cell_data=of_cells)


def contents(path: Path) -> tuple[FloatArray, Arrays, Arrays, tuple[NDArray[np.int64], ...]]:
    """Read a file in this process: points, numbers at points and at cells, and cells, none of a regular grid.

    Cells are the kind of each, where its corners begin, and the corners of all. Raises ValueError as `read`.
    """
    from vtkmodules.vtkIOLegacy import vtkDataSetReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLUnstructuredGridReader

    whole = path.read_bytes()
    if (b"DATASET " if path.suffix == ".vtk" else b"VTKFile") not in whole:
        raise ValueError("expected a data set of VTK")
    kinds = {".vtk": vtkDataSetReader, ".vtu": vtkXMLUnstructuredGridReader}
    reader: Any = kinds.get(path.suffix, vtkXMLPolyDataReader)()
    reader.SetFileName(str(path))
    if ASCII.match(whole):
        text = NAN.sub(repr(ABSENT).encode(), whole)
        reader.ReadFromInputStringOn()
        reader.SetBinaryInputString(text, len(text))
    reader.Update()
    data = reader.GetOutput()
    if data is None or not data.GetNumberOfPoints():
        raise ValueError("it has no points")
    if data.IsA("vtkPointSet"):
        points = _numbers(data.GetPoints().GetData())
    else:
        points = np.array([data.GetPoint(i) for i in range(data.GetNumberOfPoints())])
    return points, _arrays(data.GetPointData()), _arrays(data.GetCellData()), _cells(data)


def _cells(data: Any) -> tuple[NDArray[np.int64], ...]:
    """Return the kind of each cell, where its corners begin, and the corners; none of a regular grid."""
    if data.GetDataObjectType() not in LISTED or not data.GetNumberOfCells():
        return ()
    from vtkmodules.vtkFiltersCore import vtkAppendFilter

    grid = vtkAppendFilter()
    grid.AddInputData(data)
    grid.Update()
    cells = grid.GetOutput().GetCells()
    kinds, starts, corner = map(
        _numbers, (grid.GetOutput().GetCellTypesArray(), cells.GetOffsetsArray(), cells.GetConnectivityArray())
    )
    sizes = np.diff(starts)
    whole = len(sizes) == len(kinds) and (sizes > 0).all() and sizes.sum() == len(corner)
    if not whole or not 0 <= corner.min() <= corner.max() < data.GetNumberOfPoints():
        raise ValueError(DAMAGED)
    return kinds, starts, corner


def _arrays(attributes: Any) -> Arrays:
    found = {}
    for i in range(attributes.GetNumberOfArrays()):
        array = attributes.GetArray(i)  # None for words
        if array is None or not array.GetName():
            continue
        numbers = _numbers(array)
        if np.issubdtype(numbers.dtype, np.floating):
            numbers[numbers == numbers.dtype.type(ABSENT)] = np.nan
        found[array.GetName()] = numbers
    return found


def _numbers(array: Any) -> NDArray[Any]:
    """Return a copy of an array of VTK."""
    from vtkmodules.util import numpy_support

    views: Any = numpy_support  # without types
    return np.array(views.vtk_to_numpy(array))


if __name__ == "__main__":
    try:
        sys.stdout.buffer.write(pickle.dumps(contents(Path(sys.argv[1]))))
    except ValueError as error:
        sys.stdout.write(str(error))
        sys.exit(REFUSED)
