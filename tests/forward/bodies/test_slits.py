"""Closed slits of meshes from files: lips that part, the same on any number of ranks, and never without a word."""

import json

import meshio
import numpy as np
import pytest
from mpi4py import MPI

from forward.bodies.mesh_file import MeshFile
from forward.hyperelastic import Hyperelastic
from tests.launch import on_kept_ranks

CELLS, SMALL, SIZE = (8, 6, 3), (4, 3, 2), (0.12, 0.09, 0.03)
# By another code for these cells, with trilinear elements: the mean displacement of the pulled face (m), cut and whole.
CUT, WHOLE = 9.9128e-4, 5.2925e-4


def block(depth=2, named=True, division=CELLS):
    """A block, of which the uppermost layers of cells are cut apart in the middle; its lower lip may be a boundary."""
    numbers = np.arange(np.prod([n + 1 for n in division])).reshape([n + 1 for n in division])
    axes = [np.linspace(0, length, n + 1) for length, n in zip(SIZE, division, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    middle, lowest = division[0] // 2, division[2] - depth
    twins = numbers.copy()
    if depth:
        # Points of the front of the slit, below the cut layers, are single.
        cut = numbers[middle, :, lowest + 1 :]
        twins[middle, :, lowest + 1 :] = len(points) + np.arange(cut.size).reshape(cut.shape)
        points = np.concatenate([points, points[cut.ravel()]])

    def corners(of, i, j, k):
        return [of[i + a, j + b, k + c] for c in (0, 1) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]

    cells = [
        corners(twins if i >= middle else numbers, i, j, k)
        for i in range(division[0])
        for j in range(division[1])
        for k in range(division[2])
    ]

    def face(i, of, ks):
        return [
            [of[i, j, k], of[i, j + 1, k], of[i, j + 1, k + 1], of[i, j, k + 1]] for j in range(division[1]) for k in ks
        ]

    every = range(division[2])
    faces = [face(0, numbers, every), face(division[0], numbers, every)]
    if depth and named:
        faces.append(face(middle, numbers, range(lowest, division[2])))
    tags = np.concatenate([np.full(len(part), 10 + n) for n, part in enumerate(faces)])
    shapes = [("hexahedron", np.array(cells)), ("quad", np.concatenate(faces))]
    return meshio.Mesh(points, shapes, cell_data={"part": [np.ones(len(cells), dtype=np.int64), tags]})


NAMES = {"held": 10, "pulled": 11, "cut": 12}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("slit")
    meshes = {"cut": block(), "unnamed": block(named=False), "whole": block(0), "small": block(1, division=SMALL)}
    for name, mesh in meshes.items():
        meshio.write(path / f"{name}.vtu", mesh)
    return path


def model(file, **body):
    names = NAMES if file.stem in {"cut", "small"} else {name: NAMES[name] for name in ("held", "pulled")}
    return Hyperelastic.model_validate(
        {
            "formulation": "displacement",
            "body": {"kind": "mesh", "file": str(file), "names": names, "degree": 1} | body,
            "material": {"kind": "mooney-rivlin", "C1": 1000, "C2": 500, "D1": 4000},
            "clamp": ["held"],
            "loads": [{"kind": "traction", "on": "pulled", "direction": [1, 0, 0], "size": 36}],
            "outputs": [
                {"name": "lift", "kind": "mean-displacement", "on": "pulled", "component": "x"},
                {"name": "at the cut", "kind": "displacement", "at": [0.06, 0.045, 0.03], "component": "x"},
            ],
        }
    )


def answers(comm, file, degree):
    """Outputs and the state in canonical order, on the first rank."""
    built = model(file, degree=int(degree)).build(comm, ())
    solution = built.solve(np.zeros(0))
    state = built.space.gather(solution.state[None])
    return None if state is None else [solution.outputs.tolist(), state.ravel().tolist()]


@pytest.mark.fem
def test_lips_part(folder):
    for name, lift in (("cut", CUT), ("unnamed", CUT), ("whole", WHOLE)):
        assert answers(MPI.COMM_SELF, folder / f"{name}.vtu", 1)[0][0] == pytest.approx(lift, rel=1e-5)


RANKS = """
import sys, json
from pathlib import Path
from mpi4py import MPI
from tests.forward.bodies.test_slits import answers
found = answers(MPI.COMM_WORLD, Path(sys.argv[1]), sys.argv[2])
if found is not None:
    print(json.dumps(found))
"""


@pytest.mark.fem
@pytest.mark.mpi
@pytest.mark.parametrize(("ranks", "degree"), [(2, 1), pytest.param(3, 1, marks=pytest.mark.slow), (2, 2)])
def test_ranks_agree(folder, ranks, degree):
    expected = answers(MPI.COMM_SELF, folder / "small.vtu", degree)
    done = on_kept_ranks(ranks, RANKS, folder / "small.vtu", degree)
    assert done.returncode == 0, done.stderr
    for a, b in zip(expected, json.loads(done.stdout.splitlines()[-1]), strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-9 * np.abs(a).max())


def test_slits_are_said_unless_they_are_named(folder):
    (said,) = model(folder / "cut.vtu").body.findings
    assert said.text.startswith("The mesh has a closed slit of 0.0018 m² on 'cut': faces that lie on each other")
    assert not list(model(folder / "cut.vtu", slits=["cut"]).body.findings)
    (said,) = model(folder / "unnamed.vtu").body.findings
    assert said.text.startswith("The mesh has a closed slit of 0.0018 m²: faces that lie on each other")
    assert not list(model(folder / "whole.vtu").body.findings)


def test_a_boundary_without_double_points_is_no_slit(folder):
    for name, there in (("cut", "cut"), ("whole", "none in this file")):
        with pytest.raises(ValueError, match=f"slits: 'held' is no boundary whose .* such a one: {there}"):
            model(folder / f"{name}.vtu", slits=["held"])


def test_lips_stay_apart_where_cells_are_divided(folder):
    body = MeshFile(file=str(folder / "cut.vtu"), names=NAMES, slits=("cut",), levels=2)
    mesh = body.load()
    step = 1e-9 * np.ptp(mesh.points, axis=0).max()  # of the canonical order of nodes
    keys = np.floor(mesh.points / step + 1 / np.pi)
    assert len(np.unique(keys, axis=0)) == len(mesh.points) == body.vertex_count
    assert np.abs(np.ptp(mesh.points, axis=0) - SIZE).max() < 1e-6 * max(SIZE)


def test_parts_that_only_touch_are_refused(tmp_path):
    meshio.write(tmp_path / "apart.vtu", block(CELLS[2]))
    # With all layers cut the front is an edge on the lower face of the block: two parts, joined by no face.
    with pytest.raises(ValueError, match="points lie where others lie: its parts are not joined"):
        MeshFile(file=str(tmp_path / "apart.vtu"))
    shifted = block(1)
    lip = shifted.points[-CELLS[1] - 1 :]
    lip[1::2, 1] += 0.3 * SIZE[1] / CELLS[1]  # faces of one lip do not lie on those of the other
    meshio.write(tmp_path / "shifted.vtu", shifted)
    with pytest.raises(ValueError, match="4 points lie where others lie"):
        MeshFile(file=str(tmp_path / "shifted.vtu"))
