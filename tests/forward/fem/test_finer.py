"""Graded and divided meshes, and specimens on them."""

import numpy as np
import pytest
from mpi4py import MPI
from pydantic import ValidationError

from forward.bodies.geometry import Block, Box
from forward.bodies.mesh import contents, divided, faces_of
from forward.bodies.mesh_file import MeshFile
from forward.fem.finer import OtherMesh, extrapolated
from forward.finer_meshes import HALVED, OF_LINEAR, counted, finer, graded, held, share
from forward.hyperelastic import Hyperelastic
from forward.model import ModelError
from forward.specimen import Specimen
from tests.meshes import box, numbered

meshio = pytest.importorskip("meshio")


def test_a_grading_is_nested_and_as_steep_as_it_says():
    line = np.linspace(0, 1, 257)
    points = np.column_stack([line] * 3)
    placed = Box(size=(1.0, 1.0, 2.0), cells=(4, 4, 4), grading={"x-min": 8, "y-min": 4, "y-max": 2}).place(
        points * [1, 1, 2]
    )
    steps = np.diff(placed, axis=0)
    np.testing.assert_allclose(placed[[0, -1]], [[0, 0, 0], [1, 1, 2]], atol=1e-15)
    assert steps[-1, 0] / steps[0, 0] == pytest.approx(8, rel=0.01)
    assert steps[127, 1] / steps[0, 1] == pytest.approx(4, rel=0.02)
    assert steps[128, 1] / steps[-1, 1] == pytest.approx(2, rel=0.02)
    assert steps[128, 1] == pytest.approx(steps[127, 1], rel=0.02)  # no jump in the middle
    np.testing.assert_allclose(steps[:, 2], 2 / 256)
    coarse = Box(size=(1.0, 1.0, 1.0), cells=(3, 3, 3), grading={"x-max": 5})
    thirds = np.column_stack([np.arange(4) / 3] * 3)
    assert coarse.longest_edge == pytest.approx(np.diff(coarse.place(thirds)[:, 0]).max())
    fine = coarse.refined(1)
    assert fine.cells == (6, 6, 6)
    np.testing.assert_allclose(fine.place(thirds), coarse.place(thirds))


def test_a_block_is_graded_before_it_is_shaped():
    corners = tuple((2 * x + z, y, z) for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0))
    block = Block(corners=corners, cells=(2, 2, 2), grading={"x-min": 8})
    middle = block.place(np.array([[0.5, 0.5, 0.5]]))[0]
    share = (np.sqrt(8) - 1) / 7
    np.testing.assert_allclose(middle, [2 * share + 0.5, 0.5, 0.5])
    inside = np.random.default_rng(0).uniform(size=(9, 3))
    np.testing.assert_allclose(block.nearest(block.shaped(inside)), block.shaped(inside), atol=1e-9)


@pytest.mark.parametrize("grading", [{"x-min": 0.5}, {"top": 2}, {"x-min": 1e5}])
def test_gradings_that_are_none(grading):
    with pytest.raises(ValidationError):
        Box(size=(1.0, 1.0, 1.0), cells=(2, 2, 2), grading=grading)


def volume(mesh):
    at = mesh.points[mesh.cells]
    return np.abs(np.linalg.det(at[:, 1:] - at[:, :1])) / 6


def test_tetrahedra_are_divided_into_eight(tmp_path):
    meshio.write(tmp_path / "box.vtu", numbered(box("tetra")))
    whole = MeshFile(file=str(tmp_path / "box.vtu"))
    mesh = whole.load()
    held = whole.boundaries[0]
    for towards in ((), (held,)):
        fine = divided(mesh, towards)
        assert len(fine.cells) == 8 * len(mesh.cells)
        assert len(np.unique(fine.points.round(12), axis=0)) == len(fine.points)
        parts = volume(fine).reshape(-1, 8)
        np.testing.assert_allclose(parts.sum(axis=1), volume(mesh), rtol=1e-12)
        assert (parts.min(axis=1) > 0.005 * volume(mesh)).all()
        faces = np.sort(fine.cells[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3), axis=1)
        unique, count = np.unique(faces, axis=0, return_counts=True)
        assert count.max() == 2  # conforming: every face is inside, or on the surface
        outer = {tuple(face) for face in unique[count == 1].tolist()}
        for name, facets in fine.boundaries.items():
            assert len(facets) == 4 * len(mesh.boundaries[name])
            assert {tuple(sorted(facet)) for facet in facets.tolist()} <= outer
    body = whole.finer(1.5, (held,), 8.0, 4.0)
    assert body.cell_count == 8 * whole.cell_count
    assert sum(body.contents.areas.values()) == pytest.approx(sum(whole.contents.areas.values()))
    with pytest.raises(ModelError, match="divided already"):
        body.finer(1.5, (held,), 8.0, 4.0)


