"""What estimates of the error of the mesh are calibrated by: a finer mesh and its own estimate."""

import math

import meshio
import numpy as np
import pytest
from mpi4py import MPI

from forward.bodies.mesh import FACES
from forward.bodies.mesh_file import MeshFile
from forward.fem.calibration import LEAST, MOST, FinerMesh, limit, limit_alone, saturation
from forward.fem.mesh_error_cost import ALONE, MOST_UNKNOWNS, OF_ALONE, SHARE, allowance, finer, with_cells
from forward.hyperelastic import Hyperelastic
from forward.model import Stability
from tests.bodies import OUTPUTS, loaded_body
from tests.launch import on_kept_ranks
from tests.meshes import CUBE

PLAIN = tuple(output for output in OUTPUTS if output["kind"] in {"displacement", "max-displacement", "strain-energy"})
SOFT = {"kind": "neo-hookean", "C1": 1e4, "D1": 2e4}


@pytest.mark.unit
@pytest.mark.parametrize("times", [1.5, 2.0])
def test_one_singularity_is_extrapolated_exactly(times):
    """ψ_h = ψ + a h^λ and richer elements ψ + b h^λ: b may be larger than a, or of the other sign."""
    order = np.array([1.1, 1.4, 2.0, 3.5, 1.4, 1.4])
    poor, rich = np.array([1.0, 1.0, -1.0, 1.0, 0.3, 0.5]), np.array([0.4, -0.2, 0.5, 0.1, 1.2, -0.5])
    there = times**-order
    found = limit(2.0 + poor, rich - poor, 2.0 + poor * there, (rich - poor) * there, times)
    np.testing.assert_allclose(found.errors, -poor, rtol=1e-12)
    assert (found.doubts < abs(rich) + 0.1 * abs(poor)).all()


@pytest.mark.unit
def test_richer_elements_than_linear_ones_have_orders_beyond_two():
    order, times = np.array([1.2, 1.7, 2.0]), 2.0
    poor, rich = -0.8, 0.1
    there, richer_there = times**-order, times ** -(2 * order - 1)
    found = limit(3 + poor + rich, -poor, 3 + poor * there + rich * richer_there, -poor * there, times, degree=1)
    np.testing.assert_allclose(found.errors, -(poor + rich), rtol=1e-12)


@pytest.mark.unit
@pytest.mark.parametrize("degree", [1, 2])
def test_richer_elements_tell_the_order_where_a_finer_mesh_has_no_estimate(degree):
    """Errors C (h/p²)^a, as beside edges that are held; without an order it is 3/2."""
    order, error = np.array([1.05, 1.4, 2.0, 3.5]), np.array([1.0, -0.2, 3.0, 0.1])
    rich, there = (degree / (degree + 1)) ** (2 * order), ALONE**-order
    found = limit_alone(2.0 - error, error * (1 - rich), 2.0 - error * there, ALONE, degree)
    np.testing.assert_allclose(found.errors, error, rtol=1e-3)
    assert (found.doubts < abs(error)).all()
    odd = limit_alone(1.0, [-0.1, 0.0, np.nan, 0.1], [1.05, 1.05, 1.05, 1.0], ALONE, degree)
    whole = 0.05 / (1 - ALONE**-1.5)
    np.testing.assert_allclose(odd.errors, [whole, whole, np.nan, 0.0])
    assert (odd.doubts[:2] > 0.05 / (1 - ALONE**-1.0) - whole).all()  # that of order 1
    assert odd.doubts[3] == pytest.approx(0.1)


@pytest.mark.unit
def test_what_has_no_order_is_doubted():
    # An estimate that changes its sign, and one that hardly falls: richer values are extrapolated with order 1.
    own, seen, there, seen_there = np.array([1.0, 1.0]), np.array([0.1, 0.1]), np.array([1.05, 1.05]), [-0.06, 0.09]
    found = limit(own, seen, there, seen_there, 2.0)
    richer = np.array([[1.1, 1.1], [0.99, 1.14]])
    np.testing.assert_allclose(found.errors, 2 * richer[1] - richer[0] - own, rtol=1e-12)
    assert (found.doubts > abs(np.array(seen_there))).all()
    regular = limit(own, seen, there, [0.04, 0.04], 2.0)
    assert (regular.doubts < found.doubts / 3).all()
    nothing = limit([1.0, 1.0], [0.0, np.nan], [1.0, 1.0], [0.0, np.nan], 2.0)
    assert nothing.errors[0] == nothing.doubts[0] == 0
    assert np.isnan(nothing.errors[1])


