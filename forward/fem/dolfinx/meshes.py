"""Meshes of bodies, with the facets of named boundaries and the cells of named regions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import ufl
from dolfinx import mesh
from numpy.typing import NDArray

from forward.bodies.geometry import AXES, Body
from forward.bodies.mesh import X_FIRST
from forward.bodies.mesh_file import MeshFile
from forward.fem.cost import BYTES_PER_UNKNOWN, SPARE
from forward.fem.dolfinx import version
from forward.machine import require
from forward.model import FloatArray, ModelError

_CELLS = {"hexahedron": mesh.CellType.hexahedron, "tetrahedron": mesh.CellType.tetrahedron}


def mesh_body(comm: Any, body: Body) -> tuple[Any, dict[str, NDArray[np.int32]]]:
    """Mesh a body; return this rank's part and its facets on each named boundary; collective over `comm`."""
    require(BYTES_PER_UNKNOWN * body.nodes / comm.size + SPARE, "the mesh")
    if body.kind == "mesh":
        return _own_mesh(comm, body)
    msh = mesh.create_box(comm, [[0.0, 0.0, 0.0], list(body.meshed)], list(body.cells), cell_type=_CELLS[body.cell])
    version.name_variant(msh)
    # Facets are found while boundaries are still planes perpendicular to an axis.
    facets = {}
    for axis, length in enumerate(body.meshed):
        for end, position in (("min", 0.0), ("max", length)):

            def on_boundary(x: FloatArray, axis: int = axis, position: float = position, length: float = length) -> Any:
                return np.abs(x[axis] - position) < 1e-9 * length

            facets[f"{AXES[axis]}-{end}"] = mesh.locate_entities_boundary(msh, 2, on_boundary)
    msh.geometry.x[:] = body.place(msh.geometry.x)
    return msh, facets


def _own_mesh(comm: Any, body: MeshFile) -> tuple[Any, dict[str, NDArray[np.int32]]]:
    """Distribute a mesh that the first rank reads."""
    loaded = on_first(comm, body.load)
    corners = 4 if body.cell == "tetrahedron" else 8
    points, cells, boundaries = np.zeros((0, 3)), np.zeros((0, corners), dtype=np.int64), None
    if loaded is not None:
        points, boundaries = loaded.points, loaded.boundaries
        cells = loaded.cells if corners == 4 else np.ascontiguousarray(loaded.cells[:, X_FIRST])
    msh = version.mesh_of(comm, body.cell, cells, points)
    boundaries = comm.bcast(boundaries)
    msh.topology.create_entities(2)
    msh.topology.create_connectivity(2, 3)
    facet_map = msh.topology.index_map(2)
    every = np.arange(facet_map.size_local + facet_map.num_ghosts, dtype=np.int32)
    nodes = version.corners_of_facets(msh, every)
    originals = np.sort(np.asarray(msh.geometry.input_global_indices)[nodes], axis=1)
    numbers = {tuple(row): k for k, row in enumerate(originals.tolist())}
    facets = {}
    for name, wanted in boundaries.items():
        here = [numbers[row] for row in map(tuple, np.sort(wanted, axis=1).tolist()) if row in numbers]
        facets[name] = np.array(sorted(here), dtype=np.int32)
    return msh, facets


def on_first(comm: Any, load: Callable[[], Any]) -> Any:
    """Call on the first rank; exceptions raised there are raised on all ranks."""
    found, problem = None, None
    if comm.rank == 0:
        try:
            found = load()
        except ModelError as error:
            problem = str(error)
    problem = comm.bcast(problem)
    if problem is not None:
        raise ModelError(problem)
    return found


def region_numbers(comm: Any, body: MeshFile, msh: Any) -> NDArray[np.int32]:
    """Return the number of the region of each of this rank's cells, ghosts included; collective."""
    loaded = on_first(comm, body.load)
    region = comm.bcast(None if loaded is None else loaded.region.astype(np.int32))
    return np.asarray(region[msh.topology.original_cell_index])


def cells_as_given(msh: Any) -> NDArray[np.int64]:
    """Return the number (n_owned,) that each of this rank's cells had in the arrays that the mesh was made of."""
    return np.asarray(msh.topology.original_cell_index[: owned_cells(msh)], dtype=np.int64)


def corners_as_given(msh: Any) -> NDArray[np.int64]:
    """Return the vertices (n_owned, k) of each of this rank's cells, by their numbers in these arrays."""
    vertices = version.corners_of_cells(msh)[: owned_cells(msh)]
    return np.asarray(np.asarray(msh.geometry.input_global_indices)[vertices], dtype=np.int64)


def facet_measure(msh: Any, facets: dict[str, NDArray[np.int32]]) -> tuple[Any, dict[str, int]]:
    """Return the surface measure of the named boundaries and the tag of each."""
    tags = {name: tag for tag, name in enumerate(facets, start=1)}
    indices = np.concatenate(list(facets.values()))
    values = np.concatenate([np.full(len(facets[name]), tag, dtype=np.int32) for name, tag in tags.items()])
    order = np.argsort(indices)
    marked = mesh.meshtags(msh, 2, indices[order].astype(np.int32), values[order])
    return ufl.Measure("ds", domain=msh, subdomain_data=marked), tags


def owned_cells(msh: Any) -> int:
    """Number of cells that this rank owns."""
    return int(msh.topology.index_map(3).size_local)
