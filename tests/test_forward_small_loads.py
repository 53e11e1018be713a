"""Loads of 10⁻³ to 10⁻¹² of the stiffness: energies, reactions, stresses and residuals keep their digits."""

import math

import mpmath
import numpy as np
import pytest
import sympy as sp
from mpi4py import MPI

from forward import kinematics
from forward.admissible import moduli
from forward.homogeneous import HomogeneousModel, MaterialTest
from forward.hyperelastic import Hyperelastic
from forward.materials import MATERIALS, measures
from tests.bodies import MATERIALS as BLOCKS
from tests.bodies import MORE_MATERIALS, NOT_CONSTANTS, SYMPY

ALL = BLOCKS | MORE_MATERIALS
VALUES = {kind: {name: v for name, v in block.items() if name not in NOT_CONSTANTS} for kind, block in ALL.items()}
LOADS = (1e-3, 1e-6, 1e-9, 1e-12, -1e-12)
GRADIENT = np.array([[0.3, 0.7, -0.4], [-0.2, 0.1, 0.6], [0.5, -0.3, 0.2]])
FIBRE = (0.6, 0.8, 0.0)


def textbook(kind, H):
    """Energy density as in textbooks, with I1 − 3, J − 1 and so on as differences, in the digits of mpmath."""
    v = {name: mpmath.mpf(value) for name, value in VALUES[kind].items()}
    F = mpmath.eye(3) + H
    C = F.T * F
    J = mpmath.det(F)
    I1 = C[0, 0] + C[1, 1] + C[2, 2]
    square = C * C
    I2 = (I1**2 - square[0, 0] - square[1, 1] - square[2, 2]) / 2
    i1, i2 = I1 / mpmath.cbrt(J) ** 2 - 3, I2 / mpmath.cbrt(J) ** 4 - 3
    volume = v.get("D1", 0) * (J - 1) ** 2
    match kind:
        case "mooney-rivlin":
            return v["C1"] * i1 + v["C2"] * i2 + volume
        case "neo-hookean":
            return v["C1"] * i1 + volume
        case "neo-hookean-coupled":
            return v["mu"] / 2 * (I1 - 3) - v["mu"] * mpmath.log(J) + v["lmbda"] / 2 * mpmath.log(J) ** 2
        case "yeoh":
            return v["C10"] * i1 + v["C20"] * i1**2 + v["C30"] * i1**3 + volume
        case "gent":
            return -v["mu"] * v["Jm"] / 2 * mpmath.log(1 - i1 / v["Jm"]) + volume
        case "demiray":
            return v["a"] / (2 * v["b"]) * (mpmath.exp(v["b"] * i1) - 1) + volume
        case "saint-venant-kirchhoff":
            return v["lmbda"] / 8 * (I1 - 3) ** 2 + v["mu"] / 4 * (I1**2 - 2 * I2 - 2 * I1 + 3)
        case "blatz-ko":
            return v["mu"] / 2 * (I2 / J**2 + 2 * J - 5)
        case "ogden":
            stretches = [mpmath.sqrt(square) for square in mpmath.eigsy(C)[0]]
            powers = [sum((l / mpmath.cbrt(J)) ** v[f"alpha{k}"] - 1 for l in stretches) for k in "123"]
            return volume + sum(v[f"mu{k}"] / v[f"alpha{k}"] * p for k, p in zip("123", powers, strict=True))
        case "holzapfel-gasser-ogden":
            a = mpmath.matrix(FIBRE)
            longer = max((a.T * C * a)[0] - 1, 0)
            return v["c"] / 2 * i1 + v["k1"] / (2 * v["k2"]) * (mpmath.exp(v["k2"] * longer**2) - 1) + volume


def in_doubles(kind, H):
    """The same by the energy of the model, in numbers of 16 digits."""
    ops = operators()
    at = kinematics.deformation(ops, sp.Matrix(H), sp.eye(3))
    if "l1" in measures(kind):
        strains = np.linalg.eigvalsh(np.array(at.strain, dtype=float))
        logarithms = kinematics.isochoric([np.log1p(strain) / 2 for strain in strains])
        found = [*logarithms, float(at.dilation)]
    else:
        found = [kinematics.measure(ops, name, at, [sp.Matrix(FIBRE)]) for name in measures(kind)]
    return float(MATERIALS[kind](ops, *found, **VALUES[kind]))


