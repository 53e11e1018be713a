"""Numbers of XDMF files, and the meshes that DOLFINx writes: one grid with the cells, one with each set of tags."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

import numpy as np

from forward.bodies.mesh import IntArray
from forward.model import FloatArray

if TYPE_CHECKING:
    import meshio

SOLIDS = {
    "tetrahedron": "tetra",
    "hexahedron": "hexahedron",
    "tetrahedron_10": "tetra10",
    "hexahedron_20": "hexahedron20",
    "hexahedron_27": "hexahedron27",
}
FACETS = {"triangle": "triangle", "quadrilateral": "quad"}
STORED = re.compile(rb"([^\s<>\"]+\.h5):|Format=\"Binary\"[^>]*>\s*([^\s<>]+)")
TAGS = "cell_tags"  # the array of all tags, where there is one set for cells and one for facets at most


def stored(path: Path) -> list[Path]:
    """Return the files in which a file stores its numbers; raises OSError."""
    names = {name for either in STORED.findall(path.read_bytes()) for name in either}
    return [path.parent / os.fsdecode(name) for name in sorted(names - {b""})]


def numbers(item: ET.Element, path: Path) -> FloatArray:
    """Return the numbers of an item of data, in its shape.

    Raises
    ------
    ValueError
        If there are not as many, or they are stored in another way.
    OSError, KeyError
        If the file beside it cannot be read, or lacks them.
    """
    shape = [int(n) for n in item.get("Dimensions", "").split()]
    text, form = (item.text or "").strip(), item.get("Format", "XML").upper()
    if form == "HDF":
        import h5py

        name, _, place = text.partition(":")
        file = path.parent / name
        if not file.is_file():
            raise ValueError(f"its numbers are in {name}, which is not there")
        with h5py.File(file, "r") as stored:
            found = np.asarray(stored[place], dtype=float)
    elif form == "XML":
        found = np.array(text.split(), dtype=float)
    elif form == "BINARY":
        kind = {"INT": "i", "UINT": "u", "FLOAT": "f"}[item.get("NumberType", item.get("DataType", "Float")).upper()]
        order = ">" if item.get("Endian", "").upper() == "BIG" else "<"
        found = np.fromfile(path.parent / text, dtype=f"{order}{kind}{item.get('Precision', '4')}").astype(float)
    else:
        raise ValueError(f"numbers in the format {form}, expected XML, HDF or Binary")
    if found.size != np.prod(shape):
        raise ValueError(f"{found.size} numbers, expected {' × '.join(map(str, shape))}")
    return found.reshape(shape)


def geometry(root: ET.Element, path: Path) -> FloatArray:
    """Return the points (n, 3) of the first geometry.

    Raises
    ------
    ValueError
        If there is none in three dimensions.
    """
    pairs = ((one, item) for one in root.iter("Geometry") if (item := one.find("DataItem")) is not None)
    found = next(pairs, None)
    if found is None:
        raise ValueError("no Geometry with a DataItem")
    first, item = found
    if first.get("GeometryType", first.get("Type", "XYZ")).upper() != "XYZ":
        raise ValueError("a Geometry in two dimensions, expected XYZ")
    return numbers(item, path)


def read(path: Path) -> meshio.Mesh:
    """Read a mesh; where a file has several grids, as those of DOLFINx, tags are arrays of its cells and facets."""
    import meshio

    root = ET.parse(path).getroot()
    grids = list(_grids(root, path))
    if len(grids) < 2:
        return meshio.read(path)
    body = next((grid for grid in grids if grid[0] in SOLIDS.values()), None)
    if body is None:
        raise ValueError("no grid of solid cells")
    kind, cells, _ = body
    facets = [(of, some, arrays) for of, some, arrays in grids if of in FACETS.values()]
    blocks = [(kind, cells), *((of, some) for of, some, _ in facets)]
    found = [(0, cells, some, title, tags) for of, some, every in grids if of == kind for title, tags in every]
    plain = len(found) < 2 and len(facets) < 2
    found += [(k, some, some, *one) for k, (_, some, every) in enumerate(facets, start=1) for one in every]
    arrays: dict[str, list[IntArray]] = {}
    for k, block, some, title, tags in found:
        none = [np.zeros(len(other), dtype=np.int64) for _, other in blocks]
        arrays.setdefault(TAGS if plain else title, none)[k] = _matched(block, some, tags)
    return meshio.Mesh(geometry(root, path), blocks, cell_data=arrays)


def _grids(root: ET.Element, path: Path) -> Iterator[tuple[str, IntArray, list[tuple[str, IntArray]]]]:
    """Yield the kind of cells, the cells, and the arrays of whole numbers of each grid that has cells of its own."""
    for grid in root.iter("Grid"):
        topology = grid.find("Topology")
        item = None if topology is None else topology.find("DataItem")
        if topology is None or item is None:
            continue
        word = topology.get("TopologyType", topology.get("Type", "")).lower()
        kind = (SOLIDS | FACETS).get(word, word)
        arrays = []
        for one in grid.iter("Attribute"):
            values = one.find("DataItem")
            if values is not None and one.get("Center", "Node") == "Cell":
                arrays.append((one.get("Name", ""), numbers(values, path).ravel().astype(np.int64)))
        yield kind, numbers(item, path).astype(np.int64), arrays


def _matched(cells: IntArray, tagged: IntArray, tags: IntArray) -> IntArray:
    """Return the tags of cells, 0 where they have none, given those of some of them in another order."""
    if len(tags) != len(tagged):
        raise ValueError(f"{len(tags)} tags of {len(tagged)} cells")
    known = {tuple(sorted(cell)): tag for cell, tag in zip(tagged.tolist(), tags.tolist(), strict=True)}
    return np.array([known.get(tuple(sorted(cell)), 0) for cell in cells.tolist()], dtype=np.int64)
