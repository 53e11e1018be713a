"""Strain energies: closed forms of their moduli, what vanishes in the undeformed body, and the isochoric split."""

import math
from typing import get_args

import numpy as np
import pytest
import sympy as sp
from mpi4py import MPI
from mpmath import mp

from forward.fem.dolfinx import assembly, meshes, spaces
from forward.fem.invariants import OPS, Invariants
from forward.hyperelastic import Hyperelastic
from forward.materials import kinematics
from forward.materials.material import MATERIALS, constants, measured, measures, small_strain_moduli, splits
from forward.model import SolveError
from forward.scalars import unit_of
from tests.bodies import MATERIALS as BLOCKS
from tests.bodies import MORE_MATERIALS, NOT_CONSTANTS, SYMPY, energy_density, unloaded_body
from tests.launch import run_script

VALUES = {
    kind: {name: value for name, value in block.items() if name not in NOT_CONSTANTS}
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
    "ogden": lambda mu1, alpha1, mu2, alpha2, mu3, alpha3, D1: (
        (mu1 * alpha1 + mu2 * alpha2 + mu3 * alpha3) / 2,
        2 * D1,
    ),
    "holzapfel-gasser-ogden": lambda c, k1, k2, D1: (c, 2 * D1),
}
# What is written in textbooks, with F, C and the modified invariants.
TEXTBOOK = {
    "yeoh": lambda I1, C10, C20, C30, D1: C10 * (I1 - 3) + C20 * (I1 - 3) ** 2 + C30 * (I1 - 3) ** 3,
    "gent": lambda I1, mu, Jm, D1: -mu * Jm / 2 * math.log(1 - (I1 - 3) / Jm),
    "demiray": lambda I1, a, b, D1: a / (2 * b) * (math.exp(b * (I1 - 3)) - 1),
}
SKEW = ((0.6, 0.8, 0.0), (0.48, 0.6, 0.64))
F = np.array([[1.1, 0.3, -0.1], [0.05, 0.9, 0.2], [-0.15, 0.1, 1.2]])


def symbols(kind):
    return {name: sp.Symbol(name, positive=True) for name in constants(MATERIALS[kind])}


@pytest.mark.unit
def test_every_material_is_tested():
    assert set(VALUES) == set(MODULI) == set(MATERIALS)


@pytest.mark.unit
@pytest.mark.parametrize("kind", MATERIALS)
def test_small_strain_moduli(kind):
    expected = MODULI[kind](**VALUES[kind])
    assert small_strain_moduli(kind, VALUES[kind]) == pytest.approx(expected, rel=1e-10)
    assert small_strain_moduli(MATERIALS[kind], VALUES[kind]) == pytest.approx(expected, rel=1e-10)


@pytest.mark.unit
@pytest.mark.parametrize("ratio", [1e-3, 1.0, 1e4, 1e8])
def test_small_strain_moduli_of_any_compressibility(ratio):
    found = small_strain_moduli("demiray", {"a": 3.0, "b": 40.0, "D1": 1.5 * ratio})
    assert found == pytest.approx((3.0, 3.0 * ratio), rel=1e-6)


@pytest.mark.parametrize("kind", [kind for kind in MATERIALS if kind != "ogden"])
def test_energy_and_stress_vanish_in_the_undeformed_body(kind):
    fibres = SKEW if "i4" in measures(kind) else ()
    assert energy_density(kind, sp.eye(3), fibres, **VALUES[kind]) == 0
    for i, j in ((0, 0), (1, 1), (0, 1), (2, 0)):
        moved = sp.eye(3)
        moved[i, j] += sp.Rational(1, 10**20)
        assert abs(sp.N(energy_density(kind, moved, fibres, **VALUES[kind]), 30)) < 1e-10 * 1e-20


@pytest.mark.parametrize("kind", [kind for kind in MATERIALS if "D1" in VALUES[kind]])
def test_what_is_called_D1_multiplies_the_whole_volumetric_part(kind):
    assert splits(kind)
    assert splits(MATERIALS[kind])
    stretches, J, scale = (sp.Rational(13, 10), sp.Rational(4, 5), sp.Rational(11, 10)), sp.Rational(6, 5), 2

    def W(change, **values):
        less_one = tuple(change * stretch - 1 for stretch in stretches)
        known = measured(kind, SYMPY, less_one, change**3 * J - 1)
        return float(sp.N(MATERIALS[kind](SYMPY, *known.values(), **(VALUES[kind] | values)), 30))

    # Of no deformation, as J is not the product of the stretches: a formula is seen better so.
    isochoric = W(1, D1=0)
    assert W(1) - isochoric == pytest.approx(VALUES[kind]["D1"] * float(J - 1) ** 2, rel=1e-10)
    # A change of volume scales stretches by s and J by s³: what is left must not feel it.
    assert W(scale, D1=0) == pytest.approx(isochoric, rel=1e-10)


