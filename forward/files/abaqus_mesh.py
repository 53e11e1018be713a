"""Meshes of Abaqus's files with their groups: regions are sets of elements, boundaries surfaces and sets."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.bodies.mesh import IntArray, surface_of
from forward.files import abaqus
from forward.files.abaqus import SHELLS, SOLIDS, Part

if TYPE_CHECKING:
    import meshio

CELLS = {"tetra": "tetrahedron", "hexahedron": "hexahedron"}
ALL = "body"  # the region of elements in no set
# Corners of the sides S1, S2, … of linear solids.
SIDES = {
    "tetra": [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]],
    "hexahedron": [[0, 1, 2, 3], [4, 7, 6, 5], [0, 4, 5, 1], [1, 5, 6, 2], [2, 6, 7, 3], [3, 7, 4, 0]],
}


def read(path: Path) -> meshio.Mesh:
    """Read a file: all its nodes that belong to elements, its elements, and its sets of them.

    Groups of solid elements, if these are linear, are in the arrays and fields of gmsh's files, with names: regions are
    the sets that the user named, or, where these overlap, those of the solid sections. Boundaries are surfaces, sets of
    nodes (the faces of the body all of whose nodes are in the set) and sets of elements on the surface.

    Raises
    ------
    ValueError
        With what is wrong, and the line where that is known.
    OSError
        If it cannot be read.
    """
    import meshio

    part = abaqus.read(path)
    used = sorted({node for _, nodes in part.elements.values() for node in nodes} or part.nodes)
    index = {node: k for k, node in enumerate(used)}
    for label, (_, nodes) in part.elements.items():
        lost = next((node for node in nodes if node not in part.nodes), None)
        if lost is not None:
            raise ValueError(f"element {label} has the node {lost}, which is not there")
    points = np.array([part.nodes[node] for node in used], dtype=float).reshape(-1, 3)
    rows: dict[str, dict[int, list[int]]] = {}
    for label, (kind, nodes) in part.elements.items():
        rows.setdefault(kind, {})[label] = [index[node] for node in nodes]
    blocks = [(kind, np.array(list(some.values()), dtype=np.int64)) for kind, some in rows.items()]
    solid = [kind for kind in rows if kind in SOLIDS.values()]
    if len(solid) != 1 or solid[0] not in CELLS:
        return meshio.Mesh(points, blocks)
    (kind,) = solid
    cells = np.array(list(rows[kind].values()), dtype=np.int64)
    regions = _regions(part, list(rows[kind]))
    outer, boundaries = _boundaries(part, rows, kind, cells, index)
    groups = {f"{name}-nodes" if name in regions else name: member for name, member in boundaries.items()}
    if groups:
        named = np.any(list(groups.values()), axis=0)
        outer, groups = outer[named], {name: member[named] for name, member in groups.items()}
    nothing, numbers = np.zeros(0, dtype=np.int64), [np.zeros(len(some), dtype=np.int64) for some in (cells, outer)]
    titles, sets = {ALL: np.array([0, 3])}, {}
    for dim, found in ((3, regions), (2, groups)):
        for number, (name, member) in enumerate(found.items(), start=1):
            numbers[3 - dim][member] = number
            titles[name] = np.array([number, dim])
            sets[name] = [np.flatnonzero(member), nothing] if dim == 3 else [nothing, np.flatnonzero(member)]
    return meshio.Mesh(
        points,
        [(kind, cells), ((outer.shape[1] == 3 and "triangle") or "quad", outer)],
        cell_data={"gmsh:physical": numbers},
        field_data=titles,
        cell_sets=sets,
    )


def _regions(part: Part, labels: list[int]) -> dict[str, NDArray[np.bool_]]:
    """Return which of the solid elements each region has: one for each, if there are sets that say so.

    These are, in this order, all named sets but those of all elements, those of the solid sections, and those that
    were not named where the elements were. Sets that overlap, whatever is chosen, are returned as they are.
    """
    members = {name: np.isin(labels, some) for name, some in part.element_sets.items() if not name.startswith("_")}
    members = {name: member for name, member in members.items() if member.any()}
    some = {name: member for name, member in members.items() if not member.all()}
    first = some or dict(list(members.items())[:1])
    sections = {name.upper() for name in part.sections}
    choices = [
        first,
        {name: member for name, member in members.items() if name.upper() in sections},
        {name: member for name, member in first.items() if name in part.told},
    ]
    for found in choices:
        if found and not (np.sum(list(found.values()), axis=0) > 1).any():
            return found
    return first


def _boundaries(
    part: Part, rows: dict[str, dict[int, list[int]]], kind: str, cells: IntArray, index: dict[int, int]
) -> tuple[IntArray, dict[str, NDArray[np.bool_]]]:
    """Return the faces of the surface of the body, and which of them each boundary has."""
    outer, owner = surface_of(cells, CELLS[kind])
    keys = {tuple(sorted(face)): k for k, face in enumerate(outer.tolist())}
    places = {label: k for k, label in enumerate(rows[kind])}
    shells = [one for of in SHELLS.values() for one in rows.get(of, {}).items()]
    found: dict[str, NDArray[np.bool_]] = {}

    def add(name: str, member: NDArray[np.bool_]) -> None:
        same = name in found and (np.array_equal(found[name], member) or not member.any())
        if member.any() and not same:
            found[f"{name}-nodes" if name in found else name] = member

    def by_nodes(labels: list[int]) -> NDArray[np.bool_]:
        return np.asarray(np.isin(outer, [index[node] for node in labels if node in index]).all(axis=1))

    def these(sides: list[list[int]]) -> NDArray[np.bool_]:
        member = np.zeros(len(outer), dtype=bool)
        member[[keys[key] for side in sides if (key := tuple(sorted(side))) in keys]] = True
        return member

    for name, said in part.surfaces.items():
        member = by_nodes([label for labels, side in said if side is None for label in labels])
        for labels, side in said:
            mine = [places[label] for label in labels if label in places]
            if side is None:
                continue
            if side:
                if side > len(SIDES[kind]):
                    raise ValueError(f"*SURFACE {name}: the side S{side} of an element of {len(SIDES[kind])}")
                member |= these(cells[mine][:, SIDES[kind][side - 1]].tolist())
            else:
                member |= np.isin(owner, mine)
            inside = set(labels)
            member |= these([nodes for label, nodes in shells if label in inside])
        add(name, member)
    for name, labels in part.element_sets.items():
        inside = set(labels)
        add(name, these([nodes for label, nodes in shells if label in inside]))
    for name, labels in part.node_sets.items():
        if not name.startswith("_"):
            add(name, by_nodes(labels))
    return outer, found
