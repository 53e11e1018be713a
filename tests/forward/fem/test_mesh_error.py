"""What the mesh adds to outputs and states, as elements of one degree more see it."""

from dataclasses import replace
from functools import cache

import meshio
import numpy as np
import pytest
from mpi4py import MPI

from forward.combine import selected
from forward.external.models import PythonModel
from forward.fem.enriched import RULES
from forward.fem.mesh_error_cost import Way, own_estimate
from forward.hyperelastic import Hyperelastic
from forward.model import Guess, ReferenceSolution
from forward.pointwise import FunctionModel
from forward.specimen import Specimen
from tests.bodies import MATERIALS, MIXED, MORE_MATERIALS, OUTPUTS, loaded_body
from tests.launch import ROOT, UP_TO_RANKS, on_kept_ranks
from tests.meshes import box
from workflows.config.study import load as loaded

pytestmark = pytest.mark.fem
LENGTH, HEAVY = 2.0, 9.81e-3  # m, Pa/m
PLAIN = tuple(output for output in OUTPUTS if output["kind"] in {"displacement", "max-displacement", "max-von-mises"})


def solved(spec, parameters=(), comm=MPI.COMM_SELF):
    scalars = spec.scalars
    return spec.build(comm, tuple(parameters)).solve(np.array([scalars[path].value for path in parameters]))


def column(degree, cell="hexahedron", kind="saint-venant-kirchhoff"):
    """A column that stands in a rigid pipe, under its own small weight: −ρg (L z − z²/2)/(λ + 2μ)."""
    constants = {"lmbda": 1e5, "mu": 4e4}
    sides = [{"on": f"{axis}-{end}", axis: 0.0} for axis in "xy" for end in ("min", "max")]
    middle = {"kind": "displacement", "component": "z"}
    return Hyperelastic.model_validate(
        {
            "formulation": "displacement",
            "body": {"size": (1.0, 1.0, LENGTH), "cells": (1, 1, 2), "cell": cell, "degree": degree},
            "material": {"kind": kind, **constants},
            "displacements": (*sides, {"on": "z-min", "z": 0.0}),
            "loads": ({"kind": "gravity", "density": 1e-3},),
            "outputs": (
                *({**middle, "name": f"{z}", "at": (0.5, 0.5, z)} for z in (0.37, 0.5, 1.5)),
                {"kind": "strain-energy", "name": "energy"},
            ),
            "solver": {"tolerance": 1e-12},
        }
    )


@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron"])
def test_what_lies_in_the_enriched_space_is_found_exactly(cell):
    solution = solved(column(1, cell))
    error = solution.mesh_error()
    modulus, z = 1.8e5, np.array([0.37, 0.5, 1.5])
    exact = [*(-HEAVY / modulus * (LENGTH * z - z**2 / 2)), HEAVY**2 * LENGTH**3 / 6 / modulus]
    assert (np.abs(solution.outputs / exact - 1) > 0.01).all()
    np.testing.assert_allclose(solution.outputs + error.outputs, exact, rtol=1e-6)
    stored = HEAVY**2 * LENGTH**3 / 6 / modulus
    # Of a linear problem the error's energy is what the energy lacks.
    assert error.energy == pytest.approx(stored - solution.outputs[3], rel=1e-6)
    assert error.relative == pytest.approx(np.sqrt(error.energy / solution.outputs[3]), rel=1e-6)
    nodes = solution._model.space.coordinates[:, 2]
    (corrected,) = solution._model.space.gather((solution.state + error.state)[None])
    np.testing.assert_allclose(corrected[2::3], -HEAVY / modulus * (LENGTH * nodes - nodes**2 / 2), atol=1e-13)


def test_nothing_is_left_where_the_space_of_the_body_holds_the_solution():
    error = solved(column(2)).mesh_error()
    assert np.abs(error.outputs[:3]).max() < 1e-9 * HEAVY / 1e5
    assert error.relative < 1e-6


def bent(cells=(4, 1, 1), cell="hexahedron", degree=1, **blocks):
    """A thick cantilever that bends."""
    return Hyperelastic.model_validate(
        {
            "formulation": "displacement",
            "body": {"size": (2.0, 1.0, 1.0), "cells": cells, "cell": cell, "degree": degree},
            "material": {"kind": "neo-hookean-coupled", "mu": 2e4, "lmbda": 4e4},
            "clamp": ("x-min",),
            "loads": ({"kind": "traction", "on": "x-max", "direction": (0, 0, -1), "size": 400.0},),
            "outputs": (
                {"kind": "mean-displacement", "name": "tip", "on": "x-max", "component": "z"},
                {"kind": "displacement", "name": "middle", "at": (1.0, 0.5, 0.5), "component": "z"},
                {"kind": "strain-energy", "name": "energy"},
                {"kind": "max-von-mises", "name": "peak"},
            ),
            "solver": {"tolerance": 1e-10},
        }
        | blocks
    )


