"""Models made of finite-element bodies: derivatives and errors of the mesh, on one rank and on two."""

import numpy as np
import pytest
from mpi4py import MPI
from scipy.sparse import csr_matrix

from forward.affine import Sparse
from forward.combine import Joined, Mapped, Rows, selected
from forward.conformance import check_derivatives
from forward.fem.finer import FromStart, limit
from forward.hyperelastic import Hyperelastic, Path
from forward.specimen import Specimen
from tests.launch import on_kept_ranks

pytestmark = pytest.mark.fem

BODY = {"size": (1.0, 1.0, 1.0), "cells": (2, 1, 1), "degree": 1}
PULL = {"kind": "traction", "on": "x-max", "direction": (1, 0, 1), "size": 900.0}
MATERIAL = {"kind": "neo-hookean-coupled", "mu": 1e4, "lmbda": 4e4}
SHARED = {"body": BODY, "material": MATERIAL, "solver": {"tolerance": 1e-12}}
HELD = {"clamp": ["x-min"], "loads": [PULL]}
OUTPUTS = [
    {"name": "corner", "kind": "displacement", "at": (1.0, 0.0, 1.0), "component": "z"},
    {"name": "end", "kind": "mean-displacement", "on": "x-max", "component": "x"},
]
NAMES = ("material.mu", "loads.traction.size")
POINT = np.array([1.1e4, 800.0])


def body(comm, cells=(2, 1, 1)):
    spec = SHARED | HELD | {"body": BODY | {"cells": cells}, "outputs": OUTPUTS}
    return Hyperelastic.model_validate(spec).build(comm, NAMES)


def path(comm):
    steps = {"loads.traction.size": [400.0, 900.0]}
    spec = {**SHARED, **HELD, "kind": "path", "outputs": OUTPUTS, "steps": steps}
    return Path.model_validate(spec).build(comm, ("material.mu", "material.lmbda"))


def specimen(comm):
    push = PULL | {"name": "push", "direction": (0, 1, 0), "size": 300.0}
    cases = [
        {"name": "pull", **HELD, "outputs": OUTPUTS[1:]},
        {"name": "push", "clamp": ["x-min"], "loads": [push]},
    ]
    spec = SHARED | {"cases": cases, "observed": [{"at": [(1.0, 0.0, 1.0)], "components": "xz"}]}
    return Specimen.model_validate(spec).build(comm, NAMES)


def two_meshes(comm):
    fine, coarse = body(comm, (3, 1, 1)), body(comm)
    both = Joined((fine, coarse), (*fine.outputs, "corner on the coarse mesh", "end on the coarse mesh"))
    return limit(FromStart(both, POINT), csr_matrix(np.eye(2)), fine.outputs, 0.8)


def tied(comm):
    """Of one number q: μ = 1e4 q, and the traction is 300 + 500 q."""
    by = Sparse(csr_matrix([[1e4], [500.0]]), np.array([0.0, 300.0]))
    return Mapped(Rows(body(comm), csr_matrix([[1.0, 2.0], [0.0, -1.0]]), ("sum", "turned")), by, ("q",))


MADE = {
    "some outputs": (lambda comm: selected(body(comm), (1, 1, 0)), POINT),
    "tied": (tied, np.array([1.1])),
    "two meshes": (two_meshes, POINT),
    "path": (path, np.array([1.1e4, 4e4])),
    "specimen": (specimen, POINT),
    "some of a specimen": (lambda comm: selected(specimen(comm), (4, 0)), POINT),
}


def check(name, comm):
    made, point = MADE[name]
    directions = np.random.default_rng(0).uniform(-1, 1, (2, len(point)))
    found = check_derivatives(made(comm), point, 0.3 * point, directions=directions, steps=(1 / 32, 1 / 64, 1 / 128))
    found.require()


@pytest.mark.parametrize("name", MADE)
def test_derivatives(name):
    check(name, MPI.COMM_SELF)


@pytest.mark.parametrize("name", ["some outputs", "tied", "two meshes", "path", "some of a specimen"])
def test_errors_of_the_mesh_follow_the_outputs(name):
    """They are sums of those of what a model is made of, with the weights of the outputs."""
    made, point = MADE[name]
    found = made(MPI.COMM_SELF).solve(point)
    error = found.mesh_error()
    if name == "two meshes":
        fine, coarse = (
            body(MPI.COMM_SELF, cells).solve(point).mesh_error().outputs for cells in ((3, 1, 1), (2, 1, 1))
        )
        expected = np.append(fine + 0.8 * (fine - coarse), fine - coarse)
    elif name == "path":
        alone = Hyperelastic.model_validate(SHARED | HELD | {"outputs": OUTPUTS})
        body_of_steps = alone.build(MPI.COMM_SELF, ("material.mu", "material.lmbda", "loads.traction.size"))
        steps = [body_of_steps.solve(np.append(point, size)).mesh_error().outputs for size in (400.0, 900.0)]
        expected = np.concatenate(steps)
    elif name == "some of a specimen":
        expected = specimen(MPI.COMM_SELF).solve(point).mesh_error().outputs[[4, 0]]
    else:
        own = body(MPI.COMM_SELF).solve(np.array([1.1e4, 850.0]) if name == "tied" else point).mesh_error().outputs
        expected = own[[1, 1, 0]] if name == "some outputs" else [own[0] + 2 * own[1], -own[1]]
    np.testing.assert_allclose(error.outputs, expected, rtol=1e-6)


SCRIPT = """
from mpi4py import MPI
from tests.forward.fem.test_combine import MADE
import numpy as np

for made, point in MADE.values():
    one, two = (made(comm).solve(point) for comm in (MPI.COMM_SELF, MPI.COMM_WORLD))
    weights = np.eye(len(one.outputs))
    pairs = ((one.outputs, two.outputs), (one.tangent(np.diag(point)), two.tangent(np.diag(point))),
             (one.adjoint(weights) * point, two.adjoint(weights) * point),
             (one.mesh_error().outputs, two.mesh_error().outputs))
    for a, b in pairs:
        np.testing.assert_allclose(b, a, rtol=1e-6, atol=1e-8 * np.abs(a).max())
"""


@pytest.mark.slow
@pytest.mark.mpi
def test_two_ranks_give_what_one_gives():
    done = on_kept_ranks(2, SCRIPT)
    assert done.returncode == 0, done.stderr
