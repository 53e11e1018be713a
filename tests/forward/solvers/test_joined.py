"""Answers are the equilibria that raising the loads from zero leads to, whatever else is stable."""

from dataclasses import replace

import meshio
import numpy as np
import pytest
from mpi4py import MPI

from forward.hyperelastic import Hyperelastic
from forward.model import WORK, Guess, ReferenceSolution, SolveError
from forward.pointwise import FunctionModel
from forward.solvers import newton as newtons
from forward.solvers.acceptance import Diverged, Search
from forward.solvers.joined import same
from uq.estimators import failure_domain
from uq.evaluation.block import BlockSolver
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Request, audited
from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs
from uq.surrogates.linearisation import linearise

SIZE = "loads.traction.size"
MATERIALS = {
    "demiray": ({"a": 1600.0, "b": 5.0, "D1": 2e4}, 3.15e4),
    "yeoh": ({"C10": 1e3, "C20": 100.0, "C30": 500.0, "D1": 2e4}, 8e3),
    "gent": ({"mu": 2e3, "Jm": 2.0, "D1": 2e4}, 1.2e4),
    "mooney-rivlin": ({"C1": 800.0, "C2": 200.0, "D1": 2e4}, 4e3),
    "neo-hookean": ({"C1": 1e3, "D1": 2e4}, 4e3),
    "ogden": (
        {"mu1": 1e3, "alpha1": 2.0, "mu2": 400.0, "alpha2": 9.0, "mu3": 200.0, "alpha3": -2.0, "D1": 2e4},
        4e4,
    ),
}
ROLLERS = ({"on": "x-min", "x": 0.0}, {"on": "y-min", "y": 0.0}, {"on": "z-min", "z": 0.0})


def block(material, form, **changes):
    numbers, load = MATERIALS[material]
    return Hyperelastic.model_validate(
        {
            "body": {"size": (0.1, 0.1, 0.1), "cells": (1, 1, 1)},
            "material": {"kind": material, **numbers},
            "formulation": form,
            "displacements": ROLLERS,
            "loads": ({"kind": "traction", "on": "x-max", "direction": (1.0, 0.0, 0.0), "size": load},),
            "outputs": (
                {"kind": "mean-displacement", "name": "ux", "on": "x-max", "component": "x"},
                {"kind": "mean-displacement", "name": "uy", "on": "y-max", "component": "y"},
            ),
        }
        | changes
    )


def alone(spec):
    return spec.build(MPI.COMM_SELF, (SIZE,))


PLAIN = ("demiray", "neo-hookean")  # by Newton's method alone the others go the same way


@pytest.mark.slow
@pytest.mark.fem
@pytest.mark.parametrize("form", ["mixed", "displacement"])
@pytest.mark.parametrize(
    ("material", "kind"),
    [
        *((material, "predict-correct") for material in MATERIALS),
        *((material, "newton") for material in PLAIN),
        *(pytest.param(name, "newton", marks=pytest.mark.slow) for name in MATERIALS if name not in PLAIN),
    ],
)
def test_a_block_between_rollers_is_not_turned_through_its_planes(material, form, kind):
    model = alone(block(material, form, solver={"kind": kind}))
    load = MATERIALS[material][1]
    found = model.solve(np.array([load]))
    ux, uy = found.outputs
    assert ux > 0.03  # a stretch of more than 1.3
    assert -0.05 < uy < 0  # turned, it would be below −0.1
    assert found.work.snaps == 0


@pytest.mark.fem
def test_a_turned_state_is_recognised_wherever_it_comes_from():
    model = alone(block("demiray", "mixed"))
    point = np.array([3.15e4])
    right = model.solve(point)
    equations = model.equations
    equations.set_parameters(point)
    turned, _ = newtons.newton(Search(equations, model.spec.solver), np.zeros(equations.size), 1.0)
    assert turned.stability == 2  # stable, and an equilibrium
    assert equations.crossed(turned.state)
    assert not equations.crossed(right.state)
    angle = equations.angle(equations.rotations(right.state), equations.rotations(turned.state))
    assert angle == pytest.approx(np.pi, abs=1e-3)
    reference = ReferenceSolution(point, np.array(right.state))
    for guess in (
        Guess(turned.state),
        Guess(turned.state, reference),
        Guess(turned.state, ReferenceSolution(point, turned.state, joined=False)),
    ):
        found = model.solve(point, guess)
        assert same(equations, found.state, right.state)
        assert (found.work.others, found.work.calls) == (1, 1)
        assert found.work.audit_residuals > 0


