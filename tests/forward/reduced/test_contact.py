"""A reduced model of a body under a rigid tool, against the body."""

import numpy as np
import pytest
from mpi4py import MPI

from forward.conformance import check_derivatives
from forward.hyperelastic import Hyperelastic
from forward.reduced.model import ReducedModel
from forward.reduced.reduction import Reduction, Sizes
from forward.reduced.snapshots import solved
from tests.steps import STEPS

pytestmark = pytest.mark.fem

BALL = {"kind": "indenter", "shape": "sphere", "on": "z-max", "at": [0.05, 0.03, 0.03], "direction": [0, 0, -1]}
BODY = {
    "body": {"kind": "box", "size": [0.1, 0.06, 0.03], "cells": [6, 4, 2], "cell": "hexahedron", "degree": 1},
    "material": {"kind": "neo-hookean", "C1": 1e3, "D1": 3e3},
    "formulation": "displacement",
    "clamp": ["z-min"],
    "loads": [BALL | {"depth": 0.003, "radius": 0.02}],
    "outputs": [
        {"name": "force", "kind": "force"},
        {"name": "beside", "kind": "displacement", "at": [0.05, 0.045, 0.03], "component": "z"},
        {"name": "below", "kind": "reaction", "on": "z-min", "component": "z"},
    ],
}
NAMES = ("material.C1", "loads.indenter.depth", "loads.indenter.x")
NOMINAL, SPREAD = np.array([1e3, 0.003, 0.05]), np.array([100, 5e-4, 0.002])


def test_under_a_tool_that_moves_it_follows_the_body():
    """The gap is exact at all points of the surface; a tool that is deeper, and elsewhere, touches other points."""
    full = Hyperelastic.model_validate(BODY).build(MPI.COMM_SELF, NAMES)
    trained = solved(full, NOMINAL + SPREAD * np.random.default_rng(1).uniform(-1.7, 1.7, (16, 3)), SPREAD)
    data = Reduction(full, NOMINAL, SPREAD).reduced(trained, Sizes(modes=24, cubature=1e-3, more=40))
    model = ReducedModel(data, NAMES)
    assert len(data.levels[0].works[1].weights) == 6 * 4 * 25  # all points of the surface
    points = NOMINAL + SPREAD * np.random.default_rng(2).uniform(-1.3, 1.3, (5, 3))
    found, truth = [model.solve(point) for point in points], np.array([full.solve(point).outputs for point in points])
    errors = truth - np.array([one.outputs for one in found])
    relative = np.sqrt((errors**2).mean(axis=0)) / truth.std(axis=0)
    assert (relative < 0.03).all(), relative
    np.testing.assert_allclose([one.outputs[0] for one in found], [one.outputs[2] for one in found], rtol=0.01)
    check_derivatives(model, NOMINAL, 0.1 * SPREAD, steps=STEPS).require()