@cache
def finely_bent():
    return solved(bent(cells=(12, 6, 6), degree=2)).outputs


@pytest.mark.few(1)
@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron"])
def test_the_error_of_a_coarse_mesh_is_told(cell):
    solution = solved(bent(cells=(4, 2, 2), cell=cell))
    fine = finely_bent()
    error = solution.mesh_error()
    effectivity = error.outputs[:3] / (fine - solution.outputs)[:3]
    assert ((effectivity > 0.85) & (effectivity < 1.1)).all(), effectivity
    assert np.isnan(error.outputs[3])
    assert error.work.factorisations == (1 if cell == "hexahedron" else 2)  # which bend by 13 %: a second step


def test_a_mesh_too_coarse_for_newton_steps_is_told():
    """Linear tetrahedra that lock: a few Newton steps in richer elements do not get where these would be."""
    small, large = (
        solved(
            bent(
                cells=(4, 1, 1),
                cell="tetrahedron",
                material={"kind": "neo-hookean-coupled", "mu": 2e4, "lmbda": lmbda},
                loads=({"kind": "traction", "on": "x-max", "direction": (0, 0, -1), "size": size},),
            )
        ).mesh_error()
        for lmbda, size in ((4e4, 4.0), (4e7, 1000.0))
    )
    assert small.nonlinearity < 0.1
    assert not large.nonlinearity < 1


def test_a_slender_body_that_locks_is_carried_as_far_as_richer_elements_bend():
    """Linear hexahedra that sag half as far: the first step lengthens what it turns, and leaves more than there was."""
    beam = loaded(ROOT / "configs" / "beam.toml", ["model.body.degree=1", "model.body.cells=[8, 1, 2]"]).model
    solution = solved(beam)
    error = solution.mesh_error()
    richer = solved(beam.model_copy(update={"body": beam.body.enriched()})).outputs
    assert (richer > 1.9 * solution.outputs).all()
    np.testing.assert_allclose(solution.outputs + error.outputs, richer, rtol=0.03)
    assert error.nonlinearity < 0.05


QUICK = ("mooney-rivlin", "demiray", "holzapfel-gasser-ogden", *MIXED)
SLOW = [pytest.param(form, marks=pytest.mark.slow) for form in (*MATERIALS, *MORE_MATERIALS) if form not in QUICK]


@pytest.mark.parametrize("form", [*QUICK, *SLOW])
def test_every_material_and_load_and_form_is_orthogonal(form, monkeypatch):
    plain = loaded_body(form)
    quadrature = plain.body.enriched().quadrature  # that of the forces must be the same for this
    solution = solved(loaded_body(form, body={"quadrature_degree": quadrature}, outputs=PLAIN))
    model, enriched = solution._model, solution._model.enriched
    np.testing.assert_allclose(enriched.down(enriched.up(solution.state)), solution.state, atol=1e-14, rtol=1e-12)
    forces = enriched.imbalance(solution)
    coarse = enriched.restrict(forces)
    coarse[model.equations.fixed] = 0
    assert np.linalg.norm(coarse) < 1e-8 * np.linalg.norm(forces)
    error = solution.mesh_error()
    assert np.isfinite(error.outputs[:3]).all()
    assert np.isnan(error.outputs[3:]).all()
    assert error.energy > 0
    weights = np.array([[0.0, 0.0, 1.0, 0.0]])
    (adjoint,) = enriched.adjoints(solution, weights)
    for rule in RULES:  # without further steps
        monkeypatch.setitem(RULES, rule, replace(RULES[rule], bent=np.inf))
    linear = (enriched.values(solution, enriched.state(solution)) - solution.outputs)[2]
    assert -adjoint @ forces == pytest.approx(linear, rel=1e-7)  # the dual-weighted residual
    cells = solution.mesh_indicators(weights[0])
    assert cells.shape == (model.spec.body.cell_count,)
    assert abs(linear) <= cells.sum() * (1 + 1e-7)