# --- bodies that buckle to the side to which they are pushed --------------------------------------------------------


def small_steps(model, point, count=32):
    """Raise the loads by small steps of Newton's method from the last state."""
    equations, state = model.equations, np.zeros(model.equations.size)
    equations.linearisation_point.begin()
    equations.set_parameters(point)
    for k in range(1, count + 1):
        state = newtons.newton(Search(equations, model.spec.solver), state, k / count)[0].state
    return state


@pytest.mark.slow
@pytest.mark.fem
@pytest.mark.parametrize(
    ("body", "form"),
    [
        ("column", "displacement"),
        ("plate", "mixed"),
        pytest.param("column", "mixed", marks=pytest.mark.slow),
        pytest.param("plate", "displacement", marks=pytest.mark.slow),
    ],
)
def test_a_body_buckles_to_the_side_to_which_it_is_pushed(body, form):
    """It stays on the other one where the push is reversed only once it has buckled, as a path from a reference is."""
    column = body == "column"
    aside = {"kind": "traction", "name": "aside", "on": "x-max", "direction": (0.0, 1.0, 0.0), "size": 0.5}
    push = {"kind": "traction", "name": "push", "on": "x-max", "direction": (-1.0, 0.0, 0.0), "size": 140.0}
    under = {"kind": "pressure", "name": "aside", "on": "y-min", "size": 5.0}
    spec = Hyperelastic.model_validate(
        {
            "body": {"size": (1.0, 0.1, 0.1) if column else (1.0, 0.06, 0.3), "cells": (6, 1, 1)},
            "material": {"kind": "neo-hookean", "C1": 1e4, "D1": 1e5},
            "formulation": form,
            "clamp": ("x-min",),
            "displacements": () if column else ({"on": "x-max", "x": -0.02, "y": 0.0, "z": 0.0},),
            "loads": (push, aside) if column else (under,),
            "outputs": ({"kind": "mean-displacement", "name": "uy", "on": "y-max", "component": "y"},),
        }
    )
    main, to = ("loads.push.size", 140.0) if column else ("displacements.x-max.x", -0.02)
    limits = (-0.6, 1.6) if column else (-5.0, 15.0)
    inputs = Inputs(
        {
            main: Uniform(lower=min(0.95 * to, 1.05 * to), upper=max(0.95 * to, 1.05 * to)),
            "loads.aside.size": Uniform(lower=limits[0], upper=limits[1]),
        }
    )
    model = spec.build(MPI.COMM_SELF, inputs.names)
    guess = linearise(inputs, SerialEvaluate(model)).prediction.on(model)
    points = to * np.array([[1, 0], [1, 0], [1, 0]]) + np.outer([0.5, 0.2, -0.2], [0.0, limits[1]])
    many = list(model.solve_many(points, map(guess, points)))
    for point, one in zip(points, many, strict=True):
        assert one.outputs[0] * point[1] > 0
        assert same(model.equations, one.state, small_steps(model, point))
    assert [one.work.others for one in many] == [0, 0, 1]
    if body == "column":  # hardly pushed aside, it moves by most of its way within a step
        with pytest.raises(SolveError, match=r"of the way: the body buckles, snaps, or bends too sharply"):
            model.solve(np.array([to, 0.001]))


