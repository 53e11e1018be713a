"""Blocks with given corners: their map, their boundaries, and equilibria in them."""

import numpy as np
import pytest
from mpi4py import MPI
from scipy.spatial import ConvexHull

from forward.bodies.geometry import Block, Box, outside
from forward.fem.dolfinx import spaces
from forward.fem.equations import Discretisation
from forward.hyperelastic import Hyperelastic
from forward.solvers.equilibrium import solving
from forward.solvers.steps import finish
from tests.bodies import MATERIALS, OUTPUTS, loaded_body
from tests.launch import ROOT, on_kept_ranks
from workflows.config.study import load

CUBE = np.array([(x, y, z) for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)])
SHEAR = np.array([[1.0, 0.2, 0.1], [-0.3, 0.8, 0.2], [0.1, 0.0, 0.9]])


def frustum():
    """A pyramid cut by a slanted plane, sheared: all faces are plane, and no two are parallel."""
    base = CUBE[:, :2] - (0.4, 0.3)
    height = CUBE[:, 2] * (1 + 0.2 * base[:, 0]) / (1 + 0.07 * base[:, 0])  # where z = 1 + 0.2 x cuts an edge
    return np.column_stack([base * (1 - 0.35 * height[:, None]), height]) @ SHEAR.T + (3, 2, 1)


PLANE = frustum()
WARPED = CUBE @ SHEAR.T + 0.15 * np.random.default_rng(3).uniform(-1, 1, (8, 3))
FACES = [f"{axis}-{end}" for axis in "xyz" for end in ("min", "max")]


def block(corners, cells=(2, 3, 2), **mesh):
    return Block(corners=tuple(tuple(map(float, corner)) for corner in corners), cells=cells, **mesh)


def area(corners, boundary):
    """Area vector, outwards, of a face: half the product of its diagonals, whatever its shape between the edges."""
    axis, end = "xyz".index(boundary[0]), boundary[2:]
    a, b, c, d = (corners[k] for k in range(8) if CUBE[k, axis] == (end == "max"))
    vector = np.cross(d - a, c - b) / 2
    return vector if (end == "max") == (axis != 1) else -vector


def test_the_faces_of_the_test_blocks_close():
    for corners in (CUBE, PLANE, WARPED):
        np.testing.assert_allclose(sum(area(corners, face) for face in FACES), 0, atol=1e-15)
    np.testing.assert_allclose(area(CUBE, "y-max"), [0, 1, 0])


@pytest.mark.parametrize("corners", [PLANE, WARPED, 1e-3 * WARPED], ids=["plane", "warped", "small"])
def test_points_are_found_inside_and_not_outside(corners):
    body = block(corners)
    np.testing.assert_allclose(body.place(CUBE), corners, rtol=1e-15)
    x = np.random.default_rng(1).random((40, 3))
    x[:20, 1] = np.round(x[:20, 1])  # on a boundary
    assert not any(outside(body, point) for point in body.place(x))
    x[:, 1] = np.where(x[:, 1] < 0.5, -0.01, 1.01)
    assert all(outside(body, point) for point in body.place(x))
    assert all(outside(body, point) for point in ((9.0, 0.0, 0.0), (-1e3, 1e4, 7.0), (0.0, 0.0, -2.0)))


def test_a_box_is_a_block():
    box = Box(size=(1.0, 0.7, 0.8), cells=(2, 1, 1))
    same = block(box.vertices)
    assert same.vertices == box.vertices
    assert box.longest_edge == 0.8
    assert same.model_copy(update={"cells": box.cells}).longest_edge == pytest.approx(0.8)
    assert same.bounds == box.bounds == ((0, 1), (0, 0.7), (0, 0.8))
    for face in FACES:
        assert same.corners_of(face) == box.corners_of(face)
    x = np.random.default_rng(0).random((5, 3))
    np.testing.assert_allclose(same.place(x), x * box.size, rtol=1e-14)


@pytest.mark.fem
def test_a_box_as_a_block_gives_what_the_box_gives():
    box = loaded_body("demiray")
    mesh = {name: getattr(box.body, name) for name in ("cells", "cell", "degree")}
    same = Hyperelastic.model_validate(box.model_dump() | {"body": block(box.body.vertices, **mesh).model_dump()})
    found, expected = (spec.build(MPI.COMM_SELF, ()).solve(np.empty(0)).outputs for spec in (same, box))
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def body_of(corners, cell, degree, **blocks):
    mesh = block(corners, cell=cell, degree=degree)
    given = {"body": mesh.model_dump(), "material": MATERIALS["demiray"], "clamp": ("x-min",), "outputs": OUTPUTS[:1]}
    return Hyperelastic.model_validate(given | blocks)


SHAPES = [("hexahedron", 1), ("hexahedron", 2), ("tetrahedron", 1), ("tetrahedron", 2)]


@pytest.mark.fem
@pytest.mark.parametrize(("cell", "degree"), [SHAPES[0], SHAPES[2]])
@pytest.mark.parametrize("corners", [PLANE, WARPED], ids=["plane", "warped"])
def test_a_pressure_pushes_on_its_face_only(corners, cell, degree):
    loads = tuple({"kind": "pressure", "on": face, "size": 1.0, "name": face} for face in FACES)
    spec = body_of(corners, cell, degree, loads=loads)
    body = Discretisation(spec, MPI.COMM_SELF, tuple(f"loads.{face}.size" for face in FACES))
    for face, pressures in zip(FACES, np.eye(6), strict=True):
        body.set_parameters(pressures)
        body.at_load(1.0)
        body.set_state(np.zeros(spec.unknowns))
        forces = body.imbalance().reshape(-1, 3)
        np.testing.assert_allclose(forces.sum(axis=0), area(corners, face), atol=1e-13)
        nodes = spaces.boundary_nodes(body.space, body.facets[face])
        assert len(nodes) == np.prod([n + 1 for axis, n in zip("xyz", (2, 3, 2), strict=True) if axis != face[0]])
        assert np.abs(np.delete(forces, nodes, axis=0)).max() < 1e-10