def inside(points, corners):
    """Volume of hexahedra by Gauss points: ∫ det ∂x/∂ξ of the trilinear map; and the least determinant there."""
    s = np.array([0.5 - 12**-0.5, 0.5 + 12**-0.5])
    total, least = np.zeros(len(corners)), np.inf
    for xi in np.stack(np.meshgrid(s, s, s), axis=-1).reshape(-1, 3):
        factors = np.where(VTK, xi, 1 - xi)
        slopes = [np.where(VTK[:, a], 1, -1) * np.delete(factors, a, axis=1).prod(axis=1) for a in range(3)]
        jacobian = np.linalg.det(np.einsum("ak,nki->nai", slopes, points[corners]))
        total, least = total + jacobian / 8, min(least, jacobian.min())
    return total, least


VTK = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])


def test_hexahedra_are_divided_into_eight(tmp_path):
    plain = box("hexahedron")
    rng = np.random.default_rng(0)
    plain.points = plain.points + 0.04 * rng.uniform(-1, 1, plain.points.shape)  # curved faces
    meshio.write(tmp_path / "box.vtu", numbered(plain))
    whole = MeshFile(file=str(tmp_path / "box.vtu"))
    mesh = whole.load()
    held = whole.boundaries[0]
    before, _ = inside(mesh.points, mesh.cells)
    for towards in ((), (held,)):
        fine = divided(mesh, towards)
        assert len(np.unique(fine.points.round(12), axis=0)) == len(fine.points)
        parts, least = inside(fine.points, fine.cells)
        assert least > 0
        np.testing.assert_allclose(parts.reshape(-1, 8).sum(axis=1), before, rtol=1e-12)
        faces = np.sort(faces_of(fine.cells, "hexahedron"), axis=1)
        unique, count = np.unique(faces, axis=0, return_counts=True)
        assert count.max() == 2  # conforming
        outer = {tuple(face) for face in unique[count == 1].tolist()}
        assert len(outer) == 4 * sum(len(facets) for facets in mesh.boundaries.values())
        for name, facets in fine.boundaries.items():
            assert len(facets) == 4 * len(mesh.boundaries[name])
            assert {tuple(sorted(facet)) for facet in facets.tolist()} <= outer
    thin = [divided(mesh, towards) for towards in ((), (held,))]
    nearest = [inside(m.points, m.cells)[0][np.isin(m.cells, m.boundaries[held]).any(axis=1)].sum() for m in thin]
    assert 0.4 < nearest[1] / nearest[0] < 0.6  # of half the thickness
    twice = whole.refined(2)
    made = contents(twice.load(), twice.contents.digest)
    left_out = {"longest_edge", "boundaries", "areas", "regions"}
    assert twice.contents.model_dump(exclude=left_out) == made.model_dump(exclude=left_out)
    assert made.longest_edge <= twice.contents.longest_edge * (1 + 1e-12)
    assert whole.finer(2.0, (held,), 8.0, 4.0).cell_count == 8 * whole.cell_count


def quality(mesh):
    """Volume over the cube of the longest edge of each cell."""
    at = mesh.points[mesh.cells]
    edges = [np.linalg.norm(at[:, i] - at[:, j], axis=1) for i, j in ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))]
    return volume(mesh) / np.max(edges, axis=0) ** 3


def test_finer_meshes_of_a_file(tmp_path):
    meshio.write(tmp_path / "box.msh", box("tetra"), file_format="gmsh22", binary=False)
    body = MeshFile(file=str(tmp_path / "box.msh"))
    assert body.refined(0) is body
    fine = body.refined(1).refined(2)
    assert fine == body.refined(3)
    mesh, made = fine.load(), contents(fine.load(), fine.contents.digest)
    # What is said before anything is divided is so.
    assert fine.contents.model_dump(exclude={"longest_edge", "boundaries", "areas", "regions"}) == made.model_dump(
        exclude={"longest_edge", "boundaries", "areas", "regions"}
    )
    assert body.longest_edge / 8 <= made.longest_edge <= fine.longest_edge
    assert made.areas == pytest.approx(body.contents.areas)
    assert made.regions == pytest.approx(body.contents.regions)
    assert made.cells == 512 * body.cell_count
    assert quality(mesh).min() > quality(body.load()).min() / 2
    assert MeshFile.model_validate(fine.model_dump()) == fine
    with pytest.raises(ValidationError, match="less than or equal to 6"):
        body.refined(7)
    with pytest.raises(ModelError, match="its mesh is divided already"):
        body.finer(1.5, (), 8.0, 4.0).refined(1)