# --- an arch that snaps ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def arch(tmp_path_factory):
    """A clamped shallow arch of a row of hexahedra, loaded on its crown, in the displacement form."""
    n, rise, thick, width = 10, 0.085, 0.045, 0.1
    s = np.linspace(0, 1, n + 1)
    points = [(x, 4 * rise * x * (1 - x) + thick * (j - 0.5), width * k) for x in s for j in (0, 1) for k in (0, 1)]

    def quad(i, which):
        return [4 * i + 2 * j + k for j, k in which]

    around = ((0, 0), (1, 0), (1, 1), (0, 1))
    cells = [[c for k in (0, 1) for c in (4 * e + k, 4 * e + 4 + k, 4 * e + 6 + k, 4 * e + 2 + k)] for e in range(n)]
    crown = [[4 * e + 2, 4 * e + 6, 4 * e + 7, 4 * e + 3] for e in (n // 2 - 1, n // 2)]
    parts = [np.full(n, 9), np.array([1, 1, 2, 2])]
    path = tmp_path_factory.mktemp("arch") / "arch.vtu"
    quads = [quad(0, around), quad(n, around), *crown]
    meshio.Mesh(points, [("hexahedron", cells), ("quad", quads)], cell_data={"part": parts}).write(path)
    return Hyperelastic.model_validate(
        {
            "body": {
                "kind": "mesh",
                "file": str(path),
                "degree": 2,
                "names": {"ends": 1, "crown": 2, "body": 9},
            },
            "material": {"kind": "mooney-rivlin", "C1": 8e3, "C2": 2e3, "D1": 1e4},
            "formulation": "displacement",
            "clamp": ("ends",),
            "loads": ({"kind": "traction", "on": "crown", "direction": (0.0, -1.0, 0.0), "size": 45.0},),
            "outputs": ({"kind": "mean-displacement", "name": "sag", "on": "crown", "component": "y"},),
        }
    )


@pytest.fixture(scope="module")
def sags(arch):
    """How far the crown sags under each load, by small steps from rest, each by Newton's method from the last state."""
    model = alone(arch)
    equations, state, found = model.equations, np.zeros(model.equations.size), {}
    equations.linearisation_point.begin()
    equations.set_parameters(np.array([60.0]))
    for load in range(1, 61):
        try:
            state = newtons.newton(Search(equations, model.spec.solver), state, load / 60)[0].state
        except Diverged:
            continue  # just beyond the limit
        equations.set_state(state)
        found[load] = model.functionals[0].value()
    return found


@pytest.mark.few(1)
@pytest.mark.fem
@pytest.mark.parametrize("mean", [15.0, 50.0])
def test_an_arch_snaps_where_raising_the_load_makes_it(arch, sags, mean):
    """From a reference before the jump and from one beyond it, alone and in lockstep."""
    model = alone(arch)
    loads = np.array(list(sags))
    steps = np.abs(np.diff(list(sags.values())))
    limit = loads[np.argmax(steps)]
    assert steps.max() > 10 * np.median(steps)
    assert 15 < limit < 40
    points = np.array([[5.0], [limit - 8], [limit - 2], [limit + 4], [58.0]])
    inputs = Inputs({SIZE: Uniform(lower=mean - 10, upper=mean + 10)})
    guess = linearise(inputs, SerialEvaluate(model)).prediction.on(model)
    assert guess(points[0]).reference.joined == (mean < limit)
    for many in (list(model.solve_many(points, map(guess, points))), [model.solve(p, guess(p)) for p in points]):
        for (load,), one in zip(points, many, strict=True):
            assert one.outputs[0] == pytest.approx(sags[load], rel=1e-5)
            assert one.work.snaps == (load > limit)
        others = sum(one.work.others for one in many)
        assert others > 0 if mean > limit else others == 0


@pytest.mark.slow
@pytest.mark.fem
def test_just_beyond_the_end_of_the_branch_the_body_jumps(arch):
    """Where no equilibrium is near and residuals are small all the same."""
    model = alone(arch)
    equations, settings, most = model.equations, model.spec.solver, 60.0
    state, load, step = np.zeros(equations.size), 0.0, 1 / 64
    equations.linearisation_point.begin()
    equations.set_parameters(np.array([most]))
    while step > 1e-5:
        try:
            found = newtons.newton(Search(equations, settings), state, load + step, near=True)[0]
        except Diverged:
            step /= 2
        else:
            state, load = found.state, load + step
    assert 15 < most * load < 40
    above = model.solve(np.array([1.3 * load * most]))
    for more in (1e-3, 2e-3):
        one = model.solve(np.array([(1 + more) * load * most]))
        assert one.work.snaps == 1
        equations.linearisation_point.begin()
        there = newtons.newton(Search(equations, settings), above.state, 1.0)[0].state  # down from above
        assert same(equations, one.state, there)


@pytest.mark.fem
def test_fibres_that_carry_only_tension_are_no_jump():
    """Their tangent at rest predicts no load step, however short; the tangent beside rest does."""
    numbers = {"c": 1e4, "k1": 2e4, "k2": 1.5, "D1": 1e5, "fibres": ((1.0, 0.5, 0.0), (1.0, -0.5, 0.0))}
    spec = Hyperelastic.model_validate(
        {
            "body": {"size": (0.06, 0.02, 0.01), "cells": (3, 1, 2)},
            "material": {"kind": "holzapfel-gasser-ogden", **numbers},
            "clamp": ("x-min",),
            "loads": ({"kind": "gravity", "direction": (0.0, 0.0, -1.0), "density": 150.0},),
            "outputs": ({"kind": "mean-displacement", "name": "sag", "on": "x-max", "component": "z"},),
        }
    )
    inputs = Inputs({"material.k1": Uniform(lower=1.5e4, upper=2.5e4)})
    model = spec.build(MPI.COMM_SELF, inputs.names)
    centre = linearise(inputs, SerialEvaluate(model))
    guess = centre.prediction.on(model)
    first = model.solve(np.array([2e4]))
    assert guess(np.array([2e4])).reference.joined
    assert first.work.snaps == 0
    assert same(model.equations, first.state, small_steps(model, np.array([2e4]), 8))
    for point in np.array([[1.6e4], [2.4e4]]):
        one = model.solve(point, guess(point))
        assert (one.work.snaps, one.work.audits) == (0, 0)


# --- who is audited, and what is said of it --------------------------------------------------------------------------


@pytest.mark.unit
def test_audits_are_drawn_by_the_points_alone():
    points = np.random.default_rng(1).normal(size=(4000, 3))
    chosen = audited(points)
    drawn = np.array([chosen(point) for point in points])
    assert 0.002 < drawn.mean() < 0.01
    backwards = audited(points[::-1])
    assert [backwards(point) for point in points] == drawn.tolist()
    for n in (64, 65, 100):
        for k in range(20):
            some = points[k * n : (k + 1) * n]
            assert any(map(audited(some), some))
    few = points[:63]
    assert list(map(audited(few), few)) == drawn[:63].tolist()


@pytest.mark.fem
def test_what_is_drawn_is_followed_from_the_reference():
    model = alone(block("neo-hookean", "displacement"))
    inputs = Inputs({SIZE: Uniform(lower=3.6e3, upper=4.4e3)})
    centre = linearise(inputs, SerialEvaluate(model))
    points = np.linspace(3.6e3, 4.4e3, 64)[:, None]
    found = BlockSolver(model, Request(points, start=centre.prediction))(points, lambda done, failed: None)
    drawn = [audited(points)(point) for point in points]
    assert sum(drawn) >= 1
    np.testing.assert_array_equal(found.counted("audits"), drawn)
    assert found.counted("screens").all()
    assert not found.counted("calls").any()
    assert not found.counted("audit_factorisations").any()  # Lanczos' process tells
    assert found.joined.all()
    counts = failure_domain.joined_counts([found])
    assert (counts["audited"], counts["screened"]) == (sum(drawn), 64 - sum(drawn))
    assert not list(failure_domain.of_jumps([found], inputs))


@pytest.mark.unit
def test_jumps_are_said_with_their_share():
    points = np.linspace(20, 70, 20)[:, None]
    inputs = Inputs({SIZE: Uniform(lower=20, upper=70)})
    made = SerialEvaluate(FunctionModel(lambda x: x, (SIZE,), ("sag",)))(Request(points))
    work = np.zeros((20, len(WORK)), dtype=np.int64)
    work[points[:, 0] > 50, WORK.index("snaps")] = 1
    work[3:5, WORK.index("others")] = 1
    work[:, WORK.index("screens")] = 1
    made = replace(made, work=work)
    jumped, other = failure_domain.of_jumps([made], inputs)
    assert jumped.severity == other.severity == "warning"
    assert "8 of 20 samples (40 %)" in jumped.text
    assert "all with loads.traction.size ≥ 51" in jumped.text
    assert "2 of 20 samples (10 %)" in other.text
    assert next(failure_domain.of_jumps([made], inputs, continued=True)).severity == "error"
    np.testing.assert_array_equal(failure_domain.joined_by_sample(points[[0, 3, 19]], made), [1, 3, 4])
    assert not list(
        failure_domain.of_jumps([replace(made, work=work[:, :5])], inputs)
    )  # what an earlier version has kept
