"""Rigid tools: their distances, contact on tiny meshes against closed forms, derivatives, and what is refused."""

import numpy as np
import pytest
from mpi4py import MPI
from pydantic import ValidationError
from scipy.optimize import minimize

from benchmarks.half_spaces import CONTACT, TOOLS, Mesh, compared, half_space, pressed, textbook
from benchmarks.indentation import quarter
from benchmarks.indentations import contact_values
from forward.conformance import check_derivatives
from forward.hyperelastic import Hyperelastic
from forward.model import Guess, ReferenceSolution, SolveError
from forward.terms import tools
from forward.terms.indenter import Indenter
from tests.bodies import energy_density
from tests.launch import UP_TO_RANKS, on_kept_ranks
from tests.steps import STEPS

SIDE = 20e-3
C1, D1 = 1e3, 2e3
SPHERE = {"shape": "sphere", "radius": 5e-3, "depth": 1e-3}
PLANE = {"shape": "plane", "depth": 2e-3}
SHAPES = {
    "sphere": SPHERE,
    "flat": {"shape": "flat", "radius": 5e-3, "edge": 5e-4, "depth": 1e-3},
    "cylinder": {"shape": "cylinder", "radius": 5e-3, "axis": (1.0, 0.0, 0.0), "depth": 1e-3},
    "cone": {"shape": "cone", "angle": 70.0, "tip": 4e-4, "depth": 1e-3},
    "plane": PLANE,
}
ON_ROLLERS = ({"on": "x-min", "x": 0.0}, {"on": "y-min", "y": 0.0}, {"on": "z-min", "z": 0.0})
OUTPUTS = (
    {"kind": "force", "name": "force"},
    {"kind": "force", "name": "across", "component": "x", "times": 4.0},
    {"kind": "reaction", "name": "below", "on": "z-min", "component": "z"},
    {"kind": "reaction", "name": "beside", "on": "x-min", "component": "x"},
    {"kind": "displacement", "name": "top", "at": (SIDE, SIDE, SIDE), "component": "z"},
)


def tool(**changes):
    return {
        "kind": "indenter",
        "on": "z-max",
        "at": (0.0, 0.0, SIDE),
        "direction": (0.0, 0.0, -1.0),
        **SPHERE,
        **changes,
    }


def body(*loads, cells=2, displacements=ON_ROLLERS, outputs=OUTPUTS, **changes):
    return Hyperelastic.model_validate(
        {
            "body": {
                "kind": "box",
                "size": (SIDE,) * 3,
                "cells": (cells,) * 3,
                "degree": 2,
                "grading": {"x-min": 4.0, "y-min": 4.0, "z-max": 4.0},
            },
            "material": {"kind": "neo-hookean", "C1": C1, "D1": D1},
            "formulation": "displacement",
            "displacements": displacements,
            "loads": loads,
            "outputs": outputs,
            **changes,
        }
    )


def only(shape, **changes):
    """A tool of a shape with the numbers of that shape alone."""
    numbers = {name: value for name, value in tool(**SHAPES[shape]).items() if value is not None}
    if shape in ("cone", "plane"):
        numbers.pop("radius")
    return {**numbers, **changes}


def profile(shape, rng):
    """Points on the surface of a tool, seen along its axis: distance across, and ahead of the tip (m)."""
    numbers = SHAPES[shape]
    match shape:
        case "sphere" | "cylinder":
            angle, back = rng.uniform(0, np.pi / 2, 4000), rng.uniform(0, 5e-3, 1000)
            radius = numbers["radius"]
            round_part = radius * np.array([np.sin(angle), np.cos(angle) - 1])
            return np.hstack([round_part, [np.full(1000, radius), -radius - back]])
        case "flat":
            radius, edge = numbers["radius"], numbers["edge"]
            angle, r, back = (
                rng.uniform(0, np.pi / 2, 3000),
                rng.uniform(0, radius - edge, 3000),
                rng.uniform(0, 5e-3, 3000),
            )
            corner = [radius - edge + edge * np.sin(angle) ** (2 / 3), edge * np.cos(angle) ** (2 / 3) - edge]
            return np.hstack([corner, [r, np.zeros(3000)], [np.full(3000, radius), -edge - back]])
        case "cone":
            angle, tip = np.radians(numbers["angle"]), numbers["tip"]
            r = rng.uniform(0, 2e-2, 9000) ** 2 / 2e-2
            ahead = tip / np.tan(angle) ** 2
            return np.array([r, ahead - np.hypot(r / np.tan(angle), ahead)])
        case _:
            return np.array([rng.uniform(0, 2e-2, 9000), np.zeros(9000)])


