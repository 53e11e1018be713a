"""Samples that are corrected in lockstep: the answers of each alone, whatever becomes of the others."""

import meshio
import numpy as np
import pytest
from mpi4py import MPI

from forward.fem import cost
from forward.model import Guess, InadmissibleError, SolveError
from tests.bodies import loaded_body
from tests.forward.bodies import test_mesh_file
from tests.forward.fem.test_mixed import BULK, SHEAR, TRACTION, cantilever
from tests.launch import ROOT, UP_TO_RANKS, on_kept_ranks
from tests.meshes import box
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import random_points
from uq.surrogates.linearisation import linearise
from workflows.config.study import load

pytestmark = pytest.mark.fem
C1, PRESSURE = "material.C1", "loads.pressure.size"


def beam(*changes):
    study = load(ROOT / "configs" / "tiny.toml", changes)
    return study.model.build(MPI.COMM_SELF, study.inputs.names), study.inputs


def field():
    coarse = ("model.body.cells=[4, 1, 2]", 'model.fields=[{of="stiffness", length=0.1, std=0.3, modes=3}]')
    study = load(ROOT / "configs" / "beam-field.toml", coarse)
    return study.model.build(MPI.COMM_SELF, study.inputs.names), study.inputs


def mixed():
    ranges = {BULK: Uniform(lower=50 * SHEAR, upper=100 * SHEAR), TRACTION: Uniform(lower=30.0, upper=60.0)}
    return cantilever("hexahedron", (5, 1, 1)), Inputs(ranges)


def follower():
    """Prescribed displacements, and a pressure that follows the body: the stiffness is not symmetric."""
    spec = loaded_body("mooney-rivlin")
    ranges = {C1: (0.8, 1.2), PRESSURE: (0.7, 1.3), "displacements.y-max.y": (0.5, 1.5)}
    value = {path: scalar.value for path, scalar in spec.scalars.items()}
    inputs = Inputs({path: Uniform(lower=a * value[path], upper=b * value[path]) for path, (a, b) in ranges.items()})
    return spec.build(MPI.COMM_SELF, inputs.names), inputs


def predicted(model, inputs, n):
    """Points, and their guesses by the tangent at the mean."""
    prediction = linearise(inputs, SerialEvaluate(model)).prediction
    points = inputs.points(random_points(1, 0, n, len(inputs.names)))
    return points, list(map(prediction.on(model), points))


def regional(folder):
    """A mesh from a file, of which the right half has numbers of its own."""
    meshio.write(folder / "box.msh", box(), file_format="gmsh22", binary=True)
    spec = test_mesh_file.regional(folder / "box.msh")
    value = dict(zip(test_mesh_file.NUMBERS, (1e4, 2e4, 3e4, 1e5, 1.5), strict=True))
    inputs = Inputs({path: Uniform(lower=0.8 * number, upper=1.2 * number) for path, number in value.items()})
    return spec.build(MPI.COMM_SELF, inputs.names), inputs


@pytest.mark.parametrize("make", [beam, field, mixed, follower, regional])
def test_states_are_those_of_samples_alone(make, tmp_path):
    model, inputs = make(tmp_path) if make is regional else make()
    points, guesses = predicted(model, inputs, 9)
    alone = [model.solve(point, guess) for point, guess in zip(points, guesses, strict=True)]
    slopes = [solution.tangent(np.eye(len(point))) for solution, point in zip(alone, points, strict=True)]
    for i, one in enumerate(model.solve_many(points, guesses)):
        size = np.abs(alone[i].state).max()
        np.testing.assert_allclose(one.state, alone[i].state, atol=20 * model.spec.solver.tolerance * size)
        np.testing.assert_allclose(one.outputs, alone[i].outputs, rtol=1e-6)
        np.testing.assert_allclose(one.tangent(np.eye(len(points[i]))), slopes[i], rtol=1e-4, atol=1e-6)
        assert (one.stability, one.reference) == (alone[i].stability, guesses[i].reference)
        assert one.residual <= model.spec.solver.tolerance
        assert one.work.back_substitutions > 1
        assert abs(one.work.back_substitutions - alone[i].work.back_substitutions) <= 2 + 12 * (make is follower)


def test_the_factor_is_read_once_for_all(monkeypatch):
    model, inputs = beam()
    points, guesses = predicted(model, inputs, 9)
    columns = []
    inner = model.reference.solve_uncounted
    monkeypatch.setattr(model.reference, "solve_uncounted", lambda right: columns.append(len(right)) or inner(right))
    works = [solution.work for solution in model.solve_many(points, guesses)]
    assert columns[0] == 9
    assert columns == sorted(columns, reverse=True)  # each stops when it is done
    assert sum(columns) == sum(work.back_substitutions for work in works)
    assert len(columns) == max(work.back_substitutions for work in works)