@pytest.mark.unit
@pytest.mark.parametrize("kind", [kind for kind in MATERIALS if "D1" not in VALUES[kind]])
def test_energies_without_a_split_say_so(kind):
    assert not splits(kind)


@pytest.mark.parametrize("kind", TEXTBOOK)
def test_isochoric_energies_against_the_formula(kind):
    J = np.linalg.det(F)
    expected = TEXTBOOK[kind](J ** (-2 / 3) * np.trace(F.T @ F), **VALUES[kind]) + VALUES[kind]["D1"] * (J - 1) ** 2
    assert float(energy_density(kind, sp.Matrix(F), **VALUES[kind])) == pytest.approx(expected, rel=1e-13)


@pytest.mark.unit
def test_other_energies_against_the_formula():
    E = (F.T @ F - np.eye(3)) / 2
    expected = 1e5 / 2 * np.trace(E) ** 2 + 4e4 * np.tensordot(E, E)
    found = energy_density("saint-venant-kirchhoff", sp.Matrix(F), lmbda=1e5, mu=4e4)
    assert float(found) == pytest.approx(expected, rel=1e-12)
    # I2/J² is the trace of the inverse of C.
    expected = 5e4 / 2 * (np.trace(np.linalg.inv(F.T @ F)) + 2 * np.linalg.det(F) - 5)
    assert float(energy_density("blatz-ko", sp.Matrix(F), mu=5e4)) == pytest.approx(expected, rel=1e-12)


def test_limits_of_the_fung_and_gent_energies_are_neo_hookean():
    expected = energy_density("neo-hookean", sp.Matrix(F), C1=1e4, D1=2e5)
    assert float(energy_density("demiray", sp.Matrix(F), a=2e4, b=1e-8, D1=2e5)) == pytest.approx(
        float(expected), rel=1e-6
    )
    assert float(energy_density("gent", sp.Matrix(F), mu=2e4, Jm=1e8, D1=2e5)) == pytest.approx(
        float(expected), rel=1e-6
    )


@pytest.mark.unit
def test_every_constant_has_a_unit_and_a_name_has_one():
    of = {}
    for kind in MATERIALS:
        units = {name: unit_of(get_args(hint)) for name, hint in constants(kind).items()}
        assert set(units) == set(VALUES[kind])
        for name, unit in units.items():
            assert unit in {"Pa", "1"}
            assert of.setdefault(name, unit) == unit, f"{name} has two units"
    ratios = {"Jm", "b", "alpha1", "alpha2", "alpha3", "k2"}
    assert {name for name, unit in of.items() if unit == "1"} == ratios


def test_materials_need_nothing_heavy():
    script = (
        "import sys, forward.materials.material as m; m.small_strain_moduli('gent', {'mu': 1.0, 'Jm': 2.0, 'D1': 3.0});"
        "sys.exit(bool({'sympy', 'numpy', 'ufl', 'dolfinx', 'mpi4py'} & set(sys.modules)))"
    )
    assert run_script(None, script).returncode == 0


@pytest.mark.unit
def test_fibres_bear_tension_only():
    """Simple shear I + γ e1⊗e2 makes I4 of fibres along (± 0.6, 0.8) 1 ± 0.96 γ + 0.64 γ²."""
    values = {"c": 2e4, "k1": 1e4, "k2": 0.8, "D1": 2e5}
    for gamma in (-0.4, 0.0, 0.3):
        sheared = sp.Matrix([[1, gamma, 0], [0, 1, 0], [0, 0, 1]])
        expected = 1e4 * gamma**2
        for slope in (0.96, -0.96):
            longer = max(slope * gamma + 0.64 * gamma**2, 0)
            expected += 1e4 / 1.6 * (math.exp(0.8 * longer**2) - 1)
        found = energy_density("holzapfel-gasser-ogden", sheared, ((0.6, 0.8, 0.0), (-0.6, 0.8, 0.0)), **values)
        assert float(found) == pytest.approx(expected, rel=1e-12, abs=1e-9)