@pytest.mark.parametrize("shape", SHAPES)
def test_distances_are_those_to_the_nearest_point_of_the_surface(shape):
    rng = np.random.default_rng(1)
    indenter = Indenter.model_validate(only(shape, direction=(0.0, 3.0, -4.0), at=(1e-3, 2e-3, 3e-3)))
    surface = profile(shape, rng)
    seen = np.array([rng.uniform(0, 8e-3, 50), rng.uniform(-2e-3, 3e-3, 50)])
    nearest = np.linalg.norm(surface[:, :, None] - seen[:, None, :], axis=0).min(axis=0)
    d = np.array([0, 0.6, -0.8])
    side = np.cross(d, [1.0, 0, 0]) if shape == "cylinder" else np.array([1.0, 0, 0])
    side /= np.linalg.norm(side)
    points = np.array(indenter.at) + np.outer(seen[1] + indenter.depth, d) + np.outer(seen[0], side)
    gaps = indenter.gaps(points)
    np.testing.assert_allclose(np.abs(gaps), nearest, atol=4e-5, rtol=0.12 if shape in ("flat", "cone") else 2e-3)
    assert (gaps[seen[1] > 0] > 0).all()
    on_surface = np.array(indenter.at) + np.outer(surface[1] + indenter.depth, d) + np.outer(surface[0], side)
    np.testing.assert_allclose(indenter.gaps(on_surface), 0, atol=1e-12)


@pytest.mark.unit
def test_the_pressure_is_the_slope_of_the_energy_and_smooth():
    gap = np.linspace(-3, 2, 5001)
    of = (tools.NUMPY, gap, 2.0, 1.0)
    np.testing.assert_allclose(-np.gradient(tools.energy(*of), gap)[1:-1], tools.pressure(*of)[1:-1], atol=1e-5)
    slope = -np.gradient(tools.pressure(*of), gap)
    np.testing.assert_allclose(slope, 2.0 * tools.contact(tools.NUMPY, gap, 1.0), atol=2e-3)
    np.testing.assert_allclose(tools.pressure(*of)[gap < -0.5], -2.0 * gap[gap < -0.5])
    assert (tools.pressure(*of)[gap > 0.5] == 0).all()


def uniaxial(stretch):
    """Nominal stress (Pa) of a column whose sides are free."""
    import sympy as sp

    across, along = sp.symbols("a b", positive=True)
    density = energy_density("neo-hookean", sp.diag(across, across, along), C1=C1, D1=D1)
    W = sp.lambdify((across, along), density)
    ends = [minimize(lambda x, s=s: W(x[0], s), [1.0], tol=1e-14).fun for s in (stretch + 1e-4, stretch - 1e-4)]
    return (ends[0] - ends[1]) / 2e-4


@pytest.mark.fem
def test_a_plane_compresses_a_column_homogeneously():
    """The patch test of contact."""
    found = body(only("plane")).build(MPI.COMM_SELF, ()).solve(np.zeros(0))
    force, across, below, beside, top = found.outputs
    assert force == pytest.approx(-uniaxial(0.9) * SIDE**2, rel=2e-3)  # less by the penetration
    assert top == pytest.approx(-2e-3, rel=1e-3)
    assert below == pytest.approx(force, rel=1e-8)
    assert abs(across) < 1e-12
    assert abs(beside) < 1e-7 * force


