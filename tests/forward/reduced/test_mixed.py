"""A reduced model of a nearly incompressible body in the mixed form, against the body."""

import numpy as np
import pytest
from mpi4py import MPI

from forward.conformance import check_derivatives
from forward.hyperelastic import Hyperelastic
from forward.model import ModelError
from forward.reduced.data import load, save
from forward.reduced.model import ReducedModel
from forward.reduced.newton import stable
from forward.reduced.reduction import Reduction, Sizes
from forward.reduced.snapshots import solved

pytestmark = pytest.mark.fem

BODY = {
    "body": {"kind": "box", "size": [0.1, 0.06, 0.03], "cells": [3, 2, 1], "cell": "hexahedron", "degree": 2},
    "material": {"kind": "neo-hookean", "C1": 1e3, "D1": 1e7},
    "formulation": "mixed",
    "clamp": ["z-min"],
    "loads": [
        {
            "kind": "spot",
            "on": "z-max",
            "direction": [0, 0, -1],
            "size": 0.5,
            "x": 0.05,
            "y": 0.03,
            "z": 0.03,
            "width": 0.02,
        }
    ],
    "outputs": [
        {"name": "top", "kind": "displacement", "at": [0.05, 0.03, 0.03], "component": "z"},
        {"name": "volume", "kind": "volume-change"},
        {"name": "stress", "kind": "max-von-mises"},
        {"name": "force", "kind": "reaction", "on": "z-min", "component": "z"},
    ],
}
NAMES = ("material.C1", "material.D1", "loads.spot.size", "loads.spot.x")
NOMINAL, SPREAD = np.array([1e3, 1e7, 0.5, 0.05]), np.array([100, 1e6, 0.15, 0.012])


@pytest.fixture(scope="module")
def full():
    return Hyperelastic.model_validate(BODY).build(MPI.COMM_SELF, NAMES)


@pytest.fixture(scope="module")
def snapshots(full):
    return solved(full, NOMINAL + SPREAD * np.random.default_rng(1).uniform(-1.7, 1.7, (12, 4)), SPREAD)


@pytest.fixture(scope="module")
def reduction(full):
    return Reduction(full, NOMINAL, SPREAD)


@pytest.fixture(scope="module")
def model(reduction, snapshots, tmp_path_factory):
    data = reduction.reduced(snapshots, Sizes(modes=12, cubature=1e-3, more=60))
    path = tmp_path_factory.mktemp("mixed") / "model.npz"
    save(data, path)
    return ReducedModel(load(path), NAMES)


@pytest.fixture(scope="module")
def unseen(full):
    """Points (8, 4), and the outputs (8, 4) of the body there."""
    points = NOMINAL + SPREAD * np.random.default_rng(2).uniform(-1.5, 1.5, (8, 4))
    return points, np.array([full.solve(point).outputs for point in points])


def effectivities(found, truth):
    """Estimated errors of outputs over true ones, by output."""
    errors, estimates = truth - np.array([one.outputs for one in found]), [one.estimate.outputs for one in found]
    return (errors * np.array(estimates)).sum(axis=0) / (errors**2).sum(axis=0)


def test_it_follows_the_body_without_locking_and_knows_its_errors(full, model, unseen):
    """Ten thousand times as stiff in volume as in shape: without pressures of its own it would hardly move."""
    assert model.level.pressures == 12
    assert model.level.modes == 36
    points, truth = unseen
    found = [model.solve(point) for point in points]
    errors = truth - np.array([one.outputs for one in found])
    relative = np.sqrt((errors**2).mean(axis=0)) / truth.std(axis=0)
    assert (relative < 0.03).all(), relative
    effectivity = effectivities(found, truth)
    assert (np.abs(effectivity - 1) < 0.2).all(), effectivity
    state = full.space.gather(full.solve(points[0]).state[None])[0]
    pressures = slice(model.space.displacements, None)
    assert found[0].state.shape == state.shape
    off = np.linalg.norm((found[0].state - state)[pressures]) / np.linalg.norm(state[pressures])
    assert off < 0.02, off
    exact = full.solve(points[0]).adjoint(np.eye(4)) * SPREAD
    left = np.linalg.norm(found[0].corrected_jacobian * SPREAD - exact, axis=1) / np.linalg.norm(exact, axis=1)
    assert (left[[0, 1, 3]] < 0.02).all(), left


@pytest.mark.flags
@pytest.mark.parametrize("seed", [8, 9])
def test_estimates_see_what_points_miss_whichever_these_are(reduction, snapshots, unseen, monkeypatch, seed):
    """Of so small a model errors are those of its points, of which the larger one must not have a tenth itself."""
    monkeypatch.setattr("forward.reduced.rules.SEED", seed)
    model = ReducedModel(reduction.reduced(snapshots, Sizes(modes=12, cubature=1e-3, more=60)), NAMES)
    found = [model.solve(point) for point in unseen[0]]
    effectivity = effectivities(found, unseen[1])
    assert (np.abs(effectivity - 1) < 0.2).all(), effectivity
    # Its points are chosen for what missed forces do to outputs. That of the largest stress jumps with its place.
    errors = unseen[1] - np.array([one.outputs for one in found])
    rest = errors - np.array([one.estimate.outputs for one in found])
    left = np.linalg.norm(rest, axis=0) / np.linalg.norm(errors, axis=0)
    assert (left[[0, 1, 3]] < 0.1).all(), left


def test_its_derivatives_are_its_own(model):
    check_derivatives(model, NOMINAL, 0.2 * SPREAD).require()


def test_a_pressure_is_no_instability():
    K = np.diag([2.0, 1.0, -1.0])
    assert stable(K, 1)
    assert not stable(K, 0)
    assert not stable(np.diag([2.0, -1.0, -1.0]), 1)


def test_estimates_of_a_column_whose_forces_are_symmetric():
    """No force of a snapshot works on modes that bend it: points chosen by forces alone let it bend by itself."""
    top = [0.01, 0.01, 0.1]
    column = BODY | {
        "body": BODY["body"] | {"size": [0.02, 0.02, 0.1], "cells": [1, 1, 4]},
        "loads": [BODY["loads"][0] | dict(zip("xyz", top, strict=True))],
        "outputs": [
            {"name": "side", "kind": "displacement", "at": top, "component": "x"},
            {"name": "top", "kind": "displacement", "at": top, "component": "z"},
        ],
    }
    name, spread = ("loads.spot.size",), np.array([0.02])
    full = Hyperelastic.model_validate(column).build(MPI.COMM_SELF, name)
    snapshots = solved(full, np.linspace(0.02, 0.08, 4)[:, None], spread)
    model = ReducedModel(Reduction(full, np.array([0.05]), spread).reduced(snapshots, Sizes(modes=2)), name)
    for size in (0.03, 0.05, 0.07):
        found = model.solve(np.array([size]))
        side, lower = full.solve(np.array([size])).outputs - found.outputs
        assert abs(found.estimate.outputs[0] - side) < 2e-3 * abs(found.outputs[1])
        assert 0.5 < found.estimate.outputs[1] / lower < 2


def test_blocks_are_refused(reduction, snapshots):
    with pytest.raises(ModelError, match="mixed form is not cut into blocks"):
        reduction.reduced(snapshots, Sizes(modes=4, cut=(2, 1, 1)))
