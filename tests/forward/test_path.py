"""Bodies whose loads change step by step: states, derivatives and errors of every step, and what is refused."""

import numpy as np
import pytest
from mpi4py import MPI
from pydantic import ValidationError

from forward.hyperelastic import Hyperelastic, Path
from forward.model import Guess, ReferenceSolution, SolveError, Stability
from tests.bodies import loaded_body
from tests.launch import on_kept_ranks

STEPS = {"loads.traction.size": (4e2, 1e3, 1.5e3), "displacements.y-max.y": (0.01, 0.03, 0.05)}
RANDOM = ("material.C1", "material.D1", "loads.gravity.density")


def blocks(**changes):
    """The blocks of a body under every kind of load."""
    return loaded_body("mooney-rivlin").model_dump(exclude={"kind"}) | {"kind": "path"} | changes


def path(**changes):
    return Path.model_validate(blocks(**({"steps": STEPS} | changes)))


def at(spec, **numbers):
    """The values of some numbers of a body."""
    return np.array([numbers.get(name, spec.scalars[name].value) for name in RANDOM])


def test_lists_of_loads_and_displacements_are_steps():
    given = blocks(displacements=[{"on": "y-max", "y": [0.01, 0.05]}])
    given["loads"] = [*given["loads"][:1], {**given["loads"][1], "name": "pull", "size": [10, 20.0]}]
    spec = Path.model_validate(given)
    assert spec.steps == {"loads.pull.size": (10.0, 20.0), "displacements.y-max.y": (0.01, 0.05)}
    assert spec.leading == "loads.pull.size"
    assert not {"loads.pull.size", "displacements.y-max.y"} & set(spec.scalars)
    assert [output.name for output in spec.returned][:2] == ["largest.1", "largest-z.1"]
    assert spec.returned[-1].name == "stress.2"
    assert spec.returned[-1].unit == "Pa"
    assert spec.axes_of_outputs["loads.pull.size"] == ("Pa", [10.0] * 9 + [20.0] * 9)
    assert spec.whole.scalars["loads.pull.size"].value == 20.0
    assert spec.refined(1).steps == spec.steps


@pytest.mark.parametrize(
    ("changes", "place", "message"),
    [
        ({"steps": {}}, "steps", "no number has steps"),
        (
            {"steps": {"loads.traction.siz": (1.0, 2.0)}},
            "steps.loads.traction.siz",
            "did you mean 'loads.traction.size'",
        ),
        ({"steps": {"material.C1": (1.0, 2.0)}}, "steps.material.C1", "no number of a load or displacement"),
        ({"steps": {"loads.traction.size": (1.0,)}}, "steps.loads.traction.size", "1 values, expected at least 2"),
        (
            {"steps": {"loads.gravity.density": (1.0, -2.0)}},
            "steps.loads.gravity.density.1",
            "greater than or equal to 0",
        ),
        ({"steps": {"loads.traction.size": (1.0, 1.0)}}, "steps.loads.traction.size.1", "the same as the step before"),
        (
            {"steps": {"loads.traction.size": (1.0, 2.0), "loads.pressure.size": (1.0, 2.0, 3.0)}},
            "steps",
            "lists of different lengths (loads.traction.size 2, loads.pressure.size 3)",
        ),
    ],
)
def test_what_steps_cannot_be(changes, place, message):
    with pytest.raises(ValidationError) as caught:
        path(**changes)
    (found,) = caught.value.errors()
    assert ".".join(map(str, found["loc"])) == place
    assert message in found["msg"]


def test_a_list_needs_a_path():
    given = blocks(kind="hyperelastic", displacements=[{"on": "y-max", "y": [0.01, 0.05]}])
    with pytest.raises(ValidationError, match=r"kind = 'path'"):
        Hyperelastic.model_validate(given)