@pytest.mark.fem
def test_forces_balance_and_contact_is_from_one_side():
    spec = body(tool(at=(4e-3, 3e-3, SIDE)))
    model = spec.build(MPI.COMM_SELF, ("loads.indenter.depth", "loads.indenter.z"))
    found = model.solve(np.array([1e-3, SIDE]))
    force, across, below, beside, _ = found.outputs
    assert force == pytest.approx(below, rel=1e-7)
    assert across == pytest.approx(-4 * beside, rel=1e-7)
    assert found.stability > 1  # negative eigenvalues were counted, and there are none
    away = model.solve(np.array([1e-3, SIDE + 1.5e-3]))
    np.testing.assert_allclose(away.outputs, 0, atol=1e-12)
    nearer = model.solve(np.array([1.5e-3, SIDE + 0.5e-3]))
    np.testing.assert_allclose(nearer.outputs, found.outputs, rtol=1e-9, atol=1e-15)


@pytest.mark.fem
@pytest.mark.parametrize("shape", ["sphere", pytest.param("flat", marks=pytest.mark.slow)])
def test_derivatives(shape):
    # Remainders are seen down to 1e-11 of the outputs: states are solved for further than that.
    spec = body(only(shape, at=(2e-3, 1e-3, SIDE)), solver={"tolerance": 1e-11})
    names = [f"loads.indenter.{name}" for name in ("depth", "x", "radius", "direction_x")] + ["material.C1"]
    values = np.array([spec.scalars[name].value for name in names])
    scale = np.array([1e-5, 1e-5, 1e-3 * values[2], 1e-3, 1e-3 * values[4]])
    model = spec.build(MPI.COMM_SELF, tuple(names))
    directions = np.array([[1.0, 0, 0, 0, 0], [0, 0.5, 0.5, 0, 0.5], [0, 0, 0, 1, 0]])
    # That of the direction of a punch has too small a range: points pass its edge (differences: below).
    count = 3 if shape == "sphere" else 2
    check_derivatives(model, values, scale, directions=directions[:count], steps=STEPS).require()
    slopes = model.solve(values).tangent(np.eye(len(names)))
    for k in (0, 3, 4) if shape == "sphere" else (0, 4):  # the depth, the direction and the stiffness
        step = np.eye(len(names))[k] * scale[k]
        ends = [model.solve(values + sign * step).outputs for sign in (1, -1)]
        np.testing.assert_allclose((ends[0] - ends[1])[0] / (2 * step[k]), slopes[k, 0], rtol=1e-4)


@pytest.mark.fem
@pytest.mark.parametrize("edge", [2.5e-4, 2e-3])  # below the distance of points of contact, and above
def test_the_slopes_of_a_punch_that_may_turn(edge):
    """By differences so small that few points pass its edge."""
    spec = body(only("flat", edge=edge, at=(2e-3, 1e-3, SIDE)))
    names = [f"loads.indenter.{name}" for name in ("depth", "direction_x", "direction_y", "radius")]
    values = np.array([spec.scalars[name].value for name in names])
    model = spec.build(MPI.COMM_SELF, tuple(names))
    found = model.solve(values)
    slopes = found.tangent(np.eye(4))[:, 0]
    np.testing.assert_allclose(found.adjoint(np.eye(len(model.outputs)))[0], slopes, rtol=1e-9)
    for k, step in enumerate([1e-6, 1e-5, 1e-5, 5e-8]):
        ends = [model.solve(values + sign * step * np.eye(4)[k]).outputs[0] for sign in (1, -1)]
        assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(slopes[k], rel=1e-4), names[k]


@pytest.mark.fem
def test_tools_are_made_stiffer_until_the_body_stays_out():
    """A tool is made for the constants as stated; a body that is much stiffer would enter it."""
    spec = body(tool())
    model = spec.build(MPI.COMM_SELF, ("material.C1", "material.D1"))
    assert model.solve(np.array([C1, D1])).stiffer == 1
    assert model.equations.penetrations()["indenter"] < 1e-3 * 1e-3
    stiff = model.solve(50 * np.array([C1, D1]))
    assert (
        stiff.stiffer > 1
    )  # the tool was made stiffer for this sample, and its derivatives are those of what it gives
    stiff.visit()
    assert model.equations.penetrations()["indenter"] < 1e-3 * 1e-3
    step = 50 * np.array([1e-3 * C1, 0])
    ends = [model.solve(50 * np.array([C1, D1]) + sign * step).outputs[0] for sign in (1, -1)]
    assert stiff.tangent(step)[0] == pytest.approx((ends[0] - ends[1]) / 2, rel=1e-4)
    with pytest.raises(SolveError, match=r"the body enters the tool 'indenter' by 0\.\d+ of its depth, where 0.001"):
        model.solve(1e4 * np.array([C1, D1]))