class MovedBoundary(Discretisation):
    """A body whose whole boundary follows x → F x."""

    deformation = np.array([[1.1, 0.3, -0.1], [0.05, 0.9, 0.2], [-0.15, 0.1, 1.2]])

    def set_parameters(self, parameters):
        super().set_parameters(parameters)
        places = np.asarray(self.space.tabulate_dof_coordinates())[: self.nodes_owned]
        self._full_targets = (places @ (self.deformation - np.eye(3)).T).ravel()[self.fixed]
        self._moves = True


@pytest.mark.fem
@pytest.mark.parametrize(("cell", "degree"), SHAPES)
@pytest.mark.parametrize("corners", [PLANE, WARPED], ids=["plane", "warped"])
def test_patch_of_distorted_cells(corners, cell, degree):
    inside = block(corners).place(np.array([(0.5, 1 / 3, 1.0), (0.3, 0.4, 0.2), (1.0, 1.0, 0.0)]))
    points = tuple(
        {"kind": "displacement", "name": f"{i}{c}", "at": tuple(map(float, at)), "component": c}
        for i, at in enumerate(inside)
        for c in "xyz"
    )
    outputs = ({"kind": "volume-change", "name": "V"}, {"kind": "strain-energy", "name": "W"}, *points)
    spec = body_of(corners, cell, degree, clamp=tuple(FACES), outputs=outputs, formulation="displacement")
    body = MovedBoundary(spec, MPI.COMM_SELF, ())
    body.set_parameters(np.empty(0))
    body.at_load(1.0)
    u = finish(solving(body, spec.solver, np.zeros(spec.unknowns)), body.solve).state
    places = np.asarray(body.space.tabulate_dof_coordinates())
    np.testing.assert_allclose(
        u[: places.size].reshape(-1, 3), places @ (body.deformation - np.eye(3)).T, rtol=0, atol=1e-9
    )

    body.at_load(1.0)
    body.set_state(u)
    change, energy, *displacements = (output.functional(body).value() for output in spec.outputs)
    assert change == pytest.approx(np.linalg.det(body.deformation) - 1, rel=1e-10)
    np.testing.assert_allclose(displacements, (inside @ (body.deformation - np.eye(3)).T).ravel(), rtol=0, atol=1e-9)
    if corners is PLANE:
        I1 = np.linalg.det(body.deformation) ** (-2 / 3) * np.trace(body.deformation.T @ body.deformation)
        a, b, D1 = (MATERIALS["demiray"][name] for name in ("a", "b", "D1"))
        density = a / (2 * b) * np.expm1(b * (I1 - 3)) + D1 * change**2
        assert energy == pytest.approx(density * ConvexHull(PLANE).volume, rel=1e-9)


SCRIPT = """
import sys
import numpy as np
from tests.forward.fem.test_block import WARPED, body_of
from tests.ranks import groups

points = tuple({"kind": "displacement", "name": c, "at": tuple(map(float, WARPED[3])), "component": c} for c in "xyz")
loads = ({"kind": "traction", "on": "x-max", "direction": (0.0, 1.0, 1.0), "size": 2e3},)
outputs = (*points, {"kind": "volume-change", "name": "V"})
for comm in groups(1, 2):
    model = body_of(WARPED, "hexahedron", 1, loads=loads, outputs=outputs).build(comm, ())
    solution = model.solve(np.empty(0))
    state = model.space.gather(solution.state[None])
    if comm.rank == 0:
        path = f"{sys.argv[1]}/{comm.size}.npz"
        np.savez(path, state=state, outputs=solution.outputs, coordinates=model.space.coordinates)
"""


@pytest.mark.fem
@pytest.mark.mpi
def test_ranks_that_share_a_block_agree_with_one(tmp_path):
    done = on_kept_ranks(2, SCRIPT, tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    one, two = (dict(np.load(tmp_path / f"{ranks}.npz")) for ranks in (1, 2))
    np.testing.assert_allclose(two["coordinates"], one["coordinates"], rtol=0, atol=1e-14)
    np.testing.assert_allclose(two["outputs"], one["outputs"], rtol=1e-9)
    np.testing.assert_allclose(two["state"], one["state"], rtol=0, atol=1e-9 * np.abs(one["state"]).max())


def rise_of_cooks_membrane(cells, form="mixed"):
    changes = [f"model.body.cells=[{cells}, {cells}, 1]", f'model.formulation="{form}"']
    spec = load(ROOT / "configs" / "cook.toml", changes).model
    return spec.build(MPI.COMM_SELF, ()).solve(np.empty(0)).outputs[0]


@pytest.mark.fem
def test_cooks_membrane_rises_as_published_in_the_mixed_form():
    assert rise_of_cooks_membrane(8) == pytest.approx(6.9e-3, rel=0.01)
    assert rise_of_cooks_membrane(8, "displacement") < 6.6e-3


@pytest.mark.fem
@pytest.mark.slow
def test_cooks_membrane_converges_to_the_published_rise():
    assert rise_of_cooks_membrane(16) == pytest.approx(6.9e-3, rel=1e-2)
    coarse, middle, fine = (rise_of_cooks_membrane(cells, "displacement") for cells in (4, 8, 16))
    limit = fine + (fine - middle) ** 2 / (2 * middle - coarse - fine)
    assert limit == pytest.approx(6.9e-3, rel=1e-2)
