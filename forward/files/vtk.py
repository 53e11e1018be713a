"""Files of VTK as VTK itself reads them: polygons, grids, pieces, words among the arrays, every compression."""

from __future__ import annotations

import pickle
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, cast

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray

if TYPE_CHECKING:
    import meshio

ABSENT = -9.87654321e30  # in place of "nan" in a text, where the reader of the old format ends at a word
NAN = re.compile(rb"(?<=\s)[-+]?nan(?:\([^)\s]*\))?(?=\s)", re.IGNORECASE)
KINDS = {
    1: "vertex",
    3: "line",
    5: "triangle",
    8: "quad",
    9: "quad",
    10: "tetra",
    11: "hexahedron",
    12: "hexahedron",
    13: "wedge",
    14: "pyramid",
    21: "line3",
    22: "triangle6",
    23: "quad8",
    24: "tetra10",
    25: "hexahedron20",
    28: "quad9",
    29: "hexahedron27",
}
PIXELS = {8: [0, 1, 3, 2], 11: [0, 1, 3, 2, 4, 5, 7, 6]}  # whose corners have another order
IntArray = NDArray[np.int64]
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
        raise ImportError("No module named 'vtkmodules'", name="vtkmodules")
    command = [sys.executable, "-m", __name__, str(path.absolute())]
    found = subprocess.run(command, capture_output=True, check=False, cwd=Path(__file__).resolve().parents[2])
    if found.returncode == REFUSED:
        raise ValueError(found.stdout.decode())
    try:
        return cast("meshio.Mesh", pickle.loads(found.stdout)) if found.returncode == 0 else _lost()
    except (pickle.UnpicklingError, EOFError):
        return _lost()


def _lost() -> NoReturn:
    raise ValueError(DAMAGED)


def main(path: Path) -> int:
    """Write the mesh of a file, or what is wrong with it, to the standard output; return the exit code."""
    try:
        found = pickle.dumps(mesh(path))
    except ValueError as error:
        sys.stdout.write(str(error))
        return REFUSED
    sys.stdout.buffer.write(found)
    return 0


def mesh(path: Path) -> meshio.Mesh:
    """Read a file in this process; raises as `read`."""
    import meshio

    data = _read(path)
    count = data.GetNumberOfPoints()
    if not count:
        raise ValueError("it has no points")
    points = _numbers(data.GetPoints().GetData()) if hasattr(data, "GetPoints") else _places(data, count)
    blocks, order = _cells(data, count)
    of_cells = {
        name: np.split(values[np.concatenate(order)], np.cumsum([len(one) for one in order])[:-1])
        for name, values in _arrays(data.GetCellData()).items()
        if blocks
    }
    return meshio.Mesh(points, blocks, point_data=_arrays(data.GetPointData()), cell_data=of_cells)


def _read(path: Path) -> Any:
    """Return VTK's data set."""
    from vtkmodules.vtkCommonCore import vtkLogger

    whole = path.read_bytes()
    reader = _reader(path.suffix, whole)
    wrong: list[str] = []
    for event in ("ErrorEvent", "WarningEvent"):
        reader.AddObserver(event, lambda *_: wrong.append(DAMAGED))
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    if path.suffix == ".vtk":
        reader.ReadAllScalarsOn()
        reader.ReadAllVectorsOn()
        reader.ReadAllFieldsOn()
        if re.match(rb"[^\n]*\n[^\n]*\n\s*ASCII", whole):
            reader.ReadFromInputStringOn()
            text = NAN.sub(repr(ABSENT).encode(), whole)
            reader.SetBinaryInputString(text, len(text))
    reader.SetFileName(str(path))
    reader.Update()
    found = reader.GetOutput()
    if wrong or reader.GetErrorCode() or found is None:
        raise ValueError(DAMAGED)
    return found


