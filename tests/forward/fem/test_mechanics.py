"""Equilibria against closed forms, published values and balances; the closed forms read the same energies by SymPy."""

import mpmath
import numpy as np
import pytest
import sympy as sp
import ufl
from mpi4py import MPI

from forward.fem.dolfinx import compile, meshes, spaces
from forward.fem.equations import Discretisation
from forward.fem.layout import Layout
from forward.hyperelastic import Hyperelastic
from forward.materials.material import MATERIALS as REGISTERED
from forward.solvers.equilibrium import solving
from forward.solvers.steps import finish
from tests import textbook
from tests.bodies import (
    CELLS,
    FORMS,
    MATERIALS,
    MIXED,
    MORE_MATERIALS,
    NOT_CONSTANTS,
    OUTPUTS,
    unloaded_body,
)

pytestmark = pytest.mark.fem
SIZE = (1.0, 0.7, 0.8)
VOLUME = float(np.prod(SIZE))
ALL_MATERIALS = MATERIALS | MORE_MATERIALS


def rationals(block):
    return {name: sp.Rational(str(value)) for name, value in block.items() if name not in NOT_CONSTANTS}


def exact(material, F):
    """Energy density, nominal stress P, von Mises stress and J of a homogeneous deformation, by the textbook."""
    return textbook.of_numbers(ALL_MATERIALS[material.split()[0]], F)


def lateral_stretch(material, stretches):
    """Stretches with those that are None chosen (equal) so that their stress vanishes."""
    block = ALL_MATERIALS[material.split()[0]]

    def along_the_free(free):
        given = [free if s is None else mpmath.mpf(str(s)) for s in stretches]
        steps = [textbook.STEP if s is None else 0 for s in stretches]
        ends = [
            textbook.energy(block, mpmath.diag([g + sign * d for g, d in zip(given, steps, strict=True)]))
            for sign in (1, -1)
        ]
        return (ends[0] - ends[1]) / (2 * textbook.STEP)

    with mpmath.workdps(60):
        value = 1.0 if None not in stretches else float(mpmath.findroot(along_the_free, (0.9, 1.05), tol=1e-30))
    return [value if s is None else s for s in stretches]


ROLLERS = tuple({"on": f"{axis}-min", axis: 0.0} for axis in "xyz")


@pytest.mark.parametrize(
    "stretches",
    [
        pytest.param((1.3, None, None), id="uniaxial tension"),
        pytest.param((0.7, None, None), id="uniaxial compression"),
        pytest.param((1.2, 1.2, None), id="equibiaxial tension", marks=pytest.mark.slow),  # as uniaxial compression
        pytest.param((1.4, 1.0, None), id="pure shear", marks=pytest.mark.slow),
        pytest.param((0.9, 0.9, 0.9), id="compression of the volume"),
    ],
)
@pytest.mark.parametrize("material", [*ALL_MATERIALS, *MIXED])
def test_homogeneous_stretches(material, stretches):
    moved = tuple(
        {"on": f"{axis}-max", axis: (s - 1) * length}
        for axis, length, s in zip("xyz", SIZE, stretches, strict=True)
        if s is not None
    )
    outputs = (
        {"kind": "reaction", "name": "R", "on": "x-max", "component": "x"},
        {"kind": "reaction", "name": "R-", "on": "x-min", "component": "x"},
        {"kind": "strain-energy", "name": "W"},
        {"kind": "volume-change", "name": "V"},
        {"kind": "mean-displacement", "name": "uz", "on": "z-max", "component": "z"},
        {"kind": "max-von-mises", "name": "S"},
    )
    spec = unloaded_body(material, clamp=(), displacements=ROLLERS + moved, outputs=outputs)
    found = spec.build(MPI.COMM_SELF, ()).solve(np.empty(0)).outputs

    F = np.diag(lateral_stretch(material, stretches) if None in stretches else stretches)
    W, P, stress, J = exact(material, F)
    force = P[0, 0] * SIZE[1] * SIZE[2]
    expected = [force, -force, W * VOLUME, J - 1, (F[2, 2] - 1) * SIZE[2]]
    np.testing.assert_allclose(found[:-1], expected, rtol=1e-10)
    assert found[-1] == pytest.approx(stress, rel=1e-10, abs=1e-7)  # it vanishes where only the volume changes


