"""The mixed form: a nearly incompressible body neither locks nor costs more, whatever its bulk modulus."""

import numpy as np
import pytest
from mpi4py import MPI

from forward.conformance import check_derivatives
from forward.hyperelastic import Hyperelastic
from tests.bodies import MIXED, unloaded_body
from tests.launch import UP_TO_RANKS, on_kept_ranks
from tests.steps import STEPS
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Request
from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods.monte_carlo import SensitivityMonteCarlo
from uq.surrogates.linearisation import linearise

pytestmark = pytest.mark.fem
SHEAR = 2e4  # Pa
RATIOS = (1, 1e2, 1e4, 1e6, 1e8)  # κ/μ
LOAD = 60.0  # Pa; the tip sinks by a tenth of the length
BULK, TRACTION = "material.D1", "loads.traction.size"


def cantilever(cell, cells, formulation="mixed", parameters=(BULK, TRACTION)):
    """A slender block that is bent by a traction at its end."""
    spec = Hyperelastic.model_validate(
        {
            "formulation": formulation,
            "body": {"size": (0.1, 0.02, 0.02), "cells": cells, "cell": cell},
            "material": {"kind": "neo-hookean", "C1": SHEAR / 2, "D1": SHEAR / 2},
            "clamp": ("x-min",),
            "loads": ({"kind": "traction", "on": "x-max", "direction": (0.0, -1.0, 0.0), "size": LOAD},),
            "outputs": (
                {"kind": "mean-displacement", "name": "tip", "on": "x-max", "component": "y"},
                {"kind": "reaction", "name": "reaction", "on": "x-min", "component": "y"},
                {"kind": "strain-energy", "name": "energy"},
                {"kind": "volume-change", "name": "volume"},
            ),
        }
    )
    return spec.build(MPI.COMM_SELF, parameters)