@pytest.mark.fem
def test_every_step_is_the_body_under_its_loads():
    spec = path()
    model = spec.build(MPI.COMM_SELF, RANDOM)
    values = at(spec)
    solution = model.solve(values)
    assert solution.stability == Stability.COUNTED
    single = spec.whole.build(MPI.COMM_SELF, (*RANDOM, *STEPS))
    directions = np.diag(values)
    tangents = solution.tangent(directions).reshape(3, 3, -1)
    gradients = solution.adjoint(np.eye(27))
    np.testing.assert_allclose(gradients @ directions.T, solution.tangent(directions).T, rtol=1e-7, atol=1e-9)
    for k in range(3):
        alone = single.solve(np.append(values, [numbers[k] for numbers in STEPS.values()]))
        np.testing.assert_allclose(solution.outputs.reshape(3, -1)[k], alone.outputs, rtol=1e-8)
        slopes = alone.tangent(np.hstack([directions, np.zeros((3, 2))]))
        np.testing.assert_allclose(tangents[:, k], slopes, rtol=1e-7, atol=1e-9)
    # States begin with the last step, whose displacements are the fields of results.
    np.testing.assert_allclose(solution.state[: alone.state.size], alone.state, rtol=1e-8, atol=1e-14)
    assert model.space.displacements == alone.state.size
    # Differences of the whole path
    step = 1e-4 * values * np.array([1, -1, 1])
    difference = (model.solve(values + step).outputs - model.solve(values - step).outputs) / 2
    smooth = [i for i, name in enumerate(model.outputs) if not name.startswith(("stress", "largest"))]
    np.testing.assert_allclose(solution.tangent(step)[smooth], difference[smooth], rtol=1e-5, atol=1e-9)


@pytest.mark.fem
def test_a_predicted_path_is_corrected_with_a_factor_for_each_step():
    spec = path(loads=blocks()["loads"][:2])  # dead loads: the stiffness is symmetric
    model = spec.build(MPI.COMM_SELF, RANDOM)
    values = at(spec)
    centre = model.solve(values)
    change = np.array([300.0, -2e3, 10.0])
    guess = Guess(centre.state + centre.state_tangent(change), ReferenceSolution(values, centre.state, np.abs(change)))
    model.solve(values + change, guess)  # makes the factors
    found = model.solve(values + change / 2, guess)
    assert found.work.factorisations == 0
    np.testing.assert_allclose(found.outputs, model.solve(values + change / 2).outputs, rtol=1e-7)


@pytest.mark.fem
def test_derivatives_that_will_be_asked_for_are_found_while_the_factor_of_their_step_is_there():
    spec = path()
    model = spec.build(MPI.COMM_SELF, RANDOM)
    late, soon = (model.solve(at(spec), Guess(derivatives=known)) for known in (False, True))
    for found in (late, soon):
        found.tangent(np.eye(3)), found.state_tangent(np.eye(3)[0])
    np.testing.assert_array_equal(soon.outputs, late.outputs)
    np.testing.assert_allclose(soon.tangent(np.eye(3)), late.tangent(np.eye(3)), rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(
        soon.state_tangent(np.eye(3)[1]), late.state_tangent(np.eye(3)[1]), rtol=1e-9, atol=1e-15
    )
    assert soon.work.factorisations <= late.work.factorisations - (model.spec.count - 1)


@pytest.mark.fem
def test_a_path_that_stops_keeps_the_steps_before():
    spec = path(steps={"loads.traction.size": (5e2, 1e3, -1e9)})
    model = spec.build(MPI.COMM_SELF, RANDOM)
    with pytest.raises(SolveError, match=r"^step 3 of 3 \(loads\.traction\.size = -1e\+09\): ") as caught:
        model.solve(at(spec))
    known = np.isfinite(caught.value.reached)
    assert known[:18].all()
    assert not known[18:].any()
    first = path(steps={"loads.traction.size": (5e2, 1e3)}).build(MPI.COMM_SELF, RANDOM).solve(at(spec))
    np.testing.assert_allclose(caught.value.reached[:18], first.outputs, rtol=1e-9)


@pytest.mark.fem
def test_errors_of_the_mesh_are_those_of_the_steps():
    spec = path()
    solution = spec.build(MPI.COMM_SELF, RANDOM).solve(at(spec))
    error = solution.mesh_error()
    single = spec.whole.build(MPI.COMM_SELF, (*RANDOM, *STEPS))
    last = single.solve(np.append(at(spec), [numbers[-1] for numbers in STEPS.values()])).mesh_error()
    np.testing.assert_allclose(error.outputs[18:], last.outputs, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(error.state[: last.state.size], last.state, rtol=1e-4, atol=1e-9)


SCRIPT = """
import numpy as np
from mpi4py import MPI
from tests.forward.test_path import RANDOM, at, path

comm = MPI.COMM_WORLD
spec = path()
def solve(comm):
    model = spec.build(comm, RANDOM)
    solution = model.solve(at(spec))
    state = comm.bcast(model.space.gather(solution.state[None]))
    assert np.array_equal(model.space.scatter(state)[0], solution.state)
    return solution.outputs, state, solution.adjoint(np.eye(27))
for one, other in zip(solve(comm), solve(MPI.COMM_SELF)):
    np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())
"""


@pytest.mark.fem
@pytest.mark.mpi
def test_two_ranks_share_a_path():
    done = on_kept_ranks(2, SCRIPT)
    assert done.returncode == 0, done.stderr
