"""Meshes with values as ParaView files, without VTK: to import it takes longer than most studies take to write."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray

Array = NDArray[Any]
TYPES = {"f8": "Float64", "f4": "Float32", "i8": "Int64", "i4": "Int32", "u1": "UInt8"}


@dataclass(frozen=True, eq=False)
class Grid:
    """A mesh whose cells are all of one kind, with values."""

    points: FloatArray  # (n, 3) (m)
    cells: Array  # numbers (m, k) of the points of each cell, in VTK's order
    kind: int  # VTK's number of the kind of the cells
    point_data: Mapping[str, Array] = field(default_factory=dict)  # values (n,) or (n, 3) by name
    cell_data: Mapping[str, Array] = field(default_factory=dict)  # values (m,) by name


def vtu(grid: Grid) -> bytes:
    """Return a grid as a VTK XML file of an unstructured grid (Kitware, VTK file formats), its arrays compressed."""
    many, corners = grid.cells.shape
    ends = np.arange(corners, corners * many + 1, corners)
    kinds = np.full(many, grid.kind, dtype=np.uint8)
    topology = {"connectivity": grid.cells.ravel(), "offsets": ends, "types": kinds}
    lines = [
        '<?xml version="1.0"?>',
        '<VTKFile type="UnstructuredGrid" version="2.3" byte_order="LittleEndian" header_type="UInt64" '
        'compressor="vtkZLibDataCompressor">',
        "<UnstructuredGrid>",
        f'<Piece NumberOfPoints="{len(grid.points)}" NumberOfCells="{many}">',
        *_section("PointData", grid.point_data),
        *_section("CellData", grid.cell_data),
        *_section("Points", {"Points": grid.points}),
        *_section("Cells", topology),
        "</Piece>",
        "</UnstructuredGrid>",
        "</VTKFile>\n",
    ]
    return "\n".join(lines).encode()


def _section(tag: str, arrays: Mapping[str, Array]) -> Iterator[str]:
    yield f"<{tag}>"
    for name, given in arrays.items():
        values = np.ascontiguousarray(given, dtype=given.dtype.newbyteorder("<"))
        components = f' NumberOfComponents="{values.shape[1]}"' if values.ndim > 1 else ""
        begin = f'<DataArray type="{TYPES[values.dtype.str[1:]]}" Name="{escape(name)}"{components} format="binary">'
        yield f"{begin}{_packed(values)}</DataArray>"
    yield f"</{tag}>"


def _packed(values: Array) -> str:
    """Return an array as one compressed block: numbers of blocks and bytes, and the bytes, each in base 64."""
    squeezed = zlib.compress(values.tobytes(), 1) if values.size else b""
    sizes = [1, values.nbytes, 0, len(squeezed)] if values.size else [0, 0, 0]
    header = np.array(sizes, dtype="<u8").tobytes()
    return base64.b64encode(header).decode() + base64.b64encode(squeezed).decode()
