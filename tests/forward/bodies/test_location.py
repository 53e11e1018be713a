"""Points in cells: inside, on faces and vertices, moved by rounding, and beside the mesh."""

import numpy as np
import pytest

from forward.bodies.geometry import Block, Box, holds, tolerance
from forward.bodies.location import locate, shapes
from forward.bodies.mesh import FACES
from tests.launch import on_kept_ranks

UNIT = np.array([[x, y, z] for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)])
SIX = [[0, 1, 3, 7], [0, 1, 7, 5], [0, 5, 7, 4], [0, 3, 2, 7], [0, 6, 4, 7], [0, 2, 6, 7]]
RNG = np.random.default_rng(3)


def cells(kind, n=3):
    """Corners of cells of a cube whose inner vertices are shifted."""
    grid = np.stack(np.meshgrid(*[np.arange(n + 1)] * 3, indexing="ij"), axis=-1).astype(float)
    shift = 0.2 * np.random.default_rng(0).uniform(-1, 1, grid.shape)
    inner = ((grid > 0) & (grid < n)).all(axis=-1)
    grid[inner] += shift[inner]
    first = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    corners = np.array([[grid[tuple(i + corner.astype(int))] for corner in UNIT] for i in first]) / n
    return corners if kind == "hexahedron" else corners[:, SIX].reshape(-1, 4, 3)


def places(corners, found):
    return np.einsum("nk,nka->na", shapes(found.local, corners.shape[1]), corners[found.cells])


@pytest.mark.parametrize("kind", ["hexahedron", "tetrahedron"])
@pytest.mark.parametrize("rounding", [0.0, 1e-15, 1e-10, 1e-6])
def test_points_within_rounding_of_a_vertex_lie_in_a_cell(kind, rounding):
    corners = cells(kind)
    vertices = np.unique(corners.reshape(-1, 3).round(12), axis=0)
    points = np.concatenate([vertices, RNG.uniform(size=(50, 3))])
    points[:-50] += rounding * RNG.uniform(-1, 1, (len(vertices), 3))
    found = locate(corners, points)
    assert ((found.local >= 0) & (found.local <= 1)).all()
    assert (found.distances <= 2 * max(rounding, 1e-12)).all()
    np.testing.assert_allclose(places(corners, found), points, atol=2 * max(rounding, 1e-12))


@pytest.mark.parametrize("kind", ["hexahedron", "tetrahedron"])
def test_points_beside_the_mesh_have_the_nearest_face(kind):
    corners = cells(kind)
    points = np.column_stack([RNG.uniform(size=(20, 2)), np.full(20, 1.001)])
    found = locate(corners, points)
    np.testing.assert_allclose(found.distances, 1e-3, rtol=0.02)
    np.testing.assert_allclose(places(corners, found), points, atol=1.02e-3)
    assert (locate(corners, np.array([[5.0, 5.0, 5.0]])).distances < 7).all()


def test_no_cells_and_no_points():
    assert np.isinf(locate(np.zeros((0, 8, 3)), np.zeros((2, 3))).distances).all()
    assert len(locate(cells("hexahedron"), np.zeros((0, 3))).cells) == 0


def test_a_thousandth_of_a_body_is_near():
    box = Box(size=(3.0, 4.0, 12.0), cells=(1, 1, 1))
    assert tolerance(box) == pytest.approx(0.013)
    assert holds(box, (3.012, 1.0, 1.0))
    assert not holds(box, (3.014, 1.0, 1.0))
    block = Block(corners=tuple(map(tuple, 2 * UNIT + [0, 1, 0])), cells=(1, 1, 1))
    assert holds(block, (2.003, 1.5, 0.5))
    assert not holds(block, (2.004, 1.5, 0.5))


SCRIPT = """
import sys

import numpy as np
from mpi4py import MPI

from forward.fem.dolfinx import meshes, spaces
from forward.bodies.geometry import Box
from forward.bodies.mesh_file import MeshFile

for file in sys.argv[1:]:
    degree = 2
    body = MeshFile(file=file, unit=1e-3, degree=degree) if file != "box" else Box(
        size=(0.05, 0.04, 0.03), cells=(3, 3, 2), cell="tetrahedron", degree=degree)
    msh, _ = meshes.mesh_body(MPI.COMM_WORLD, body)
    space = spaces.vector_space(msh, degree)
    nodes = np.concatenate(MPI.COMM_WORLD.allgather(spaces.node_coordinates(space)))
    points = 1e-3 * np.array([[float(f"{x:.5f}") for x in row] for row in 1e3 * nodes])  # as a scan writes them, in mm
    mine, nodes, weights, distances = spaces.point_rows(space, points)
    count = MPI.COMM_WORLD.allreduce(mine.astype(int))
    assert (count == 1).all(), count
    assert (distances <= 1e-8).all(), distances.max()
    # The weights reproduce a quadratic function, of the place.
    f = spaces.function(space)
    x = space.tabulate_dof_coordinates()
    f.x.array[0::3] = x[:, 0] * x[:, 1] + x[:, 2] ** 2
    values = np.einsum("nk,nk->n", weights, f.x.array[3 * nodes])
    exact = points[:, 0] * points[:, 1] + points[:, 2] ** 2
    assert (np.abs(values - exact)[mine] < 2e-9).all()
print("fine")
"""


@pytest.mark.fem
@pytest.mark.parametrize("ranks", [1, 2, pytest.param(3, marks=pytest.mark.slow)])
def test_every_point_of_a_scan_has_one_rank(tmp_path, ranks):
    """Nodes of boxes and of meshes from files, written with five digits."""
    meshio = pytest.importorskip("meshio")
    files = ["box"]
    for kind, name in (("hexahedron", "hexahedron"), ("tetrahedron", "tetra")):
        corners = 50 * cells(kind) @ np.array([[0.8, 0.36, 0.48], [-0.6, 0.48, 0.64], [0.0, -0.8, 0.6]]).T
        points, numbers = np.unique(corners.reshape(-1, 3).round(9), axis=0, return_inverse=True)
        numbers = numbers.reshape(len(corners), -1)
        if kind == "hexahedron":
            numbers = numbers[:, [0, 1, 3, 2, 4, 5, 7, 6]]
        else:
            edges = points[numbers[:, 1:]] - points[numbers[:, :1]]
            turned = np.linalg.det(edges) < 0
            numbers[turned] = numbers[turned][:, [1, 0, 2, 3]]
        faces = np.concatenate([numbers[:, face] for face in FACES[kind]])
        _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
        blocks = [(name, numbers), ("quad" if kind == "hexahedron" else "triangle", faces[first[count == 1]])]
        meshio.Mesh(points, blocks).write(tmp_path / f"{kind}.vtu")
        files.append(str(tmp_path / f"{kind}.vtu"))
    done = on_kept_ranks(ranks, SCRIPT, *files)
    assert done.returncode == 0, done.stderr
    assert "fine" in done.stdout
