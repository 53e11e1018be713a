"""Strain energies: closed forms of their moduli, what vanishes in the undeformed body, and the isochoric split."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import sympy as sp
from mpi4py import MPI

from forward import kinematics
from forward.hyperelastic import Hyperelastic
from forward.materials import MATERIALS, constants, small_strain_moduli, splits, units
from forward.model import SolveError
from tests.bodies import MATERIALS as BLOCKS
from tests.bodies import MORE_MATERIALS
from tests.launch import run_script

OPS = SimpleNamespace(ln=sp.log, exp=sp.exp, sqrt=sp.sqrt, tr=sp.trace, det=lambda F: F.det())
VALUES = {
    kind: {name: value for name, value in block.items() if name != "kind"}
    for kind, block in (BLOCKS | MORE_MATERIALS).items()
}
MODULI = {  # μ and κ
    "mooney-rivlin": lambda C1, C2, D1: (2 * (C1 + C2), 2 * D1),
    "neo-hookean": lambda C1, D1: (2 * C1, 2 * D1),
    "neo-hookean-coupled": lambda mu, lmbda: (mu, lmbda + 2 * mu / 3),
    "yeoh": lambda C10, C20, C30, D1: (2 * C10, 2 * D1),
    "gent": lambda mu, Jm, D1: (mu, 2 * D1),
    "demiray": lambda a, b, D1: (a, 2 * D1),
    "saint-venant-kirchhoff": lambda lmbda, mu: (mu, lmbda + 2 * mu / 3),
    "blatz-ko": lambda mu: (mu, 5 * mu / 3),
}
# What is written in textbooks, with F, C and the modified invariants.
TEXTBOOK = {
    "yeoh": lambda I1, C10, C20, C30, D1: C10 * (I1 - 3) + C20 * (I1 - 3) ** 2 + C30 * (I1 - 3) ** 3,
    "gent": lambda I1, mu, Jm, D1: -mu * Jm / 2 * math.log(1 - (I1 - 3) / Jm),
    "demiray": lambda I1, a, b, D1: a / (2 * b) * (math.exp(b * (I1 - 3)) - 1),
}
F = np.array([[1.1, 0.3, -0.1], [0.05, 0.9, 0.2], [-0.15, 0.1, 1.2]])


def energy(kind, F, **constants):
    """Energy density by SymPy of a deformation gradient, in symbols or numbers."""
    return MATERIALS[kind](OPS, *kinematics.invariants(OPS, F), **constants)


def symbols(kind):
    return {name: sp.Symbol(name, positive=True) for name in constants(MATERIALS[kind])}


def test_every_material_is_tested():
    assert set(VALUES) == set(MODULI) == set(MATERIALS)


@pytest.mark.parametrize("kind", MATERIALS)
def test_small_strain_moduli(kind):
    expected = MODULI[kind](**VALUES[kind])
    assert small_strain_moduli(kind, VALUES[kind]) == pytest.approx(expected, rel=1e-10)
    assert small_strain_moduli(MATERIALS[kind], VALUES[kind]) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("ratio", [1e-3, 1.0, 1e4, 1e8])
def test_small_strain_moduli_of_any_compressibility(ratio):
    found = small_strain_moduli("demiray", {"a": 3.0, "b": 40.0, "D1": 1.5 * ratio})
    assert found == pytest.approx((3.0, 3.0 * ratio), rel=1e-6)


@pytest.mark.parametrize("kind", MATERIALS)
def test_energy_and_stress_vanish_in_the_undeformed_body(kind):
    variables = sp.Matrix(3, 3, sp.symbols("F:9"))
    identity = dict(zip(variables, sp.eye(3), strict=True))
    W = energy(kind, variables, **symbols(kind))
    assert sp.nsimplify(W.subs(identity)) == 0
    for variable in (variables[0, 0], variables[1, 1], variables[0, 1], variables[2, 0]):
        assert sp.nsimplify(sp.simplify(sp.diff(W, variable).subs(identity))) == 0


@pytest.mark.parametrize("kind", [kind for kind in MATERIALS if "D1" in VALUES[kind]])
def test_what_is_called_D1_multiplies_the_whole_volumetric_part(kind):
    assert splits(kind)
    assert splits(MATERIALS[kind])
    I1, I2, J, scale = sp.symbols("I1 I2 J s", positive=True)
    named = symbols(kind)
    W = MATERIALS[kind](OPS, I1, I2, J, **named)
    isochoric = MATERIALS[kind](OPS, I1, I2, J, **(named | {"D1": 0}))
    assert sp.simplify(W - isochoric - named["D1"] * (J - 1) ** 2) == 0
    # A change of volume scales I1 by s², I2 by s⁴ and J by s³: what is left must not feel it.
    swollen = isochoric.subs({I1: scale**2 * I1, I2: scale**4 * I2, J: scale**3 * J}, simultaneous=True)
    assert sp.simplify(sp.nsimplify(swollen - isochoric, rational=True)) == 0


@pytest.mark.parametrize("kind", [kind for kind in MATERIALS if "D1" not in VALUES[kind]])
def test_energies_without_a_split_say_so(kind):
    assert not splits(kind)


@pytest.mark.parametrize("kind", TEXTBOOK)
def test_isochoric_energies_against_the_formula(kind):
    J = np.linalg.det(F)
    expected = TEXTBOOK[kind](J ** (-2 / 3) * np.trace(F.T @ F), **VALUES[kind]) + VALUES[kind]["D1"] * (J - 1) ** 2
    assert float(energy(kind, sp.Matrix(F), **VALUES[kind])) == pytest.approx(expected, rel=1e-13)


def test_other_energies_against_the_formula():
    E = (F.T @ F - np.eye(3)) / 2
    expected = 1e5 / 2 * np.trace(E) ** 2 + 4e4 * np.tensordot(E, E)
    found = energy("saint-venant-kirchhoff", sp.Matrix(F), lmbda=1e5, mu=4e4)
    assert float(found) == pytest.approx(expected, rel=1e-12)
    # I2/J² is the trace of the inverse of C.
    expected = 5e4 / 2 * (np.trace(np.linalg.inv(F.T @ F)) + 2 * np.linalg.det(F) - 5)
    assert float(energy("blatz-ko", sp.Matrix(F), mu=5e4)) == pytest.approx(expected, rel=1e-12)


def test_limits_of_the_fung_and_gent_energies_are_neo_hookean():
    expected = energy("neo-hookean", sp.Matrix(F), C1=1e4, D1=2e5)
    assert float(energy("demiray", sp.Matrix(F), a=2e4, b=1e-8, D1=2e5)) == pytest.approx(float(expected), rel=1e-6)
    assert float(energy("gent", sp.Matrix(F), mu=2e4, Jm=1e8, D1=2e5)) == pytest.approx(float(expected), rel=1e-6)


def test_every_constant_has_a_unit_and_a_name_has_one():
    of = {}
    for kind, law in MATERIALS.items():
        assert set(units(law)) == set(VALUES[kind])
        for name, unit in units(law).items():
            assert unit in {"Pa", "1"}
            assert of.setdefault(name, unit) == unit, f"{name} has two units"
    assert {name for name, unit in of.items() if unit == "1"} == {"Jm", "b"}


def test_materials_need_nothing_heavy():
    script = (
        "import sys, forward.materials as m; m.small_strain_moduli('gent', {'mu': 1.0, 'Jm': 2.0, 'D1': 3.0});"
        "sys.exit(bool({'sympy', 'numpy', 'ufl', 'dolfinx', 'mpi4py'} & set(sys.modules)))"
    )
    assert run_script(None, script).returncode == 0


@pytest.mark.fem
def test_chains_that_are_stretched_out_stop_the_solver():
    """Past Jm the energy of Gent is no number: what goes there stops with a reason, and does not crash."""
    held = ("x-min", "y-min", "y-max", "z-min", "z-max")
    spec = Hyperelastic.model_validate(
        {
            "body": {"size": (1.0, 0.7, 0.8), "cells": (2, 1, 1), "cell": "tetrahedron", "degree": 1},
            "material": MORE_MATERIALS["gent"] | {"Jm": 0.6},
            "displacements": (*({"on": on, on[0]: 0.0} for on in held), {"on": "x-max", "x": 0.1}),
            "outputs": ({"kind": "reaction", "name": "R", "on": "x-max", "component": "x"},),
            "solver": {"minimum_load_step": 1 / 64},
        }
    )
    model = spec.build(MPI.COMM_SELF, ("displacements.x-max.x",))

    # F = diag(λ, 1, 1) has Ī1 − 3 = λ^(−2/3) (λ² + 2) − 3, which is 0.6 at λ = 1.85.
    def force(stretch):
        x = sp.Symbol("x", positive=True)
        W = energy("gent", sp.diag(x, 1, 1), **(VALUES["gent"] | {"Jm": 0.6}))
        return float(sp.diff(W, x).subs(x, stretch)) * 0.7 * 0.8

    for stretch in (1.2, 1.8):
        assert model.solve(np.array([stretch - 1])).outputs[0] == pytest.approx(force(stretch), rel=1e-6)
    with pytest.raises(SolveError, match=r"stopped at [78]\d(\.\d+)? % of the load"):
        model.solve(np.array([1.0]))
