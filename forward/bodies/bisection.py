"""Local refinement of tetrahedra by bisection, on arrays only: the same on any number of ranks and with any library.

D. N. Arnold, A. Mukherjee, L. Pouly, Locally adapted tetrahedral meshes using bisection, SIAM J. Sci. Comput. 22 (2000)
431–448. Every face has a marked edge, the same for both of its cells; the refinement edge of a cell, where it is cut
next, is one of these. Meshes are conforming, the closure terminates, and the descendants of a cell have at most 72
shapes, however often they are divided: angles stay away from 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from forward.bodies.mesh import SHIFT, IntArray, Loaded, keys_of
from forward.model import FloatArray, ModelError

BoolArray = NDArray[np.bool_]
EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
FACES = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # each is opposite the vertex of its row
# Values of `marks` for a face (a, 2, 3), where a is 0 or 1: its marked edge is (2, 3), (a, 2) or (a, 3).
OPPOSITE, TO_THIRD, TO_FOURTH = 0, 1, 2
# Order of the vertices (a, 2, 3) that a half keeps of its parent, by the mark of that face: the next cut comes first.
_ORDER = np.array([[1, 2, 0], [0, 1, 2], [0, 2, 1]])


@dataclass(frozen=True, eq=False)
class Bisected:
    """Tetrahedra that can be bisected.

    Attributes
    ----------
    points
        Vertices (n, 3).
    cells
        Vertices (c, 4) of each cell; its next cut is between the first two.
    marks
        Marked edges (c, 2) of the faces opposite the first and the second vertex; for the others it is the next cut.
    flags
        Whether each cell (c,) whose marked edges all lie in one face has a parent of that type too.
    labels
        Labels (c, 4) of the faces opposite the vertices of each cell; 0 for none.
    groups
        The labels that belong to each boundary, by name.
    regions, region
        Names of the regions, and the number of each cell's (c,).
    origin
        The cell (c,) that contained each one before the last refinement.
    """

    points: FloatArray
    cells: IntArray
    marks: NDArray[np.int8]
    flags: BoolArray
    labels: IntArray
    groups: dict[str, IntArray]
    regions: tuple[str, ...]
    region: IntArray
    origin: IntArray

    @classmethod
    def of(cls, mesh: Loaded) -> Bisected:
        """Mark the longest edge of each face and of each cell; among equal ones, the one with the lowest vertices.

        Raises
        ------
        ModelError
            If the cells are not tetrahedra.
        """
        if mesh.cell != "tetrahedron":
            raise ModelError("hexahedra cannot be refined locally, expected tetrahedra")
        rank = _rank_of_edges(mesh.points, mesh.cells)
        longest = rank.argmax(axis=1)
        ends = EDGES[longest]
        others = np.array([[k for k in range(4) if k not in edge] for edge in EDGES.tolist()])[longest]
        order = np.hstack([ends, others])
        cells = np.take_along_axis(mesh.cells, order, axis=1)
        rank = _rank_of_edges(mesh.points, cells)
        # Edges of the faces (1, 2, 3) and (0, 2, 3), in the order of the marks.
        marks = np.stack([rank[:, [5, 3, 4]].argmax(axis=1), rank[:, [5, 1, 2]].argmax(axis=1)], axis=1)
        labels, groups = _labelled(mesh.boundaries, cells)
        return cls(
            mesh.points,
            cells,
            marks.astype(np.int8),
            np.zeros(len(cells), dtype=bool),
            labels,
            groups,
            mesh.regions,
            mesh.region,
            np.arange(len(cells)),
        )

    def loaded(self) -> Loaded:
        """Return the mesh, with the facets of its boundaries; all cells are turned the same way, as VTK has them."""
        faces = self.cells[:, FACES]
        boundaries = {name: faces[np.isin(self.labels, numbers)] for name, numbers in self.groups.items()}
        at, cells = self.points[self.cells], self.cells.copy()
        mirrored = np.linalg.det(at[:, 1:] - at[:, :1]) < 0
        cells[mirrored, 2:] = cells[mirrored, :1:-1]
        return Loaded(self.points, cells, "tetrahedron", boundaries, self.regions, self.region)

    def refined(self, chosen: IntArray, times: int = 1) -> Bisected:
        """Bisect the chosen cells (k,) `times` times, and others as needed for a conforming mesh."""
        mesh = replace(self, origin=np.arange(len(self.cells)))
        for _ in range(times):
            mesh = mesh._closed(np.isin(mesh.origin, chosen))
        return mesh

    def _closed(self, cut: BoolArray) -> Bisected:
        """Bisect cells, then others until no cell has an edge with a hanging vertex."""
        mesh = self
        split: IntArray = np.zeros(0, dtype=np.int64)  # keys of the edges that were cut, sorted
        middles: IntArray = np.zeros(0, dtype=np.int64)  # the vertices in their middles
        while cut.any():
            new = np.setdiff1d(np.unique(keys_of(mesh.cells[cut][:, :2])), split)
            added = len(mesh.points) + np.arange(len(new))
            places = (mesh.points[new >> SHIFT] + mesh.points[new & (1 << SHIFT) - 1]) / 2
            order = np.argsort(np.concatenate([split, new]))
            split, middles = np.concatenate([split, new])[order], np.concatenate([middles, added])[order]
            middle = middles[np.searchsorted(split, keys_of(mesh.cells[cut][:, :2]))]
            mesh = replace(mesh, points=np.concatenate([mesh.points, places]))._halved(cut, middle)
            cut = np.isin(keys_of(mesh.cells[:, EDGES]), split).any(axis=1)
        return mesh

    def _halved(self, cut: BoolArray, middle: IntArray) -> Bisected:
        """Append the halves of the cut cells, each cut at its midpoint (k,), to the cells that stay."""
        cells, marks, labels = self.cells[cut], self.marks[cut], self.labels[cut]
        planar = (marks[:, 0] == marks[:, 1]) & (marks[:, 0] != OPPOSITE)
        again = planar & self.flags[cut]
        found_cells, found_marks, found_labels = [self.cells[~cut]], [self.marks[~cut]], [self.labels[~cut]]
        for kept, left in ((0, 1), (1, 0)):
            inherited = marks[:, left]  # the mark of the face without the vertex that is left
            own = np.array([kept, 2, 3])[_ORDER[inherited]]
            found_cells.append(np.column_stack([np.take_along_axis(cells, own, axis=1), middle]))
            # The marked edge of every face at the midpoint is opposite it, except in the face between the halves of a
            # cell that was planar for the second time: there it joins the midpoint and an end of the next cut.
            of_first = np.where(again, TO_FOURTH, TO_THIRD)
            found_marks.append(np.stack([of_first, np.full(len(cells), TO_THIRD)], axis=1).astype(np.int8))
            inner = labels.copy()
            inner[:, kept] = 0  # between the halves
            found_labels.append(np.column_stack([np.take_along_axis(inner, own, axis=1), labels[:, left]]))
        return replace(
            self,
            cells=np.concatenate(found_cells),
            marks=np.concatenate(found_marks),
            labels=np.concatenate(found_labels),
            flags=np.concatenate([self.flags[~cut], *[planar & ~self.flags[cut]] * 2]),
            region=np.concatenate([self.region[~cut], *[self.region[cut]] * 2]),
            origin=np.concatenate([self.origin[~cut], *[self.origin[cut]] * 2]),
        )


def _rank_of_edges(points: FloatArray, cells: IntArray) -> IntArray:
    """Rank the edges (c, 6) of cells by length, rounded so that equal ones tie, and then by their vertices."""
    keys, which = np.unique(keys_of(cells[:, EDGES]), return_inverse=True)
    lengths = np.linalg.norm(points[keys >> SHIFT] - points[keys & (1 << SHIFT) - 1], axis=1)
    rounded = np.round(lengths / (1e-9 * lengths.max()))
    rank = np.empty(len(keys), dtype=np.int64)
    rank[np.lexsort([-keys, rounded])] = np.arange(len(keys))
    return np.asarray(rank[which.reshape(len(cells), 6)])


def _labelled(boundaries: dict[str, IntArray], cells: IntArray) -> tuple[IntArray, dict[str, IntArray]]:
    """Label the faces (c, 4) of cells by the set of boundaries that they are on; return the labels of each too."""
    faces = np.sort(cells[:, FACES].reshape(-1, 3), axis=1)
    sizes = [len(facets) for facets in boundaries.values()]
    facets = np.sort(np.concatenate([np.zeros((0, 3), dtype=np.int64), *boundaries.values()]), axis=1)
    unique, which = np.unique(np.concatenate([faces, facets]), axis=0, return_inverse=True)
    which = which.ravel()
    member = np.zeros((len(unique), len(boundaries)), dtype=bool)
    member[which[len(faces) :], np.repeat(np.arange(len(sizes)), sizes)] = True
    rows, label = np.unique(member, axis=0, return_inverse=True)  # the first has no boundary: inside, or unnamed
    label = label.ravel()
    if rows[0].any():
        rows, label = np.concatenate([np.zeros((1, len(sizes)), dtype=bool), rows]), label + 1
    groups = {name: np.flatnonzero(rows[:, k]) for k, name in enumerate(boundaries)}
    return label[which[: len(faces)]].reshape(-1, 4), groups
