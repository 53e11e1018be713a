"""Items from outside: a cable between nodes that share no cell, and a viscous branch that remembers."""

from types import SimpleNamespace
from typing import Annotated, ClassVar

import numpy as np
import pytest
from annotated_types import Unit
from mpi4py import MPI
from pydantic import ValidationError
from scipy.optimize import brentq

from forward.conformance import check_derivatives
from forward.hyperelastic import Hyperelastic, Path
from forward.model import Guess, ModelError, ReferenceSolution, SolveError, Stability
from forward.reduced.spec import mistakes
from forward.specimen import Specimen
from forward.terms.acting import Entries
from forward.terms.term import Item
from tests.launch import UP_TO_RANKS, on_kept_ranks
from tests.steps import STEPS

MATERIAL = {"kind": "neo-hookean", "C1": 1e4, "D1": 3e4}
ENDS = {"start": (0.0, 0.0, 0.0), "end": (1.0, 1.0, 1.0)}
CABLE = {"kind": "tests.items.Cable", "name": "cable", "stiffness": 3e3} | ENDS
NAMES = ("material.C1", "loads.cable.stiffness", "loads.cable.slack", "loads.traction.size")


def cube(*loads, **changes):
    blocks = {
        "body": {"size": (1.0, 1.0, 1.0), "cells": (3, 2, 2), "cell": "hexahedron", "degree": 1},
        "material": MATERIAL,
        "clamp": ("x-min",),
        "loads": ({"kind": "traction", "on": "x-max", "direction": (1.0, 0.3, 0.0), "size": 4e3}, *loads),
        "outputs": (
            {"kind": "displacement", "name": "end", "at": (1.0, 1.0, 1.0), "component": "x"},
            {"kind": "reaction", "name": "held", "on": "x-min", "component": "x"},
            {"kind": "strain-energy", "name": "energy"},
        ),
        "solver": {"tolerance": 1e-12},
    }
    return Hyperelastic(**(blocks | changes))


def solved(spec, names=(), comm=MPI.COMM_SELF):
    model = spec.build(comm, names)
    point = np.array([spec.scalars[name].value for name in names])
    return model, point, model.solve(point)


EDGES = tuple(CABLE | {"name": f"{y:g}{z:g}", "start": (0, y, z), "end": (1, y, z)} for y in (0, 1) for z in (0, 1))
CONFINED = {
    "body": {"size": (1.0, 1.0, 1.0), "cells": (3, 1, 1), "cell": "hexahedron", "degree": 1},
    "clamp": (),
    "displacements": (
        {"on": "x-min", "x": 0.0},
        *({"on": f"{axis}-{end}", axis: 0.0} for axis in "yz" for end in ("min", "max")),
    ),
}


def stress(stretch):
    """P (Pa) of a cube that keeps its width: W = C1 (J^(−2/3) (λ² + 2) − 3) + D1 (J − 1)², J = λ."""
    C1, D1 = MATERIAL["C1"], MATERIAL["D1"]
    return C1 * (4 / 3 * stretch ** (1 / 3) - 4 / 3 * stretch ** (-5 / 3)) + 2 * D1 * (stretch - 1)


@pytest.mark.fem
@pytest.mark.parametrize("size", [8e3, -8e3])
def test_cables_along_the_edges_of_a_cube(size):
    """P(λ) + 4 EA (λ − 1) = t in tension; slack in compression: closed forms, and the force that holds."""
    traction = {"kind": "traction", "on": "x-max", "direction": (1.0, 0.0, 0.0), "size": size}
    _, _, found = solved(cube(loads=(traction, *EDGES), **CONFINED))
    pull = 4 * CABLE["stiffness"]
    stretch = brentq(lambda x: stress(x) + pull * max(x - 1, 0) - size, 0.5, 2.0, xtol=1e-14)
    assert found.outputs[0] == pytest.approx(stretch - 1, rel=1e-9)
    assert found.outputs[1] == pytest.approx(-size, rel=1e-9)


