"""Meshes as other programs write them."""

from itertools import permutations, product

import meshio
import numpy as np

SIZE, CELLS = (1.0, 0.7, 0.8), (2, 1, 1)
CUBE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
TETRAHEDRA = [[0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6]]
NAMES = ("x-min", "x-max", "y-min", "y-max", "z-min", "z-max")
FACES = {"hexahedron": ("quad", 4), "tetra": ("triangle", 3)}


def box(kind="hexahedron", scale=1.0):
    """The mesh of a box: its right half is the region `right`, its faces have the names of those of a box."""
    lengths = np.array(CELLS) + 1
    grid = np.array(list(product(*map(range, lengths))))
    points = grid / np.array(CELLS) * SIZE * scale
    number = {tuple(place): i for i, place in enumerate(grid)}
    cells, regions = [], []
    for corner in product(*map(range, CELLS)):
        corners = np.array([number[tuple(np.add(corner, step))] for step in CUBE])
        made = [corners] if kind == "hexahedron" else corners[TETRAHEDRA]
        cells += list(made)
        regions += [1 + (corner[0] > 0)] * len(made)
    local = (
        [[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
        if kind == "hexahedron"
        else [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]
    )
    facets, numbers = [], []
    for cell in cells:
        for face in np.asarray(cell)[local]:
            for axis in range(3):
                for end, place in enumerate((0, CELLS[axis])):
                    if (grid[face, axis] == place).all():
                        facets.append(face)
                        numbers.append(10 + 2 * axis + end)
    of_cells = [np.array(regions, dtype=np.int32), np.array(numbers, dtype=np.int32)]
    return meshio.Mesh(
        points,
        [(kind, np.array(cells)), (FACES[kind][0], np.array(facets))],
        cell_data={"gmsh:physical": of_cells, "gmsh:geometrical": of_cells},
        field_data={
            "left": np.array([1, 3]),
            "right": np.array([2, 3]),
            **{name: np.array([10 + k, 2]) for k, name in enumerate(NAMES)},
        },
    )


def numbered(mesh):
    """The same without names, as formats have it that know none."""
    return meshio.Mesh(mesh.points, mesh.cells, cell_data={"part": mesh.cell_data["gmsh:physical"]})


def corner(width=2):
    """The mesh of an L of 1 m × 1 m × 1/4 m, without the quarter beyond (½, ½); `width` cells (even) along its arms."""
    counts = np.array((width, width, 1))
    grid = np.array(list(product(*(range(n + 1) for n in counts))))
    number = {tuple(place): i for i, place in enumerate(grid)}
    cells = []
    for first in product(*map(range, counts)):
        if min(first[:2]) < width // 2:
            ways = [np.cumsum([first, *way], axis=0) for way in permutations(np.eye(3, dtype=int))]
            cells += [[number[tuple(place)] for place in way] for way in ways]
    cells = np.array(cells)
    faces = np.sort(cells[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    outer, count = np.unique(faces, axis=0, return_counts=True)
    outer = outer[count == 1]
    ends = {"top": (grid[outer][:, :, 1] == width).all(axis=1), "right": (grid[outer][:, :, 0] == width).all(axis=1)}
    facets = np.concatenate([outer[on] for on in ends.values()])
    of_cells = [np.ones(len(cells), dtype=np.int32), np.repeat([10, 11], [on.sum() for on in ends.values()])]
    return meshio.Mesh(
        grid / counts * np.array((1.0, 1.0, 0.25)),
        [("tetra", cells), ("triangle", facets)],
        cell_data={"gmsh:physical": of_cells, "gmsh:geometrical": of_cells},
        field_data={"body": np.array([1, 3]), "top": np.array([10, 2]), "right": np.array([11, 2])},
    )
