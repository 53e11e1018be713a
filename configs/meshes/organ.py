"""Mesh of an organ: a body of two lobes, about the size and shape of a liver, with a vein through it and a tumour.

It writes organ.msh beside itself, in millimetres: region `tissue`, region `tumour`, boundary `vessel` (the wall of the
vein), boundary `tool` (a round patch on top, where an instrument presses), boundary `surface` (the rest).

    python configs/meshes/organ.py [LENGTH]     LENGTH of the cells in mm, by default 15; needs pip install gmsh meshio
"""

import sys
from pathlib import Path

import gmsh
import meshio
import numpy as np

VEIN = {"x": 15.0, "z": -8.0, "radius": 12.0}  # a straight tube along y
TUMOUR = {"centre": (48.0, -8.0, 16.0), "radius": 13.0}
TOOL = {"x": 45.0, "y": -10.0, "radius": 16.0}
NUMBERS = {"tissue": (1, 3), "tumour": (2, 3), "vessel": (3, 2), "tool": (4, 2), "surface": (5, 2)}


def ellipsoid(centre: tuple[float, float, float], axes: tuple[float, float, float]) -> tuple[int, int]:
    """Make a ball and stretch it."""
    ball = gmsh.model.occ.addSphere(*centre, 1.0)
    gmsh.model.occ.dilate([(3, ball)], *centre, *axes)
    return 3, ball


def generate(length: float) -> meshio.Mesh:
    """Make the geometry, mesh it, and give numbers to cells and triangles."""
    occ = gmsh.model.occ
    lobes = occ.fuse(
        [ellipsoid((40.0, 0.0, 0.0), (75.0, 62.0, 42.0))], [ellipsoid((-40.0, 5.0, 8.0), (65.0, 42.0, 26.0))]
    )[0]
    below = occ.addBox(-150.0, -100.0, -100.0, 300.0, 200.0, 72.0)  # the lower face is flat
    vein = occ.addCylinder(VEIN["x"], -150.0, VEIN["z"], 0.0, 300.0, 0.0, VEIN["radius"])
    body = occ.cut(lobes, [(3, below), (3, vein)])[0]
    ball = occ.addSphere(*TUMOUR["centre"], TUMOUR["radius"])
    occ.fragment(body, [(3, ball)])
    occ.synchronize()
    gmsh.option.setNumber("Mesh.MeshSizeMax", length)
    gmsh.option.setNumber("Mesh.MeshSizeMin", 0.4 * length)
    gmsh.option.setNumber("Mesh.MeshSizeFromCurvature", 10)
    gmsh.option.setNumber("Mesh.Algorithm3D", 10)
    gmsh.model.mesh.generate(3)
    gmsh.model.mesh.optimize("Netgen")
    tags, places, _ = gmsh.model.mesh.getNodes()
    number = {int(tag): i for i, tag in enumerate(tags)}
    points = places.reshape(-1, 3)

    def cells(dim: int) -> np.ndarray:
        _, _, nodes = gmsh.model.mesh.getElements(dim)
        return np.array([number[int(n)] for n in nodes[0]]).reshape(-1, dim + 1) if nodes else np.zeros((0, dim + 1))

    tetrahedra, triangles = cells(3), cells(2)
    inside = np.linalg.norm(points[tetrahedra].mean(axis=1) - TUMOUR["centre"], axis=1) < TUMOUR["radius"]
    faces = np.sort(tetrahedra[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3), axis=1)
    once, times = np.unique(faces, axis=0, return_counts=True)
    outer = {tuple(face) for face in once[times == 1].tolist()}
    triangles = np.array([t for t in triangles if tuple(sorted(t.tolist())) in outer])
    corners = points[triangles]
    middle = corners.mean(axis=1)
    on_vein = (np.hypot(corners[..., 0] - VEIN["x"], corners[..., 2] - VEIN["z"]) < 1.01 * VEIN["radius"]).all(axis=1)
    near = np.hypot(middle[:, 0] - TOOL["x"], middle[:, 1] - TOOL["y"]) < TOOL["radius"]
    kinds = np.where(on_vein, 3, np.where(near & (middle[:, 2] > 0), 4, 5))
    used, tetrahedra = np.unique(tetrahedra, return_inverse=True)
    new = np.full(len(points), -1)
    new[used] = np.arange(len(used))
    regions = np.where(inside, 2, 1)
    physical = [regions.astype(np.int32), kinds.astype(np.int32)]
    return meshio.Mesh(
        points[used].round(6),
        [("tetra", tetrahedra.reshape(-1, 4)), ("triangle", new[triangles])],
        cell_data={"gmsh:physical": physical, "gmsh:geometrical": physical},
        field_data={name: np.array(pair) for name, pair in NUMBERS.items()},
    )


if __name__ == "__main__":
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    mesh = generate(float(sys.argv[1]) if len(sys.argv) > 1 else 15.0)
    gmsh.finalize()
    meshio.write(Path(__file__).with_name("organ.msh"), mesh, file_format="gmsh22", binary=True)