@pytest.mark.flags
@pytest.mark.parametrize(
    "stretches",
    [
        (0.99, 0.99, 0.99),
        pytest.param((1.1, 1.1, 1.1), marks=pytest.mark.slow),
        (0.9, 0.9, 0.9001),
        (1.2, 0.9, 0.9),
    ],
    ids=str,
)
def test_principal_stretches_that_coincide(stretches):
    """Also where only the volume changes, so that the change of shape consists of rounding errors."""
    test_homogeneous_stretches("ogden", stretches)


class MovedBoundary(Discretisation):
    """A body whose whole boundary follows x → F x: constant per boundary is not enough for shear."""

    deformation = np.eye(3)

    def set_parameters(self, parameters):
        super().set_parameters(parameters)
        places = np.asarray(self.space.tabulate_dof_coordinates())[: self.nodes_owned]
        self._full_targets = (places @ (self.deformation - np.eye(3)).T).ravel()[self.fixed]
        self._moves = True


@pytest.mark.parametrize(
    "deformation",
    [
        pytest.param([[1, 0.4, 0], [0, 1, 0], [0, 0, 1]], id="simple shear", marks=pytest.mark.slow),  # as general
        pytest.param([[1.1, 0.3, -0.1], [0.05, 0.9, 0.2], [-0.15, 0.1, 1.2]], id="general"),
        pytest.param([[0, -1, 0], [1, 0, 0], [0, 0, 1]], id="turn by a right angle"),
    ],
)
@pytest.mark.parametrize("material", [*ALL_MATERIALS, *MIXED])
def test_affine_deformations(material, deformation):
    outputs = tuple(
        {"kind": "reaction", "name": f"{on}{c}", "on": on, "component": c} for on in ("y-max", "z-min") for c in "xyz"
    ) + tuple(output for output in OUTPUTS if output["kind"] in ("strain-energy", "volume-change", "max-von-mises"))
    spec = unloaded_body(
        material,
        body={"cells": (3, 2, 3)},
        clamp=("x-min", "x-max", "y-min", "y-max", "z-min", "z-max"),
        displacements=(),
        outputs=outputs,
    )
    equations = MovedBoundary(spec, MPI.COMM_SELF, ())
    equations.deformation = F = np.array(deformation, dtype=float)
    equations.set_parameters(np.empty(0))
    equations.at_load(1.0)
    u = finish(solving(equations, spec.solver, np.zeros(equations.size)), equations.solve).state
    equations.at_load(1.0)
    equations.set_state(u)
    places = np.asarray(equations.space.tabulate_dof_coordinates())
    np.testing.assert_allclose(equations.displacements(), places @ (F - np.eye(3)).T, rtol=0, atol=1e-10)

    found = [output.functional(equations).value() for output in spec.outputs]
    W, P, stress, J = exact(material, F)
    if material in MIXED:
        pressure = 2 * MATERIALS[material.split()[0]]["D1"] * (J - 1)
        np.testing.assert_allclose(u[len(places.ravel()) :], pressure, rtol=1e-9, atol=1e-6)
    forces = [*(P[:, 1] * SIZE[0] * SIZE[2]), *(-P[:, 2] * SIZE[0] * SIZE[1])]
    np.testing.assert_allclose(found, [*forces, W * VOLUME, J - 1, stress], rtol=1e-10, atol=1e-6)