CUBE = {
    "body": {"kind": "box", "size": (1.0, 1.0, 1.0), "cells": (2, 2, 2), "degree": 1},
    "material": {"kind": "neo-hookean-coupled", "mu": 1e4, "lmbda": 4e4},
    "cases": [
        {
            "name": "pull",
            "clamp": ["z-min"],
            "loads": [{"kind": "traction", "on": "z-max", "direction": [0, 0, 1], "size": 900}],
        }
    ],
    "observed": [{"on": "z-max"}],
}
FIELD = {"of": "stiffness", "length": 0.6, "std": 0.4}
PRESSED = {
    "body": {"kind": "box", "size": (1.0, 1.0, 1.0), "cells": (3, 3, 3), "degree": 1},
    "material": {"kind": "mooney-rivlin", "C1": 1e4, "C2": 0.0, "D1": 2e6},
    "clamp": ["x-min"],
    "displacements": [{"on": "y-min", "y": 0.0}],
    "outputs": [{"name": "u", "kind": "max-displacement", "component": "x"}],
    "loads": [{"kind": "traction", "on": "x-max", "direction": [1, 0, 0], "size": 900}],
}


def test_meshes_are_graded_to_the_faces_that_are_held():
    spec = finer(Specimen.model_validate(CUBE))
    assert (spec.body.cells, spec.body.degree) == ((5, 5, 5), 2)
    beside = dict.fromkeys(("x-min", "x-max", "y-min", "y-max"), 4.0)
    assert {face: ratio for face, ratio in spec.body.grading.items() if ratio > 1} == {"z-min": 8.0} | beside
    same = graded(Specimen.model_validate(CUBE))
    assert (same.body.cells, same.body.degree) == ((3, 3, 3), 2)
    assert same.body.grading == spec.body.grading
    assert share(Specimen.model_validate(CUBE)) == pytest.approx(1 / ((5 / 3) ** 3 - 1))
    # As many nodes as linear cells that are smaller.
    many = CUBE["body"] | {"cells": [12, 12, 8], "quadrature_degree": 3}
    one, field = CUBE | {"body": many}, {**FIELD, "basis": "nodes"}
    found = [make(Specimen.model_validate(one)).body for make in (finer, graded)]
    assert [(body.cells, body.degree) for body in found] == [((9, 9, 6), 2), ((6, 6, 4), 2)]
    assert found[0].quadrature_degree is None
    nested = Specimen.model_validate(one | {"fields": [field]})
    assert (finer(nested).body.cell_count, finer(nested).body.degree) == (14 * 14 * 10, 2)
    assert (graded(nested).body.cell_count, graded(nested).body.degree) == (12 * 12 * 8, 2)
    assert share(nested) == pytest.approx(1 / (0.35**-1.6 - 1))
    free = nested.model_copy(update={"cases": [nested.cases[0].model_copy(update={"clamp": ()})]})
    assert (finer(free).body.cell_count, graded(free), share(free)) == (12 * 12 * 8, None, OF_LINEAR)
    two = Specimen.model_validate(CUBE | {"body": many | {"degree": 2, "quadrature_degree": None}})
    assert (finer(two).body.cells, finer(two).body.degree) == ((18, 18, 12), 2)
    assert share(two) == pytest.approx(1 / (1.5**3 - 1))
    # A body that is graded more stays so, and one that is graded so is its own.
    steep = CUBE["body"] | {"grading": {"z-min": 20.0}}
    assert finer(Specimen.model_validate(CUBE | {"body": steep})).body.grading["z-min"] == 20.0
    assert graded(same) is None
    found = [make(two.model_copy(update={"fields": nested.fields})).body for make in (finer, graded)]
    other = two.model_copy(update={"body": two.body.model_copy(update={"cell": "tetrahedron"})})
    assert [counted(spec) for spec in (two, nested, other)] == [True, False, False]  # linear cells, tetrahedra
    assert [(body.cell_count, body.degree) for body in found] == [(26 * 26 * 17, 2), (14 * 14 * 9, 2)]
    few = nested.model_copy(update={"body": Box.model_validate(CUBE["body"])})
    found = [make(few).body for make in (finer, graded)]
    assert [(body.cell_count, body.degree) for body in found] == [(8 * 8 * 6, 2), (6 * 6 * 4, 2)]
    assert share(few) == pytest.approx(1 / 7)
    fields = [{**FIELD, "basis": "modes", "modes": 3}, {**FIELD, "of": "density", "basis": "modes", "modes": 3}]
    heavy = {"kind": "gravity", "direction": (0, 0, -1), "density": 1000}
    cases = [{**CUBE["cases"][0], "loads": [*CUBE["cases"][0]["loads"], heavy]}]
    both = finer(Specimen.model_validate(CUBE | {"cases": cases, "fields": fields})).fields
    assert [(one.of, one.basis) for one in both] == [("stiffness", "nodes"), ("density", "nodes")]


