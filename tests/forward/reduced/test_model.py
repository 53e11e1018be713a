"""Reduced models of tiny bodies, against the bodies themselves."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI
from pydantic import ValidationError

from forward.conformance import check_derivatives
from forward.fem.forms import Forms
from forward.hyperelastic import Hyperelastic
from forward.materials.material import MATERIALS
from forward.model import InadmissibleError, ModelError
from forward.reduced.data import load, save
from forward.reduced.integrands import of_density, of_form
from forward.reduced.model import ReducedModel
from forward.reduced.newton import outside_of
from forward.reduced.outputs import NEAR_PEAK
from forward.reduced.reduction import Reduction, Sizes, enriched
from forward.reduced.snapshots import Snapshots, adjoint_states, directions
from forward.reduced.spec import Reduced, mistakes
from tests.steps import STEPS

pytestmark = pytest.mark.fem

BODY = {
    "body": {"kind": "box", "size": [0.1, 0.06, 0.03], "cells": [3, 2, 1], "cell": "hexahedron", "degree": 1},
    "material": {"kind": "neo-hookean", "C1": 1e3, "D1": 3e3},
    "formulation": "displacement",
    "clamp": ["x-min"],
    "displacements": [{"on": "x-max", "x": 0.004}],
    "fields": [{"of": "stiffness", "length": 0.05, "std": 0.2, "modes": 2}],
    "loads": [
        {"kind": "gravity", "density": 1000},
        {"kind": "pressure", "on": "z-max", "size": 200},
        {
            "kind": "spot",
            "on": "y-max",
            "direction": [0, 1, 0],
            "size": 0.1,
            "x": 0.05,
            "y": 0.06,
            "z": 0.015,
            "width": 0.02,
        },
    ],
    "outputs": [
        {"name": "end", "kind": "displacement", "at": [0.1, 0.03, 0.03], "component": "z"},
        {"name": "top", "kind": "mean-displacement", "on": "z-max", "component": "z"},
        {"name": "u_max", "kind": "max-displacement"},
        {"name": "energy", "kind": "strain-energy"},
        {"name": "volume", "kind": "volume-change"},
        {"name": "stress", "kind": "max-von-mises"},
        {"name": "force", "kind": "reaction", "on": "x-max", "component": "x"},
    ],
}
PATHS = ("material.C1", "loads.gravity.density", "loads.pressure.size", "loads.spot.x", "displacements.x-max.x")
NOMINAL = np.array([1e3, 1e3, 200, 0.05, 0.004, 0, 0])
SPREAD = np.array([100, 100, 50, 0.01, 0.001, 1, 1])


@pytest.fixture(scope="module")
def full():
    spec = Hyperelastic.model_validate(BODY)
    return spec.build(MPI.COMM_SELF, (*PATHS, *spec.coefficients))


@pytest.fixture(scope="module")
def snapshots(full):
    points = NOMINAL + SPREAD * np.random.default_rng(1).uniform(-1.5, 1.5, (6, 7))
    solutions = [full.solve(point) for point in points]
    states = np.array([s.state for s in solutions])
    adjoints = np.vstack([adjoint_states(full, full.solve(point)) for point in points])
    tangents = np.vstack([full.solve(point).state_tangent(directions(SPREAD, point)) for point in points])
    gathered = (full.space.gather(rows) for rows in (states, adjoints, tangents))
    return Snapshots(points, *gathered, np.array([s.outputs for s in solutions]))


@pytest.fixture(scope="module")
def reduction(full):
    return Reduction(full, NOMINAL, SPREAD)


@pytest.fixture(scope="module")
def exact(reduction, snapshots):
    """As many modes as states and tangents have, and points that miss nothing."""
    return reduction.reduced(snapshots, Sizes(modes=48, cubature=1e-11))


@pytest.fixture(scope="module")
def small(reduction, snapshots, tmp_path_factory):
    """Few modes; through a file."""
    data = reduction.reduced(snapshots, Sizes(modes=8, cubature=1e-3))
    path = tmp_path_factory.mktemp("reduced") / "small.npz"
    save(data, path)
    return load(path)


def test_where_modes_hold_state_and_tangents_everything_is_that_of_the_body(full, snapshots, exact):
    model = ReducedModel(exact, full.parameters)
    for point, state in zip(snapshots.parameters[:2], snapshots.states, strict=False):
        of_body, found = full.solve(point), model.solve(point)
        np.testing.assert_allclose(found.outputs, of_body.outputs, rtol=1e-6)
        np.testing.assert_allclose(found.state, state, atol=1e-7 * np.abs(state).max())
        expected = of_body.tangent(np.diag(SPREAD))
        size = np.abs(expected).max(axis=0)
        np.testing.assert_allclose(found.tangent(np.diag(SPREAD)) / size, expected / size, atol=1e-4)
        along = of_body.state_tangent(SPREAD)
        np.testing.assert_allclose(
            found.state_tangent(SPREAD), full.space.gather(along[None])[0], atol=1e-4 * np.abs(along).max()
        )


def test_its_derivatives_are_its_own(full, small):
    model = ReducedModel(small, full.parameters)
    check_derivatives(model, NOMINAL, 0.2 * SPREAD, steps=STEPS).require()


def test_some_parameters_keep_their_means(full, small):
    some = ReducedModel(small, ("loads.pressure.size", "fields.stiffness.1"))
    found = some.solve(np.array([230, 0.5]))
    whole = NOMINAL.copy()
    whole[[2, 6]] = 230, 0.5
    every = ReducedModel(small, full.parameters).solve(whole)
    np.testing.assert_allclose(found.outputs, every.outputs, rtol=1e-12)
    assert found.tangent(np.eye(2)).shape == (2, 7)
    np.testing.assert_allclose(found.adjoint(np.eye(7)), every.adjoint(np.eye(7))[:, [2, 6]], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("alone", [False, True])
def test_in_lockstep_the_equilibria_are_those_of_newtons_method(full, small, alone, monkeypatch):
    points = NOMINAL + SPREAD * np.random.default_rng(3).uniform(-1, 1, (7, 7))
    points[3, 0] = -3
    model = ReducedModel(small, full.parameters, alone=alone, tested=False)
    monkeypatch.setattr("forward.reduced.model.TOGETHER", 5)
    found = list(model.solve_many(points))
    assert isinstance(found.pop(3), InadmissibleError)
    one_by_one = ReducedModel(small, full.parameters, alone=alone)
    assert (model.together, one_by_one.together) == (5, 1)
    for one, point in zip(found, np.delete(points, 3, axis=0), strict=True):
        expected = one_by_one.solve(point)
        assert one.work.assemblies == 0 < one.work.residuals
        np.testing.assert_allclose(one.outputs, expected.outputs, rtol=1e-7)
        np.testing.assert_allclose(one.c, expected.c, atol=1e-8 * np.abs(expected.c).max())
        size = np.abs(expected.jacobian).max(axis=1, keepdims=True)
        np.testing.assert_allclose(one.jacobian / size, expected.jacobian / size, atol=1e-6)
        assert np.isnan(one.estimate.outputs).all() == alone


def test_forces_may_be_left_out_of_balance_in_lockstep(full, small):
    points = NOMINAL + SPREAD * np.random.default_rng(3).uniform(-1, 1, (4, 7))
    exact, rough = (
        list(ReducedModel(small, full.parameters, tested=False, unbalanced=part).solve_many(points))
        for part in (1e-9, 1e-4)
    )
    spread = np.std([one.outputs for one in exact], axis=0)
    for one, other in zip(exact, rough, strict=True):
        assert 0 < other.work.residuals < one.work.residuals
        assert (np.abs(other.outputs - one.outputs) < 0.02 * spread).all()


def test_outputs_may_be_cut_off_beyond_those_of_the_snapshots(full, snapshots, small):
    points = NOMINAL + SPREAD * np.random.default_rng(3).uniform(-1, 1, (4, 7))
    free = np.array([ReducedModel(small, full.parameters).solve(point).outputs for point in points])
    lowest, highest = snapshots.outputs.min(axis=0), snapshots.outputs.max(axis=0)
    assert small.about["highest"] == highest.tolist()
    about = small.about | {"highest": (lowest + 0.5 * (free.max(axis=0) - lowest)).tolist()}
    model = ReducedModel(replace(small, about=about), full.parameters, tested=False, within=True)
    found = np.array([one.outputs for one in model.solve_many(points)])
    more = 0.25 * (np.array(about["highest"]) - lowest)
    np.testing.assert_allclose(found, np.clip(free, lowest - more, about["highest"] + more), rtol=1e-6)
    assert (found < free - 1e-6 * np.abs(free)).any(axis=0).all()


def test_what_lockstep_does_not_find_newtons_method_does(full, small, monkeypatch):
    monkeypatch.setattr("forward.reduced.lockstep.ITERATIONS", 2)
    model = ReducedModel(small, full.parameters, tested=False)
    (found,) = model.solve_many(NOMINAL[None] + 0.5 * SPREAD)
    expected = ReducedModel(small, full.parameters).solve(NOMINAL + 0.5 * SPREAD)
    np.testing.assert_array_equal(found.outputs, expected.outputs)
    assert found.work.assemblies > 0


def test_estimates_see_the_errors_where_the_larger_model_holds_the_state(full, snapshots, small):
    model = ReducedModel(small, full.parameters)
    errors, estimates = [], []
    for point, outputs in zip(snapshots.parameters, snapshots.outputs, strict=True):
        solution = model.solve(point)
        errors.append(outputs - solution.outputs)
        estimates.append(solution.estimate.outputs)
    e, x = np.array(errors), np.array(estimates)
    effectivity = (e * x).sum(axis=0) / (e**2).sum(axis=0)
    assert (np.abs(effectivity[:2] - 1) < 0.3).all(), effectivity  # linear outputs: the corrected values are closer
    assert (np.linalg.norm(e - x, axis=0) < np.linalg.norm(e, axis=0))[[0, 1, 3, 4, 6]].all()


def test_largest_values_have_places(full, snapshots, reduction, small):
    """Those of a state of the body are where its displacements and stresses are largest."""
    for state, point, outputs in zip(snapshots.states[:2], snapshots.parameters, snapshots.outputs, strict=False):
        (place,) = reduction.places(state[None], point[None])
        assert (place[[0, 1, 3, 4, 6]] == -1).all()
        moved = np.linalg.norm(state.reshape(-1, 3), axis=1)
        assert abs(moved[full.equations.layout.positions[place[2]]] - outputs[2]) < 1e-9 * outputs[2]
        stress = full.functionals[5]
        assert abs(stress.value() - outputs[5]) < 1e-9 * outputs[5]
        assert stress.place() == place[5]
    found = ReducedModel(small, full.parameters).solve(snapshots.parameters[0])
    corrected = np.linalg.norm(found.corrected_state.reshape(-1, 3), axis=1).max()
    assert abs(corrected - found.outputs[2] - found.estimate.outputs[2]) < 1e-9


def test_points_near_the_largest_stress_of_a_snapshot_are_all_kept(full, snapshots, reduction, small):
    """Those beside it in the same cell too: where loads move on, they have the largest."""
    near, at_points = False, full.equations.at_points(full.functionals[5].stress)
    for state, point in zip(snapshots.states, snapshots.parameters, strict=True):
        reduction.places(state[None], point[None])  # the body is in this state from then on
        values = at_points().ravel()
        near = near | (values >= NEAR_PEAK * values.max())
    assert small.outputs[5].kind == "peak"
    assert len(small.outputs[5].points.weights) == near.sum() < near.size


def test_gradients_are_corrected_too(full, snapshots, small):
    """Those of the larger model are far closer to those of the body, where it holds the state."""
    model = ReducedModel(small, full.parameters)
    own, corrected = [], []
    for point in snapshots.parameters[:3]:
        solution, exact = model.solve(point), full.solve(point).adjoint(np.eye(7)) * SPREAD
        size = np.linalg.norm(exact, axis=1)
        own.append(np.linalg.norm(solution.jacobian * SPREAD - exact, axis=1) / size)
        corrected.append(np.linalg.norm(solution.corrected_jacobian * SPREAD - exact, axis=1) / size)
    smooth = [0, 1, 3, 4, 6]
    assert (np.mean(corrected, axis=0) < 0.3 * np.mean(own, axis=0))[smooth].all(), (own, corrected)
    assert np.max(corrected, axis=0)[smooth].max() < 0.02


def test_nodes_cells_and_fields_are_those_of_the_body(full, small):
    model = ReducedModel(small, full.parameters)
    np.testing.assert_array_equal(model.space.coordinates, full.space.coordinates)
    np.testing.assert_array_equal(model.space.cells()[0], full.space.cells()[0])
    points = NOMINAL + SPREAD * np.random.default_rng(2).standard_normal((3, 7))
    ours, theirs = model.space.factors(points), full.space.factors(points)
    np.testing.assert_allclose(ours["stiffness"], theirs["stiffness"], rtol=1e-12)


def test_what_it_is_not_for_is_said(full, small):
    model = ReducedModel(small, full.parameters)
    with pytest.raises(InadmissibleError, match="material: not stable at rest"):
        model.solve(np.array([-3, *NOMINAL[1:]]))
    assert "loads.pressure.size = 900 (trained from" in outside_of(small, np.array([1e3, 1e3, 900, 0.05, 0.004, 0, 0]))
    assert not outside_of(small, small.snapshots.mean(axis=0))
    tool = {"kind": "indenter", "shape": "sphere", "on": "z-max", "at": [0.05, 0.03, 0.03], "direction": [0, 0, -1]}
    tool |= {"depth": 1e-3, "radius": 0.01, "friction": 0.3}
    rubbing = Hyperelastic.model_validate(BODY | {"loads": [tool]})
    assert "no friction" in "".join(mistakes(rubbing))


def test_the_full_model_is_asked_where_the_estimate_is_too_large(full, small):
    model = ReducedModel(small, full.parameters, tolerance=1e-9, full=lambda: full)
    np.testing.assert_allclose(model.solve(NOMINAL).outputs, full.solve(NOMINAL).outputs, rtol=1e-9)
    assert len(model.asked) == 1
    generous = ReducedModel(small, full.parameters, tolerance=1e9, full=lambda: full)
    generous.solve(NOMINAL)
    assert generous.asked == []


def test_what_the_full_model_was_asked_enriches_it(full, snapshots, small, tmp_path):
    """Its answer is held then, with one mode more; what was known before is not lost."""
    far = NOMINAL + SPREAD * np.array([-2, 1.5, 2, -1, 1, 1, -1])
    asking = ReducedModel(small, full.parameters, tolerance=1e-9, full=lambda: full)
    asking.solve(far)
    save(enriched(small, np.array(asking.asked), cubature=1e-9), tmp_path / "more.npz")
    more = load(tmp_path / "more.npz")
    assert more.levels[0].modes == small.levels[0].modes + 1
    assert len(more.snapshots) == len(small.snapshots) + 1
    assert (more.lower <= far).all()
    assert (more.upper >= far).all()
    before, after = ReducedModel(small, full.parameters), ReducedModel(more, full.parameters)

    def errors(point):
        outputs, spread = full.solve(point).outputs, np.array(small.about["spread"])
        return [float(np.abs((model.solve(point).outputs - outputs) / spread).max()) for model in (before, after)]

    old, new = errors(far)
    assert new < 1e-6 * old, (old, new)
    for point in snapshots.parameters[:2]:
        old, new = errors(point)
        assert new < 1.5 * old, (old, new)
    check_derivatives(after, NOMINAL, 0.2 * SPREAD, steps=STEPS).require()


def test_it_is_loaded_and_solved_without_fenicsx(small, tmp_path):
    save(small, tmp_path / "model.npz")
    script = (
        "import sys; from forward.reduced.data import load; from forward.reduced.model import ReducedModel\n"
        f"from pathlib import Path; data = load(Path({str(tmp_path / 'model.npz')!r}))\n"
        "found = ReducedModel(data, data.parameters).solve(data.nominal); found.estimate\n"
        "print(sorted({'dolfinx', 'ufl', 'petsc4py', 'mpi4py'} & set(sys.modules)), *found.outputs)"
    )
    out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert out.startswith("[]")
    expected = ReducedModel(small, small.parameters).solve(NOMINAL).outputs
    np.testing.assert_allclose([float(x) for x in out.split()[1:]], expected, rtol=1e-12)


def test_a_file_of_another_kind_is_refused_in_one_line(tmp_path):
    (tmp_path / "model.npz").write_text("no model")
    with pytest.raises(ModelError, match="is not a reduced model"):
        load(tmp_path / "model.npz")
    with pytest.raises(ModelError, match="cannot be read: No such file"):
        load(tmp_path / "none.npz")
    (tmp_path / "cut.npz").write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(ValidationError, match="is not a reduced model"):
        Reduced(file=str(tmp_path / "cut.npz"))


def test_a_body_of_a_kind_that_is_not_there_is_one_line(small):
    strange = replace(small, spec=small.spec | {"material": {"kind": "of-my-own", "mu": 1e3}})
    with pytest.raises(ModelError, match=r"^the reduced model: its body: material.*of-my-own"):
        ReducedModel(strange, strange.parameters)


CONSTANTS = {
    "mooney-rivlin": {"C1": 1e3, "C2": 5e2, "D1": 4e3},
    "neo-hookean": {"C1": 1e3, "D1": 4e3},
    "neo-hookean-coupled": {"mu": 1e3, "lmbda": 2e3},
    "yeoh": {"C10": 1e3, "C20": 100, "C30": 10, "D1": 4e3},
    "gent": {"mu": 1e3, "Jm": 3.0, "D1": 4e3},
    "demiray": {"a": 1e3, "b": 2.0, "D1": 4e3},
    "saint-venant-kirchhoff": {"lmbda": 1e3, "mu": 2e3},
    "blatz-ko": {"mu": 1e3},
    "ogden": {"mu1": 1e3, "alpha1": 2.0, "mu2": -200, "alpha2": -2.0, "mu3": 10, "alpha3": 5.0, "D1": 4e3},
    "holzapfel-gasser-ogden": {"c": 1e3, "k1": 2e3, "k2": 5.0, "D1": 4e3, "fibres": [[1, 0, 0], [0, 1, 0.3]]},
}


@pytest.mark.parametrize("kind", MATERIALS.own)
def test_the_stress_that_is_read_is_the_derivative_of_the_energy_that_is_read(kind):
    """Nothing is compiled, and the stress is written in another way than the energy."""
    material = {"kind": kind} | CONSTANTS[kind]
    blocks = {"material": material, "loads": [{"kind": "gravity", "density": 1}], "fields": [], "displacements": []}
    outputs = [{"name": "u", "kind": "max-displacement"}]
    forms = Forms(Hyperelastic.model_validate(BODY | blocks | {"outputs": outputs}), MPI.COMM_SELF, ())
    (works,) = of_form(forms, forms.virtual_work_of_energy, ())
    density = of_density(forms, forms.stored_energy, forms.dx, ())
    assert works.components == density.components == tuple(range(3, 12))
    gradient = 0.15 * np.random.default_rng(3).standard_normal((9, 5))
    stress = np.array(works.tape(list(gradient)))
    h = 1e-5
    for k, row in enumerate(stress):
        ends = []
        for sign in (1, -1):
            moved = gradient.copy()
            moved[k] += sign * h
            ends.append(density.tape(list(moved))[0])
        np.testing.assert_allclose(row, (ends[0] - ends[1]) / (2 * h), rtol=1e-6, atol=1e-5 * np.abs(stress).max())


def test_of_many_points_a_part_are_candidates_for_the_integrals_over_all(full, snapshots, reduction, monkeypatch):
    monkeypatch.setattr("forward.reduced.rules.CANDIDATES", 40)
    data = reduction.reduced(snapshots, Sizes(modes=5, cubature=1e-3))
    assert len(data.levels[0].works[0].weights) <= 40
    model, other = ReducedModel(data, full.parameters), reduction.reduced(snapshots, Sizes(modes=5, cubature=1e-11))
    every = ReducedModel(other, full.parameters)
    spread = np.array(data.about["spread"])
    for point in snapshots.parameters[:3]:
        off = np.abs(model.solve(point).outputs - every.solve(point).outputs) / spread
        assert (off < 0.05).all(), off
