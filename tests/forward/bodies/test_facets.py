"""What flat facets hide of curved surfaces: of balls, pipes and creases, and in the outputs of a sphere."""

from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI

from benchmarks.facets import INNER, OUTER, body, exact, octant
from forward.bodies.bisection import Bisected
from forward.bodies.facets import lift_of, lifted
from forward.bodies.mesh import TETRAHEDRA, Loaded
from forward.bodies.mesh_file import MeshFile
from forward.bodies.tetrahedra import packed
from tests.launch import on_kept_ranks
from tests.meshes import box


def mesh(cell, points, cells):
    return Loaded(points, cells, cell, {}, ("body",), np.zeros(len(cells), dtype=int))


def volume(points, cells):
    """By tetrahedra: of hexahedra the mean over both ways to cut their faces."""
    if cells.shape[1] == 4:
        return np.abs(np.linalg.det(points[cells[:, 1:]] - points[cells[:, :1]])).sum() / 6
    turned = cells[:, [1, 2, 3, 0, 5, 6, 7, 4]]
    return np.mean([volume(points, way[:, TETRAHEDRA["hexahedron"]].reshape(-1, 4)) for way in (cells, turned)])


@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron"])
@pytest.mark.parametrize("along", [3, 6])
def test_the_volume_of_a_hollow_ball_is_found(cell, along):
    """Facets hide a part of order h² of it, and what is left is of order h³ or less; planes stay planes."""
    points, cells = octant(cell, along, 2)
    moved = lifted(mesh(cell, points, cells)).points
    whole = np.pi / 6 * (OUTER**3 - INNER**3)
    hidden, left = (volume(at, cells) / whole - 1 for at in (points, moved))
    assert hidden < -0.005
    assert abs(left) < abs(hidden) / (2 * along)
    assert np.abs(moved[np.abs(points) < 1e-12]).max() < 1e-12
    radii = np.linalg.norm(moved, axis=1) / np.linalg.norm(points, axis=1)
    assert (radii > 1 - 1e-12).all()  # inside too, where vertices follow


@pytest.mark.parametrize("changes", [{"levels": 1}, {"divide": ()}, {"levels": 1, "divide": ()}])
def test_a_divided_mesh_hides_what_the_file_does(tmp_path, changes):
    """Its new facets lie in one plane with their neighbours, those of the file do not."""
    whole = body(tmp_path, "tetrahedron", 3, 2).body
    before, after = whole.load(), whole.lifted()
    divided = whole.model_validate(whole.model_dump(exclude={"contents"}) | changes)
    moved = divided.lifted().points - divided.load().points
    n = len(before.points)  # vertices of the file come first
    np.testing.assert_allclose(moved[:n], after.points - before.points, rtol=0, atol=1e-15)
    assert len(moved) > 4 * n
    assert np.linalg.norm(moved, axis=1).max() == pytest.approx(np.linalg.norm(moved[:n], axis=1).max())


def test_a_mesh_that_was_refined_hides_what_the_first_one_does(tmp_path):
    """Also as a file, and divided further."""
    first = body(tmp_path, "tetrahedron", 2, 1).body
    before, after = first.load(), first.lifted()
    finer = Bisected.of(before).refined(np.arange(0, len(before.cells), 3)).loaded()
    finer = replace(finer, lift=lift_of(before, after, finer.points))
    volumes = [volume(at.points, at.cells) for at in (before, after, finer, lifted(finer))]
    assert volumes[2] == pytest.approx(volumes[0])
    assert volumes[3] == pytest.approx(volumes[1])
    assert len(finer.points) > len(before.points)
    (tmp_path / "mesh.npz").write_bytes(packed(finer))
    read = MeshFile(file=str(tmp_path / "mesh.npz"), levels=1).lifted()
    assert volume(read.points, read.cells) == pytest.approx(volumes[1])
    assert lifted(replace(finer, lift=0 * finer.lift)) is None


@pytest.mark.unit
def test_flat_facets_of_flat_faces_hide_nothing():
    for kind, cell in (("hexahedron", "hexahedron"), ("tetra", "tetrahedron")):
        made = box(kind)
        assert lifted(mesh(cell, made.points, made.cells[0].data)) is None


@pytest.mark.unit
def test_a_pipe_is_lifted_between_its_creases():
    """A quarter of a full cylinder: only its mantle moves, by a third of twice k h²/8, and stays in its end planes."""
    angles, heights = np.linspace(0, np.pi / 2, 7), np.linspace(0, 1, 4)
    rim = [(r * np.cos(a), r * np.sin(a), z) for z in heights for r in (0.4, 1.0) for a in angles]
    number = np.arange(len(rim)).reshape(4, 2, 7)
    cells = [
        [
            *number[k, 0, [i, i + 1]],
            *number[k, 1, [i + 1, i]],
            *number[k + 1, 0, [i, i + 1]],
            *number[k + 1, 1, [i + 1, i]],
        ]
        for k in range(3)
        for i in range(6)
    ]
    points, cells = np.array(rim), np.array(cells)
    moved = lifted(mesh("hexahedron", points, cells)).points - points
    radii, edge = np.hypot(*points[:, :2].T), 2 * np.sin(np.pi / 24)
    outwards = (moved[:, :2] * points[:, :2]).sum(axis=1) / radii
    np.testing.assert_allclose(outwards, radii * edge**2 / 8 * 2 / 3, rtol=0.1)
    assert np.abs(moved[np.isin(points[:, 2], [0, 1]), 2]).max() < 1e-12
    np.testing.assert_allclose(outwards, np.linalg.norm(moved, axis=1), rtol=1e-3)


@pytest.mark.slow
@pytest.mark.fem
def test_what_facets_hide_of_a_thick_sphere(tmp_path):
    """Of its energy and of displacements, against the radial equation; a mesh that is divided hides as much."""
    spec = body(tmp_path, "hexahedron", 3, 2)
    solution = spec.build(MPI.COMM_SELF, ()).solve(np.zeros(0))
    found = solution.saturation()
    true = exact() - solution.outputs
    of_mesh = solution.mesh_error().calibrated(found).outputs
    assert (np.abs(true) > 4 * (np.abs(of_mesh) + found.doubts))[0]  # that of the polyhedron alone is too small by far
    rest = true - of_mesh
    assert (np.abs(found.hidden - rest) < 0.25 * np.abs(found.hidden) + found.doubts).all(), (found.hidden, rest)


SCRIPT = """
import sys
from pathlib import Path
import numpy as np
from benchmarks.facets import body
from tests.ranks import groups

for comm in groups(1, 2):
    spec = body(Path(sys.argv[1]), "tetrahedron", 2, 1)
    found = spec.build(comm, ()).solve(np.zeros(0)).saturation().hidden
    assert all(np.array_equal(found, other) for other in comm.allgather(found))
    if comm.rank == 0:
        np.save(f"{sys.argv[1]}/{comm.size}.npy", found)
"""


@pytest.mark.slow
@pytest.mark.fem
@pytest.mark.mpi
def test_ranks_agree(tmp_path):
    body(tmp_path, "tetrahedron", 2, 1)  # writes the file, before several ranks do
    done = on_kept_ranks(2, SCRIPT, tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    one, two = (np.load(tmp_path / f"{ranks}.npy") for ranks in (1, 2))
    np.testing.assert_allclose(two, one, rtol=1e-7)