@pytest.mark.fem
def test_predictions_are_worth_no_more_than_newtons_method_takes():
    """A prediction that errs more than the state of the reference is not begun from, and no path to it is divided."""
    names = ("loads.indenter.depth", "material.C1")
    model = body(tool()).build(MPI.COMM_SELF, names)
    mean = np.array([1e-3, C1])
    at_mean = model.solve(mean)
    reference = ReferenceSolution(mean, at_mean.state)
    slopes = at_mean.state_tangent(np.eye(2))
    model.solve(mean, Guess(at_mean.state, reference))
    far = np.array([1.5e-3, C1])
    found = [
        model.solve(far, Guess(state, near))
        for state, near in (
            (at_mean.state + (far - mean) @ slopes, reference),
            (at_mean.state - (far - mean) @ slopes, reference),
            (at_mean.state, reference),
            (at_mean.state, None),
        )
    ]
    good, bad, still, newton = (solution.work for solution in found)
    assert bad.factorisations == still.factorisations <= newton.factorisations
    assert bad.back_substitutions == still.back_substitutions
    np.testing.assert_array_equal(found[1].state, found[2].state)
    np.testing.assert_allclose(found[0].outputs, found[3].outputs, rtol=1e-6, atol=1e-9)
    assert good.back_substitutions <= newton.back_substitutions + 8  # four corrections in vain


@pytest.mark.fem
@pytest.mark.parametrize(("depth", "force"), [(1e-3, 15.40374270e-3), (1.5e-3, 29.49819956e-3)])
def test_newtons_method_does_not_go_round_among_points_that_touch(depth, force):
    """A ball that is pressed in by half its radius at once: linearised at the state alone, points go to and fro."""
    pressed_in = {"shape": "sphere", "radius": 3e-3, "depth": depth}
    outputs = [{"name": "force", "kind": "force", "times": 4}]
    found = quarter(12e-3, (4, 4, 4), 6.0, pressed_in, outputs=outputs).build(MPI.COMM_SELF, ()).solve(np.zeros(0))
    assert found.outputs[0] == pytest.approx(force, rel=1e-7)
    assert found.work.load_steps == 0
    assert found.work.factorisations < 25


@pytest.mark.fem
def test_a_tool_is_linearised_where_the_last_step_was_to_lead():
    """A plane, 2 mm deep at rest: its law goes on as a pull on what was to be pressed and has left it by 1 mm."""
    equations = body(only("plane")).build(MPI.COMM_SELF, ()).equations
    equations.at_load(1.0)
    rest = np.zeros(equations.size)
    left, pressed_less = rest.copy(), rest.copy()
    left[2 : 3 * equations.nodes_owned : 3] = -3e-3
    pressed_less[2 : 3 * equations.nodes_owned : 3] = -1e-3
    pressed, off = (equations.residual(u).vector * equations.free_displacements for u in (rest, left))
    size = np.abs(pressed).max()
    np.testing.assert_allclose(off, 0, atol=1e-9 * size)
    for curved in (True, False):
        beyond = equations.factorise(left, curved=curved, last=(rest, rest))
        np.testing.assert_allclose(beyond, -0.5 * pressed, atol=1e-9 * size)
        for u, last in ((left, (left, rest)), (pressed_less, (rest, rest)), (rest, (rest, rest)), (left, None)):
            assert np.all(equations.factorise(u, curved=curved, last=last) == 0)


