"""Meshes that are refined locally: they conform, keep their shape, and carry boundaries and regions along."""

from dataclasses import replace

import meshio
import numpy as np
import pytest
from scipy.spatial import Delaunay

from forward.bodies.bisection import EDGES, FACES, Bisected
from forward.bodies.geometry import Block, Box
from forward.bodies.mesh import Loaded
from forward.bodies.mesh_file import MeshFile
from forward.bodies.tetrahedra import packed, tetrahedra
from forward.model import ModelError
from tests.meshes import box

TRIANGLES = [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]


def shapes(mesh):
    """Circumradius-free measure of each cell: longest edge over the diameter of the ball inside, 1 if regular."""
    at = mesh.points[mesh.cells]
    longest = np.linalg.norm(at[:, EDGES[:, 0]] - at[:, EDGES[:, 1]], axis=2).max(axis=1)
    areas = sum(np.linalg.norm(np.cross(at[:, b] - at[:, a], at[:, c] - at[:, a]), axis=1) / 2 for a, b, c in FACES)
    return longest / (2 * np.sqrt(6) * 3 * volumes(mesh) / areas)


def volumes(mesh):
    at = mesh.points[mesh.cells]
    return np.abs(np.linalg.det(at[:, 1:] - at[:, :1])) / 6


def areas(mesh):
    corners = {name: np.moveaxis(mesh.points[facets], 1, 0) for name, facets in mesh.boundaries.items()}
    return {name: np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 for name, (a, b, c) in corners.items()}


def check_conforming(mesh):
    """No vertex lies inside an edge or a face: inner faces have two cells, and the others make the boundary."""
    faces, count = np.unique(np.sort(mesh.cells[:, FACES].reshape(-1, 3), axis=1), axis=0, return_counts=True)
    assert count.max() == 2
    outer = {tuple(face) for face in faces[count == 1].tolist()}
    named = {tuple(sorted(facet)) for facets in mesh.boundaries.values() for facet in facets.tolist()}
    assert named <= outer
    return outer, named


def a_box():
    body = Box(size=(1.0, 0.7, 0.3), cells=(2, 1, 1), cell="tetrahedron", grading={"x-min": 3.0})
    mesh, place = tetrahedra(body)
    return replace(mesh, points=place(mesh.points))


def a_cloud():
    """Cells of all shapes, of which a tenth is nearly flat."""
    points = np.random.default_rng(3).random((60, 3))
    cells = Delaunay(points).simplices.astype(np.int64)
    faces, count = np.unique(np.sort(cells[:, FACES].reshape(-1, 3), axis=1), axis=0, return_counts=True)
    halves = {"all": faces[count == 1], "left": faces[(count == 1) & (points[faces].mean(axis=1)[:, 0] < 0.5)]}
    region = (points[cells].mean(axis=1)[:, 1] > 0.5).astype(np.int64)
    return Loaded(points, cells, "tetrahedron", halves, ("lower", "upper"), region)


@pytest.mark.parametrize("first", [a_box(), a_cloud()], ids=["box", "cloud"])
def test_cells_are_refined_towards_a_point(first):
    marked = Bisected.of(first)
    corner, smallest = first.points[0], volumes(first).min()
    for _ in range(10):
        near = np.abs(marked.points[marked.cells] - corner).max(axis=2).min(axis=1)
        marked = marked.refined(np.flatnonzero(near == 0), 3)
        mesh = marked.loaded()
        outer, named = check_conforming(mesh)
        assert outer == named
        assert volumes(mesh).sum() == pytest.approx(volumes(first).sum(), rel=1e-12)
        assert areas(mesh) == pytest.approx(areas(first), rel=1e-12)
        for k in range(len(first.regions)):
            assert volumes(mesh)[mesh.region == k].sum() == pytest.approx(volumes(first)[first.region == k].sum())
        at = mesh.points[mesh.cells]
        assert (np.linalg.det(at[:, 1:] - at[:, :1]) > 0).all()
        assert shapes(mesh).max() <= 4 * shapes(first).max()
    assert volumes(mesh).min() < 1e-6 * smallest
    assert len(mesh.cells) < 150 * len(first.cells)  # 2^30 if everywhere
    # The descendants of a cell have few shapes, however often they are divided.
    assert len(np.unique(np.round(shapes(mesh), 6))) <= 36 * len(first.cells)


def test_the_cell_that_each_was_in_is_known():
    marked = Bisected.of(a_box())
    finer = marked.refined(np.array([0, 5]), 3)
    parts = np.bincount(finer.origin, weights=volumes(finer.loaded()), minlength=len(marked.cells))
    assert parts == pytest.approx(volumes(marked.loaded()))
    assert np.bincount(finer.origin)[[0, 5]].min() >= 8
    with pytest.raises(ModelError, match="hexahedra cannot be refined locally"):
        Bisected.of(Loaded(np.zeros((8, 3)), np.arange(8)[None], "hexahedron", {}, ("body",), np.zeros(1, int)))


def test_all_cells_are_bisected_evenly_where_they_fit_together():
    mesh, _ = tetrahedra(Box(size=(1.0, 1.0, 1.0), cells=(2, 2, 2), cell="tetrahedron"))
    marked = Bisected.of(mesh)
    for cells in (96, 192, 384):
        marked = marked.refined(np.arange(len(marked.cells)))
        assert len(marked.cells) == cells


def test_a_refined_mesh_is_a_body_from_a_file(tmp_path):
    meshio.write(tmp_path / "box.msh", box("tetra"), file_format="gmsh22", binary=False)
    mesh = Bisected.of(MeshFile(file=str(tmp_path / "box.msh")).load()).refined(np.array([0]), 3).loaded()
    (tmp_path / "mesh.npz").write_bytes(packed(mesh))
    assert packed(mesh) == packed(mesh)
    body = MeshFile(file=str(tmp_path / "mesh.npz"))
    again = body.load()
    assert (again.points == mesh.points).all()
    assert (again.cells == mesh.cells).all()
    assert again.regions == ("left", "right")
    assert body.contents.areas == pytest.approx(MeshFile(file=str(tmp_path / "box.msh")).contents.areas)
    assert body.contents.regions == pytest.approx({"left": 0.28, "right": 0.28})
    (tmp_path / "other.npz").write_bytes(b"no mesh")
    with pytest.raises(ValueError, match=r"other.npz: cannot be read as a mesh"):
        MeshFile(file=str(tmp_path / "other.npz"))


def test_points_between_the_corners_of_a_block_follow_its_faces():
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0.5), (0, 0, 1), (1, 0, 1), (0, 1, 1), (1, 1, 1)]
    body = Block(corners=corners, cells=(1, 1, 1), cell="tetrahedron")
    mesh, place = tetrahedra(body)
    marked = Bisected.of(mesh)
    for _ in range(6):
        marked = marked.refined(np.arange(len(marked.cells)))
    found = replace(marked.loaded(), points=place(marked.points))
    below = found.points[np.unique(found.boundaries["z-min"])]
    assert below[:, 2] == pytest.approx(0.5 * below[:, 0] * below[:, 1])
    assert len(below) == 25
