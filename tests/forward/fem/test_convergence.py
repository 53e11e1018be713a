"""Convergence to a manufactured solution, of which SymPy derives the body force from the energy of the model."""

from functools import cache

import basix
import numpy as np
import pytest
import sympy as sp
import ufl
from mpi4py import MPI

from forward.fem.dolfinx import spaces, version
from forward.fem.equations import Discretisation
from forward.hyperelastic import Hyperelastic
from forward.solvers.acceptance import Search
from forward.solvers.newton import newton

pytestmark = pytest.mark.fem
MATERIAL = {"kind": "neo-hookean-coupled", "mu": 1.0, "lmbda": 2.0}
AMPLITUDES = (0.06, -0.04, 0.05)


@cache
def manufactured():
    """u, ∇u and the force −Div P as functions of points (n, 3): u vanishes on the boundary of the unit cube."""
    X = sp.symbols("x y z")
    bump = sp.prod(sp.sin(sp.pi * x) for x in X)
    u = sp.Matrix([a * bump * sp.exp(X[i] / 2) for i, a in enumerate(AMPLITUDES)])
    H = u.jacobian(X)

    F = sp.Matrix(3, 3, sp.symbols("F:9"))
    mu, lmbda = MATERIAL["mu"], MATERIAL["lmbda"]
    C, J = F.T * F, F.det()
    W = mu / 2 * (sp.trace(C) - 3) - mu * sp.log(J) + lmbda / 2 * sp.log(J) ** 2
    P = [sp.diff(W, f) for f in F]
    elasticity = sp.lambdify([F], [[sp.diff(p, f) for f in F] for p in P], cse=True)

    displacement = sp.lambdify([X], list(u), cse=True)
    gradient = sp.lambdify([X], list(H), cse=True)
    second = sp.lambdify([X], [[sp.diff(h, x) for h in H] for x in X], cse=True)

    def rows(values, points):
        return np.stack([np.broadcast_to(v, len(points)) for v in values], axis=-1)

    def force(points):
        columns = points.T
        A = elasticity((np.eye(3).ravel() + rows(gradient(columns), points)).T)
        dH = second(columns)
        # (Div P)_i = Σ_j ∂P_ij/∂F_kl ∂H_kl/∂X_j
        return -rows([sum(A[3 * i + j][m] * dH[j][m] for j in range(3) for m in range(9)) for i in range(3)], points)

    return (
        lambda points: rows(displacement(points.T), points),
        lambda points: rows(gradient(points.T), points).reshape(-1, 3, 3),
        force,
    )