@pytest.mark.fem
def test_a_cable_across_a_body():
    """The forces that the body without it lacks are the slope of the cable's energy, by differences."""
    model, _, found = solved(cube(CABLE, clamp=("x-min",)))
    bare, _, without = solved(cube())
    assert found.outputs[0] < 0.95 * without.outputs[0]
    bare.equations.set_state(found.state)
    lacking = bare.space.gather(bare.equations.imbalance()[None])[0].reshape(-1, 3)[-1]
    end = model.space.gather(found.state[None])[0][-3:]

    def energy(move):
        return CABLE["stiffness"] * np.sqrt(3) / 2 * (np.linalg.norm(1 + end + move) / np.sqrt(3) - 1) ** 2

    slopes = [(energy(step) - energy(-step)) / 2e-6 for step in 1e-6 * np.eye(3)]
    np.testing.assert_allclose(lacking, -np.array(slopes), rtol=1e-6, atol=1e-6)


@pytest.mark.fem
@pytest.mark.parametrize("changes", [{}, {"formulation": "mixed"}, {"solver": "newton"}])
def test_derivatives_with_a_cable(changes):
    if "formulation" in changes:
        changes = changes | {"body": {"size": (1.0, 1.0, 1.0), "cells": (2, 1, 1), "cell": "hexahedron", "degree": 2}}
    model, point, found = solved(cube(CABLE | {"slack": 0.9}, **changes), NAMES)
    check_derivatives(model, point, 1e-2 * point, steps=STEPS).require()
    near = 1.01 * point
    guess = Guess(found.state, ReferenceSolution(point, found.state))
    cheap, full = model.solve(near, guess), model.solve(near)
    np.testing.assert_allclose(cheap.outputs, full.outputs, rtol=1e-8)
    slopes = full.adjoint(np.eye(3))
    np.testing.assert_allclose(cheap.adjoint(np.eye(3)), slopes, rtol=1e-5, atol=1e-4 * np.abs(slopes).max())
    several = [one.outputs for one in model.solve_many(np.array([point, near]), [guess, guess])]
    np.testing.assert_allclose(several, [found.outputs, full.outputs], rtol=1e-8)


TIMES = (0.0, 0.5, 1.5, 2.0, 6.0)
BRANCH = {"kind": "tests.items.Branch", "name": "branch", "G": 2e4, "tau": 2.0, "time": TIMES}
OF_BRANCH = ("material.C1", "loads.branch.G", "loads.branch.tau")


@pytest.mark.fem
@pytest.mark.parametrize("times", [TIMES, tuple(np.linspace(0, 4, 81))])
def test_a_cube_that_is_held_relaxes(times):
    """The branch's stress is 2G (λ − 1) ∏ 1/(1 + Δt/τ), close to that times exp(−t/τ) where steps are short."""
    moved = (*CONFINED["displacements"], {"on": "x-max", "x": 0.1})
    path = cube(loads=(), **CONFINED | {"displacements": moved}).model_dump(exclude={"kind"})
    _, _, found = solved(Path(**path | {"loads": (BRANCH | {"time": times},)}))
    left = np.cumprod(np.append(1.0, 1 / (1 + np.diff(times) / BRANCH["tau"])))
    held = -found.outputs.reshape(-1, 3)[:, 1]
    np.testing.assert_allclose(held, stress(1.1) + 2 * BRANCH["G"] * 0.1 * left, rtol=1e-9)
    if len(times) > 50:
        np.testing.assert_allclose(left, np.exp(-np.array(times) / BRANCH["tau"]), rtol=0.03)


def creeping():
    """A block that creeps under a traction, beside a branch."""
    path = cube().model_dump(exclude={"kind"})
    return Path(**path | {"loads": (*path["loads"], BRANCH)})