@pytest.mark.unit
def test_what_goes_together_is_multiplied_and_the_rest_added():
    found = limit(np.zeros(5), np.ones(5), [1.2, -0.3, 3.5, 0.7, np.nan], [0.3, 0.3, 0.3, 0.3, np.nan], 2.0)
    seen = np.array([1.0, 1.0, 1.0, 1.0, np.nan])
    made = saturation(seen, found, 1.3)
    np.testing.assert_allclose(made.outputs * seen + made.shifts, found.errors)
    ratios = found.errors / seen
    multiplied = (ratios >= LEAST) & (ratios <= MOST)
    assert multiplied.tolist() == [True, False, False, True, False]
    np.testing.assert_array_equal(made.outputs[~multiplied], [1.0, 1.0, np.nan])
    np.testing.assert_array_equal(made.shifts[multiplied], 0.0)
    assert (made.state, made.energy, made.measured) == (1.3, 1.3, True)


COUPLED = {"kind": "neo-hookean-coupled", "mu": 2e4, "lmbda": 4e4}


def block(cells=(2, 2, 2), degree=1, **blocks):
    """A block that is held by two plates and pressed: singular edges."""
    return Hyperelastic.model_validate(
        {
            "formulation": "displacement",
            "body": {"size": (1.0, 1.0, 0.6), "cells": cells, "degree": degree},
            "material": COUPLED,
            "clamp": ("z-min",),
            "displacements": ({"on": "z-max", "x": 0.0, "y": 0.0, "z": -0.06},),
            "outputs": (
                {"kind": "reaction", "name": "force", "on": "z-max", "component": "z"},
                {"kind": "strain-energy", "name": "energy"},
                {"kind": "max-von-mises", "name": "peak"},
            ),
            "solver": {"tolerance": 1e-10},
        }
        | blocks
    )