class Forced(Discretisation):
    """A body under a force per volume that is given at the quadrature points."""

    def __init__(self, spec, comm):
        super().__init__(spec, comm, ())
        _, places, *_ = self.interpolation(spec.body.quadrature)
        force = manufactured()[2](places.reshape(-1, 3))
        densities = [spaces.function(spaces.quadrature_space(self.mesh, spec.body.quadrature)) for _ in range(3)]
        for density, column in zip(densities, force.T, strict=True):
            density.x.array[version.nodes_of_cells(density.function_space, 1).ravel()] = column
        load = self.vector(ufl.inner(ufl.as_vector(densities), self.test) * self.dx)()
        internal = self._residual
        self._residual = lambda: internal() - float(self._load.value) * load

    def interpolation(self, degree):
        """Nodes of the cells, and at quadrature points: places, shape functions, their gradients, and weights."""
        cell = getattr(basix.CellType, self.spec.body.cell)
        points, weights = basix.make_quadrature(cell, degree)
        element = basix.create_element(
            basix.ElementFamily.P, cell, self.spec.body.degree, basix.LagrangeVariant.gll_warped
        )
        table = element.tabulate(1, points)[..., 0]  # (value and derivatives, points, nodes)
        nodes = version.nodes_of_cells(self.space, table.shape[2])
        X = np.asarray(self.space.tabulate_dof_coordinates())[nodes]
        jacobian = np.einsum("dqa,cai->cqid", table[1:], X)
        gradients = np.einsum("dqa,cqdi->cqai", table[1:], np.linalg.inv(jacobian))
        volumes = weights * np.abs(np.linalg.det(jacobian))
        return nodes, np.einsum("qa,cai->cqi", table[0], X), table[0], gradients, volumes

    def errors(self, u):
        """Norms of the errors of u and of ∇u."""
        nodes, places, shapes, gradients, volumes = self.interpolation(2 * self.spec.body.degree + 2)
        values = u.reshape(-1, 3)[nodes]
        exact_u, exact_gradient, _ = manufactured()
        gap = np.einsum("qa,cai->cqi", shapes, values) - exact_u(places.reshape(-1, 3)).reshape(places.shape)
        slope = np.einsum("cai,cqaj->cqij", values, gradients)
        slope -= exact_gradient(places.reshape(-1, 3)).reshape(slope.shape)
        return [np.sqrt(volumes.ravel() @ (e**2).reshape(volumes.size, -1).sum(axis=1)) for e in (gap, slope)]


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("cell", "degree", "cells", "bound"),
    [
        ("hexahedron", 1, (6, 12), (2e-4 * (16 / 12) ** 2, 1.3e-2 * 16 / 12)),
        ("hexahedron", 2, (3, 6), (2.6e-5 * (8 / 6) ** 3, 1.3e-3 * (8 / 6) ** 2)),
        ("tetrahedron", 1, (7, 14), (1e-3 * (16 / 14) ** 2, 2.9e-2 * 16 / 14)),
        ("tetrahedron", 2, (3, 6), (9.5e-5 * (8 / 6) ** 3, 5.6e-3 * (8 / 6) ** 2)),
    ],
)
def test_errors_fall_at_the_theoretical_rate(cell, degree, cells, bound):
    errors = []
    for n in cells:
        spec = Hyperelastic.model_validate(
            {
                "body": {"size": (1.0, 1.0, 1.0), "cells": (n, n, n), "cell": cell, "degree": degree},
                "material": MATERIAL,
                "clamp": ("x-min", "x-max", "y-min", "y-max", "z-min", "z-max"),
                "outputs": ({"kind": "strain-energy", "name": "energy"},),
            }
        )
        body = Forced(spec, MPI.COMM_SELF)
        body.set_parameters(np.empty(0))
        body.at_load(1.0)
        exact = manufactured()[0](np.asarray(body.space.tabulate_dof_coordinates())).ravel()
        found, _ = newton(Search(body, spec.solver), exact, 1.0)  # it is near what is solved for
        errors.append(body.errors(found.state))
    rates = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert rates[-1] == pytest.approx([degree + 1, degree], abs=0.15)
    assert (np.array(errors[-1]) < bound).all()


def test_the_manufactured_solution_is_what_sympy_says():
    """The force is the divergence of the stress: by differences, at one point."""
    u, gradient, force = manufactured()
    place, h = np.array([0.3, 0.6, 0.45]), 1e-4
    steps = h * np.eye(3)
    slope = np.stack([(u(place[None] + s) - u(place[None] - s))[0] / (2 * h) for s in steps], axis=-1)
    np.testing.assert_allclose(gradient(place[None])[0], slope, atol=1e-7)

    def stress(X):
        F = np.eye(3) + gradient(X[None])[0]
        return MATERIAL["mu"] * F + (MATERIAL["lmbda"] * np.log(np.linalg.det(F)) - MATERIAL["mu"]) * np.linalg.inv(F).T

    divergence = sum((stress(place + s) - stress(place - s))[:, j] / (2 * h) for j, s in enumerate(steps))
    np.testing.assert_allclose(force(place[None])[0], -divergence, rtol=1e-6)
    corners = np.array([[0, 0.2, 0.7], [1, 0.5, 0.5], [0.3, 0.4, 1]])
    np.testing.assert_allclose(u(corners), 0, atol=1e-16)