def test_bodies_with_outputs_have_finer_meshes_too():
    """Thin cells at what is held, but not at planes of symmetry; under tools 2 and 1.5 times the cells."""
    spec = Hyperelastic.model_validate(PRESSED)
    assert held(spec) == ("x-min",)
    found = [make(spec).body for make in (finer, graded)]
    assert [(body.cells, body.degree) for body in found] == [((5, 5, 5), 2), ((3, 3, 3), 2)]
    assert found[0].grading == dict.fromkeys(spec.body.boundaries, 4.0) | {"x-min": 8.0, "x-max": 1.0}
    assert [finer(spec).formulation, finer(spec).mixed] == ["auto", True]  # which linear cells cannot be
    tool = {
        "kind": "indenter",
        "shape": "plane",
        "on": "x-max",
        "at": [1, 0, 0],
        "direction": [-1, 0, 0],
        "depth": 0.01,
    }
    many = PRESSED["body"] | {"cells": [8, 6, 6]}
    touched = Hyperelastic.model_validate(PRESSED | {"loads": [tool], "body": many})
    assert [make(touched).body.cells for make in (finer, graded)] == [(8, 6, 6), (6, 5, 5)]
    field = {**FIELD, "basis": "nodes"}
    varied = Hyperelastic.model_validate(PRESSED | {"loads": [tool], "body": many, "fields": [field]})
    assert (finer(varied).body.cells, finer(varied).body.degree, graded(varied)) == ((16, 12, 12), 1, None)
    two = Hyperelastic.model_validate(PRESSED | {"loads": [tool], "body": many | {"degree": 2}})
    assert [(one.body.cells, one.body.grading) for one in (finer(two), graded(two))] == [
        ((16, 12, 12), {}),
        ((12, 9, 9), {}),
    ]
    assert (share(two), counted(two)) == (0.0, False)


