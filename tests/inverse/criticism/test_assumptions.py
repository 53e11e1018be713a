"""What is taken for granted: closed forms, inversions done again, numbers of one load case, points at a face."""

from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI

from benchmarks import assumptions as bench
from forward.bodies.geometry import AXES
from forward.findings import CATALOGUE
from forward.hyperelastic import Path
from forward.model import SolveError
from forward.pointwise import FunctionModel
from forward.specimen import Specimen
from inverse.criticism.assumptions import (
    PART,
    Assumption,
    Assumptions,
    Moved,
    bent,
    by_evaluation,
    findings,
    merged,
    moved_by,
    of_data,
    off,
    quantities,
)
from inverse.data.measurements import Measurements
from inverse.data.noise import Noise
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.methods.infer import Problem
from inverse.methods.invert_few import invert_few
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import LogUniform, Normal
from uq.inputs.random_parameters import Inputs
from workflows.studies.assumptions import TakenForGranted, Uncertain, of_numbers

RNG = np.random.default_rng(3)
A, B = RNG.standard_normal((8, 2)), RNG.standard_normal((8, 1))
INPUTS = Inputs({"a": Normal(mean=1.0, std=0.5), "b": Normal(mean=-1.0, std=2.0)})
NUMBERS = [Assumption("s", 0.03, "1", PART)]


def outputs(bend):
    """A model of a, b and s, bent in all of them, with its derivatives."""

    def values(p):
        return A @ p[:2] + B @ p[2:] + bend * (A[:, 0] * p[0] * p[1] + B[:, 0] * p[2] * p[0] ** 2)

    def slopes(p):
        by_p = A + bend * np.column_stack([A[:, 0] * p[1] + 2 * B[:, 0] * p[2] * p[0], A[:, 0] * p[0]])
        return np.hstack([by_p, B + bend * (B[:, 0] * p[0] ** 2)[:, None]])

    return values, slopes


def moved(bend, noise=None, s=3.0, dof=None, off=0.3):
    """How far the mode is said to move with s, and the mode itself for other s, of data that do not fit."""
    values, slopes = outputs(bend)
    names = tuple(map(str, range(8)))
    measured = values(np.array([1.2, -0.5, s])) + off * np.cos(np.arange(8))
    data = Measurements.of(measured, np.full(8, 0.3), [0] * 8, range(8), names)

    def at(number):
        one = FunctionModel(
            lambda p: values(np.append(p, number)), ("a", "b"), names, lambda p: slopes(np.append(p, number))[:, :2]
        )
        return Posterior(INPUTS, SerialEvaluate(one), data.values, Noise(data.sigma, dof, noise))

    posterior = at(s)
    gaussian = laplace(posterior, starts=1)
    whole = FunctionModel(values, ("a", "b", "s"), names, slopes)
    ask = by_evaluation(SerialEvaluate(whole))
    beside = of_data([data], {}, 0.0)
    assumed = Assumptions(data, NUMBERS, beside, np.array([s]), {}, ask)
    found = moved_by(posterior, gaussian, posterior.at(gaussian.mode[None], derivatives=True), assumed)
    return found, lambda number: laplace(at(number), starts=1), beside


@pytest.mark.unit
@pytest.mark.parametrize("bend", [0.0, 0.15])
@pytest.mark.parametrize("dof", [None, 5.0])
def test_answers_move_as_those_of_inversions_done_again(bend, dof):
    """Also where residuals are large and the model is bent in the number that is held."""
    found, again, beside = moved(bend, dof=dof)
    step = 1e-3
    ends = [again(3.0 + sign * step) for sign in (1, -1)]
    right = np.subtract(*(INPUTS.from_normals(one.mode[None])[0][0] for one in ends)) / (2 * step) * 0.03
    np.testing.assert_allclose(found.parameters[0], right, rtol=2e-3, atol=1e-6)
    added = (ends[0].log_posterior - ends[1].log_posterior) / (2 * step) * 0.03
    assert found.log_evidence[0] == pytest.approx(added, rel=1e-4)
    assert len(found.parameters) == 1 + len(beside) == 9


