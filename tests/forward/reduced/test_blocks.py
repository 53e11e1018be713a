"""Local modes of a body in blocks: continuous, orthogonal where they must be, exact where a block is kept in full."""

from dataclasses import replace

import meshio
import numpy as np
import pytest
from mpi4py import MPI

from forward.hyperelastic import Hyperelastic
from forward.model import ModelError
from forward.reduced import modes
from forward.reduced.model import ReducedModel
from forward.reduced.reduction import Reduction, Sizes
from forward.reduced.snapshots import Snapshots
from tests import meshes

pytestmark = pytest.mark.fem

SPOT = {
    "kind": "spot",
    "on": "z-max",
    "direction": [0, 0, -1],
    "size": 0.3,
    "x": 0.06,
    "y": 0.02,
    "z": 0.02,
    "width": 0.01,
}
BODY = {
    "body": {"kind": "box", "size": [0.12, 0.04, 0.02], "cells": [6, 2, 1], "cell": "hexahedron", "degree": 1},
    "material": {"kind": "neo-hookean", "C1": 1e3, "D1": 3e3},
    "formulation": "displacement",
    "clamp": ["z-min"],
    "loads": [SPOT],
    "outputs": [
        {"name": "middle", "kind": "displacement", "at": [0.06, 0.02, 0.02], "component": "z"},
        {"name": "stress", "kind": "max-von-mises"},
    ],
}
PATHS = ("material.C1", "loads.spot.x", "loads.spot.size")
NOMINAL, SPREAD = np.array([1e3, 0.06, 0.3]), np.array([100, 0.015, 0.05])


@pytest.fixture(scope="module")
def full():
    return Hyperelastic.model_validate(BODY).build(MPI.COMM_SELF, PATHS)


def snapshots_at(full, points):
    solutions = [full.solve(point) for point in points]
    states = full.space.gather(np.array([one.state for one in solutions]))
    none = np.zeros((0, states.shape[1]))
    return Snapshots(points, states, none, none, np.array([one.outputs for one in solutions]))


@pytest.fixture(scope="module")
def snapshots(full):
    return snapshots_at(full, NOMINAL + SPREAD * np.random.default_rng(1).uniform(-1.7, 1.7, (10, 3)))


@pytest.fixture(scope="module")
def reduction(full):
    return Reduction(full, NOMINAL, SPREAD)