@pytest.mark.fem
@pytest.mark.parametrize("kind", ["specimen", "outputs"])
def test_fields_of_both_kinds_are_carried_to_another_mesh(kind):
    """Exactly, to a mesh that is the same: outputs and derivatives, modes of a stiffness and of a density."""
    heavy = {"kind": "gravity", "direction": (1, 0, -1), "density": 100}
    case = CUBE["cases"][0] | {"loads": [*CUBE["cases"][0]["loads"], heavy]}
    fields = [{**FIELD, "modes": 2}, {**FIELD, "of": "density", "modes": 1}]
    points = [{"on": "z-max"}] if kind == "specimen" else [{"name": "u", "kind": "max-displacement", "component": "x"}]
    if kind == "specimen":
        spec = Specimen.model_validate(CUBE | {"cases": [case], "fields": fields, "observed": points})
    else:
        acting = {name: case[name] for name in ("clamp", "loads")}
        body = {name: CUBE[name] for name in ("body", "material")}
        spec = Hyperelastic.model_validate(body | acting | {"fields": fields, "outputs": points})
    model = spec.build(MPI.COMM_SELF, ("material.mu", *spec.coefficients))
    there = OtherMesh(model, finer(spec).model_copy(update={"body": spec.body}))
    point = np.array([1.1e4, 0.8, -0.5, 1.2])
    own, other = model.solve(point), there.solve(point)
    np.testing.assert_allclose(other.outputs, own.outputs, rtol=1e-6, atol=1e-8)
    directions = np.diag([1e3, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(other.tangent(directions), own.tangent(directions), rtol=1e-5, atol=1e-9)
    weights = np.ones(len(own.outputs))
    np.testing.assert_allclose(other.adjoint(weights), own.adjoint(weights), rtol=1e-5)


def test_linear_cells_of_a_file_are_looked_at_as_quadratic_ones(tmp_path):
    meshio.write(tmp_path / "box.vtu", numbered(box("tetra")))
    body = {"kind": "mesh", "file": str(tmp_path / "box.vtu"), "degree": 1}
    held, loaded = MeshFile(file=body["file"]).boundaries[:2]
    pull = {"kind": "traction", "on": loaded, "direction": [0, 0, 1], "size": 900}
    case = {"name": "pull", "clamp": [held], "loads": [pull]}
    spec = Specimen.model_validate(CUBE | {"body": body, "cases": [case], "observed": [{"on": loaded}]})
    found = finer(spec).body
    assert (found.degree, found.cell_count) == (2, spec.body.cell_count)
    assert share(spec) == OF_LINEAR
    assert graded(spec) is None
    two = spec.model_copy(update={"body": found})
    assert (finer(two).body.degree, finer(two).body.cell_count) == (2, 8 * found.cell_count)
    assert share(two) == HALVED


@pytest.mark.slow
@pytest.mark.fem
def test_the_finer_mesh_is_nearer_to_the_truth():
    """And the same as a specimen that has this mesh from the start."""
    model = Specimen.model_validate(CUBE).build(MPI.COMM_SELF, ("material.mu",))
    point = np.array([1.1e4])
    coarse = model.solve(point)
    here, there = coarse.outputs, OtherMesh(model, finer(model.spec)).solve(point).outputs
    spec = finer(model.spec)
    plain = spec.build(MPI.COMM_SELF, ("material.mu",)).observing(model.places, model.axes, model.cases)
    np.testing.assert_allclose(there, plain.solve(point).outputs, rtol=1e-12)
    body = spec.body.model_copy(update={"cells": (8, 8, 8)})
    best = spec.model_copy(update={"body": body}).build(MPI.COMM_SELF, ("material.mu",))
    truly = best.observing(model.places, model.axes, model.cases).solve(point)
    truth = truly.outputs
    seen = (there - here) @ (truth - here) / ((truth - here) @ (truth - here))
    assert 0.4 < seen < 1
    equal = extrapolated(model).otherwise  # for where thin cells have no equilibrium
    assert (equal.fine.spec.body.cells, equal.fine.spec.body.grading) == ((5, 5, 5), {})
    plain = np.split(equal.of(model).solve(point).outputs, 2)[0]
    assert np.linalg.norm(truth - plain) < 0.1 * np.linalg.norm(truth - here)
    # What is extrapolated from it is nearer still; so are its derivatives, from a start elsewhere.
    limit = extrapolated(model, np.array([1e4])).of(model).solve(point)
    tends, between = np.split(limit.outputs, 2)
    assert np.linalg.norm(truth - tends) < 0.5 * np.linalg.norm(truth - there)
    # Linear meshes of 3 and 2 cells left a sixth of the error.
    assert np.linalg.norm(truth - tends) < 0.05 * np.linalg.norm(truth - here)
    assert np.linalg.norm(between) > np.linalg.norm(truth - there)
    slopes = truly.tangent(np.ones(1))
    gaps = [
        np.linalg.norm(slopes - one) for one in (limit.tangent(np.ones(1))[: len(here)], coarse.tangent(np.ones(1)))
    ]
    assert gaps[0] < 0.3 * gaps[1]


@pytest.mark.slow
@pytest.mark.fem
@pytest.mark.parametrize("basis", ["nodes", pytest.param("modes", marks=pytest.mark.slow)])
def test_fields_are_those_of_the_mesh_itself(basis):
    """A field that is linear in space is the same on both meshes."""
    field = {**FIELD, "basis": basis} | ({"modes": 2} if basis == "modes" else {})
    spec = Specimen.model_validate(CUBE | {"fields": [field]})
    names = (*spec.coefficients, "material.mu")
    model = spec.build(MPI.COMM_SELF, names)
    rest = np.zeros(2) if basis == "modes" else model.vertices.coordinates @ [0.3, -0.2, 0.5]
    log = model.log_fields(np.array([[*rest, 1e4]]))[0]
    mesh = OtherMesh(model, finer(spec))
    around, weights = mesh._interpolation
    fine = (weights * log[around]).sum(axis=1)
    if basis == "nodes":
        places = mesh._mesh.vertices.coordinates
        np.testing.assert_allclose(fine - fine[0], (places - places[0]) @ [0.3, -0.2, 0.5], atol=1e-12)
    point = np.array([*rest, 1e4])
    found, here = mesh.solve(point), model.solve(point)
    np.testing.assert_allclose(found.outputs, here.outputs, rtol=0.2, atol=0.05 * np.abs(found.outputs).max())
    along = np.array([0.3, -0.5, 100.0]) if basis == "modes" else np.append(rest, 100.0)
    step = 1e-3
    there, before = (mesh.solve(point + sign * step * along).outputs for sign in (1, -1))
    np.testing.assert_allclose(found.tangent(along), (there - before) / (2 * step), rtol=1e-4, atol=1e-9)
