"""Points, and values at them, from the files that scanners, cameras and other programs write.

STL and PLY hold surfaces, legacy VTK, VTU, VTP, gmsh's and Abaqus's files meshes, XDMF either: also a series over time
whose numbers are in HDF5, as DOLFINx writes it, of which the last step counts.
"""

from __future__ import annotations

import contextlib
import io
import locale
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from forward.settings import one_line
from inverse.data.table import DataError

STL_HEAD, STL_FACET = 84, 50  # bytes
PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
PLY_KINDS = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
POLYDATA = (".vtk", ".vtp")  # that VTK itself reads where meshio does not


@dataclass(frozen=True, eq=False)
class Points:
    """What a file holds.

    Attributes
    ----------
    places
        (n, 3), in the units of the file.
    values
        Arrays (n, …) at the points, by name.
    cells
        Points of the cells, kind by kind: two files with the same points have the same.
    """

    places: FloatArray
    values: dict[str, FloatArray] = field(default_factory=dict)
    cells: tuple[NDArray[np.int64], ...] = ()


def points_of(path: Path) -> Points:
    """Read a file.

    Raises
    ------
    DataError
        If it cannot be read, or its points are not finite ones in three dimensions.
    """
    if not path.is_file():
        raise DataError(f"{path.name}: cannot be read: No such file or directory")
    readers: dict[str, Callable[[Path], Points]] = {".stl": _stl, ".ply": _ply, ".xdmf": _xdmf, ".vtp": _polydata}
    try:
        found = readers.get(path.suffix, _meshio)(path)
    except DataError:
        raise
    except ImportError as error:
        package = (error.name or "").partition(".")[0]
        wanted = {"vtkmodules": "'tissuq[vtk]'"}.get(package, package)
        raise DataError(f"{path.name}: files of this kind need {package} (pip install {wanted})") from None
    except Exception as error:  # files may be anything, and their readers fail in many ways
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DataError(one_line(f"{path.name}: cannot be read as {path.suffix}: {reason}")) from None
    if found.places.ndim != 2 or found.places.shape[1] != 3 or not len(found.places):
        raise DataError(f"{path.name}: no points in three dimensions")
    if not np.isfinite(found.places).all():
        raise DataError(f"{path.name}: a point has a coordinate that is not a number")
    return found


def _meshio(path: Path) -> Points:
    import meshio

    said = io.StringIO()  # what meshio prints, also before it exits
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            mesh = meshio.read(path)
    except (Exception, SystemExit) as error:
        if path.suffix in POLYDATA:
            return _polydata(path)
        reason = said.getvalue() if isinstance(error, SystemExit) else str(error)
        raise ValueError(reason.strip() or type(error).__name__) from None
    values = {name: np.asarray(one, dtype=float) for name, one in mesh.point_data.items()}
    return Points(np.asarray(mesh.points, float), values, tuple(np.asarray(block.data) for block in mesh.cells))


def _polydata(path: Path) -> Points:
    """Read polygons, which meshio does not, by VTK."""
    from vtkmodules.util import numpy_support
    from vtkmodules.vtkCommonCore import vtkLogger
    from vtkmodules.vtkIOLegacy import vtkPolyDataReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    whole = path.read_bytes()
    if (b"PolyData" if path.suffix == ".vtp" else b"DATASET POLYDATA") not in whole:
        raise ValueError("expected a data set of VTK")
    reader: Any = vtkXMLPolyDataReader() if path.suffix == ".vtp" else vtkPolyDataReader()
    shown = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    words = locale.setlocale(locale.LC_ALL)  # the legacy reader leaves "C", in which no later text could hold "±"
    try:
        if path.suffix != ".vtp":
            reader.ReadAllScalarsOn()
            reader.ReadAllVectorsOn()
            reader.ReadAllFieldsOn()
        reader.SetFileName(str(path))
        reader.Update()
    finally:
        locale.setlocale(locale.LC_ALL, words)
        vtkLogger.SetStderrVerbosity(shown)
    mesh, as_numbers = reader.GetOutput(), cast("Any", numpy_support).vtk_to_numpy
    if reader.GetErrorCode() or not mesh.GetNumberOfPoints():
        raise ValueError("it is cut off, or has no points")
    arrays = mesh.GetPointData()
    names = [arrays.GetArrayName(k) for k in range(arrays.GetNumberOfArrays())]
    values = {name: _copied(as_numbers(arrays.GetArray(name))) for name in names}
    polygons = mesh.GetPolys()
    parts = (polygons.GetOffsetsArray(), polygons.GetConnectivityArray())
    cells = tuple(_copied(as_numbers(part)).astype(np.int64) for part in parts)
    return Points(_copied(as_numbers(mesh.GetPoints().GetData())), values, cells)


def _copied(numbers: Any) -> FloatArray:
    """Return numbers of VTK's that stay when it is gone."""
    return np.array(numbers, dtype=np.float64)


def _stl(path: Path) -> Points:
    """Read the corners of the facets, three after three: the format does not say which coincide."""
    data = path.read_bytes()
    count = int.from_bytes(data[80:STL_HEAD], "little") if len(data) >= STL_HEAD else -1
    if len(data) == STL_HEAD + STL_FACET * count:
        facets = np.frombuffer(data, dtype=np.dtype([("corners", "<12f4"), ("more", "<u2")]), offset=STL_HEAD)
        corners = facets["corners"][:, 3:].reshape(-1, 3).astype(float)
    elif data.lstrip().startswith(b"solid"):
        text = data.decode(errors="replace")
        found = re.findall(r"^\s*vertex\s+(\S+)\s+(\S+)\s+(\S+)\s*$", text, re.MULTILINE)
        corners = np.array(found, dtype=float).reshape(-1, 3)
        if len(found) % 3 or text.count("facet normal") * 3 != len(found) or "endsolid" not in text:
            raise ValueError("it ends within a facet, or has others than triangles")
    else:
        size = STL_HEAD + STL_FACET * max(count, 0)
        raise ValueError(f"{len(data):,} bytes, expected {size:,} for {max(count, 0):,} facets, or 'solid' in a text")
    return Points(corners, cells=(np.arange(len(corners)).reshape(-1, 3),))