def operators():
    """Operators in doubles, with SymPy's matrices."""
    ops = type(SYMPY)(**vars(SYMPY))
    for name in ("exp", "sinh", "sqrt", "log1p", "expm1"):
        setattr(ops, name, getattr(math, name))
    ops.ln = math.log
    ops.positive = lambda x: max(float(x), 0.0)
    ops.near = lambda z, limit, inside, outside: inside if abs(z) < limit else outside
    return ops


@pytest.mark.parametrize("kind", ALL)
def test_energies_keep_their_digits(kind):
    """Against 60 digits of the textbook's formula, from a strain of a third down to 10⁻¹²."""
    for size in (0.3, 1e-2, 1e-4, 1e-6, 1e-9, 1e-12):
        H = size * GRADIENT
        with mpmath.workdps(60):
            expected = float(textbook(kind, mpmath.matrix(H.tolist())))
        found = in_doubles(kind, H.tolist())
        assert found > 0
        assert found == pytest.approx(expected, rel=3e-14)


@pytest.mark.parametrize("kind", [kind for kind in ALL if "fibres" not in ALL[kind]])
def test_material_points_under_small_strains(kind):
    """Uniaxial stress is Young's modulus times the strain, and simple shear μγ, up to the order of the strain."""
    mu, kappa = moduli(kind, VALUES[kind])
    young = 9 * kappa * mu / (3 * kappa + mu)
    for strain in (2.0**-20, -(2.0**-30), 2.0**-40):  # of which 1 + strain is exact
        tests = [MaterialTest(mode="uniaxial", at=(1 + strain,)), MaterialTest(mode="simple-shear", at=(strain,))]
        pull, shear = HomogeneousModel(kind, VALUES[kind], tests, ()).stresses(np.zeros((1, 0)))[0]
        assert pull == pytest.approx(young * strain, rel=20 * abs(strain) + 1e-12)
        assert shear == pytest.approx(mu * strain, rel=20 * abs(strain) + 1e-12)


@pytest.mark.fem
@pytest.mark.parametrize("kind", ["mooney-rivlin", "neo-hookean-coupled", "gent", "blatz-ko"])
def test_small_loads_are_linear_elasticity(kind):
    """A bar pulled by a traction t: energy t²/2E, reaction, stress, change of volume t/3κ and elongation t/E."""
    rollers = tuple({"on": f"{axis}-min", axis: 0.0} for axis in "xyz")
    spec = Hyperelastic.model_validate(
        {
            "formulation": "displacement",
            "body": {"size": (1.0, 1.0, 1.0), "cells": (2, 1, 1), "cell": "tetrahedron", "degree": 1},
            "material": ALL[kind],
            "displacements": rollers,
            "loads": ({"kind": "traction", "on": "x-max", "direction": (1.0, 0.0, 0.0), "size": 1.0},),
            "outputs": (
                {"kind": "strain-energy", "name": "energy"},
                {"kind": "reaction", "name": "reaction", "on": "x-min", "component": "x"},
                {"kind": "max-von-mises", "name": "stress"},
                {"kind": "volume-change", "name": "volume"},
                {"kind": "max-displacement", "name": "elongation", "component": "x"},
            ),
        }
    )
    model = spec.build(MPI.COMM_SELF, ("loads.traction.size",))
    mu, kappa = moduli(kind, VALUES[kind])
    young = 9 * kappa * mu / (3 * kappa + mu)
    for load in LOADS:
        t = load * mu
        solution = model.solve(np.array([t]))
        expected = [t**2 / (2 * young), -t, abs(t), t / (3 * kappa), abs(t) / young]
        assert solution.outputs[0] > 0
        np.testing.assert_allclose(solution.outputs, expected, rtol=5 * abs(load) + 2e-8)
        assert solution.residual <= 1e-8
    # What rounding leaves is a part of the load, however small that is: a residual of 3 % never is.
    state = solution.state
    assert model.body.rounding(state, model.body.residual(state).scale) <= 1e-4 * model.body.residual(state).scale