@pytest.mark.fem
def test_derivatives_through_what_is_kept():
    model, point, found = solved(creeping(), OF_BRANCH)
    creep = found.outputs.reshape(-1, 3)[:, 0]
    assert (np.diff(creep) > 0.02 * creep[0]).all()
    along = np.array([[1.0, 0.7, -0.5]])
    check_derivatives(model, point, 1e-2 * point, directions=along, steps=STEPS).require()
    with pytest.raises(SolveError, match="the error of the mesh is not estimated with 'branch'"):
        found.mesh_error()


class Drawn(Item):
    """A force on one node along the displacement of another: its stiffness is not symmetric."""

    kind: str
    k: Annotated[float, Unit("N/m")]
    symmetric: ClassVar[bool] = False

    def acting(self, equations):
        return SimpleNamespace(
            nodes=np.array([(1.0, 1.0, 1.0), (1.0, 0.0, 0.0)]),
            forces=lambda now: -now.numbers["k"] * now.state[::-1] * [[1], [0]],
            stiffness=lambda now: Entries.of(-now.numbers["k"] * np.eye(6, k=3)),
            by_number=lambda now: {"k": -now.state[::-1] * [[1], [0]]},
        )


@pytest.mark.fem
def test_derivatives_where_the_stiffness_is_not_symmetric():
    drawn = {"kind": "tests.forward.fem.test_items.Drawn", "name": "drawn", "k": 5e2}
    model, point, found = solved(cube(CABLE, drawn), (*NAMES, "loads.drawn.k"))
    assert not model.equations.symmetric
    assert found.stability == Stability.COUNTED
    stiffness = model.equations.sparse_stiffness().toarray()
    asymmetric = stiffness - stiffness.T
    assert np.count_nonzero(np.abs(asymmetric) > 1e-6) == 6  # three entries and their reflections
    check_derivatives(model, point, 1e-2 * point, steps=STEPS).require()


SCRIPT = """
import sys
import numpy as np
from mpi4py import MPI
from tests.forward.fem.test_items import CABLE, NAMES, OF_BRANCH, creeping, cube, solved

specs = {"cable": (cube(CABLE | {"slack": 0.9}), NAMES), "branch": (creeping(), OF_BRANCH)}
def solve(item, comm):
    model, point, found = solved(*specs[item], comm)
    state = comm.bcast(model.space.gather(found.state[None]))
    return found.outputs, state, found.tangent(np.eye(len(point))), found.adjoint(np.eye(len(found.outputs)))
for item in sys.argv[1:]:
    for one, other in zip(solve(item, MPI.COMM_WORLD), solve(item, MPI.COMM_SELF)):
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-9 * np.abs(other).max())
"""


@pytest.mark.slow
@pytest.mark.fem
@pytest.mark.mpi
@UP_TO_RANKS
def test_ranks_share_a_body_with_items(ranks):
    done = on_kept_ranks(ranks, SCRIPT, "cable", "branch")
    assert done.returncode == 0, done.stderr


@pytest.mark.fem
def test_what_an_item_cannot_have():
    spec = cube(CABLE)
    assert spec.unestimated_with == "'cable'"
    assert not spec.path_dependent
    _, _, found = solved(spec)
    for ask in (found.mesh_error, found.saturation, lambda: found.mesh_indicators(np.eye(3))):
        with pytest.raises(SolveError, match="the error of the mesh is not estimated with 'cable'"):
            ask()
    branched = {"name": "one", "clamp": ("x-min",), "loads": (BRANCH | {"time": 0.0},)}
    with pytest.raises(ValidationError, match="a specimen remembers nothing yet"):
        Specimen(body=spec.body, material=MATERIAL, cases=(branched,))
    assert list(mistakes(spec)) == [
        "the load 'cable' is no form and cannot be reduced, expected loads that are written as forms"
    ]
    with pytest.raises(ValidationError, match="not estimated with 'cable', expected neither"):
        cube(CABLE, adapt={"tolerance": 0.1})
    with pytest.raises(ModelError, match=r"the load 'cable' acts 1.* mm from the nearest node of the mesh"):
        solved(cube(CABLE | {"end": (0.9, 1.0, 1.0)}))