def test_strain_energy_of_libceed():
    spec = Hyperelastic.model_validate(
        {
            "body": {"size": (1.0, 1.0, 1.0), "cells": (2, 2, 2), "degree": 2, "quadrature_degree": 5},
            "material": {"kind": "neo-hookean-coupled", "mu": 1.0, "lmbda": 4.0},
            "clamp": ("x-min",),
            "loads": ({"kind": "traction", "on": "x-max", "direction": (0.0, 0.0, -1.0), "size": 0.5},),
            "outputs": ({"kind": "strain-energy", "name": "energy"},),
            "solver": {"tolerance": 1e-12},
        }
    )
    solution = spec.build(MPI.COMM_SELF, ()).solve(np.empty(0))
    # libCEED's logarithm is a truncated series: with it, this model gives 0.21246279167, without it 0.21246279127.
    assert solution.outputs[0] == pytest.approx(0.2124627916, abs=5e-10)


@pytest.mark.parametrize("material", FORMS)
def test_reactions_balance_the_loads(material):
    outputs = tuple(
        {"kind": "reaction", "name": f"{on}{c}", "on": on, "component": c} for on in ("x-min", "z-max") for c in "xyz"
    )
    spec = unloaded_body(
        material,
        body={"cells": (3, 2, 2)},
        clamp=("x-min",),
        displacements=({"on": "z-max", "x": 0.1, "z": 0.05},),
        outputs=outputs,
    )
    model = spec.build(MPI.COMM_SELF, ("loads.gravity.density", "loads.traction.size"))
    density, size = 700.0, 900.0
    reactions = model.solve(np.array([density, size])).outputs.reshape(2, 3)
    # They share an edge, whose nodes count for both boundaries: take them once.
    equations = model.equations
    edge = np.intersect1d(*(nodes_of(equations, on) for on in ("x-min", "z-max")))
    shared = equations.imbalance()[: 3 * equations.nodes_owned].reshape(-1, 3)[edge].sum(axis=0)
    weight = density * 9.81 * VOLUME * np.array([0, -1, 0.3]) / np.hypot(1, 0.3)
    traction = size * SIZE[1] * SIZE[2] * np.array([1, 0, 1]) / np.sqrt(2)
    total = reactions.sum(axis=0) - shared
    np.testing.assert_allclose(total, -weight - traction, rtol=1e-9, atol=1e-9 * np.linalg.norm(weight))


def nodes_of(equations, boundary):
    axis, end = "xyz".index(boundary[0]), boundary[2:]
    places = np.asarray(equations.space.tabulate_dof_coordinates())
    return np.flatnonzero(np.isclose(places[:, axis], SIZE[axis] if end == "max" else 0.0))


def test_the_published_beam():
    outputs = (
        {"kind": "max-displacement", "name": "uy", "component": "y"},
        {"kind": "max-displacement", "name": "ux", "component": "x"},
        *({"kind": "reaction", "name": f"R{c}", "on": "x-min", "component": c} for c in "xyz"),
    )
    spec = Hyperelastic.model_validate(
        {
            "body": {"size": (0.28, 0.0215, 0.087), "cells": (12, 2, 4), "degree": 2},
            "material": {"kind": "mooney-rivlin", "C1": 1e4, "C2": 2e5, "D1": 3e5},
            "clamp": ("x-min",),
            "loads": ({"kind": "gravity", "direction": (0.0, -1.0, 0.0), "density": 750.0},),
            "outputs": outputs,
            "solver": {"tolerance": 1e-10},
        }
    )
    model = spec.build(MPI.COMM_SELF, ("loads.gravity.density", "material.D1"))
    solution = model.solve(np.array([750.0, 3e5]))
    # ρ = 600 (1 + ω1/2), D1 = 2e5 (1 + ω2)
    slopes = np.array([solution.tangent(np.array([300.0, 0.0])), solution.tangent(np.array([0.0, 2e5]))])
    np.testing.assert_allclose(np.abs(slopes[:, :2]), [[0.0365, 0.0214], [0.0139, 0.0080]], rtol=5e-3)
    assert np.sign(slopes[:, :2]).tolist() == [[1, 1], [-1, -1]]
    tip = np.flatnonzero(np.isclose(model.space.coordinates[:, 0], 0.28))
    field = model.space.gather(solution.state[None]).reshape(-1, 3)
    assert field[tip, 1].min() == pytest.approx(-0.1227, rel=5e-3)
    assert solution.outputs[0] == pytest.approx(-field[:, 1].min(), abs=1e-15)

    weight = 750 * 9.81 * np.prod(spec.body.size)
    np.testing.assert_allclose(solution.outputs[2:], [0, weight, 0], rtol=1e-9, atol=1e-9 * weight)
    np.testing.assert_allclose(slopes[:, 2:], [[0, weight * 300 / 750, 0], [0, 0, 0]], rtol=1e-9, atol=1e-9 * weight)


