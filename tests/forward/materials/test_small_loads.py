"""Loads of 10⁻³ to 10⁻¹² of the stiffness: energies, reactions, stresses and residuals keep their digits."""

import math

import mpmath
import numpy as np
import pytest
import sympy as sp
from mpi4py import MPI

from forward.hyperelastic import Hyperelastic
from forward.materials import kinematics
from forward.materials.admissible import moduli
from forward.materials.material import MATERIALS, measures
from forward.materials.material_point import HomogeneousModel, MaterialTest
from tests import textbook
from tests.bodies import MATERIALS as BLOCKS
from tests.bodies import MORE_MATERIALS, NOT_CONSTANTS, SYMPY

ALL = BLOCKS | MORE_MATERIALS
VALUES = {kind: {name: v for name, v in block.items() if name not in NOT_CONSTANTS} for kind, block in ALL.items()}
LOADS = (1e-3, 1e-6, 1e-9, 1e-12, -1e-12)
GRADIENT = np.array([[0.3, 0.7, -0.4], [-0.2, 0.1, 0.6], [0.5, -0.3, 0.2]])
FIBRE = (0.6, 0.8, 0.0)


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
    given = {"fibres": (FIBRE,)} if "fibres" in ALL[kind] else {}
    for size in (0.3, 1e-2, 1e-4, 1e-6, 1e-9, 1e-12):
        H = size * GRADIENT
        with mpmath.workdps(60):
            expected = float(textbook.energy(ALL[kind] | given, mpmath.eye(3) + mpmath.matrix(H.tolist())))
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
@pytest.mark.parametrize(
    "material",
    [
        *("mooney-rivlin", "neo-hookean-coupled", "gent", "blatz-ko", "ogden", "holzapfel-gasser-ogden"),
        *("neo-hookean mixed", "ogden mixed"),
        pytest.param("holzapfel-gasser-ogden mixed", marks=pytest.mark.slow),
    ],
)
def test_small_loads_are_linear_elasticity(material):
    """A bar under a traction t: energy t²/2E, reaction, stress, change of volume t E/(3κ E') and elongation t/E'.

    E' is E, and with fibres that are pulled E + 4 k1.
    """
    kind, _, mixed = material.partition(" ")
    rollers = tuple({"on": f"{axis}-min", axis: 0.0} for axis in "xyz")
    spec = Hyperelastic.model_validate(
        {
            "formulation": mixed or "displacement",
            "body": {"size": (1.0, 1.0, 1.0), "cells": (2, 1, 1), "cell": "tetrahedron", "degree": 2 if mixed else 1},
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
        along = young + 4 * VALUES[kind].get("k1", 0.0) * (t > 0)
        expected = [t**2 / (2 * along), -t, abs(t), t / (3 * kappa) * young / along, abs(t) / along]
        assert solution.outputs[0] > 0
        np.testing.assert_allclose(solution.outputs, expected, rtol=5 * abs(load) + 2e-8)
        assert solution.residual <= 1e-8
    # What rounding leaves is a part of the load, however small that is: a residual of 3 % never is.
    state = solution.state
    scale = model.equations.residual(state).scale
    assert model.equations.rounding(state, scale) <= 1e-4 * scale