def test_the_error_that_is_left_is_calibrated():
    solution = solved(bent(cells=(4, 2, 2), cell="tetrahedron"))
    ends = {"x-min": 8, "y-min": 4, "y-max": 4, "z-min": 4, "z-max": 4}
    body = {"size": (2.0, 1.0, 1.0), "cells": (10, 5, 5), "degree": 2, "grading": ends}
    fine = solved(bent(body=body)).outputs
    error, saturation = solution.mesh_error(), solution.saturation()
    calibrated = error.calibrated(saturation)
    np.testing.assert_array_equal(calibrated.seen, error.outputs)
    assert np.isnan(calibrated.outputs[3])
    assert 1 < saturation.state < 1.3
    before, after = (np.abs(e.outputs / (fine - solution.outputs) - 1)[:3] for e in (error, calibrated))
    assert (after < 0.05).all(), (before, after)
    assert (after < before / 2).all(), (before, after)
    assert (np.abs(calibrated.outputs - fine + solution.outputs) <= saturation.doubts)[:3].all()
    assert calibrated.relative == pytest.approx(error.relative * np.sqrt(saturation.energy))
    assert solved(bent()).saturation().outputs[0] == pytest.approx(solved(bent()).saturation().outputs[0], rel=1e-12)


def test_a_reaction_is_in_balance_with_the_loads():
    """Whatever the mesh, however far richer elements bend."""
    reaction = {"kind": "reaction", "name": "held", "on": "x-min", "component": "z"}
    solution = solved(bent(outputs=(reaction,)))
    assert solution.outputs[0] == pytest.approx(400.0, rel=1e-8)
    assert abs(solution.mesh_error().outputs[0]) < 1e-7 * 400


def test_a_weight_on_what_is_not_estimated_is_refused():
    solution = solved(bent())
    with pytest.raises(ValueError, match="is not estimated"):
        solution.mesh_indicators(np.array([0.0, 0.0, 0.0, 1.0]))


def test_regions_inclusions_and_random_fields_are_those_of_the_body(tmp_path):
    path = tmp_path / "box.msh"
    meshio.write(path, box("tetra"), file_format="gmsh22", binary=True)
    fields = [
        {"of": "stiffness", "length": 0.5, "std": 0.3, "modes": 3},
        {"of": "density", "length": 0.5, "std": 0.3, "modes": 2},
    ]
    inclusion = {"kind": "sphere", "x": 0.5, "y": 0.4, "z": 0.4, "radius": 0.3, "width": 0.3, "contrast": 5.0}
    changes = {"regions": {"right": {"C1": 3e4}}, "inclusions": (inclusion,), "fields": fields, "outputs": PLAIN}
    boxed = loaded_body("mooney-rivlin", outputs=PLAIN).model_dump(exclude_none=True)
    spec = Hyperelastic.model_validate(
        boxed | {"body": {"kind": "mesh", "file": str(path), "degree": 1, "quadrature_degree": 3}} | changes
    )
    paths = ("fields.stiffness.0", "fields.stiffness.1")
    model = spec.build(MPI.COMM_SELF, paths)
    assert spec.enriched().body.nodes == len(model.enriched.equations.layout.coordinates)
    found = []
    for point in ([0.0, 0.0], [1.5, -1.0], [0.0, 0.0]):
        solution = model.solve(np.array(point))
        forces = model.enriched.imbalance(solution)
        coarse = model.enriched.restrict(forces)
        coarse[model.equations.fixed] = 0
        assert np.linalg.norm(coarse) < 1e-8 * np.linalg.norm(forces)
        found.append(solution.mesh_error().outputs[:3])
        np.testing.assert_array_equal(solution.outputs, model.solve(np.array(point)).outputs)
    np.testing.assert_allclose(found[0], found[2], rtol=1e-9)  # whatever was estimated before
    assert np.abs(found[1] / found[0] - 1).max() > 0.01