def bent(model, ratio):
    return model.solve(np.array([ratio * SHEAR / 2, LOAD]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cell", "coarse", "fine"),
    [("tetrahedron", (10, 2, 2), (15, 3, 3)), ("hexahedron", (5, 1, 1), (10, 2, 2))],
)
def test_a_bent_block_does_not_lock(cell, coarse, fine):
    model, finer = cantilever(cell, coarse), cantilever(cell, fine)
    tips, volumes = [], []
    for ratio in RATIOS:
        solution = bent(model, ratio)
        assert solution.work.load_steps == 0
        assert solution.work.factorisations <= 6
        assert solution.outputs[1] == pytest.approx(LOAD * 0.02**2, rel=1e-8)
        solution.linearise()
        assert model.equations.inertia() == 0
        tips.append(solution.outputs[0])
        volumes.append(solution.outputs[3])
    for i in (0, 4):
        assert tips[i] == pytest.approx(bent(finer, RATIOS[i]).outputs[0], rel=0.01)
    # The limit of a body that keeps its volume.
    np.testing.assert_allclose(tips[3:], tips[2], rtol=1e-4)
    assert tips[4] == pytest.approx(tips[3], rel=1e-6)
    assert volumes[4] * 1e4 == pytest.approx(volumes[2], rel=1e-3)

    locked = cantilever(cell, coarse, "displacement")
    assert bent(locked, 1).outputs[0] == pytest.approx(tips[0], rel=2e-3)
    assert abs(bent(locked, 1e3).outputs[0]) < 0.98 * abs(tips[2])


@pytest.mark.parametrize("cell", ["tetrahedron", "hexahedron"])
def test_both_forms_tend_to_the_same_answer(cell):
    gaps = []
    for cells in ((5, 1, 1), (10, 2, 2)):
        energies = [bent(cantilever(cell, cells, form), 10).outputs[2] for form in ("displacement", "mixed")]
        gaps.append(abs(energies[0] / energies[1] - 1))
    assert gaps[1] < 0.6 * gaps[0]
    assert gaps[1] < 0.03


def test_derivatives_of_a_nearly_incompressible_body():
    model = cantilever("tetrahedron", (5, 1, 1), parameters=("material.C1", BULK, TRACTION))
    point = np.array([SHEAR / 2, 1e4 * SHEAR / 2, LOAD])
    check_derivatives(model, point, 0.3 * point, accuracy=1e-9, steps=STEPS).require()


def test_a_solution_does_not_depend_on_the_bulk_moduli_before():
    # The analysis of the matrix must not look at its values.
    fresh, used = (cantilever("hexahedron", (5, 1, 1)) for _ in range(2))
    for ratio in (1, 1e8):
        bent(used, ratio).tangent(np.ones(2))
    expected, found = bent(fresh, 1e4), bent(used, 1e4)
    np.testing.assert_array_equal(found.state, expected.state)
    np.testing.assert_array_equal(found.tangent(np.ones(2)), expected.tangent(np.ones(2)))


def test_instability_is_counted_alike():
    counts = []
    for formulation in ("displacement", "mixed"):
        model = cantilever("hexahedron", (6, 2, 2), formulation)
        equations = bent(model, 1).visit()
        # Compressed by three times what buckles it (in two planes), and by half of what the next mode needs; ν = 1/8.
        strain = 0.03 * np.array([-1, 1 / 8, 1 / 8])
        u = strain * (np.asarray(equations.space.tabulate_dof_coordinates()) - [0, 0.01, 0.01])
        state = equations.with_pressures(u.ravel())
        state[u.size :] = SHEAR * (np.prod(1 + strain) - 1)
        equations.factorise(state)
        counts.append(equations.inertia())
    assert counts == [2, 2]


@pytest.mark.parametrize("form", MIXED)
def test_a_state_has_a_canonical_order(form):
    spec = unloaded_body(form, body={"cells": (3, 2, 4)}, outputs=({"kind": "strain-energy", "name": "energy"},))
    model = spec.build(MPI.COMM_SELF, ())
    equations = model.equations
    places = [np.asarray(space.tabulate_dof_coordinates()) for space in (equations.space, equations.unknowns.pressure)]
    state = np.concatenate([places[0].ravel(), places[1] @ [100.0, 10.0, 1.0]])
    whole = model.space.gather(state[None])
    assert whole.shape == (1, spec.unknowns)
    assert spec.unknowns == 3 * 7 * 5 * 9 + 4 * 3 * 5
    np.testing.assert_array_equal(whole[0, : model.space.displacements].reshape(-1, 3), model.space.coordinates)
    # Vertices are nodes, in the same order.
    sizes = np.array(spec.body.size) / (3, 2, 4)
    at_vertex = np.isclose(model.space.coordinates / sizes, np.round(model.space.coordinates / sizes)).all(axis=1)
    expected = model.space.coordinates[at_vertex] @ [100.0, 10.0, 1.0]
    np.testing.assert_allclose(whole[0, model.space.displacements :], expected, rtol=1e-12)
    np.testing.assert_array_equal(model.space.scatter(whole)[0], state)
    equations.set_state(state)
    np.testing.assert_array_equal(equations.state(), state)
    equations.set_state(0 * state)
    np.testing.assert_array_equal(equations.unknowns.take(equations.unknown.x.array), 0)


def test_fields_are_those_of_displacements_and_predictions_hold_pressures():
    model = cantilever("hexahedron", (5, 1, 1))
    inputs = Inputs(
        {
            BULK: Uniform(lower=0.9e4 * SHEAR, upper=1.1e4 * SHEAR),
            TRACTION: Uniform(lower=0.9 * LOAD, upper=1.1 * LOAD),
        }
    )
    evaluate = SerialEvaluate(model)
    data = SensitivityMonteCarlo(samples=8, seed=1).run(inputs, evaluate)
    nodes = model.spec.body.nodes
    for name in ("field_nominal", "field_mean", "field_std"):
        assert data[name].shape == (nodes, 3)
    assert data["field_derivative"].shape == (2, nodes, 3)
    tip = np.isclose(model.space.coordinates[:, 0], 0.1)
    assert np.abs(data["field_mean"].to_numpy()[tip, 1]).mean() == pytest.approx(abs(data["mean"].item(0)), rel=0.01)

    centre = linearise(inputs, evaluate)
    assert centre.prediction.reference.state.size == model.spec.unknowns > 3 * nodes
    points = np.array([[1.05e4 * SHEAR, 1.05 * LOAD]])
    cold, warm = (evaluate(Request(points, start=start)) for start in (None, centre.prediction))
    np.testing.assert_allclose(warm.outputs, cold.outputs, rtol=1e-8)
    assert warm.work.sum() < cold.work.sum()


RANKS = """
import sys
import numpy as np
from mpi4py import MPI
from tests.forward.fem.test_mixed import LOAD, SHEAR, cantilever
from tests.ranks import groups
alone = MPI.COMM_SELF
for comm in groups():
    MPI.COMM_SELF = comm
    found = []
    for cell in ("tetrahedron", "hexahedron"):
        model = cantilever(cell, (6, 1, 1))
        solution = model.solve(np.array([1e6 * SHEAR / 2, LOAD]))
        slope = solution.tangent(np.array([0.0, LOAD]))
        field = model.space.gather(np.array([solution.state]))
        if comm.rank == 0:
            displacements, pressures = np.split(field[0], [model.space.displacements])
            found.append([*solution.outputs, *slope, np.linalg.norm(displacements), pressures[0], pressures[-1],
                          np.linalg.norm(pressures), solution.work.factorisations])
        assert solution.linearise().inertia() == 0
    if comm.rank == 0:
        np.save(f"{sys.argv[1]}/{comm.size}.npy", found)
MPI.COMM_SELF = alone
"""


@pytest.mark.mpi
@UP_TO_RANKS
def test_ranks_agree_about_a_nearly_incompressible_body(tmp_path, ranks):
    done = on_kept_ranks(ranks, RANKS, tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    found = [np.load(tmp_path / f"{n}.npy") for n in range(1, ranks + 1)]
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], rtol=1e-8)