@pytest.mark.unit
def test_the_scale_of_the_data_in_closed_form():
    found, _, beside = moved(0.0)
    assert [one.name for one in beside] == [f"data.scale.{i}" for i in range(8)]
    std = INPUTS.std
    precision = A.T @ A / 0.09 + np.diag(std**-2.0)
    values = outputs(0.0)[0](np.array([1.2, -0.5, 3.0])) + 0.3 * np.cos(np.arange(8))
    right = [np.linalg.solve(precision, A[i] * values[i] * PART / 0.09) for i in range(8)]
    np.testing.assert_allclose(found.parameters[1:], right, rtol=1e-6, atol=1e-12)


@pytest.mark.unit
def test_the_size_of_the_errors_may_be_unknown():
    found, again, _ = moved(0.1, noise=LogUniform(lower=0.1, upper=10.0))
    ends = [again(3.0 + sign * 1e-3) for sign in (1, -1)]
    right = np.subtract(*(INPUTS.from_normals(one.mode[None, :2])[0][0] for one in ends)) / 2e-3 * 0.03
    np.testing.assert_allclose(found.parameters[0], right, rtol=0.05)


@pytest.mark.unit
def test_a_model_without_an_answer_says_nothing_and_stops_nothing():
    def lost(points, values, start):
        raise SolveError("no answer")

    data = Measurements.of(np.ones(2), np.ones(2), [0, 0], [0, 1], ["u", "v"])
    assumed = Assumptions(data, NUMBERS, of_data([data], {"u": "m"}, 0.0), np.ones(1), {"u": "m"}, lost)
    changes = assumed.changes(np.zeros((1, 2)), None)
    assert np.isnan(changes).all()
    uncertain = replace(assumed, groups={"s": np.eye(3)[0]}).shared
    with pytest.raises(SolveError, match="no answer"):  # without which nothing can be inferred
        uncertain(np.zeros(2))
    assert [one.name for one in assumed.all] == ["s", "data.scale.displacement", "data.scale.v"]


@pytest.mark.unit
def test_what_is_otherwise_and_by_how_much():
    gravity = {"kind": "gravity", "direction": [0, 0, -1], "density": 1000}
    tool = {"kind": "indenter", "shape": "sphere", "radius": 5e-3, "direction": [0, 0, -1], "depth": 1e-3}
    blocks = {
        "body": {"kind": "box", "size": [0.02, 0.04, 0.04], "cells": [1, 1, 1]},
        "material": {"kind": "neo-hookean", "C1": 1e3, "D1": 1e4},
        "inclusions": [{"name": "lump", "x": 0.01, "y": 0.0, "z": 0.02, "radius": 0.005, "contrast": 3, "width": 2e-3}],
        "cases": [
            {"name": "one", "clamp": ["z-min"], "loads": [gravity]},
            {"name": "two", "clamp": ["z-min"], "displacements": [{"on": "z-max", "x": 0, "z": -1e-3}]},
            {"name": "three", "clamp": ["z-min"], "loads": [tool | {"on": "z-max", "at": [0.01, 0.02, 0.04]}]},
        ],
    }  # fmt: skip
    found = {one.name: one for one in of_numbers(Specimen.model_validate(blocks).every_scalar, ["material.C1"], 0.04)}
    assert "material.C1" not in found
    assert found["material.D1"][1:] == (100.0, "Pa", PART)
    assert found["inclusions.lump.y"][1:] == (4e-4, "m", 0.0)  # a place, by a part of the body's size
    assert found["inclusions.lump.radius"].size == pytest.approx(5e-5)
    assert found["cases.one.loads.gravity.density"].size == 10.0
    assert found["cases.two.displacements.z-max.z"].size == pytest.approx(-1e-5)
    assert found["cases.two.displacements.z-max.x"].size == 0  # of which nothing is known
    assert found["cases.three.loads.indenter.z"][1:] == (4e-4, "m", 0.0)
    assert found["cases.three.loads.indenter.direction_z"][1:] == (PART, "1", 0.0)  # by an angle
    shared = of_numbers(Specimen.model_validate(blocks).every_scalar, ["loads.gravity.density"], 0.04)
    assert "cases.one.loads.gravity.density" not in {one.name for one in shared}