@pytest.mark.fem
def test_only_the_tool_that_nothing_touches_is_linearised_elsewhere():
    """Two planes, 2 mm and 4 mm deep at rest, over what has moved by 3 mm: only the first one draws it back."""
    planes = [only("plane") | {"name": name, "depth": depth} for name, depth in (("near", 2e-3), ("far", 4e-3))]
    two, one = (body(*loads, outputs=OUTPUTS[2:]).build(MPI.COMM_SELF, ()).equations for loads in (planes, planes[:1]))
    found = []
    for equations in (two, one):
        equations.at_load(1.0)
        rest = np.zeros(equations.size)
        left = rest.copy()
        left[2 : 3 * equations.nodes_owned : 3] = -3e-3
        found.append(equations.factorise(left, last=(rest, rest)))
    np.testing.assert_allclose(*found, atol=1e-9 * np.abs(found[1]).max())
    assert np.abs(found[1]).max() > 0


@pytest.mark.fem
def test_contact_is_complementary():
    """At quadrature points: p ≥ 0, no gap below the aim, and p g = 0 up to it."""
    model = body(tool(at=(4e-3, 3e-3, SIDE), depth=2e-3)).build(MPI.COMM_SELF, ())
    model.solve(np.zeros(0)).visit()
    pressure, gap = contact_values(model.equations, "indenter")().T
    assert (pressure >= 0).all()
    assert pressure.max() > 100
    assert gap.min() > -1e-3 * 2e-3
    assert np.abs(pressure * gap).max() < 1e-3 * 2e-3 * pressure.max()
    assert (pressure[gap > 1e-4 * 2e-3] == 0).all()


@pytest.mark.fem
def test_a_tool_between_the_points_that_are_looked_at_is_no_silent_zero():
    """A needle that hits no quadrature point."""
    needle = only("cone", angle=5.0, tip=1e-6, depth=2e-4, at=(7.1e-3, 6.3e-3, SIDE))
    with pytest.raises(SolveError, match="enters the body between the points at which contact is looked for"):
        body(needle).build(MPI.COMM_SELF, ()).solve(np.zeros(0))


@pytest.mark.fem
def test_a_body_rests_on_a_table():
    """Nothing else holds it up; what lies at the edges would lift off, were it glued."""
    table = {"kind": "indenter", "name": "table", "shape": "plane", "on": "z-min", "at": (0.0, 0.0, 0.0)}
    table |= {"direction": (0.0, 0.0, 1.0), "depth": 0.0}
    weight = {"kind": "gravity", "density": 1000.0}
    outputs = ({"kind": "force", "name": "force", "tool": "table"}, OUTPUTS[-1])
    spec = body(table, weight, displacements=ON_ROLLERS[:2], outputs=outputs)
    force, top = spec.build(MPI.COMM_SELF, ()).solve(np.zeros(0)).outputs
    assert force == pytest.approx(1000 * 9.81 * SIDE**3, rel=1e-7)
    assert -5e-4 < top < -1e-4


@pytest.mark.fem
def test_two_tools_squeeze_a_body_between_them():
    upper, lower = tool(name="upper"), tool(name="lower", on="z-min", at=(0.0, 0.0, 0.0), direction=(0.0, 0.0, 1.0))
    outputs = tuple({"kind": "force", "name": name, "tool": name} for name in ("upper", "lower"))
    spec = body(upper, lower, displacements=ON_ROLLERS[:2], outputs=outputs, cells=3)
    above, below = spec.build(MPI.COMM_SELF, ()).solve(np.zeros(0)).outputs
    assert above == pytest.approx(below, rel=1e-7)
    assert above > 1e-3


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"at": (0.0, 0.0, SIDE - 2e-3)}, "the tool starts inside the body, 0.002 m deep at 'z-max'"),
        ({"direction": (0.0, 0.0, 1.0)}, "behind its tip"),
        ({"at": (0.0, 0.0, 2 * SIDE)}, "does not reach 'z-max': at its depth, 0.019 m are left"),
        ({"depth": 0.03}, r"as deep as the body is thick there \(0.02 m\)"),
        ({"depth": -1e-3}, "greater than or equal to 0"),
        ({"friction": -0.1}, "greater than or equal to 0"),
        ({"increments": 4}, "increments are there for friction"),
        ({"radius": None}, "a tool with shape = 'sphere' needs radius"),
        ({"edge": 1e-3}, "a tool with shape = 'sphere' has no edge"),
        ({"shape": "cylinder", "axis": (0.0, 0.0, 2.0)}, "lies along its direction"),
        ({"on": "z-mx"}, "did you mean 'z-max'"),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(changes, said):
    with pytest.raises(ValidationError, match=said):
        body({name: value for name, value in tool(**changes).items() if value is not None})