def arch(folder, parts):
    """A quarter of a ring of three trilinear hexahedra, each cut in parts³: the same polyhedron."""
    number, corners, facets = {}, [], {0: [], 1: []}
    for i, j, k in np.ndindex(parts, 3 * parts, parts):
        whole = np.array([0, j // parts, 0])
        local = (np.array([i, j % parts, k]) + CUBE) / parts
        ends = (whole + np.array(CUBE)) / (1, 3, 1)
        angles = math.pi / 2 * ends[:, 1]
        radii = 0.7 + 0.3 * ends[:, 0]
        images = np.column_stack([radii * np.cos(angles), radii * np.sin(angles), 0.3 * ends[:, 2]])
        weights = [np.prod(np.where(np.array(CUBE) == 1, x, 1 - x), axis=1) for x in local]
        here = [number.setdefault(tuple(np.round(w @ images, 9) + 0.0), len(number)) for w in weights]
        corners.append(here)
        if j == 0:
            facets[0].append([here[n] for n in FACES["hexahedron"][2]])
        if j == 3 * parts - 1:
            facets[1].append([here[n] for n in FACES["hexahedron"][3]])
    quads = [*facets[0], *facets[1]]
    tags = np.repeat([7, 8], parts**2)
    mesh = meshio.Mesh(
        np.array(list(number)),
        [("hexahedron", np.array(corners)), ("quad", np.array(quads))],
        cell_data={"part": [np.ones(len(corners), dtype=np.int64), tags]},
    )
    path = folder / f"arch-{parts}.vtu"
    meshio.write(path, mesh)
    outputs = (
        {"kind": "displacement", "name": "end", "at": (0.0, 1.0, 0.0), "component": "z"},
        {"kind": "displacement", "name": "middle", "at": (0.5 * 3**0.5, 0.5, 0.3), "component": "x"},
        {"kind": "strain-energy", "name": "energy"},
    )
    load = {"kind": "traction", "on": "8", "direction": (0.0, -1.0, 1.0), "size": 500.0}
    body = {"kind": "mesh", "file": str(path), "degree": 1}
    return block(body=body, clamp=("7",), displacements=(), loads=(load,), outputs=outputs)


def solved(spec):
    return spec.build(MPI.COMM_SELF, ()).solve(np.zeros(0))


@pytest.mark.fem
def test_where_errors_cancel_the_typical_factor_is_doubted_more():
    """Sheared and stretched, errors at both plates have opposite signs in the force, and at the point."""
    moved = {"on": "z-max", "x": 0.2, "y": 0.0, "z": 0.05}
    outputs = (
        {"kind": "reaction", "name": "force", "on": "z-max", "component": "z"},
        {"kind": "displacement", "name": "point", "at": (1.0, 0.5, 0.3), "component": "x"},
        {"kind": "strain-energy", "name": "energy"},
        {"kind": "max-von-mises", "name": "peak"},
    )
    solution = solved(block((3, 2, 2), outputs=outputs, displacements=(moved,)))
    true = solved(block((6, 6, 6), 2, outputs=outputs, displacements=(moved,))).outputs - solution.outputs
    found = solution.saturation(-1e9)
    assert not found.measured
    error = solution.mesh_error().calibrated(found).outputs
    off, usual = np.abs(error - true)[:3], 0.5 * np.abs(error)[:3]
    assert (off > usual).tolist() == [True, True, False]
    assert (off <= found.doubts[:3]).all()
    assert found.doubts[2] == pytest.approx(usual[2], rel=0.1)
    assert np.isnan(found.doubts[3])


@pytest.mark.fem
@pytest.mark.slow
def test_errors_on_a_curved_body_are_those_of_its_polyhedron(tmp_path):
    """Against the elements of one degree more on a mesh that is cut in four."""
    solution = solved(arch(tmp_path, 1))
    exact = solved(arch(tmp_path, 4).enriched()).outputs
    true = exact - solution.outputs
    found = solution.saturation()
    assert found.measured
    calibrated = solution.mesh_error().calibrated(found).outputs
    ratios = calibrated / true
    assert ((ratios > 0.8) & (ratios < 1.25)).all(), ratios
    assert (np.abs(calibrated - true) <= found.doubts).all(), (calibrated - true, found.doubts)


@pytest.mark.fem
def test_the_error_at_singular_edges_is_calibrated():
    solution = solved(block())
    ends = {f"{axis}-{end}": 6 for axis in "xyz" for end in ("min", "max")}
    fine = solved(block(body={"size": (1.0, 1.0, 0.6), "cells": (8, 8, 6), "grading": ends, "degree": 1}).enriched())
    found = solution.saturation()
    calibrated = solution.mesh_error().calibrated(found).outputs[:2]
    true = (fine.outputs - solution.outputs)[:2]
    assert ((calibrated / true > 0.85) & (calibrated / true < 1.15)).all(), calibrated / true
    assert (np.abs(calibrated - true) <= found.doubts[:2]).all()
    assert np.isnan(found.outputs[2])
    assert np.isnan(found.doubts[2])


@pytest.mark.fem
def test_errors_of_a_mixed_form_are_calibrated():
    spec = loaded_body("neo-hookean mixed", outputs=PLAIN)
    solution = solved(spec)
    finest = spec.model_copy(update={"body": spec.body.refined(1).refined(1)})
    fine = solved(finest)
    found = solution.saturation()
    true = fine.outputs + fine.mesh_error().outputs - solution.outputs
    calibrated = solution.mesh_error().calibrated(found).outputs
    known = np.isfinite(true)
    assert (np.abs(calibrated - true) <= found.doubts)[known].all(), (calibrated, true, found.doubts)
    assert (np.abs(calibrated - true) < 0.3 * np.abs(true))[known].all(), calibrated / true


@pytest.mark.unit
def test_the_finer_mesh_is_as_fine_as_is_affordable(tmp_path):
    found, times, *_, estimated = finer(block(degree=2))
    assert (found.body.cells, times, estimated) == ((4, 4, 4), 2.0, True)
    found, times, *_ = finer(block(cells=(7, 7, 5), degree=2))
    assert (found.body.cells, times) == ((11, 11, 8), 1.5)
    assert found.unknowns <= MOST_UNKNOWNS
    assert finer(block(cells=(16, 16, 16), degree=2)) is None
    assert finer(block(degree=2, formulation="mixed", material=SOFT)).spec.mixed
    meshio.write(tmp_path / "cube.vtu", meshio.Mesh(np.array(CUBE, dtype=float), [("hexahedron", [list(range(8))]),
        ("quad", [[0, 1, 2, 3]])]))  # fmt: skip
    body = MeshFile(file=str(tmp_path / "cube.vtu"))
    divided = block().model_copy(update={"body": body.finer(2.0, (), 1.0, 1.0)})
    assert finer(divided) is None  # it is divided already
    assert finer(block().model_copy(update={"body": body})).spec.body.cell_count == 8


@pytest.mark.fem
def test_a_finer_mesh_does_not_know_the_coefficients_of_fields():
    """Modes of a field are others on every mesh."""
    spec = block(cells=(2, 1, 1), fields=({"of": "stiffness", "length": 0.5, "std": 0.3, "modes": 2},))
    model = spec.build(MPI.COMM_SELF, ("material.mu", "fields.stiffness.0"))
    fine = FinerMesh(model)
    assert fine.calibrated(model.solve(np.array([2e4, 1.0]))) is None
    found = fine.calibrated(model.solve(np.array([1.5e4, 0.0])))
    plain = block(cells=(2, 1, 1)).build(MPI.COMM_SELF, ("material.mu",)).solve(np.array([1.5e4])).saturation()
    np.testing.assert_allclose(found.outputs[:2], plain.outputs[:2], rtol=0.1)  # but for its log-normal mean


SCRIPT = """
import sys
import numpy as np
from tests.bodies import loaded_body
from tests.forward.fem.test_calibration import PLAIN, block
from tests.ranks import groups

for comm in groups(1, 2):
    for form in ("displacement", "mixed"):
        spec = block() if form == "displacement" else loaded_body("neo-hookean mixed", outputs=PLAIN)
        found = spec.build(comm, ()).solve(np.zeros(0)).saturation()
        parts = np.array([*found.outputs, *found.shifts, *found.doubts, found.state])
        assert all(np.array_equal(parts, other, equal_nan=True) for other in comm.allgather(parts))
        if comm.rank == 0:
            np.save(f"{sys.argv[1]}/{form} {comm.size}.npy", parts)
"""


@pytest.mark.mpi
@pytest.mark.slow
def test_ranks_agree(tmp_path):
    done = on_kept_ranks(2, SCRIPT, tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    for form in ("displacement", "mixed"):
        one, other = (np.load(tmp_path / f"{form} {ranks}.npy") for ranks in (1, 2))
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-9)


@pytest.mark.unit
def test_layers_of_plane_strain_are_not_cut():
    plane = {"displacements": ({"on": "z-min", "z": 0.0}, {"on": "z-max", "z": 0.0}), "clamp": ("x-min",)}
    assert block((4, 4, 1), **plane).plane == ("z",)
    assert block((4, 4, 1), **plane).finer(2.0).body.cells == (8, 8, 1)
    assert finer(block((4, 4, 1), **plane)).spec.body.cells == (8, 8, 1)
    assert block((4, 4, 2), **plane).plane == ()  # someone wants to see what happens there
    assert block((4, 4, 1)).plane == ()  # between plates that hold it, it bulges
    ball = {"kind": "sphere", "x": 0.5, "y": 0.5, "z": 0.3, "radius": 0.2, "width": 0.1, "contrast": 3.0}
    assert block((4, 4, 1), **plane, inclusions=(ball,)).plane == ()


@pytest.mark.unit
def test_a_single_layer_is_halved_or_there_is_no_finer_mesh():
    """Two layers in its place, beside edges divided by 1.5, show an order that is of neither."""
    thin, thick = block(cells=(10, 5, 1), degree=2), block(cells=(10, 5, 2), degree=2)
    assert finer(thin).spec.body.cells == (20, 10, 2)
    assert with_cells(thin, 1.5) is None
    assert with_cells(thick, 1.5).cells == (15, 8, 3)


@pytest.mark.unit
def test_short_studies_have_coarser_finer_meshes_or_none():
    spec = block((5, 5, 5), degree=2)
    found = [finer(spec, spare) for spare in (math.inf, 1000.0, 20.0, -2.0)]
    seconds = [0.0 if one is None else one.seconds for one in found]
    assert seconds == sorted(seconds, reverse=True)
    assert found[0].times == 2.0
    assert found[-1] is None or found[-1].times < 2.0
    for one, spare in zip(found, (math.inf, 1000.0, 20.0, -2.0), strict=True):
        assert one is None or one.seconds <= allowance(spec, spare, SHARE if one.estimated else OF_ALONE)
    assert spec.mesh_error_cost(-2.0).calibration < spec.mesh_error_cost().calibration
    assert allowance(spec, 100.0) - allowance(spec, 0.0) == pytest.approx(100 * spec.cost().sample)


@pytest.mark.fem
def test_a_mesh_without_an_estimate_of_its_own_calibrates_nearly_as_well(monkeypatch):
    """Where a study is short and richer elements are dear: those of the mixed form."""
    energy = {"kind": "strain-energy", "name": "energy"}
    spec = block((2, 2, 2), 2, formulation="mixed", material=SOFT, outputs=(energy,))
    solution = spec.build(MPI.COMM_SELF, ()).solve(np.zeros(0))
    best = solution.saturation()
    monkeypatch.setattr("forward.fem.mesh_error_cost.TIMES", ())
    alone = solution.saturation()
    assert not finer(spec).estimated
    assert alone.measured
    assert alone.doubts > best.doubts
    better, error = (solution.mesh_error().calibrated(one).outputs for one in (best, alone))
    assert abs(error - better) <= alone.doubts
    assert 0.6 < error / better < 1.6


@pytest.mark.fem
def test_a_finer_mesh_is_solved_on_with_one_factor():
    """The same as with Newton's method and a test of stability."""
    solution = block((3, 3, 2), degree=2).build(MPI.COMM_SELF, ()).solve(np.zeros(0))
    mesh = FinerMesh(solution._model)
    quick = mesh.calibrated(solution)
    assert mesh._untested.equations.work.factorisations == 0  # but that of the reference
    careful = FinerMesh(solution._model)
    careful.__dict__["_untested"] = mesh._tested
    slow = careful.calibrated(solution)
    np.testing.assert_allclose(quick.outputs[:2], slow.outputs[:2], rtol=2e-3)
    np.testing.assert_allclose(quick.doubts[:2], slow.doubts[:2], rtol=2e-2)


@pytest.mark.unit
def test_smaller_steps_are_doubted_more():
    order, poor, rich = 1.4, np.array([1.0]), np.array([0.4])
    left = [
        limit(2 + poor, rich - poor, 2 + poor * t**-order, (rich - poor) * t**-order, t).doubts[0]
        for t in (2.0, 1.5, 1.25)
    ]
    assert left == sorted(left)
    assert left[2] > 1.2 * left[0] - 0.1 * 0.2


@pytest.mark.fem
@pytest.mark.parametrize(("size", "unstable"), [(100.0, False), (250.0, True)])
def test_a_column_that_does_not_buckle_for_its_cells_alone(size, unstable):
    """Linear cells are too stiff in bending: these buckle at twice the load at which cells half as long do."""
    spec = Hyperelastic.model_validate(
        {
            "formulation": "displacement",
            "body": {"kind": "box", "size": [1, 0.1, 0.1], "cells": [4, 1, 1], "cell": "hexahedron", "degree": 1},
            "material": SOFT,
            "clamp": ["x-min"],
            "loads": [{"kind": "traction", "on": "x-max", "direction": [-1, 0, 0], "size": size}],
            "outputs": PLAIN[:1],
        }
    )
    solution = spec.build(MPI.COMM_SELF, ()).solve(np.zeros(0))
    assert solution.stability == Stability.COUNTED
    assert solution.saturation(math.inf).unstable == unstable
