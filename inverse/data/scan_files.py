"""Points, and values at them, from the files that scanners, cameras and other programs write.

STL and PLY hold surfaces, legacy VTK, VTU, VTP, gmsh's and Abaqus's files meshes, XDMF either: also a series over time
whose numbers are in HDF5, as DOLFINx writes it, of which the last step counts.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from forward.files import meshes
from forward.files.xdmf import geometry, numbers
from forward.model import FloatArray
from forward.settings import one_line
from inverse.data.table import DataError

STL_HEAD, STL_FACET = 84, 50  # bytes
PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
# By the names of C, and by those that say their size.
PLY_NAMES = "char uchar short ushort int uint float double int8 uint8 int16 uint16 int32 uint32 float32 float64"
PLY_KINDS = dict(zip(PLY_NAMES.split(), 2 * ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"], strict=True))


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
    """Read a file; raises `DataError` if it cannot be read, or its points are not finite ones in three dimensions."""
    if not path.is_file():
        raise DataError(f"{path.name}: cannot be read: No such file or directory")
    readers: dict[str, Callable[[Path], Points]] = {".stl": _stl, ".ply": _ply, ".xdmf": _xdmf}
    try:
        found = readers.get(path.suffix, _mesh)(path)
    except DataError:
        raise
    except ImportError as error:
        package = (error.name or "").partition(".")[0]
        wanted = {"vtk": "'tissuq[vtk]'"}.get(package, package)
        raise DataError(f"{path.name}: files of this kind need {package} (pip install {wanted})") from None
    except Exception as error:  # files may be anything, and their readers fail in many ways
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DataError(one_line(f"{path.name}: cannot be read as {path.suffix}: {reason}")) from None
    if found.places.ndim != 2 or found.places.shape[1] != 3 or not len(found.places):
        raise DataError(f"{path.name}: no points in three dimensions")
    if not np.isfinite(found.places).all():
        raise DataError(f"{path.name}: a point has a coordinate that is not a number")
    return found


def _mesh(path: Path) -> Points:
    mesh = meshes.read(path)
    values = {name: np.asarray(one, dtype=float) for name, one in mesh.point_data.items()}
    return Points(np.asarray(mesh.points, float), values, tuple(np.asarray(block.data) for block in mesh.cells))


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
    places = geometry(root, path)
    values = {}
    for one in root.iter("Attribute"):
        item = one.find("DataItem")
        if item is not None and one.get("Center", "Node") == "Node":
            values[one.get("Name", "")] = item
    topologies = [item for one in root.iter("Topology") if (item := one.find("DataItem")) is not None]
    cells = tuple(numbers(item, path).astype(np.int64) for item in topologies[:1])
    return Points(places, {name: numbers(item, path) for name, item in values.items()}, cells)