@pytest.mark.unit
def test_what_is_uncertain_together_is_told_of_together():
    sizes = [Assumption(f"cases.{case}.loads.traction.size", 10.0, "Pa", 0.05) for case in ("shear", "pull")]
    others = [Assumption("inclusions.lump.width", 1e-3, "m", 0.1), Assumption("data.shift.x", 1e-3, "m")]
    groups = {"loads.traction.size": np.array([1.0, 1, 0, 0]), "lump": np.array([0.0, 0, 1, 1])}
    shown, weights = merged([*sizes, *others], groups)
    assert list(map(str, shown)) == ["loads.traction.size is 5 % larger", "lump is 1 standard deviation larger"]
    np.testing.assert_array_equal(weights, [[1, 1, 0, 0], [0, 0, 1, 1]])
    shown, weights = merged([*sizes, *others], {"inclusions.lump.width": np.array([0.0, 0, 1, 0])})
    assert shown == [others[0], *sizes, others[1]]
    np.testing.assert_array_equal(weights, np.eye(4)[[2, 0, 1, 3]])
    assert str(Assumption("data.scale", 0.2, "1", 0.2)) == "data.scale is 20 % larger"


@pytest.mark.unit
def test_a_place_is_no_part_of_itself():
    """A relative deviation of a coordinate means nothing, and is refused; one of a radius is what it says."""
    spec, unknown = bench.cube_spec(1), ("material.mu",)
    for name, refused in (
        ("inclusions.lump.x", True),
        ("inclusions.lump.radius", False),
        ("loads.traction.size", False),
    ):
        taken = TakenForGranted(spec, unknown, (), {name: Uncertain(relative=0.1)})
        assert [place for place, _, _ in taken.mistakes()] == ([("uncertain", name)] if refused else [])
    (radius,) = (one for one in taken.numbers if one.name == "inclusions.lump.radius")
    assert radius.size == pytest.approx(0.01 * 0.014)
    both = [one.size for one in taken.numbers if one.name.endswith("traction.size")]
    assert both == pytest.approx([15.0, 20.0])
    np.testing.assert_array_equal(
        taken.groups["loads.traction.size"], [one.name.endswith("traction.size") for one in taken.all]
    )


@pytest.mark.unit
@pytest.mark.parametrize(
    ("name", "few", "field"),
    [("loads.traction.size", False, True), ("data.scale", True, True), ("data.shift.x", True, True)],
)
def test_heavy_tails_need_what_can_be_sampled(name, few, field):
    """Numbers of the model, beside few parameters."""
    taken = TakenForGranted(bench.cube_spec(1), ("material.mu",), (), {name: Uncertain(std=0.1)})
    assert [bool(list(taken.of_heavy_tails("student-t", field=one))) for one in (False, True)] == [few, field]


@pytest.mark.unit
def test_what_moves_most_is_said_in_three_clauses_at_most():
    assumed = [
        Assumption("cases.pull.loads.traction.size", 2.0, "Pa", PART),
        Assumption("data.scale.displacement", PART, "1", PART),
        Assumption("data.shift.x", 5e-4, "m"),
        Assumption("inclusions.lump.width", 6e-5, "m", PART),
        Assumption("cases.pull.loads.ball.direction_x", PART, "1"),
    ]
    shifts = np.array([[2.6, -0.1], [-0.4, np.nan], [0.02, 0.05], [0.3, 0.2], [np.nan, np.nan]])
    (one,) = findings(assumed, ["mu", "contrast"], shifts)
    assert one.severity == "note"
    assert one.code in CATALOGUE
    assert one.text == (
        "Taken for granted: if cases.pull.loads.traction.size is 1 % larger than stated, mu is 2.6 deviations larger; "
        "if measured displacement is 1 % larger than stated, mu is 0.4 deviations smaller; if inclusions.lump.width "
        "is 1 % larger than stated, mu is 0.3 deviations larger."
    )
    assert findings(assumed[2:3], ["mu", "contrast"], shifts[2:3]) == []
    assert str(assumed[2]) == "points are 500 µm farther along x"


