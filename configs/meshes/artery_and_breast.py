"""Meshes of hexahedra: a quarter of a ring of an artery, and a breast on the chest wall.

It writes artery.msh and breast.msh beside itself, in millimetres, with the faces of the block that was bent as their
boundaries: of the artery `inside`, `cut-x`, `cut-y` (planes of symmetry), `below`, `above`; of the breast `chest`.

    python configs/meshes/artery_and_breast.py     needs pip install meshio
"""

from pathlib import Path

import meshio
import numpy as np

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])


def ring(x):
    """Bend a unit block to a quarter of a ring: inner radius 3.1 mm, wall 0.9 mm, 1 mm long."""
    radius, angle = 3.1 + 0.9 * x[:, 0], np.pi / 2 * x[:, 1]
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), x[:, 2]])


def dome(x):
    """Bend it to a dome: 60 mm in radius, 55 mm high, 15 mm at its rim; the square becomes a disc."""
    u, v = 2 * x[:, 0] - 1, 2 * x[:, 1] - 1
    disc = np.column_stack([u * np.sqrt(1 - v**2 / 2), v * np.sqrt(1 - u**2 / 2)])
    height = 15 + 40 * np.sqrt(1 - 0.98 * np.clip((disc**2).sum(axis=1), 0, 1))
    return np.column_stack([60 * disc, height * x[:, 2]])


def write(name, bend, cells, faces):
    """Write a bent block of so many cells, with faces (axis, end) as boundaries of these names."""
    steps = [np.linspace(0, 1, n + 1) for n in cells]
    points = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    numbers = np.arange(len(points)).reshape([n + 1 for n in cells])
    hexahedra = np.array([[numbers[tuple(cell + c)] for c in CORNERS] for cell in np.ndindex(*cells)])
    quads, tags, names = [], [], {"tissue": np.array([1, 3])}
    for tag, (label, (axis, end)) in enumerate(faces.items(), start=2):
        side = np.take(numbers, -end, axis=axis)
        found = np.stack([side[:-1, :-1], side[1:, :-1], side[1:, 1:], side[:-1, 1:]], axis=-1).reshape(-1, 4)
        quads.append(found)
        tags += [tag] * len(found)
        names[label] = np.array([tag, 2])
    data = [np.ones(len(hexahedra), dtype=np.int32), np.array(tags, dtype=np.int32)]
    mesh = meshio.Mesh(
        bend(points),
        [("hexahedron", hexahedra), ("quad", np.concatenate(quads))],
        cell_data={"gmsh:physical": data, "gmsh:geometrical": data},
        field_data=names,
    )
    meshio.write(Path(__file__).parent / f"{name}.msh", mesh, file_format="gmsh22", binary=False)


sides = {"inside": (0, 0), "cut-x": (1, 1), "cut-y": (1, 0), "below": (2, 0), "above": (2, 1)}
write("artery", ring, (3, 8, 1), sides)
write("breast", dome, (8, 8, 4), {"chest": (2, 0)})