@pytest.mark.fem
def test_where_a_tool_stops_is_said_in_millimetres():
    few = {"iterations": 1, "minimum_load_step": 0.5}
    spec = body(tool(name="ball", depth=2e-3), outputs=OUTPUTS[2:], solver=few)
    with pytest.raises(
        SolveError, match=r"^stopped at 50 % of the load \(tool 'ball' at 1 of 2 mm\): no convergence in"
    ):
        spec.build(MPI.COMM_SELF, ()).solve(np.zeros(0))


@pytest.mark.unit
def test_a_tool_does_not_hold_what_it_pushes_away():
    with pytest.raises(ValidationError, match="nothing holds the body along z"):
        body(tool(), displacements=ON_ROLLERS[:2])


@pytest.mark.unit
def test_the_force_of_an_unknown_tool():
    output = {"kind": "force", "name": "F", "tool": "punch"}
    with pytest.raises(ValidationError, match="unknown tool; expected one of: indenter"):
        body(tool(), outputs=(output,))
    with pytest.raises(ValidationError, match="unknown tool; no load is an indenter"):
        body(outputs=(output,))
    with pytest.raises(ValidationError, match=r"which tool\? expected one of: ball"):
        body(tool(name="ball"), outputs=({"kind": "force", "name": "F"},))


@pytest.mark.unit
@pytest.mark.parametrize(
    "held",
    [
        {"clamp": ("z-max",)},
        {"displacements": (*ON_ROLLERS, {"on": "z-max", "z": -1e-3})},
    ],
)
def test_a_tool_does_not_press_on_what_is_held(held):
    with pytest.raises(ValidationError, match="this boundary is held where the tool presses on it"):
        body(tool(), **held)
    aside = {
        "displacements": (*ON_ROLLERS[:2], {"on": "z-min", "x": 0.0, "y": 0.0, "z": 0.0}, {"on": "z-max", "x": 0.0})
    }
    assert body(tool(), **aside)


@pytest.mark.parametrize(
    ("name", "ends", "said"),
    [
        ("x", (-0.05, 0.05), "stays 4.52 cm off the body, and its force is 0: at x = -0.05."),
        ("z", (0.015, SIDE), "starts 5 mm inside the body, which counts as a deeper push: at z = 0.015."),
        ("depth", (1e-3, 0.03), "goes 1 cm through the body, for which there is no answer: at depth = 0.03."),
        ("direction_z", (-1.0, 1.0), "points away from the body, in which it starts: at direction_z = 1."),
    ],
)
def test_samples_that_a_tool_does_not_suit_are_said_before(name, ends, said):
    spec = body(tool(at=(4e-3, 4e-3, SIDE)))
    path = f"loads.indenter.{name}"
    texts = [one.text for one in spec.findings_over({path: ends})]
    assert any(text == f"In some samples loads.indenter {said}" for text in texts), texts
    near = spec.scalars[path].value
    assert not any("In some samples" in one.text for one in spec.findings_over({path: (0.98 * near, 1.02 * near)}))


@pytest.mark.unit
def test_a_tool_sharper_than_the_mesh_is_said_to_be():
    texts = [finding.text for finding in body(tool(radius=1e-3, depth=1e-4)).findings]
    assert any("below the edges of the cells there" in text for text in texts)
    assert not body(tool(radius=1.0, depth=1e-3)).findings
    assert any("is rounded over 100 µm" in f.text for f in body(only("flat", edge=1e-4)).findings)
    assert not body(only("flat", radius=8e-3, edge=4e-3)).findings


@pytest.mark.unit
def test_words():
    words = body(tool()).loads[0].words({name: f"<{name}>" for name in body(tool()).loads[0].scalars})
    expected = "indenter on z-max: rigid sphere, radius <radius>; moved by <depth> along (0, 0, -1)"
    assert words.startswith(expected)