def test_stress_of_fibres():
    """P by the slopes of the energy against differences of the energy, with two skew families."""
    values = VALUES["holzapfel-gasser-ogden"]
    names = sp.symbols("i1 j i4 i6")
    W = MATERIALS["holzapfel-gasser-ogden"](SYMPY, *names[:2], names[2:], **values)
    numbers = sp.Matrix(F)
    deformation = kinematics.deformation(SYMPY, numbers - sp.eye(3), sp.eye(3))
    fibres = [sp.Matrix(fibre) for fibre in SKEW]
    found = {name: kinematics.measure(SYMPY, name, deformation, fibres) for name in ("i1", "j", "i4")}
    at = dict(zip(names, (found["i1"], found["j"], *found["i4"]), strict=True))
    slopes = [W.diff(name).subs(at) for name in names]
    by_name = dict(zip(("i1", "j"), slopes[:2], strict=True))
    P = kinematics.nominal_stress(SYMPY, numbers, deformation, by_name, list(zip(fibres, slopes[2:], strict=True)))
    for i, j in ((0, 0), (0, 1), (2, 1)):
        step = np.zeros((3, 3))
        step[i, j] = 1e-5
        ends = [
            float(energy_density("holzapfel-gasser-ogden", sp.Matrix(F + s), SKEW, **values)) for s in (step, -step)
        ]
        assert float(P[i, j]) == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-8, abs=1e-4)


@pytest.mark.fem
def test_ogden_stress_and_stiffness_where_stretches_are_equal():
    """P = F Σ ∂W/∂λ_k n_k⊗n_k / λ_k in 40 digits, and differences of it, at repeated, close and distinct stretches."""
    values = {"mu1": 6e5, "alpha1": 1.3, "mu2": 1e3, "alpha2": 5.0, "mu3": -1e4, "alpha3": -20.0, "D1": 2e6}
    # One linear tetrahedron with a homogeneous deformation: its state is a deformation gradient.
    mesh = meshes.mesh_body(MPI.COMM_SELF, unloaded_body("ogden").body)[0]
    space = spaces.vector_space(mesh, 1)
    u, along = spaces.function(space), spaces.function(space)
    of = Invariants("ogden", mesh, u, lambda direction: direction)
    P = of.stress(MATERIALS["ogden"](OPS, *of.measures.values(), **values))
    point = np.array([[0.2, 0.2, 0.2]])
    values_at = [
        assembly.PointValues(of.inserted(form), point, space, MPI.COMM_SELF)
        for form in (P, of.derivative_of(P, u, along))
    ]
    places = space.tabulate_dof_coordinates()

    def stress(F):
        values_, vectors = mp.eigsy(F.T * F)
        stretches = [mp.sqrt(value) for value in values_]
        J = mp.det(F)
        slopes = [2 * values["D1"] * (J - 1) * J / l for l in stretches]
        for k in "123":
            mu, alpha = (mp.mpf(values[f"{name}{k}"]) for name in ("mu", "alpha"))
            powers = [(l / mp.cbrt(J)) ** alpha for l in stretches]
            slopes = [s + mu * (p - sum(powers) / 3) / l for s, p, l in zip(slopes, powers, stretches, strict=True)]
        middle = mp.diag([s / l for s, l in zip(slopes, stretches, strict=True)])
        return F * vectors * middle * vectors.T

    rng = np.random.default_rng(0)
    turn, axes = np.linalg.qr(rng.normal(size=(2, 3, 3)))[0]
    D = rng.normal(size=(3, 3))
    lateral = 1.3**-0.5
    for stretch in (
        (1, 1, 1),
        (1 + 1e-9, 1, 1),
        (1.0001, 1, 0.9999),
        (1.3, lateral, lateral),
        (1.2, 1.2, 1.2**-2),
        (1.2, 1.2 + 1e-7, 0.7),
        (0.7, 0.7, 0.7),
        (1.5, 1.0, 0.7),
    ):
        F = turn @ axes @ np.diag(stretch) @ axes.T
        with mp.workdps(40):
            exact, step = mp.matrix(F.tolist()), mp.matrix((1e-12 * D).tolist())
            expected = np.array(stress(exact).tolist(), dtype=float)
            slope = (stress(exact + step) - stress(exact - step)) / mp.mpf(2e-12)
            slopes = np.array(slope.tolist(), dtype=float)
        u.x.array[:] = (places @ (F - np.eye(3)).T).ravel()
        along.x.array[:] = (places @ D.T).ravel()
        found = [values()[0].reshape(3, 3) for values in values_at]
        scale = max(np.abs(expected).max(), 1e5)
        np.testing.assert_allclose(found[0], expected, rtol=0, atol=1e-10 * scale)
        np.testing.assert_allclose(found[1], slopes, rtol=0, atol=1e-9 * np.abs(slopes).max())


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
        W = energy_density("gent", sp.diag(x, 1, 1), **(VALUES["gent"] | {"Jm": 0.6}))
        return float(sp.diff(W, x).subs(x, stretch)) * 0.7 * 0.8

    for stretch in (1.2, 1.8):
        assert model.solve(np.array([stretch - 1])).outputs[0] == pytest.approx(force(stretch), rel=1e-6)
    with pytest.raises(SolveError, match=r"stopped at [78]\d(\.\d+)? % of the load"):
        model.solve(np.array([1.0]))