@pytest.mark.unit
def test_what_is_too_uncertain_for_first_order_is_said():
    """By what a model that is bent in the number does where it is larger by its deviation; scales are linear."""
    names = tuple(map(str, range(8)))
    model = FunctionModel(
        lambda p: A @ p[:2] + B[:, 0] * p[2] ** 2,
        ("a", "b", "s"),
        names,
        lambda p: np.column_stack([A, 2 * B[:, 0] * p[2]]),
    )
    data = Measurements.of(np.ones(8), np.full(8, 0.3), [0] * 8, range(8), names)
    stated, beside = [Assumption("s", 0.5, "1")], of_data([data], {}, 0.0)
    groups = {"s": np.eye(9)[0], "scales": np.append(0.0, np.ones(8))}
    assumed = Assumptions(
        data, stated, beside, np.array([3.0]), {}, by_evaluation(SerialEvaluate(model)), groups=groups
    )
    np.testing.assert_allclose(assumed.bends(np.array([1.0, -1.0]), None), [B[:, 0] * 0.25, np.zeros(8)], atol=1e-12)
    rows = assumed.shared(np.array([1.0, -1.0]))["uncertain"]
    predicted = A @ [1.0, -1.0] + 9 * B[:, 0]
    np.testing.assert_allclose(rows, [6 * B[:, 0] * 0.5, -PART * predicted], rtol=1e-12)
    (one,) = bent(["s", "scales"], ["a", "b"], np.array([[0.1, -0.31], [0.2, np.nan]]))
    assert one.severity == "warning"
    assert one.text == (
        "s is too uncertain for its first order: second order moves b by 0.31 deviations; make it a parameter, with a "
        "normal prior."
    )


def test_what_is_uncertain_is_as_stated_whatever_the_size_of_the_errors():
    """Errors that are a fifth of what is stated, by a factor that is inferred: a stated deviation is no fifth of it."""
    rng, m = np.random.default_rng(1), 200
    rows, by_s = rng.standard_normal((m, 2)), rng.standard_normal(m)
    names = tuple(map(str, range(m)))
    values = rows @ [1.2, -0.5] + 0.7 * by_s + 0.02 * rng.standard_normal(m)
    data = Measurements.of(values, np.full(m, 0.1), [0] * m, range(m), names)
    model = FunctionModel(lambda p: rows @ p, ("a", "b"), names, lambda p: rows)
    method = bench.METHOD.model_copy(update={"noise": LogUniform(lower=0.01, upper=10.0)})
    problem = Problem(data, method, shared=lambda point: {"uncertain": 0.5 * by_s[None]})
    found = invert_few(INPUTS, SerialEvaluate(model), problem).dataset
    covariance = np.linalg.inv(0.02**2 * np.eye(m) + 0.25 * np.outer(by_s, by_s))
    right = np.linalg.inv(np.diag(INPUTS.std**-2.0) + rows.T @ covariance @ rows)
    np.testing.assert_allclose(found["std"][:2], np.sqrt(np.diag(right)), rtol=0.15)
    assert float(found["uncertain_mean"][0]) == pytest.approx(1.4, abs=0.05)
    mean = right @ (rows.T @ covariance @ values + INPUTS.mean / INPUTS.std**2)
    left = 1 / (4 + by_s @ by_s / 0.02**2)  # of s, were a and b known
    of_both = left * by_s @ rows / 0.02**2
    assert float(found["uncertain_std"][0]) == pytest.approx(2 * np.sqrt(left + of_both @ right @ of_both), rel=0.15)
    np.testing.assert_allclose(found["mean"][:2], mean, atol=0.3 * np.sqrt(np.diag(right)).max())


@pytest.mark.unit
def test_what_the_data_contradict_is_said():
    (one,) = off(["load", "scale"], np.array([2.9, -3.14]))
    assert one.severity == "warning"
    assert one.text == (
        "The data say that scale is smaller than stated by 3.1 of its deviations: it is known less well, or something "
        "else is wrong."
    )


@pytest.mark.unit
def test_steps_of_a_path_are_of_one_quantity():
    data = Measurements.of(np.ones(3), np.ones(3), [0] * 3, [0, 1, 2], ["force.1", "force.2", "lift.1"])
    assert quantities(data, {"lift.1": "m"}) == ["force", "force", "displacement"]