@pytest.mark.parametrize(
    ("cell", "degree"), [("tetrahedron", 1), ("tetrahedron", 2), ("hexahedron", 1), ("hexahedron", 2)]
)
def test_nodes_are_counted_and_numbered_by_place(cell, degree):
    spec = unloaded_body("mooney-rivlin", body={"cells": (3, 2, 4), "cell": cell, "degree": degree})
    space = spaces.vector_space(meshes.mesh_body(MPI.COMM_SELF, spec.body)[0], degree)
    layout = Layout(space, MPI.COMM_SELF)
    assert layout.coordinates.size == spec.unknowns == 3 * (3 * degree + 1) * (2 * degree + 1) * (4 * degree + 1)
    axes = [np.linspace(0, length, degree * n + 1) for length, n in zip(SIZE, (3, 2, 4), strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    np.testing.assert_allclose(layout.coordinates, grid, atol=1e-14)
    rows = np.random.default_rng(0).random((2, spec.unknowns))
    np.testing.assert_array_equal(layout.gather(layout.scatter(rows)), rows)
    places = np.asarray(space.tabulate_dof_coordinates())
    np.testing.assert_array_equal(layout.gather(places.reshape(1, -1)).reshape(-1, 3), layout.coordinates)
    cells, _ = layout.cells()
    assert len(cells) == 3 * 2 * 4 * (6 if cell == "tetrahedron" else 1)
    corners = layout.coordinates[cells[:, :4]] if cell == "tetrahedron" else layout.coordinates[cells[:, [0, 1, 3, 4]]]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / (6 if cell == "tetrahedron" else 1)
    assert volumes.sum() == pytest.approx(VOLUME)


def test_places_are_told_apart_on_fine_meshes():
    # Nodes at multiples of 1/1024 fall on the ends of intervals that divide the length by powers of ten.
    spec = unloaded_body("mooney-rivlin", body={"size": (1.0, 0.01, 0.01), "cells": (1024, 1, 1)}, outputs=OUTPUTS[:1])
    layout = Layout(spaces.vector_space(meshes.mesh_body(MPI.COMM_SELF, spec.body)[0], 1), MPI.COMM_SELF)
    columns = layout.coordinates.reshape(-1, 2, 2, 3)
    np.testing.assert_allclose(columns[:, 0, :, 1], 0, atol=1e-15)
    np.testing.assert_allclose(columns[:, :, 1, 2], 0.01)


def test_compiling_a_form_changes_no_other(tmp_path, monkeypatch):
    # Else forms would be compiled again in the next run.
    monkeypatch.setattr(compile, "_CACHE", tmp_path)
    msh = meshes.mesh_body(MPI.COMM_SELF, unloaded_body("mooney-rivlin").body)[0]
    u = spaces.function(spaces.vector_space(msh, 1))
    forms = [k * ufl.inner(u, u) * ufl.dx(domain=msh, metadata={"quadrature_degree": 1}) for k in (2, 2, 3)]
    before = forms[0].signature()
    compiled = len(list(tmp_path.glob("*/*.so")))  # elements
    compile.compile_form(forms[2], MPI.COMM_SELF)
    assert len(list(tmp_path.glob("*/*.so"))) == compiled + 1
    assert forms[1].signature() == before


def test_every_material_has_a_cell():
    assert set(CELLS) == set(ALL_MATERIALS) == set(REGISTERED)