@pytest.mark.slow
def test_data_of_a_specimen_have_errors():
    spec = Specimen.model_validate(
        {
            "body": {"size": (1.0, 1.0, 1.0), "cells": (3, 3, 3), "degree": 1},
            "material": {"kind": "neo-hookean-coupled", "mu": 2e4, "lmbda": 4e4},
            "cases": [
                {
                    "name": name,
                    "clamp": ["z-min"],
                    "loads": [{"kind": "traction", "on": "z-max", "direction": along, "size": 2000.0}],
                }
                for name, along in (("shear", (1, 0, 0)), ("pull", (0, 0, 1)))
            ],
            "observed": [{"at": [(1.0, 1.0, 1.0), (0.41, 0.0, 0.77)]}],
        }
    )
    model = spec.build(MPI.COMM_SELF, ())
    solution = model.solve(np.zeros(0))
    finest = spec.model_copy(update={"body": spec.body.model_copy(update={"cells": (8, 8, 8), "degree": 2})})
    exact = solved(finest).outputs
    error = solution.mesh_error()
    assert error.outputs.shape == (12,)
    large = np.abs(exact - solution.outputs) > 0.1 * np.abs(exact - solution.outputs).max()
    effectivity = (error.outputs / (exact - solution.outputs))[large]
    assert ((effectivity > 0.8) & (effectivity < 1.2)).all(), effectivity
    assert error.state.shape == solution.state.shape
    seen = selected(model, (3, 3, 0)).solve(np.zeros(0)).mesh_error()
    np.testing.assert_array_equal(seen.outputs, error.outputs[[3, 3, 0]])
    saturation = solution.saturation()
    assert ((saturation.outputs >= 0.5) & (saturation.outputs <= 3)).all()
    effectivity = (error.calibrated(saturation).outputs / (exact - solution.outputs))[large]
    assert ((effectivity > 0.85) & (effectivity < 1.25)).all(), effectivity
    other = model.observing(np.array([[1.0, 1.0, 1.0]]), (2,), (1,)).solve(np.zeros(0)).mesh_error()
    assert other.outputs == pytest.approx(error.outputs[8:9], rel=1e-9)


def test_models_without_a_mesh_have_none():
    model = FunctionModel(np.sum, ("a", "b"), ("sum",))
    assert model.solve(np.ones(2)).mesh_error() is None
    assert model.solve(np.ones(2)).saturation() is None
    assert bent().enriched().body.degree == 2

    plain = PythonModel.model_validate({"function": "math.hypot", "parameters": {"x": 1.0}, "outputs": ["y"]})
    assert plain.mesh_error_cost() is None


def near(spec, path, change, way):
    """A solution that was found with the factor of a reference, and its enriched equations solved in another way."""
    value = spec.scalars[path].value
    model = spec.build(MPI.COMM_SELF, (path,))
    model.enriched.way = way
    centre = model.solve(np.array([value]))
    reference = ReferenceSolution(centre.parameters, centre.state)
    state = centre.state + centre.state_tangent(np.array([(change - 1) * value]))
    return model.solve(np.array([change * value]), Guess(state, reference))


@pytest.mark.parametrize(("cell", "load"), [("hexahedron", "traction"), ("tetrahedron", "pressure")])
def test_steps_without_a_factor_come_close(cell, load):
    direction = {"direction": (0, 0, -1)} if load == "traction" else {}
    loads = ({"kind": load, "on": "x-max" if direction else "z-max", "size": 400.0, **direction},)
    spec = bent(cells=(4, 2, 2), cell=cell, degree=2, loads=loads)
    (path,) = (path for path in spec.scalars if path.startswith("loads."))
    exact, rough = (near(spec, path, 1.5, way) for way in (Way.FACTOR, Way.SMOOTHING))
    expected, found = exact.mesh_error(), rough.mesh_error()
    assert found.work.factorisations == 0
    assert found.work.residuals < 40
    np.testing.assert_allclose(found.outputs[:2], expected.outputs[:2], rtol=0.08)
    assert found.energy == pytest.approx(expected.energy, rel=0.08)
    weights = np.array([1.0, 0.0, 0.0, 0.0])
    cells = [solution.mesh_indicators(weights) for solution in (exact, rough)]
    assert np.corrcoef(cells)[0, 1] > 0.98


@pytest.mark.parametrize(("cell", "load"), [("hexahedron", "traction"), ("tetrahedron", "pressure")])
def test_the_blocks_of_nodes_are_nearly_those_of_the_stiffness(cell, load):
    direction = {"direction": (0, 0, -1)} if load == "traction" else {}
    loads = ({"kind": load, "on": "x-max" if direction else "z-max", "size": 400.0, **direction},)
    model = bent(cells=(4, 2, 2), cell=cell, degree=2, loads=loads).build(MPI.COMM_SELF, ())
    solution = model.solve(np.zeros(0))
    equations = model.enriched.visit(solution)
    stiffness = equations.sparse_stiffness().toarray()
    blocks = equations.nodal_blocks()
    np.testing.assert_allclose(np.einsum("nii->ni", blocks).ravel(), stiffness.diagonal(), rtol=0.1)
    rows = np.arange(len(stiffness)).reshape(-1, 3)[::7]
    exact = np.array([stiffness[np.ix_(row, row)] for row in rows])
    sizes = np.abs(exact).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(blocks[::7] / sizes, exact / sizes, atol=0.1)