@pytest.mark.unit
@pytest.mark.parametrize("on_surface", [False, True])
def test_points_at_a_face_move_along_it_or_into_the_body(on_surface):
    """Outside there is no displacement: slopes across a face are those from inside, and on a surface there are none."""
    places = np.array([[1.0, 0.4, 0.5], [0.5, 0.5, 0.5]] if not on_surface else [[1.0, 0.4, 0.5]])
    n = len(places)
    data = Measurements.of_points(places, np.zeros((n, 3)), np.ones((n, 3)), np.zeros(n, int), ["p"] * n, ("one",))
    data = data.subset(data.axes == 0)

    def nearest(points):
        inside = np.clip(points, 0.0, 1.0)
        return np.column_stack([np.ones(len(points)), inside[:, 1:]]) if on_surface else inside

    moved = Moved(data, 1.0, nearest, on_surface)
    u = 3 * moved.places[..., 0] ** 2 + 2 * moved.places[..., 1]
    slopes = moved.slopes(u.reshape(1, -1))[0]
    right = [[6.0, 3.0], [2.0, 2.0], [0.0, 0.0]] if not on_surface else [[0.0], [2.0], [0.0]]
    np.testing.assert_allclose(slopes, right, atol=1e-3)


# --- bodies ----------------------------------------------------------------------------------------------------------


@pytest.mark.fem
def test_numbers_of_one_load_case_alone():
    case = bench.cube(1)
    sizes = [f"cases.{name}.loads.traction.size" for name in ("shear", "pull")]

    def made(*names):
        model = case.spec.build(MPI.COMM_SELF, ("material.mu", *names))
        return model.observing(case.data.places, case.data.axes, case.data.cases, case.data.along)

    model, point, of_pull = made(*sizes), np.array([900.0, 150.0, 200.0]), case.data.cases == 1
    solution = model.solve(point)
    slopes = solution.tangent(np.eye(3))
    assert not slopes[1, of_pull].any()
    assert not slopes[2, ~of_pull].any()
    ends = [np.asarray(model.solve(point + sign * np.array([0.0, 0.15, 0.0])).outputs) for sign in (1, -1)]
    np.testing.assert_allclose(slopes[1], (ends[0] - ends[1]) / 0.3, atol=1e-5 * np.abs(slopes[1]).max())
    np.testing.assert_allclose(solution.outputs, made().solve(point[:1]).outputs, rtol=1e-6)


@pytest.mark.fem
def test_a_factor_on_all_steps_of_a_path():
    blocks = {
        "body": {"kind": "box", "size": [1, 1, 1], "cells": [1, 1, 1]},
        "material": {"kind": "neo-hookean", "C1": 1e3, "D1": 1e4},
        "clamp": ["z-min"],
        "loads": [{"kind": "traction", "on": "z-max", "direction": [0, 0, 1], "size": [100.0, 200.0]}],
        "outputs": [{"name": "uz", "kind": "displacement", "at": [0.5, 0.5, 1.0], "component": "z"}],
    }
    names = ("material.C1", "steps.loads.traction.size")
    model = Path.model_validate(blocks).build(MPI.COMM_SELF, names)
    solution, *ends = (model.solve(np.array([1e3, factor])) for factor in (1.0, 1.001, 0.999, 1.1))
    slope = (np.asarray(ends[0].outputs) - np.asarray(ends[1].outputs)) / 2e-3
    np.testing.assert_allclose(solution.tangent(np.array([0.0, 1.0])), slope, rtol=1e-4)
    blocks["loads"][0]["size"] = [110.0, 220.0]
    more = Path.model_validate(blocks).build(MPI.COMM_SELF, names[:1]).solve(np.array([1e3]))
    np.testing.assert_allclose(ends[2].outputs, more.outputs, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.fem
def test_a_body_moves_as_inversions_done_again():
    case = bench.cube(2)
    assumed, shifts, std, _ = bench.told(case, bench.METHOD.model_copy(update={"samples": 32}))
    chosen = [k for k, one in enumerate(assumed) if one.name in {"cases.pull.loads.traction.size", "data.shift.z"}]
    assert len(chosen) == 2
    again = bench.again(case, [assumed[k] for k in chosen], std)
    for said, right in zip(shifts[chosen], again, strict=True):
        np.testing.assert_allclose(said, right, rtol=0.05, atol=0.02)
    assert {one.name for one in assumed} >= {f"data.shift.{axis}" for axis in AXES}