def _ply(path: Path) -> Points:
    """Read the elements ``vertex`` and ``face``; meshio never ends on a file that is cut off."""
    head, end, body = path.read_bytes().partition(b"end_header")
    words = [line.split() for line in head.decode(errors="replace").splitlines()]
    form = next((line[1] for line in words if line[:1] == ["format"] and len(line) > 1), "")
    if not (head.startswith(b"ply") and end and form in PLY_ORDERS):
        raise ValueError("expected 'ply', a format (ascii, binary_little_endian, binary_big_endian) and 'end_header'")
    body = body[body.index(b"\n") + 1 :]
    tokens = body.split() if form == "ascii" else []
    values: dict[str, FloatArray] = {}
    corners: list[NDArray[np.int64]] = []
    done = 0  # tokens, or bytes
    for name, count, properties in _ply_elements(words):
        if all(len(one) == 2 for one in properties):
            kinds = [(title, PLY_ORDERS[form] + PLY_KINDS[kind]) for kind, title in properties]
            if form == "ascii":
                part = np.array(tokens[done : done + count * len(kinds)], dtype=float).reshape(count, len(kinds))
                columns = {title: part[:, k] for k, (title, _) in enumerate(kinds)}
                done += part.size
            else:
                rows = np.frombuffer(body, np.dtype(kinds), count, done)
                columns = {title: rows[title].astype(float) for title, _ in kinds}
                done += rows.nbytes
            values = columns if name == "vertex" else values
            continue
        if len(properties) != 1:
            raise ValueError(f"elements '{name}' with a list beside others, expected the list alone")
        _, of_count, of_number, _ = properties[0]
        for _ in range(count):
            if form == "ascii":
                size = int(tokens[done])
                found = np.array(tokens[done + 1 : done + 1 + size], dtype=np.int64)
                done += 1 + size
            else:
                length = np.dtype(PLY_ORDERS[form] + PLY_KINDS[of_count])
                size = int(np.frombuffer(body, length, 1, done)[0])
                found = np.frombuffer(body, PLY_ORDERS[form] + PLY_KINDS[of_number], size, done + length.itemsize)
                done += length.itemsize + found.nbytes
            if len(found) != size:
                raise ValueError("it ends within a face")
            corners += [np.append(size, found).astype(np.int64)] if name == "face" else []
    if not {"x", "y", "z"} <= values.keys():
        raise ValueError("no vertices with x, y and z")
    places = np.column_stack([values.pop(axis) for axis in "xyz"])
    return Points(places, values, (np.concatenate(corners),) if corners else ())


def _ply_elements(words: list[list[str]]) -> list[tuple[str, int, list[list[str]]]]:
    """Return names, numbers and properties of the elements of a PLY file."""
    found: list[tuple[str, int, list[list[str]]]] = []
    for line in words:
        if line[:1] == ["element"]:
            found.append((line[1], int(line[2]), []))
        elif line[:1] == ["property"]:
            found[-1][2].append(line[1:])
    return found


def _xdmf(path: Path) -> Points:
    """Read the first geometry, and of each array the last that is there."""
    root = ET.parse(path).getroot()
    geometry = root.find(".//Geometry")
    item = None if geometry is None else geometry.find("DataItem")
    if geometry is None or item is None:
        raise ValueError("no Geometry with a DataItem")
    if geometry.get("GeometryType", geometry.get("Type", "XYZ")).upper() != "XYZ":
        raise ValueError("a Geometry in two dimensions, expected XYZ")
    places = _numbers(item, path)
    values = {}
    for one in root.iter("Attribute"):
        item = one.find("DataItem")
        if item is not None and one.get("Center", "Node") == "Node":
            values[one.get("Name", "")] = item
    topologies = [item for one in root.iter("Topology") if (item := one.find("DataItem")) is not None]
    cells = tuple(_numbers(item, path).astype(np.int64) for item in topologies[:1])
    return Points(places, {name: _numbers(item, path) for name, item in values.items()}, cells)


def _numbers(item: ET.Element, path: Path) -> FloatArray:
    """Return the numbers of an item of data, in its shape."""
    shape = [int(n) for n in item.get("Dimensions", "").split()]
    text, form = (item.text or "").strip(), item.get("Format", "XML").upper()
    if form == "HDF":
        from uq.evaluation.hdf5 import stored_array

        name, _, place = text.partition(":")
        file = path.parent / name
        if not file.is_file():
            raise ValueError(f"its numbers are in {name}, which is not there")
        numbers = stored_array(file, place)
    elif form == "XML":
        numbers = np.array(text.split(), dtype=float)
    elif form == "BINARY":
        kind = {"INT": "i", "UINT": "u", "FLOAT": "f"}[item.get("NumberType", item.get("DataType", "Float")).upper()]
        order = ">" if item.get("Endian", "").upper() == "BIG" else "<"
        numbers = np.fromfile(path.parent / text, dtype=f"{order}{kind}{item.get('Precision', '4')}").astype(float)
    else:
        raise ValueError(f"numbers in the format {form}, expected XML, HDF or Binary")
    if numbers.size != np.prod(shape):
        raise ValueError(f"{numbers.size} numbers, expected {' × '.join(map(str, shape))}")
    return numbers.reshape(shape)