@pytest.mark.parametrize("D1", [2e5, 5e7])
def test_steps_without_a_factor_come_close_with_pressures(D1):
    spec = bent(
        cells=(4, 2, 2), cell="tetrahedron", degree=2, loads=({"kind": "pressure", "on": "z-max", "size": 400.0},),
        material={"kind": "neo-hookean", "C1": 1e4, "D1": D1}, formulation="mixed",
    )  # fmt: skip
    exact, rough = (near(spec, "loads.pressure.size", 1.5, way) for way in (Way.FACTOR, Way.SMOOTHING))
    expected, found = exact.mesh_error(), rough.mesh_error()
    assert found.work.factorisations == 0
    assert found.work.residuals < 100
    np.testing.assert_allclose(found.outputs[:2], expected.outputs[:2], rtol=0.06)
    weights = np.array([1.0, 0.0, 0.0, 0.0])
    cells = [solution.mesh_indicators(weights) for solution in (exact, rough)]
    assert np.corrcoef(cells)[0, 1] > 0.98


@pytest.mark.parametrize(("form", "precision"), [("neo-hookean mixed", "single"), ("mooney-rivlin", "double")])
def test_the_factor_of_a_reference_serves_others(form, precision):
    spec = loaded_body(form, outputs=PLAIN, solver={"precision": precision})
    exact, found = (
        near(spec, next(path for path in spec.scalars if path.startswith("loads.")), 1.3, way).mesh_error()
        for way in (Way.FACTOR, Way.REFERENCE)
    )
    assert found.work.factorisations == 0
    np.testing.assert_allclose(found.outputs[:3], exact.outputs[:3], rtol=0.01)


def test_how_is_decided_by_sizes():
    small, large = bent(), bent(cells=(40, 20, 20), degree=2)
    assert small.mesh_error_cost().way == Way.FACTOR
    assert large.mesh_error_cost().way == Way.SMOOTHING
    assert large.mesh_error_cost().seconds < large.enriched().cost().textbook / 10
    assert large.model_copy(update={"formulation": "mixed"}).mesh_error_cost().way == Way.REFERENCE
    tetrahedra = bent(cells=(20, 10, 10), cell="tetrahedron", degree=2).model_copy(update={"formulation": "mixed"})
    assert tetrahedra.mesh_error_cost().way == Way.SMOOTHING
    assert bent(cells=(12, 6, 6)).mesh_error_cost().way == Way.REFERENCE


SCRIPT = """
import sys
import numpy as np
from forward.fem.mesh_error_cost import Way
from tests.bodies import OUTPUTS, loaded_body
from tests.ranks import groups

for comm in groups():
    for form in ("neo-hookean mixed", "mooney-rivlin", "demiray"):
        spec = loaded_body(form, body={"cells": (3, 2, 2)}, outputs=OUTPUTS[:4])
        model = spec.build(comm, ())
        if form != "mooney-rivlin":
            model.enriched.way = Way.SMOOTHING
        solution = model.solve(np.zeros(0))
        error = solution.mesh_error()
        assert all(np.array_equal(error.outputs, other) for other in comm.allgather(error.outputs))
        state = model.space.gather(error.state[None])
        cells = model.equations.layout.by_cell(solution.mesh_indicators(np.array([0.0, 0.0, 1.0, 0.0])))
        if comm.rank == 0:
            found = {"outputs": error.outputs, "sizes": [error.energy, error.relative], "state": state, "cells": cells}
            np.savez(f"{sys.argv[1]}/{form} {comm.size}.npz", **found)
"""


SHAPES = ("neo-hookean mixed", "mooney-rivlin", "demiray")


@pytest.mark.slow
@pytest.mark.mpi
@UP_TO_RANKS
def test_ranks_agree(tmp_path, ranks):
    done = on_kept_ranks(ranks, SCRIPT, tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    found = [[dict(np.load(tmp_path / f"{form} {n}.npz")) for form in SHAPES] for n in range(1, ranks + 1)]
    for other in found[1:]:
        for here, expected in zip(other, found[0], strict=True):
            for name, values in expected.items():
                np.testing.assert_allclose(here[name], values, rtol=0, atol=1e-8 * np.abs(values).max(), err_msg=name)


def test_elements_of_two_degrees_more_say_too_little_by_steps_with_pressures(monkeypatch):
    """What is left by steps is a large part of what they say more than elements of one degree more."""
    ways = []

    def by_steps(*specs):
        ways.append(Way.SMOOTHING)
        return replace(own_estimate(*specs), way=Way.SMOOTHING)

    monkeypatch.setattr("forward.fem.body.own_estimate", by_steps)
    model = loaded_body("neo-hookean mixed").build(MPI.COMM_SELF, ())
    assert model.enriched_twice is None
    assert ways