@pytest.fixture(scope="module")
def stiffness(reduction):
    """In the order of nodes of results, with its free unknowns."""
    reduction._rest.set()
    equations = reduction.equations
    found = equations.sparse_stiffness()
    w = np.random.default_rng(0).standard_normal(equations.size)
    w[equations.fixed] = 0
    expected, product = equations.stiffness_times(w), found @ w
    expected[equations.fixed] = product[equations.fixed] = 0
    np.testing.assert_allclose(product, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    order = np.argsort(equations.layout.scatter(np.arange(float(equations.size))[None])[0].astype(int))
    free = np.ones(equations.size, dtype=bool)
    free[equations.fixed] = False
    return found[order][:, order], free[order]


def parts_of(full, cut, where=None):
    cells, _ = full.space.cells()
    labels = modes.boxes(cells, full.space.coordinates, cut)
    return modes.partition(labels, cells, full.space.coordinates, where)


def test_every_node_belongs_to_the_blocks_of_its_cells(full):
    parts = parts_of(full, (3, 2, 1), np.array([[0.06, 0.005, 0.01]]))
    x, y, _ = full.space.coordinates.T
    sides = 1 + np.isclose(x[:, None], [0.04, 0.08]).any(axis=1).astype(int)
    sides = sides * (1 + np.isclose(y, 0.02).astype(int))
    np.testing.assert_array_equal(parts.blocks.sum(axis=1)[parts.of_node], sides)
    assert parts.inside.sum() == 6
    in_full = parts.full[parts.of_node]
    np.testing.assert_array_equal(in_full, (x >= 0.04 - 1e-9) & (x <= 0.08 + 1e-9) & (y <= 0.02 + 1e-9))


def test_modes_are_orthonormal_and_those_inside_a_block_stay_there(full, snapshots, stiffness):
    K, free = stiffness
    parts = parts_of(full, (3, 1, 1))
    found = modes.modes_of_blocks(parts, K, free, snapshots.states, 100)
    np.testing.assert_allclose(found @ (K @ found.T), np.eye(len(found)), atol=1e-8)
    assert not np.abs(found[:, ~free]).any()
    # All modes hold all snapshots.
    left = snapshots.states - (snapshots.states @ (K @ found.T)) @ found
    assert np.abs(left).max() < 1e-6 * np.abs(snapshots.states).max()
    # One snapshot in the left block and another one in the right block are held too, joined with the least energy.
    of_unknown = np.repeat(parts.of_node, 3)
    left_block = int(np.flatnonzero(parts.inside & parts.blocks[:, 0])[0])
    inside = free & parts.inside[of_unknown]
    carried = modes._carrier(K, inside, free & ~inside)
    apart = snapshots.states[0] - carried(snapshots.states[:1])[0]
    mixed = np.where(of_unknown == left_block, apart, 0.0)
    assert np.abs(mixed - (mixed @ (K @ found.T)) @ found).max() < 1e-6 * np.abs(mixed).max()


def test_where_all_blocks_are_kept_in_full_the_model_is_the_body(full, snapshots, reduction):
    places = ((0.02, 0.02, 0.01), (0.1, 0.02, 0.01))
    data = reduction.reduced(snapshots, Sizes(modes=2, cubature=1e-11, more=0, cut=(2, 1, 1), full=places))
    model = ReducedModel(data, full.parameters)
    assert model.level.modes >= 3 * 21  # all free nodes: those of the upper side
    point = NOMINAL + np.array([-250, 0.03, 0.15])  # outside of what the snapshots have seen
    np.testing.assert_allclose(model.solve(point).outputs, full.solve(point).outputs, rtol=1e-8)


def test_a_block_kept_in_full_takes_loads_that_no_snapshot_has_seen(full, reduction):
    """The tool was far to the left in all snapshots; the block where it is now is kept in full."""
    trained = snapshots_at(full, np.array([[c, x, 0.3] for c in (900, 1100) for x in (0.02, 0.03, 0.04)]))
    point = np.array([1e3, 0.1, 0.3])
    expected = full.space.gather(full.solve(point).state[None])[0]
    errors = []
    for where in ((), ((0.1, 0.02, 0.01),)):
        data = reduction.reduced(trained, Sizes(modes=12, cubature=1e-6, more=0, cut=(3, 1, 1), full=where))
        found = ReducedModel(data, full.parameters).solve(point).state
        errors.append(np.linalg.norm(found - expected) / np.linalg.norm(expected))
    assert errors[1] < 0.05
    assert errors[1] < errors[0] / 5


def test_what_cannot_be_cut_is_said(full, snapshots, reduction, monkeypatch):
    with pytest.raises(ModelError, match="no regions, expected numbers of blocks"):
        reduction.reduced(snapshots, Sizes(modes=4, cut="regions"))
    monkeypatch.setattr("forward.reduced.modes.MOST_IN_FULL", 10)
    with pytest.raises(ModelError, match="expected at most 10: cut finer"):
        reduction.reduced(snapshots, Sizes(modes=4, cut=(2, 1, 1), full=((0.0, 0.0, 0.0),)))


def test_a_load_that_moves_is_read_though_no_load_is_proportional_to_a_number(full, snapshots, reduction):
    """All loads must count in full while forms are read, whatever was assembled before."""
    data = reduction.reduced(snapshots, Sizes(modes=10, cubature=1e-9, more=0))
    point = snapshots.parameters[0]
    np.testing.assert_allclose(
        ReducedModel(data, full.parameters).solve(point).outputs, snapshots.outputs[0], rtol=1e-6
    )


def test_regions_are_blocks(tmp_path):
    """Those of a mesh file that are halves of a box make the same model as a cut into halves; one is much stiffer."""
    meshio.write(tmp_path / "box.msh", meshes.box(), file_format="gmsh22", binary=False)
    body = {
        "body": {"kind": "mesh", "file": str(tmp_path / "box.msh")},
        "material": {"kind": "neo-hookean", "C1": 1e3, "D1": 3e3},
        "formulation": "displacement",
        "regions": {"right": {"contrast": 5.0}},
        "clamp": ["x-min"],
        "loads": [{"kind": "gravity", "density": 20, "direction": [0, 0, -1]}],
        "outputs": [{"name": "u_max", "kind": "max-displacement"}],
    }
    paths = ("regions.right.contrast", "loads.gravity.density")
    full = Hyperelastic.model_validate(body).build(MPI.COMM_SELF, paths)
    nominal, spread = np.array([5.0, 20]), np.array([1.0, 4])
    trained = snapshots_at(full, nominal + spread * np.random.default_rng(1).uniform(-1.7, 1.7, (6, 2)))
    reduction = Reduction(full, nominal, spread)
    sizes = Sizes(modes=8, cubature=1e-6, more=0, cut="regions")
    found, halves = (reduction.reduced(trained, one) for one in (sizes, replace(sizes, cut=(2, 1, 1))))
    assert len(np.unique(full.space.regions())) == 2
    np.testing.assert_allclose(np.abs(found.fields), np.abs(halves.fields), atol=1e-9 * np.abs(found.fields).max())
    point = nominal + spread * np.array([0.7, -1.1])
    np.testing.assert_allclose(ReducedModel(found, paths).solve(point).outputs, full.solve(point).outputs, rtol=1e-3)
