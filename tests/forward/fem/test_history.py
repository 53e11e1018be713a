"""Bodies on which tools rub: Coulomb's law in its limits, derivatives through the path, and what is refused."""

import numpy as np
import pytest
from mpi4py import MPI
from pydantic import ValidationError

from forward.conformance import check_derivatives
from forward.fem.model import HyperelasticModel
from forward.hyperelastic import Path
from forward.model import SolveError
from tests.forward.terms.test_indenter import SIDE, body, only, tool
from tests.launch import on_kept_ranks
from tests.steps import STEPS

FRICTION = 0.3
ACCURATE = 1e-10
SHEARED = (0.0, 1e-3, 2e-3, 4e-3, 6e-3)  # places (m) of a plate after it has been pressed down
NAMES = ("material.C1", "loads.indenter.friction", "loads.indenter.depth")


def sheared(places=SHEARED, **changes):
    """A bonded block, pressed by a rough plate that then moves sideways."""
    outputs = (
        {"kind": "force", "name": "aside", "component": "x"},
        {"kind": "force", "name": "down"},
        {"kind": "reaction", "name": "below", "on": "z-min", "component": "x"},
    )
    plate = only("plane", friction=FRICTION, increments=2)
    block = {"kind": "box", "size": (SIDE,) * 3, "cells": (2, 2, 2), "degree": 2}
    blocks = body(plate, displacements=(), clamp=("z-min",), outputs=outputs, body=block).model_dump(exclude={"kind"})
    blocks |= {"kind": "path", "steps": {"loads.indenter.x": places}}
    return Path.model_validate(blocks | changes)


def values(spec):
    whole = spec.whole.scalars if isinstance(spec, Path) else spec.scalars
    return np.array([whole[name].value for name in NAMES])


@pytest.fixture(scope="module")
def plate():
    """The plate with its solution at the numbers as stated."""
    spec = sheared()
    model = spec.build(MPI.COMM_SELF, NAMES)
    return model, values(spec), model.solve(values(spec))


@pytest.mark.fem
def test_a_plate_sticks_and_then_slides(plate):
    """F_t < μ F_n while it sticks, F_t = μ F_n where it slides: closed forms."""
    _, _, found = plate
    aside, down, below = found.outputs.reshape(-1, 3).T
    assert abs(aside[0]) < 1e-12
    assert aside[1] / down[1] < 0.5 * FRICTION
    assert aside[2] / aside[1] == pytest.approx(2, rel=0.02)  # sticking, it moves with the plate
    assert aside[-1] / down[-1] == pytest.approx(FRICTION, rel=1e-3)
    assert (aside <= FRICTION * down * (1 + 1e-9)).all()
    np.testing.assert_allclose(below, -aside, rtol=1e-6, atol=1e-10)
    assert found.stability == 2  # negative eigenvalues were counted


@pytest.mark.fem
def test_derivatives_through_the_path(plate):
    model, point, found = plate
    directions = np.diag(1e-3 * point)
    tangents = found.tangent(directions)
    np.testing.assert_allclose(found.adjoint(np.eye(15)) @ directions.T, tangents.T, rtol=1e-7, atol=1e-12)
    for direction, tangent in zip(directions[1:], tangents[1:], strict=True):
        ends = [model.solve(point + sign * direction).outputs for sign in (1, -1)]
        np.testing.assert_allclose((ends[0] - ends[1]) / 2, tangent, rtol=1e-4, atol=1e-9)


@pytest.mark.fem
def test_a_path_with_friction_that_stops_keeps_the_steps_before(plate):
    spec = sheared(steps={"loads.indenter.depth": (1e-3, 2e-3, 0.05)})
    point = values(spec)[:2]
    with pytest.raises(SolveError, match=r"^step 3 of 3 \(loads\.indenter\.depth = 0\.05\): stopped at \d+") as caught:
        spec.build(MPI.COMM_SELF, NAMES[:2]).solve(point)
    reached = caught.value.reached
    assert np.isnan(reached[6:]).all()
    np.testing.assert_allclose(reached[3:6], plate[2].outputs[:3], rtol=1e-2, atol=1e-9)  # by other increments


@pytest.mark.fem
@pytest.mark.flags
def test_a_rough_ball_is_stiffer():
    """By a few percent where the body is compressible; with little friction, as without.

    A solution is as accurate as its tolerance, and so are differences of two; 1e-10 is what friction can keep here.
    """
    spec = body(tool(friction=2.0, increments=4), solver={"tolerance": ACCURATE})
    model = spec.build(MPI.COMM_SELF, NAMES)
    smooth = body(tool()).build(MPI.COMM_SELF, ())
    assert isinstance(smooth, HyperelasticModel)  # without friction nothing of it is there
    without = smooth.solve(np.zeros(0)).outputs[0]
    point = values(spec)
    assert 1.005 < model.solve(point).outputs[0] / without < 1.03
    almost = point * [1, 1e-6, 1]
    assert model.solve(almost).outputs[0] == pytest.approx(without, rel=1e-6)
    along = np.array([[0.3, 1.0, 0.5]])
    check_derivatives(model, point, 1e-3 * point, directions=along, accuracy=ACCURATE, steps=STEPS).require()


SCRIPT = """
import numpy as np
from mpi4py import MPI
from tests.forward.fem.test_history import NAMES, sheared, values

spec = sheared((0.0, 1e-3))
def solve(comm):
    model = spec.build(comm, NAMES)
    found = model.solve(values(spec))
    state = comm.bcast(model.space.gather(found.state[None]))
    return found.outputs, state, found.adjoint(np.eye(6))
for one, other in zip(solve(MPI.COMM_WORLD), solve(MPI.COMM_SELF)):
    np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-7 * np.abs(other).max())
"""


@pytest.mark.fem
@pytest.mark.mpi
@pytest.mark.slow
def test_two_ranks_share_a_body_with_friction():
    done = on_kept_ranks(2, SCRIPT)
    assert done.returncode == 0, done.stderr


def test_how_many_increments():
    assert body(tool()).increments == 1
    assert body(tool(friction=0.1)).increments == 10
    assert sheared().increments == 10
    assert body(tool(friction=0.1, increments=3)).increments == 3


def test_friction_that_cannot_be():
    with pytest.raises(ValidationError, match="greater than or equal to 0"):
        body(tool(friction=-0.1))
    assert "loads.indenter.friction" not in body(tool()).scalars
    assert "without friction" in body(tool()).loads[0].words(dict.fromkeys(body(tool()).loads[0].scalars, "1"))
    rough = body(tool(friction=0.1)).loads[0]
    assert rough.words({name: "<" + name + ">" for name in rough.scalars}).endswith("friction <friction>")