@pytest.mark.fem
def test_a_singular_stiffness_is_not_remembered():
    """MUMPS has failed once; the next factorisation is another one."""
    model = body(only("plane")).build(MPI.COMM_SELF, ())
    before = model.solve(np.zeros(0)).outputs
    with pytest.raises(SolveError, match="singular"):
        model.equations.factorise(np.full(model.equations.size, np.nan))
    np.testing.assert_allclose(model.solve(np.zeros(0)).outputs, before, rtol=1e-9, atol=1e-15)


@pytest.mark.fem
@pytest.mark.parametrize(
    ("shape", "mesh", "error"),
    [
        ("cone", (40.0, 0.4, 2.0), 0.045),
        pytest.param("sphere", (160.0, 0.2, 1.6), 0.02, marks=pytest.mark.slow),
        pytest.param("cone", (160.0, 0.2, 1.6), 0.02, marks=pytest.mark.slow),
        pytest.param("flat", (160.0, 0.2, 1.6), 0.02, marks=pytest.mark.slow),
    ],
)
def test_closed_forms_of_a_half_space(shape, mesh, error):
    """The body is finite and its cells are too stiff: forces are too large, by less where it is larger or finer."""
    found = compared(shape, Mesh(*mesh))
    assert 0 < found.own - 1 < error
    assert found.penetration < 1e-3


def test_closed_forms_of_profiles_tend_to_those_of_the_textbook():
    """Where edges and tips are sharp; Hertz's sphere is a paraboloid."""
    for shape in TOOLS:
        ideal = pressed(shape)
        sharper = {name: getattr(ideal, name) / 50 for name in ("edge", "tip") if getattr(ideal, name)}
        found = half_space(ideal.model_copy(update=sharper), 3e3)
        assert found.force == pytest.approx(textbook(shape, 3e3), rel=3e-3), shape
        assert found.radius == pytest.approx(CONTACT, rel=3e-3), shape


SHARED = """
import numpy as np
from mpi4py import MPI
from tests.forward.terms.test_indenter import ON_ROLLERS, SIDE, body, only, tool
from tests.ranks import groups

names = [f"loads.ball.{name}" for name in ("depth", "x", "direction_x")] + ["material.C1"]
table = only("plane", name="table", on="z-min", at=(0.0, 0.0, 0.0), direction=(0.0, 0.0, 1.0), depth=5e-4)
outputs = (
    {"kind": "force", "name": "force", "tool": "ball"},
    {"kind": "force", "name": "across", "tool": "ball", "component": "x"},
    {"kind": "force", "name": "below", "tool": "table"},
    {"kind": "contact-area", "name": "area", "tool": "ball"},
    {"kind": "max-pressure", "name": "pressure", "tool": "ball"},
)
spec = body(tool(name="ball", at=(4e-3, 3e-3, SIDE)), table, displacements=ON_ROLLERS[:2], outputs=outputs)
values = np.array([spec.scalars[name].value for name in names])
first = None
for comm in groups():
    model = spec.build(comm, tuple(names))
    solution = model.solve(values)
    states = comm.bcast(model.space.gather(solution.state[None]))
    touched = solution.visit().touched()
    found = [
        solution.outputs,
        solution.tangent(np.eye(4)),
        solution.adjoint(np.eye(5)),
        states,
        np.array(list(model.equations.penetrations().values())),
        *(rows[np.lexsort(np.round(rows[:, :3], 9).T), 3] for rows in (touched["ball"], touched["table"])),
    ]
    if first is None and comm.rank == 0:
        first = found
        assert solution.outputs[0] > 0.01
    if comm.rank == 0:
        for k, (one, other) in enumerate(zip(first, found, strict=True)):
            scale = np.abs(one).max(axis=0)
            np.testing.assert_allclose(other / scale, one / scale, atol=1e-7, err_msg=f"{k} on {comm.size} ranks")
"""


@pytest.mark.slow
@pytest.mark.fem
@pytest.mark.mpi
@UP_TO_RANKS
def test_ranks_share_a_body_between_two_tools(ranks):
    done = on_kept_ranks(ranks, SHARED)
    assert done.returncode == 0, done.stdout + done.stderr