def _reader(suffix: str, whole: bytes) -> Any:
    """Return VTK's reader of what a file says that it is."""
    from vtkmodules import vtkIOLegacy, vtkIOXML

    if suffix == ".vtk":
        kinds: dict[bytes, Any] = {
            b"DATASET POLYDATA": vtkIOLegacy.vtkPolyDataReader,
            b"DATASET UNSTRUCTURED_GRID": vtkIOLegacy.vtkUnstructuredGridReader,
            b"DATASET STRUCTURED_GRID": vtkIOLegacy.vtkStructuredGridReader,
            b"DATASET STRUCTURED_POINTS": vtkIOLegacy.vtkStructuredPointsReader,
            b"DATASET RECTILINEAR_GRID": vtkIOLegacy.vtkRectilinearGridReader,
        }
    elif suffix == ".vtu":
        kinds = {b"UnstructuredGrid": vtkIOXML.vtkXMLUnstructuredGridReader}
    else:
        kinds = {b"PolyData": vtkIOXML.vtkXMLPolyDataReader}
    for mark, kind in kinds.items():
        if mark in whole:
            return kind()
    raise ValueError("expected a data set of VTK")


def _places(data: Any, count: int) -> FloatArray:
    """Return the points (n, 3) of a grid that does not store them."""
    return np.array([data.GetPoint(k) for k in range(count)])


def _cells(data: Any, count: int) -> tuple[list[tuple[str, IntArray]], list[IntArray]]:
    """Return cells kind by kind, and their numbers in the file; none of a regular grid.

    Numbers alone are asked for: VTK itself reads beyond its points where a damaged file says so.
    """
    if hasattr(data, "GetPolys"):
        parts = [(data.GetVerts(), 1), (data.GetLines(), 3), (data.GetPolys(), 0)]
        kinds = np.repeat([kind for _, kind in parts], [part.GetNumberOfCells() for part, _ in parts])
    elif hasattr(data, "GetCells") and data.GetNumberOfCells():
        parts = [(data.GetCells(), 0)]
        kinds = _numbers(data.GetCellTypesArray()).astype(np.int64)
    else:
        return [], []
    offsets, corners = [np.zeros(1, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for part, _ in parts:
        if part.GetNumberOfCells():
            ends = _numbers(part.GetOffsetsArray()).astype(np.int64)
            offsets.append(ends[1:] - ends[0] + offsets[-1][-1])
            corners.append(_numbers(part.GetConnectivityArray()).astype(np.int64))
    starts, corner = np.concatenate(offsets), np.concatenate(corners)
    sizes = np.diff(starts)
    whole = len(sizes) == len(kinds) and (sizes > 0).all() and sizes.sum() == len(corner)
    if not whole or (len(corner) and not 0 <= corner.min() <= corner.max() < count):
        raise ValueError(DAMAGED)
    blocks, order = [], []
    for kind, size in sorted(set(zip(kinds.tolist(), sizes.tolist(), strict=True))):
        mine = np.flatnonzero((kinds == kind) & (sizes == size))
        name = KINDS.get(kind) or {3: "triangle", 4: "quad"}.get(size, "polygon")
        blocks.append((name, corner[starts[mine][:, None] + np.arange(size)][:, PIXELS.get(kind, slice(None))]))
        order.append(mine)
    return blocks, order


def _arrays(data: Any) -> dict[str, FloatArray]:
    """Return the arrays of numbers by name."""
    found = {}
    for k in range(data.GetNumberOfArrays()):
        array = data.GetArray(k)  # None of words
        if array is not None and data.GetArrayName(k):
            found[data.GetArrayName(k)] = _numbers(array)
    return found


def _numbers(array: Any) -> FloatArray:
    """Return numbers of VTK's that stay when it is gone."""
    from vtkmodules.util import numpy_support

    numbers = np.array(numpy_support.vtk_to_numpy(array))  # type: ignore[no-untyped-call]
    if np.issubdtype(numbers.dtype, np.floating):
        numbers[numbers == numbers.dtype.type(ABSENT)] = np.nan
    return numbers


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