def test_a_sample_that_fails_leaves_the_others_alone():
    """One is not admissible, one has no equilibrium, one needs Newton's method, one the path in two parts."""
    model, inputs = beam("model.solver.minimum_load_step=0.05")
    points, guesses = predicted(model, inputs, 8)
    good = list(model.solve_many(points, guesses))
    bad, astray = points.copy(), list(guesses)
    density = inputs.names.index("loads.gravity.density")
    bad[1] = -1.0
    bad[3, density] = 1e7
    far = guesses[5].state * 30.0
    astray[5] = Guess(far, guesses[5].reference)
    bad[6, density] *= 2.5
    found = list(model.solve_many(bad, astray))
    assert isinstance(found[1], InadmissibleError)
    assert isinstance(found[3], SolveError)
    assert "of the load" in found[3].reason
    assert found[3].work.factorisations > 3
    assert found[5].work.factorisations > 0
    np.testing.assert_allclose(found[5].state, good[5].state, atol=1e-8)
    assert found[6].residual <= 1e-8
    for i in (0, 2, 4, 7):
        np.testing.assert_allclose(found[i].state, good[i].state, atol=1e-10)
        assert found[i].work == good[i].work
        assert found[i].stability == good[i].stability


def test_only_points_with_one_reference_go_together(monkeypatch):
    columns = []
    model, inputs = beam()
    inner = model.reference.solve_uncounted
    monkeypatch.setattr(model.reference, "solve_uncounted", lambda right: columns.append(len(right)) or inner(right))
    points, guesses = predicted(model, inputs, 3)
    elsewhere = linearise(inputs, SerialEvaluate(model), inputs.mean * 1.02).prediction.on(model)(points[2])
    for start, together in (
        (guesses, 3),
        (None, 0),
        ([None, *guesses[1:]], 2),
        ([guesses[0], Guess(guesses[1].state), guesses[2]], 0),
        ([*guesses[:2], elsewhere], 2),
    ):
        columns.clear()
        assert len(list(model.solve_many(points, start))) == 3
        assert max(columns, default=0) == together
    for changes in (("model.solver.kind='newton'",), ("model.solver.solve_seconds=1e3",)):
        assert beam(*changes)[0].together == 1
    assert cost.together(10**4) == cost.MOST_TOGETHER
    assert 1 <= cost.together(10**6) < cost.together(10**5) < cost.MOST_TOGETHER


def test_as_one_ends_the_next_begins(monkeypatch):
    """More samples than go together; what becomes of the equations between results changes none of them."""
    model, inputs = beam()
    points, guesses = predicted(model, inputs, 12)
    elsewhere = linearise(inputs, SerialEvaluate(model), inputs.mean * 1.02).prediction.on(model)
    alone = [model.solve(point, guess) for point, guess in zip(points, guesses, strict=True)]
    monkeypatch.setitem(vars(model), "together", 3)
    columns, inner = [], model.reference.solve_uncounted
    monkeypatch.setattr(model.reference, "solve_uncounted", lambda right: columns.append(len(right)) or inner(right))
    found = list(model.solve_many(points, guesses))
    assert max(columns) == 3
    assert len(columns) < 1.3 * sum(columns) / 3  # most of the time there are three
    for one, other, between in zip(found, alone, model.solve_many(points, guesses), strict=True):
        np.testing.assert_allclose(one.state, other.state, atol=1e-9)
        np.testing.assert_array_equal(between.state, one.state)
        assert between.work == one.work
        between.tangent(np.eye(2))
        model.solve(points[0] * 1.01, elsewhere(points[0] * 1.01)).tangent(np.eye(2))


SCRIPT = """
import numpy as np
from tests.forward.fem import test_lockstep as t
from tests.ranks import groups
from workflows.config.study import load

for comm in groups():
    study = load(t.ROOT / "configs" / "tiny.toml")
    model = study.model.build(comm, study.inputs.names)
    prediction = comm.bcast(t.linearise(study.inputs, t.SerialEvaluate(model)).prediction)
    points = study.inputs.points(t.random_points(1, 0, 3, 2))
    guesses = list(map(prediction.on(model), points))
    columns, inner = [], model.reference.solve_uncounted
    model.reference.solve_uncounted = lambda right: columns.append(len(right)) or inner(right)
    found = list(model.solve_many(points, guesses))
    assert columns[0] == 3
    assert sum(columns) == sum(one.work.back_substitutions for one in found)
    states = model.space.gather(np.array([one.state for one in found]))
    if comm.rank == 0:
        print(np.abs(states).max(), repr(np.linalg.norm(states)), flush=True)
"""


@pytest.mark.mpi
@UP_TO_RANKS
def test_ranks_that_share_a_model_correct_together_too(ranks):
    done = on_kept_ranks(ranks, SCRIPT)
    assert done.returncode == 0, done.stderr
    one, *others = (np.array(line.split(), dtype=float) for line in done.stdout.splitlines())
    assert len(others) == ranks - 1
    for other in others:
        np.testing.assert_allclose(one, other, rtol=1e-9)
